"""Signed distance of points to a link's collision primitives, negative inside.

Distances to boxes, spheres, capsules and cylinders are exact [m]. Their gradients are exact where the distance is
differentiable; on a centre or an axis, where it is not, they are zero (see `se3.safe_norm`), never NaN.
Two approximations: inside a union the depth to the nearest single primitive's surface is a lower bound of the depth
below the union's surface, and a hull's distance is the greatest of its face planes' distances, exact inside and a lower
bound outside near edges and corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from graspd_core.hands.model import HandModel, Primitive
from graspd_core.se3 import safe_norm

# Primitives of which planes and bounds are remembered: those of the most crowded hand.
_MOST = 2048


def primitive_sdf(primitive: Primitive, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Signed distance [m] of points in the link's frame to one primitive."""
    rotation, translation = (torch.as_tensor(a).to(points) for a in (primitive.rotation, primitive.translation))
    local = (points - translation) @ rotation
    size = primitive.size
    if primitive.kind == "box":
        return box_sdf(local, torch.tensor(size, dtype=points.dtype, device=points.device))
    if primitive.kind == "sphere":
        return sphere_sdf(local, size[0])
    if primitive.kind == "capsule":
        return capsule_sdf(local, size[0], size[1])
    if primitive.kind == "cylinder":
        return cylinder_sdf(local, size[0], size[1])
    normals, offsets = (torch.as_tensor(a).to(points) for a in hull_planes(primitive))
    return (local @ normals.T - offsets).amax(-1)


def depth_inside(hand: HandModel, link: int, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points"]:
    """Depth [m] of points in a link's frame inside the union of its primitives, zero outside and for a bare link.

    Primitives are only asked about points within their bounding boxes: a hand of many fine meshes has a hundred
    thousand planes.
    """
    depth = np.zeros(len(points))
    near = np.flatnonzero(within_bounds(hand.primitives_of[link], points))
    for primitive in hand.primitives_of[link]:
        at = near[within_bounds((primitive,), points[near])]
        if len(at):
            depth[at] = np.maximum(depth[at], -primitive_sdf(primitive, torch.as_tensor(points[at])).numpy())
    return depth


def within_bounds(
    primitives: Sequence[Primitive], points: Float[np.ndarray, "points 3"], margin: float = 0.0
) -> Bool[np.ndarray, "points"]:
    """Which points in the link's frame lie within the bounding box of its primitives, or up to `margin` [m] off it."""
    if not primitives:
        return np.zeros(len(points), dtype=bool)
    low, high = _bounds_of_all(tuple(primitives))
    return np.all((points >= low - margin) & (points <= high + margin), axis=1)


@lru_cache(maxsize=_MOST)
def _bounds_of_all(primitives: tuple[Primitive, ...]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Least and greatest coordinates of one or more primitives in their link's frame [m]."""
    low, high = zip(*(bounds(primitive) for primitive in primitives), strict=True)
    return np.min(low, axis=0), np.max(high, axis=0)


@lru_cache(maxsize=_MOST)
def bounds(primitive: Primitive) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Least and greatest coordinates of a primitive in its link's frame [m]; those of a box about it if it is round."""
    if primitive.kind == "hull":
        corners = primitive.vertices @ primitive.rotation.T + primitive.translation
        return corners.min(0), corners.max(0)
    size = primitive.size
    half = {"box": size, "sphere": size * 3, "cylinder": (size[0], *size), "capsule": (size[0], size[0], sum(size))}
    reach = np.abs(primitive.rotation) @ np.array(half[primitive.kind])
    return primitive.translation - reach, primitive.translation + reach


@lru_cache(maxsize=_MOST)
def hull_planes(primitive: Primitive) -> tuple[Float[np.ndarray, "planes 3"], Float[np.ndarray, "planes"]]:
    """Distinct face planes `n·x = d` of a hull in its own frame: outward unit normals and offsets [m]."""
    a, b, c = (primitive.vertices[primitive.faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1)
    keep = area > 1e-14
    normals = cross[keep] / area[keep, None]
    planes = np.column_stack([normals, (normals * a[keep]).sum(1)])
    # Coplanar triangles of one facet make one plane (rounded to 1e-9, far below what a mesh file resolves).
    planes = planes[np.unique(np.round(planes, 9), axis=0, return_index=True)[1]]
    return planes[:, :3], planes[:, 3]


def sphere_sdf(points: Float[Tensor, "*batch 3"], radius: float | Float[Tensor, "*#batch"]) -> Float[Tensor, "*batch"]:
    """Distance [m] to a sphere about the origin."""
    return safe_norm(points) - radius


def capsule_sdf(
    points: Float[Tensor, "*batch 3"],
    radius: float | Float[Tensor, "*#batch"],
    half_length: float | Float[Tensor, "*#batch"],
) -> Float[Tensor, "*batch"]:
    """Distance [m] to a capsule along z: all points within `radius` of the segment |z| ≤ `half_length`."""
    z = points[..., 2]
    beyond = z.sign() * (z.abs() - half_length).clamp_min(0.0)
    return safe_norm(torch.cat([points[..., :2], beyond[..., None]], -1)) - radius


def box_sdf(points: Float[Tensor, "*batch 3"], half_extents: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch"]:
    """Distance [m] to an axis-aligned box about the origin."""
    return _corner_sdf(points.abs() - half_extents)


def cylinder_sdf(
    points: Float[Tensor, "*batch 3"],
    radius: float | Float[Tensor, "*#batch"],
    half_length: float | Float[Tensor, "*#batch"],
) -> Float[Tensor, "*batch"]:
    """Distance [m] to a flat-ended cylinder along z, |z| ≤ `half_length`."""
    return _corner_sdf(torch.stack([safe_norm(points[..., :2]) - radius, points[..., 2].abs() - half_length], -1))


def _corner_sdf(past: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
    """Distance to a corner of `n` orthogonal faces from the signed distances past each face."""
    return safe_norm(past.clamp_min(0.0)) + past.amax(-1).clamp_max(0.0)
