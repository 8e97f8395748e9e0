"""Poisson's field on a grid: zero on the surface of its points, right on both sides, closed over what is missing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd_core.errors import CloudError
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.shapes import make_shape
from graspd_core.mesh.surface_queries import make_surface, surface_distance, winding_inside
from graspd_core.perception.reconstruct.merge_views import Surfels
from graspd_core.perception.reconstruct.poisson import BAND_CELLS, grid_poisson_field, march

CELL = 0.0025


def axes_about(points: np.ndarray) -> list[np.ndarray]:
    return [np.arange(points[:, k].min() - 3.5 * CELL, points[:, k].max() + 4.5 * CELL, CELL) for k in range(3)]


def field_of(surfels: Surfels, axes: list[np.ndarray]) -> np.ndarray:
    return grid_poisson_field(surfels, np.stack(np.meshgrid(*axes, indexing="ij"), -1), CELL)


def samples(shape: str, count: int, seed: int = 0) -> Surfels:
    return Surfels(*surface_samples(make_shape(shape), count, seed))


@pytest.mark.parametrize(("shape", "worst_mm"), [("sphere", 0.3), ("box", 1.6), ("torus", 0.6), ("l_block", 1.6)])
def test_the_surface_goes_through_its_points(shape, worst_mm):
    surfels = samples(shape, 4000)
    axes = axes_about(surfels.points)
    surface = make_surface(march(field_of(surfels, axes), axes))
    apart = 1000 * surface_distance(surface, samples(shape, 2000, seed=1).points)
    # Edges are rounded by about half a cell.
    assert np.quantile(apart, 0.98) < worst_mm
    assert apart.mean() < 0.25


@settings(max_examples=20, deadline=None)
@given(
    st.floats(0.02, 0.05),
    st.tuples(*[st.floats(-0.2, 0.2)] * 3),
    st.integers(0, 2**16),
)
def test_near_a_sphere_the_field_is_the_distance_and_far_from_it_has_its_sign(radius, centre, seed):
    normals = np.random.default_rng(seed).normal(size=(6000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    axes = axes_about(radius * normals + centre)
    field = field_of(Surfels(radius * normals + centre, normals), axes)
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    distance = np.linalg.norm(nodes - centre, axis=-1) - radius
    near, far = np.abs(distance) < CELL, np.abs(distance) > 1.5 * CELL
    assert np.abs(field - distance)[near].max() < 0.4 * CELL
    assert (np.sign(field) == np.sign(distance))[far].all()
    assert np.abs(field).max() <= BAND_CELLS * CELL * (1 + 1e-12)


def test_a_half_that_was_not_seen_is_closed():
    surfels = samples("sphere", 6000)
    seen = surfels.points[:, 2] > -0.3 * np.abs(surfels.points[:, 2]).max()
    axes = axes_about(surfels.points)
    field = field_of(Surfels(surfels.points[seen], surfels.normals[seen]), axes)
    inside = winding_inside(march(field, axes), np.array([[0.0, 0.0, 0.0], surfels.points.min(0) - CELL]))
    assert inside.tolist() == [True, False]


def test_where_the_density_of_points_changes_the_surface_stays():
    surfels = samples("sphere", 24_000)
    top, few = surfels.points[:, 2] > 0, np.arange(24_000) % 10 == 0
    kept = top | few
    axes = axes_about(surfels.points)
    surface = make_surface(march(field_of(Surfels(surfels.points[kept], surfels.normals[kept]), axes), axes))
    assert 1000 * surface_distance(surface, surfels.points).max() < 0.5


def test_normals_of_no_surface_are_refused():
    surfels = samples("sphere", 2000)
    with pytest.raises(CloudError, match="2000 points"):
        field_of(Surfels(surfels.points, np.zeros((2000, 3))), axes_about(surfels.points))


def test_points_of_no_surface_are_refused_though_a_field_could_be_drawn_to_them():
    points = np.random.default_rng(0).normal(0, 0.02, (3000, 3))
    with pytest.raises(CloudError, match=r"no surface fits its 3000 points \(\d\d% do\)"):
        field_of(Surfels(points, points / np.linalg.norm(points, axis=1, keepdims=True)), axes_about(points))
