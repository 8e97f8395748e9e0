"""Several views to one set of oriented points."""

import numpy as np
import pytest

from graspd_bench.rendering.tabletop import depth_views, ring_poses, tabletop
from graspd_core.errors import CloudError
from graspd_core.mesh.surface_queries import make_distance_query, unsigned_distance
from graspd_core.perception.cloud.camera import PinholeCamera, cloud_from_depth
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.reconstruct.merge_views import Surfels, merge_views, point_step, thin

CAMERA = PinholeCamera(240, 180, 260.0, 260.0, 119.5, 89.5)
SCENE = tabletop("mug", yaw=0.3)
POSES = ring_poses(6, elevation=0.8, distance=0.4)
DEPTHS = [np.where(label == 0, depth, 0.0) for depth, label in depth_views(SCENE, CAMERA, POSES)]
VIEWS = [cloud_from_depth(depth, CAMERA, pose) for depth, pose in zip(DEPTHS, POSES, strict=True)]


def test_merged_points_lie_on_the_surface_and_face_a_camera():
    merged = merge_views(VIEWS)
    assert unsigned_distance(make_distance_query(SCENE.truth), merged.points).mean() < 0.0006
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
    query = make_distance_query(SCENE.truth)
    before = unsigned_distance(query, np.concatenate([view.points for view in noisy])).mean()
    assert unsigned_distance(query, merge_views(noisy).points).mean() < 0.6 * before


def test_flying_pixels_are_dropped():
    rng = np.random.default_rng(0)
    view = VIEWS[0]
    ray = view.points - view.viewpoint
    few = rng.choice(len(ray), 60, replace=False)
    flying = view.viewpoint + ray[few] * rng.uniform(0.7, 0.93, (60, 1))
    merged = merge_views([PointCloud(np.vstack([view.points, flying]), view.viewpoint)], point_step([view]))
    assert unsigned_distance(make_distance_query(SCENE.truth), merged.points).max() < 0.008


def test_thinning_is_even_and_keeps_both_sides():
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(0, 0.05, (4000, 2)), np.zeros(4000)])
    up = np.tile([0.0, 0.0, 1.0], (4000, 1))
    both = thin(Surfels(np.vstack([flat, flat]), np.vstack([up, -up])), 0.005)
    assert len(both.points) == 200
    assert (both.normals[:, 2] > 0).sum() == 100
    assert len(thin(Surfels(np.zeros((0, 3)), np.zeros((0, 3))), 0.005).points) == 0


def test_points_that_are_no_surface_are_named():
    noise = np.random.default_rng(0).normal(0, 0.05, (60, 3))
    with pytest.raises(CloudError, match=r"of its 60 points lie on a surface; at least 50 .* too sparse"):
        merge_views([PointCloud(noise, np.array([0.0, 0.0, 1.0]))])
