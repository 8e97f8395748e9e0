"""Boxes, balls and what lies near to points: signed distances, and what is no region."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd_core.errors import ConfigError
from graspd_core.planning.regions import Box, NearPoints, Sphere

QUARTER = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))


def test_a_turned_box_has_signed_distances():
    box = Box((0.1, 0.0, 0.0), (0.2, 0.04, 0.06), QUARTER)
    at = np.array([[0.1, 0.0, 0.0], [0.1, 0.1, 0.0], [0.1, 0.13, 0.0], [0.15, 0.14, 0.0], [0.1, 0.0, 0.03]])
    assert np.allclose(box.distance(at), [-0.02, 0.0, 0.03, np.hypot(0.03, 0.04), 0.0])


def test_a_ball_and_what_is_near_have_signed_distances():
    at = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])
    assert np.allclose(Sphere((0.0, 0.0, 0.1), 0.2).distance(at), [-0.1, np.hypot(0.3, 0.1) - 0.2])
    near = NearPoints(np.array([[0.0, 0.0, 0.0], [0.31, 0.0, 0.0], [np.nan, 0.0, 0.0]]), radius=0.02)
    assert np.allclose(near.distance(at), [-0.02, -0.01])


@given(st.lists(st.floats(-0.2, 0.2), min_size=6, max_size=6))
def test_distances_never_change_faster_than_the_point(values: list[float]):
    a, b = np.array(values[:3]), np.array(values[3:])
    for region in (Box((0.01, 0.02, 0.0), (0.1, 0.05, 0.2), (0.5, 0.1, 0.3, 0.7)), Sphere((0, 0, 0), 0.05)):
        change = abs(float(np.diff(region.distance(np.stack([a, b])))[0]))
        assert change <= np.linalg.norm(a - b) + 1e-12


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Box((0, 0), (1, 1, 1)), "box center: .*3 finite numbers"),
        (lambda: Box((0, 0, np.nan), (1, 1, 1)), "box center"),
        (lambda: Box((0, 0, 0), (1, 0, 1)), "box size: .*above 0"),
        (lambda: Box((0, 0, 0), (1, 1, 1), (0, 0, 0, 0)), "quaternion_wxyz: all 0"),
        (lambda: Sphere((0, 0, 0), 0.0), "sphere radius: 0.0 m"),
        (lambda: Sphere((0, 0, 0), float("nan")), "sphere radius"),
        (lambda: NearPoints(np.full((2, 3), np.nan)), "none is finite"),
        (lambda: NearPoints(np.zeros((0, 3))), "none is finite"),
        (lambda: NearPoints(np.zeros((1, 3)), radius=-1.0), "region radius"),
    ],
)
def test_what_is_no_region_is_refused(make, said):
    with pytest.raises(ConfigError, match=said):
        make()
