"""What stands around the object, from what was seen of it: hulls that the hand keeps out of.

The back of a neighbour is not seen. Each is taken for the convex hull of its points and of their shadow on the table
(what is seen is carried straight down), so that what lies beneath overhangs counts as full, and what hides behind the
seen face counts only as far as the hull spans it: thin, on purpose, because a guess that bulges would block free space.
A thing that goes round the object, whose hull would hold it, is taken in parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import ConvexHull, KDTree, QhullError

from graspd_core.config import ObstacleConfig
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.sdf import build_sdf, sample_sdf
from graspd_core.mesh.unique_rows import voxel_keys
from graspd_core.scene.scene import Obstacle
from graspd_core.se3 import perpendicular
from graspd_core.types import Plane, TriangleMesh

GRID_RESOLUTION = 32
# Parts across a thing whose hull would hold the object.
MAX_PARTS_ACROSS = 8
_TARGET_SAMPLES = 2000


def make_obstacles(
    points: Sequence[Float[np.ndarray, "_ 3"]],
    support: Plane | None,
    target: TriangleMesh,
    reach: float,
    settings: ObstacleConfig | None = None,
) -> tuple[Obstacle, ...]:
    """Neighbours from their seen points, in the frame of the points [m].

    Args:
        points: those of each thing; things of too few finite points are left out.
        support: what they stand on, if anything; their points are extruded down to it.
        target: the object to grasp.
        reach: things farther than this from the object are left out [m].
        settings: of the hulls.
    """
    settings = settings or ObstacleConfig()
    near = KDTree(np.vstack([target.vertices, surface_samples(target, _TARGET_SAMPLES, 0)[0]]))
    found = []
    for seen in points:
        seen = seen[np.isfinite(seen).all(1)]
        if len(seen) < settings.min_points or near.query(seen)[0].min() > reach:
            continue
        whole = _obstacle(seen, support, settings.padding)
        if not _swallows(whole, target, settings.padding):
            found.append(whole)
            continue
        # A tray, a box or a ring about the object: its hull is no obstacle but the object's own place.
        parts = [part for part in _cells(seen, support, settings.part_size) if near.query(part)[0].min() <= reach]
        found += [_obstacle(part, support, settings.padding) for part in parts]
    return tuple(found)


def _obstacle(points: Float[np.ndarray, "n 3"], support: Plane | None, padding: float) -> Obstacle:
    mesh = padded_hull(points, support, padding)
    return Obstacle(mesh, build_sdf(mesh, resolution=GRID_RESOLUTION, padding=0.02))


def _swallows(neighbour: Obstacle, target: TriangleMesh, padding: float) -> bool:
    """Whether a neighbour's hull holds part of the object, more than where one leans on the other."""
    at = torch.as_tensor(target.vertices).to(neighbour.sdf.field)
    return bool((sample_sdf(neighbour.sdf, at)[0] < -2 * padding).any())


def _cells(points: Float[np.ndarray, "n 3"], support: Plane | None, side: float) -> list[Float[np.ndarray, "_ 3"]]:
    """The points, parted by a grid of cubes, or of columns that stand on the support."""
    if support is None:
        local = points
    else:
        right = perpendicular(support.normal)
        local = points @ np.column_stack([right, np.cross(support.normal, right)])
    side = max(side, float(np.ptp(local, axis=0).max()) / MAX_PARTS_ACROSS)
    _, which = np.unique(voxel_keys(local - local.min(0), side), return_inverse=True)
    return [points[which == part] for part in range(which.max() + 1)]


def padded_hull(points: Float[np.ndarray, "n 3"], support: Plane | None, padding: float) -> TriangleMesh:
    """The closed convex surface about points, their projection onto the support, and a skin of `padding` [m]."""
    corners = points
    if support is not None:
        height = points @ support.normal - support.offset
        corners = np.vstack([points, points - height[:, None] * support.normal])
    # A flat face that stands on nothing has no hull yet: the skin gives it a body.
    with suppress(QhullError):
        corners = corners[ConvexHull(corners).vertices]
    skin = padding * np.vstack([np.eye(3), -np.eye(3)])
    return _closed((corners[:, None] + skin).reshape(-1, 3))


def _closed(points: Float[np.ndarray, "n 3"]) -> TriangleMesh:
    """The convex hull's surface, wound outwards."""
    hull = ConvexHull(points)
    a, b, c = points[hull.simplices].transpose(1, 0, 2)
    inward = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(1) < 0
    faces = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices).astype(np.int64)
    used, compact = np.unique(faces, return_inverse=True)
    return TriangleMesh(points[used], compact.reshape(-1, 3))
