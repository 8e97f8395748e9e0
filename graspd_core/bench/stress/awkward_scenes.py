"""Scenes that are awkward to see: tables with edges, steps and holes, an arm in view, an image that ends too soon."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graspd_core.pointcloud.depth_image import cloud_from_depth
from graspd_core.pointcloud.point_cloud import PointCloud
from graspd_core.rendering.depth_noise import DEFAULT
from graspd_core.rendering.tabletop import (
    CAMERA,
    TABLE_HALF,
    TabletopScene,
    depth_views,
    ring_poses,
    tabletop,
    views_of,
)
from graspd_core.types import TriangleMesh

SEED = 11
YAW = 0.3
POSES = ring_poses(3, elevation=0.7, azimuth=0.5)

Views = Sequence[PointCloud]


def half_out_of_view(shape: str) -> Views:
    """The image ends in the middle of the object."""
    ((depth, label),) = depth_views(tabletop(shape, yaw=YAW), CAMERA, POSES[:1], DEFAULT, SEED)
    middle = int(np.nonzero(label == 0)[1].mean())
    return [cloud_from_depth(np.where(np.arange(CAMERA.width) < middle, depth, 0.0), CAMERA, POSES[0])]


def black_neighbour(shape: str) -> Views:
    """Beside the object a thing stands that gives no depth, and its place on the table with it."""
    stage = tabletop(shape, yaw=YAW, obstacles=[("cylinder", 0.13, 0.03)])
    ((depth, label),) = depth_views(stage, CAMERA, POSES[:1], DEFAULT, SEED)
    return [cloud_from_depth(np.where(label == 1, 0.0, depth), CAMERA, POSES[0])]


def at_the_edge(shape: str) -> Views:
    """The table ends beside the object, towards the camera."""
    stage = tabletop(shape, yaw=YAW)
    table = stage.table.vertices - np.array([TABLE_HALF - 0.05, 0.0, 0.0])
    return _seen(replace(stage, table=TriangleMesh(table, stage.table.faces)))


def beside_a_step(shape: str) -> Views:
    """Half of the table is 3 cm higher."""
    return _seen(_with(shape, _box((0.3, 0.8, 0.03), (0.23, 0.0, 0.015))))


def with_an_arm(shape: str) -> Views:
    """A forearm of half a metre reaches in over the table."""
    return _seen(_with(shape, _box((0.09, 0.5, 0.09), (-0.05, -0.38, 0.17))))


def thrice(shape: str) -> Views:
    """The same message three times, as three views."""
    (view,) = _seen(tabletop(shape, yaw=YAW))
    return [view, view, view]


def zero_filled(shape: str) -> Views:
    """Two pixels of three have no depth, and the driver sends the camera's own place for them."""
    (view,) = _seen(tabletop(shape, yaw=YAW))
    lost = np.random.default_rng(SEED).random(len(view.points)) < 2 / 3
    return [replace(view, points=np.where(lost[:, None], view.viewpoint, view.points))]


def unequal_pair() -> Views:
    """A box, and a slab of a third of its height against it."""
    stage = tabletop("box", obstacles=[(_box((0.08, 0.05, 0.03), (0.0, 0.0, 0.0)), 0.0702, 0.0)])
    return views_of(stage, CAMERA, ring_poses(1, elevation=0.9, azimuth=-1.57), DEFAULT, SEED)


def _seen(stage: TabletopScene) -> Views:
    return views_of(stage, CAMERA, POSES[:1], DEFAULT, SEED)


def _with(shape: str, other: TriangleMesh) -> TabletopScene:
    return replace(tabletop(shape, yaw=YAW), obstacles=(other,))


def _box(size: tuple[float, float, float], middle: tuple[float, float, float]) -> TriangleMesh:
    import trimesh

    body = trimesh.creation.box(extents=size)
    return TriangleMesh(np.array(body.vertices) + middle, np.array(body.faces, dtype=np.int64))
