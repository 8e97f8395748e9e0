"""Closest points against closed forms, and questions that have no answer."""

from __future__ import annotations

import numpy as np
import pytest

from graspd_core.mesh.shapes import BOX_HALF, make_shape
from graspd_core.mesh.surface_queries import closest_points, make_surface, surface_distance
from graspd_core.types import TriangleMesh


@pytest.mark.parametrize("shift", [0.0, 100.0])
def test_a_boxs_distance_is_exact_far_from_the_origin_too(shift):
    box, half = make_shape("box"), np.array(BOX_HALF)
    points = np.random.default_rng(0).uniform(-3, 3, (1000, 3)) * half
    points = points[(np.abs(points) > half).any(1)]
    surface = make_surface(TriangleMesh(box.vertices + shift, box.faces))
    closest, normals = closest_points(surface, points + shift)
    exact = np.clip(points, -half, half)
    # Ten roundings of a float64 of the coordinates' size.
    assert np.abs(closest - shift - exact).max() < 1e-15 * (1 + 10 * shift)
    assert np.abs(surface_distance(surface, points + shift) - np.linalg.norm(points - exact, axis=1)).max() < 2e-12
    over_a_face = (np.abs(points) > half).sum(1) == 1
    assert np.abs(normals - np.sign(points - exact))[over_a_face].max() < 1e-12


def test_points_that_are_not_finite_have_no_closest_one():
    surface = make_surface(make_shape("torus"))
    points = np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, 1e200], [0.035, 0, 0.1]])
    closest, normals = closest_points(surface, points)
    assert np.isnan(np.concatenate([closest[:3], normals[:3]])).all()
    assert surface_distance(surface, points)[:3].tolist() == [np.inf] * 3
    assert np.allclose(normals[3], [0, 0, 1], atol=0.1)


def test_no_points_have_no_closest_ones():
    surface = make_surface(make_shape("box"))
    assert surface_distance(surface, np.zeros((0, 3))).shape == (0,)
    assert [part.shape for part in closest_points(surface, np.zeros((0, 3)))] == [(0, 3), (0, 3)]


def test_faces_without_an_area_are_borne():
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    surface = make_surface(TriangleMesh(triangle, np.array([[0, 1, 2], [0, 0, 0], [1, 1, 2]])))
    assert surface_distance(surface, np.array([[0.2, 0.2, 0.5], [2.0, 0, 0]])).tolist() == [0.5, 1.0]
