"""Clouds are refused, cleaned and moved, in messages of any layout. More: test/ros/inputs/test_sensor_frames.py."""

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest
from expected import refused
from hypothesis import given
from hypothesis import strategies as st

from graspd_bench.rendering.render import look_at
from graspd_core.errors import CloudError
from graspd_core.io.messages import pixels_from_message, points_from_message
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.shapes import make_shape
from graspd_core.perception.cloud.camera import PinholeCamera, cloud_from_depth
from graspd_core.perception.cloud.point_cloud import PointCloud, clean_cloud, least_axes, transform_cloud
from graspd_core.perception.reconstruct.reconstruct import reconstruct
from graspd_core.perception.scene_from_views import scene_from_views
from graspd_core.perception.segment.segment import segment

ORIGIN = np.zeros(3)


@pytest.mark.parametrize("entry", [segment, reconstruct])
@pytest.mark.parametrize(
    ("views", "complaint"),
    [
        ([], "no view at all"),
        ([np.zeros((0, 3))], "empty"),
        ([np.full((100, 3), np.nan), np.full((20, 3), np.inf)], "all 120 points are NaN"),
        ([np.eye(3)[[0, 1, 2] * 3]], "only 9 finite points of 9; at least 50"),
        ([np.ones((500, 3))], "in one place"),
    ],
)
def test_hopeless_clouds_are_named(entry, views, complaint):
    with pytest.raises(CloudError, match=complaint):
        entry([PointCloud(points, np.zeros(3)) for points in views])


def test_cleaning_drops_nan_and_strays_and_thins():
    points, _ = surface_samples(make_shape("box"), 20_000, 0)
    strays = np.array([[0.5, 0, 0], [0, -0.4, 0.2], [np.nan, 0, 0]])
    clean = clean_cloud(np.vstack([points, strays]))
    assert np.isfinite(clean).all()
    assert np.abs(clean).max() < 0.05
    assert 1000 < len(clean) < 15_000


@pytest.mark.parametrize("far", [1e7, 1e300])
def test_one_point_far_away_does_not_spoil_the_others(far):
    points, _ = surface_samples(make_shape("box"), 3000, 0)
    clean = clean_cloud(np.vstack([points, [[far, 0, 0]]]))
    assert np.abs(clean).max() < 0.05
    np.testing.assert_array_equal(clean, clean_cloud(points))
    with pytest.raises(CloudError, match="too far apart"):
        clean_cloud(points * 1e300)


@pytest.mark.filterwarnings("error")
def test_in_a_scene_numbers_whose_squares_overflow_count_as_missing():
    points, _ = surface_samples(make_shape("box"), 3000, 0)
    missing, far = (np.vstack([points, [[place, 0, 0]]]) for place in (np.nan, 1e300))
    seen = [scene_from_views([PointCloud(cloud, np.zeros(3))], alone=True) for cloud in (missing, far)]
    np.testing.assert_array_equal(seen[0].object.mesh.vertices, seen[1].object.mesh.vertices)
    with pytest.raises(CloudError, match="NaN or infinite"):
        scene_from_views([PointCloud(np.full((1, 3), 1e300), np.zeros(3))])


def test_a_cloud_moves_with_its_camera():
    pose = look_at((0.3, 0.2, 0.1), (0, 0, 0))
    points = np.array([[0.0, 0, np.linalg.norm((0.3, 0.2, 0.1))], [0.1, 0, 0]])
    moved = transform_cloud(PointCloud(points, ORIGIN, np.array([0.0, 0, 1])), pose)
    # What lay ahead on the optical axis is what the camera looks at.
    assert moved.points == pytest.approx(np.array([[0, 0, 0], (0.3, 0.2, 0.1) + 0.1 * pose[:3, 0]]))
    assert moved.viewpoint == pytest.approx([0.3, 0.2, 0.1])
    assert moved.forward == pytest.approx(-moved.viewpoint / np.linalg.norm(moved.viewpoint))
    assert transform_cloud(PointCloud(points, ORIGIN), pose).forward is None
    assert points[1].tolist() == [0.1, 0, 0]


@pytest.mark.parametrize("scales", [(-1.0, 1.0, 1.0), (1e-3, 1e-3, 1e-3), (1.0, np.nan, 1.0)])
def test_a_cloud_is_neither_mirrored_nor_scaled(scales):
    pose = look_at((0.3, 0.2, 0.1), (0, 0, 0)) * np.array([*scales, 1.0])
    with pytest.raises(CloudError, match="is not a rigid transform; valid: a rotation, a finite position"):
        transform_cloud(PointCloud(np.ones((2, 3)), ORIGIN), pose)
    with pytest.raises(CloudError, match="is not a rigid transform; valid: a rotation, a finite position"):
        cloud_from_depth(np.ones((6, 8)), PinholeCamera(8, 6, 10.0, 10.0, 3.5, 2.5), pose)


@pytest.mark.parametrize("scales", [(1, 1, 1), (1, 1, 1e-3), (1, 1, 0), (1, 1e-4, 1e-4), (1, 0, 0), (0, 0, 0)])
def test_along_the_least_axis_points_spread_as_little_as_along_any(scales):
    rng = np.random.default_rng(0)
    points = 0.01 * rng.normal(size=(500, 24, 3)) * scales @ np.linalg.qr(rng.normal(size=(500, 3, 3)))[0]
    spreads = points.transpose(0, 2, 1) @ points
    axes = least_axes(spreads)
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0)
    values = np.linalg.eigvalsh(spreads)
    along = np.einsum("ni,nij,nj->n", axes, spreads, axes)
    assert (along - values[:, 0] <= 1e-7 * values[:, 2]).all()


def fields_of(places: dict[str, tuple[int, int]]) -> list[SimpleNamespace]:
    """PointFields of these names, offsets and types."""
    return [SimpleNamespace(name=name, offset=offset, datatype=kind) for name, (offset, kind) in places.items()]


def message_of(
    points: np.ndarray, codes: Sequence[str], step: int, row_padding: int, axes: Sequence[int] = (0, 1, 2)
) -> SimpleNamespace:
    """Return a PointCloud2 with the coordinates at the end of each point, in the order of `axes`, else junk."""
    height, width, _ = points.shape
    row_step = width * step + row_padding
    data = np.random.default_rng(1).integers(0, 256, height * row_step, dtype=np.uint8)
    fields, first = {"rgb": (0, 6)}, step - sum(int(code[2]) for code in codes)
    for axis in axes:
        size = int(codes[axis][2])
        np.ndarray((height, width), codes[axis], data, first, (row_step, step))[...] = points[..., axis]
        fields["xyz"[axis]] = (first, {4: 7, 8: 8}[size])
        first += size
    sizes = {"width": width, "height": height, "point_step": step, "row_step": row_step}
    return SimpleNamespace(is_bigendian=codes[0][0] == ">", fields=fields_of(fields), data=data.tobytes(), **sizes)


types = st.sampled_from("<>").flatmap(lambda order: st.tuples(*[st.sampled_from([f"{order}f4", f"{order}f8"])] * 3))
layouts = st.tuples(types, st.integers(24, 40), st.integers(0, 9), st.permutations(range(3)))


@given(layouts, st.integers(1, 4), st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_organised_clouds_keep_their_places(layout, height, width, seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(height, width, 3)).astype("f4").astype(float)
    points[rng.random((height, width)) < 0.3] = rng.choice([np.nan, np.inf, -np.inf])
    made = message_of(points, *layout)
    np.testing.assert_array_equal(pixels_from_message(made), points)
    finite = np.isfinite(points).all(-1)
    if finite.any():
        np.testing.assert_array_equal(points_from_message(made), points[finite])
    else:
        with pytest.raises(CloudError, match=f"all {height * width} are NaN or infinite"):
            points_from_message(made)


def test_one_coordinate_that_is_not_finite_drops_the_point():
    points = np.ones((1, 7, 3))
    for index, value in enumerate((np.nan, np.inf, -np.inf)):
        points[0, index, index] = value
    # Infinities of both signs must not cancel.
    points[0, 3] = np.inf, -np.inf, 0
    # The largest of finite numbers are finite.
    points[0, 4] = np.finfo(np.float64).max
    kept = points_from_message(message_of(points, ["<f8"] * 3, 24, 0))
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
    good = message_of(np.ones((2, 3, 3)), ["<f4"] * 3, 24, 0)
    made = {key: fields_of(value) if key == "fields" else value for key, value in change.items()}
    with refused(CloudError, culprit):
        points_from_message(SimpleNamespace(**{**vars(good), **made}))


@pytest.mark.parametrize(("code", "step"), [("<f4", 12), ("<f4", 32), (">f4", 16), ("<f8", 24)])
def test_a_camera_image_is_converted_without_looking_at_each_point(bytecodes, code, step):
    points = np.random.default_rng(0).normal(size=(480, 640, 3))
    points[::3, ::2] = np.nan
    message = message_of(points, [code] * 3, step, 0)
    assert bytecodes(lambda: points_from_message(message)) < 480 * 640 / 10
