"""Layouts of clouds as plain bytes; the same through messages is in test/ros/test_pointcloud.py."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd_core.errors import CloudError
from graspd_core.perception.cloud.point_cloud import CloudLayout, organised_points, points_from_layout


def layout_of(points: np.ndarray, code: str, step: int, row_padding: int) -> CloudLayout:
    """Coordinates one after the other at the end of each point; what comes before them, and the padding, is junk."""
    height, width, _ = points.shape
    size, row_step = int(code[2]), width * step + row_padding
    data = np.random.default_rng(1).integers(0, 256, height * row_step, dtype=np.uint8)
    first = step - 3 * size
    for axis in range(3):
        np.ndarray((height, width), code, data, first + axis * size, (row_step, step))[...] = points[..., axis]
    number = {4: 7, 8: 8}[size]
    fields = {"rgb": (0, 6), **{name: (first + axis * size, number) for axis, name in enumerate("xyz")}}
    return CloudLayout(width, height, step, row_step, code[0] == ">", fields, memoryview(data.tobytes()))


layouts = st.tuples(st.sampled_from(["<f4", ">f4", "<f8", ">f8"]), st.integers(24, 40), st.integers(0, 9))


@given(layouts, st.integers(1, 4), st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_organised_clouds_keep_their_places(layout, height, width, seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(height, width, 3)).astype("f4").astype(float)
    points[rng.random((height, width)) < 0.3] = rng.choice([np.nan, np.inf, -np.inf])
    made = layout_of(points, *layout)
    np.testing.assert_array_equal(organised_points(made), points)
    finite = np.isfinite(points).all(-1)
    if finite.any():
        np.testing.assert_array_equal(points_from_layout(made), points[finite])
    else:
        with pytest.raises(CloudError, match=f"all {height * width} are NaN or infinite"):
            points_from_layout(made)


def test_one_coordinate_that_is_not_finite_drops_the_point():
    points = np.ones((1, 7, 3))
    for index, value in enumerate((np.nan, np.inf, -np.inf)):
        points[0, index, index] = value
    # Infinities of both signs must not cancel.
    points[0, 3] = np.inf, -np.inf, 0
    # The largest of finite numbers are finite.
    points[0, 4] = np.finfo(np.float64).max
    kept = points_from_layout(layout_of(points, "<f8", 24, 0))
    np.testing.assert_array_equal(kept, points[0, 4:])


@pytest.mark.parametrize(
    ("change", "culprit"),
    [
        ({"width": 0}, "empty: width=0, height=2"),
        ({"height": 0}, "empty: width=3, height=0"),
        ({"fields": {}}, "no field 'x'; it has: none"),
        ({"fields": {"x": (0, 7), "y": (4, 7), "depth": (8, 7)}}, "no field 'z'; it has: x, y, depth"),
        ({"fields": {"x": (0, 5), "y": (4, 7), "z": (8, 7)}}, "field 'x' is INT32; it must be FLOAT32 or FLOAT64"),
        ({"fields": {"x": (0, 99), "y": (4, 7), "z": (8, 7)}}, "field 'x' is 99; it must be FLOAT32 or FLOAT64"),
        ({"point_step": 8, "row_step": 24}, "beyond point_step=8"),
        ({"row_step": 71}, "row_step=71 is smaller than width*point_step=3*24=72"),
        ({"width": 2**32 - 1, "height": 2**32 - 1, "point_step": 0, "row_step": 0}, "beyond point_step=0"),
        ({"height": 3}, "data holds 144 bytes, but height=3"),
    ],
)
def test_contradictions_are_named(change, culprit):
    good = layout_of(np.ones((2, 3, 3)), "<f4", 24, 0)
    with pytest.raises(CloudError) as refused:
        points_from_layout(replace(good, **change))
    assert culprit in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("code", "step"), [("<f4", 12), ("<f4", 32), (">f4", 16), ("<f8", 24)])
def test_a_camera_image_is_converted_without_looking_at_each_point(bytecodes, code, step):
    points = np.random.default_rng(0).normal(size=(480, 640, 3))
    points[::3, ::2] = np.nan
    layout = layout_of(points, code, step, 0)
    assert bytecodes(lambda: points_from_layout(layout)) < 480 * 640 / 10
