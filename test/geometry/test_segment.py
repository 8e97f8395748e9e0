"""Segmentation: the right object out of scenes whose truth is known, and named failures out of the others."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd_core.config import SegmentConfig
from graspd_core.errors import CloudError, NoObjectError
from graspd_core.geometry.camera import PinholeCamera
from graspd_core.geometry.choice import Target
from graspd_core.geometry.cloud import PointCloud
from graspd_core.geometry.depth import cloud_from_depth
from graspd_core.geometry.embree import make_surface, surface_distance
from graspd_core.geometry.mesh import surface_samples
from graspd_core.geometry.noise import LEVELS, NONE, DepthNoise, add_noise
from graspd_core.geometry.raycast import look_at, render_scene
from graspd_core.geometry.segment import Segmentation, segment
from graspd_core.geometry.shapes import SHAPES, make_shape
from graspd_core.geometry.tabletop import TabletopScene, depth_views, ring_poses, tabletop, views_of
from graspd_core.se3 import rotation_matrix
from graspd_core.types import TriangleMesh

# As a D415 with half its pixels each way.
CAMERA = PinholeCamera(320, 240, 308.0, 308.0, 159.5, 119.5)
THREE = tabletop("box", neighbours=[("cylinder", 0.13, 0.03), ("mug", -0.14, 0.02)])


def test_the_object_is_cut_out_of_a_table_scene():
    """Points within 6 mm of the truth: four standard deviations of the default noise at this distance."""


def block(low: tuple[float, float, float], high: tuple[float, float, float]) -> TriangleMesh:
    import trimesh

    box = trimesh.creation.box(bounds=[low, high])
    return TriangleMesh(np.array(box.vertices), np.array(box.faces))


def seen(meshes, pose, noise: DepthNoise = NONE) -> tuple[PointCloud, np.ndarray]:
    """A view of meshes in the world frame, and which of them each of its points shows."""
    depth, label = render_scene(meshes, CAMERA, pose)
    noisy = add_noise(depth, CAMERA, noise, 0)
    return cloud_from_depth(noisy, CAMERA, pose), label[noisy > 0]


def share_near(points: np.ndarray, mesh: TriangleMesh, limit: float) -> float:
    return float((surface_distance(make_surface(mesh), points) < limit).mean())


def share_found(found: Segmentation, view: PointCloud, wanted: np.ndarray) -> float:
    got = {tuple(point) for part in found.views for point in part.points}
    return float(np.mean([tuple(point) in got for point in view.points[wanted]]))
