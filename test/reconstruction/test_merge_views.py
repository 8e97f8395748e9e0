"""Several views to oriented points, and the field on a grid whose zero is the surface through them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd_bench.rendering.tabletop import depth_views, ring_poses, tabletop
from graspd_core import PinholeCamera, PointCloud, cloud_from_depth, make_shape
from graspd_core.config import ReconstructionConfig
from graspd_core.errors import CloudError
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.surface_queries import make_surface, surface_distance, winding_inside
from graspd_core.perception.reconstruct.merge_views import Surfels, merge_views, point_step, thin
from graspd_core.perception.reconstruct.poisson import BAND_CELLS, grid_poisson_field, march

CAMERA = PinholeCamera(240, 180, 260.0, 260.0, 119.5, 89.5)
SCENE = tabletop("mug", yaw=0.3)
POSES = ring_poses(6, elevation=0.8, distance=0.4)
DEPTHS = [np.where(label == 0, depth, 0.0) for depth, label in depth_views(SCENE, CAMERA, POSES)]
SETTINGS = ReconstructionConfig()
VIEWS = [cloud_from_depth(depth, CAMERA, pose) for depth, pose in zip(DEPTHS, POSES, strict=True)]


def test_merged_points_lie_on_the_surface_and_face_a_camera():
    merged = merge_views(VIEWS, point_step(VIEWS), SETTINGS)
    assert surface_distance(make_surface(SCENE.truth), merged.points).mean() < 0.0006
    assert np.linalg.norm(merged.normals, axis=1) == pytest.approx(np.ones(len(merged.points)))
    eyes = np.array([view.viewpoint for view in VIEWS])
    facing = ((eyes[None] - merged.points[:, None]) * merged.normals[:, None]).sum(-1)
    assert (facing.max(1) > 0).all()
    # A wall of 4 mm has two sides: points of either keep their own normal.
    axis = merged.points[:, :2] - SCENE.T_world_object[:2, 3]
    radius, outward = np.linalg.norm(axis, axis=1), (axis * merged.normals[:, :2]).sum(1)
    wall = (np.abs(merged.normals[:, 2]) < 0.3) & (merged.points[:, 2] > 0.05) & (radius < 0.042)
    assert (radius[wall & (outward > 0)] > 0.038).mean() > 0.95
    assert (radius[wall & (outward < 0)] < 0.038).mean() > 0.95


def test_noise_along_the_line_of_sight_is_smoothed():
    rng = np.random.default_rng(0)
    noisy = []
    for view in VIEWS:
        ray = view.points - view.viewpoint
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        noisy.append(PointCloud(view.points + rng.normal(0, 0.0015, (len(ray), 1)) * ray, view.viewpoint))
    surface = make_surface(SCENE.truth)
    before = surface_distance(surface, np.concatenate([view.points for view in noisy])).mean()
    merged = merge_views(noisy, point_step(noisy), SETTINGS)
    assert surface_distance(surface, merged.points).mean() < 0.6 * before


def test_flying_pixels_are_dropped():
    rng = np.random.default_rng(0)
    view = VIEWS[0]
    ray = view.points - view.viewpoint
    few = rng.choice(len(ray), 60, replace=False)
    flying = view.viewpoint + ray[few] * rng.uniform(0.7, 0.93, (60, 1))
    cloud = PointCloud(np.vstack([view.points, flying]), view.viewpoint)
    merged = merge_views([cloud], point_step([view]), SETTINGS)
    assert surface_distance(make_surface(SCENE.truth), merged.points).max() < 0.008


def test_thinning_is_even_and_keeps_both_sides():
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(0, 0.05, (4000, 2)), np.zeros(4000)])
    up = np.tile([0.0, 0.0, 1.0], (4000, 1))
    both = thin(Surfels(np.vstack([flat, flat]), np.vstack([up, -up])), 0.005)
    assert len(both.points) == 200
    assert (both.normals[:, 2] > 0).sum() == 100
    assert len(thin(Surfels(np.zeros((0, 3)), np.zeros((0, 3))), 0.005).points) == 0


def test_points_that_are_no_surface_are_named():
    noise = PointCloud(np.random.default_rng(0).normal(0, 0.05, (60, 3)), np.array([0.0, 0.0, 1.0]))
    with pytest.raises(CloudError, match=r"of its 60 points lie on a surface; at least 50 .* too sparse"):
        merge_views([noise], point_step([noise]), SETTINGS)


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
@given(st.floats(0.02, 0.05), st.tuples(*[st.floats(-0.2, 0.2)] * 3), st.integers(0, 2**16))
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


def test_normals_and_points_of_no_surface_are_refused():
    surfels = samples("sphere", 2000)
    with pytest.raises(CloudError, match="2000 points"):
        field_of(Surfels(surfels.points, np.zeros((2000, 3))), axes_about(surfels.points))
    points = np.random.default_rng(0).normal(0, 0.02, (3000, 3))
    with pytest.raises(CloudError, match=r"only \d\d% of its 3000 points fit one surface"):
        field_of(Surfels(points, points / np.linalg.norm(points, axis=1, keepdims=True)), axes_about(points))
