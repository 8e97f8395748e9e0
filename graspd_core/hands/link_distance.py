"""Signed distance of points to a link's collision primitives, negative inside.

Distances to boxes, spheres, capsules and cylinders are exact. Two approximations: inside a union the depth to the
nearest single primitive's surface is a lower bound of the depth below the union's surface, and a hull's distance is the
greatest of its face planes' distances, exact inside and a lower bound outside near edges and corners.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.hands.model import HandModel, Primitive
from graspd_core.hands.primitive_sdf import box_sdf, capsule_sdf, cylinder_sdf, sphere_sdf


def hand_sdf(hand: HandModel, link: int, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Signed distance [m] of points in a link's frame to the union of its primitives, +inf for a bare link."""
    distance = torch.full(points.shape[:-1], torch.inf, dtype=points.dtype, device=points.device)
    for primitive in hand.primitives_of[link]:
        distance = torch.minimum(distance, primitive_sdf(primitive, points))
    return distance


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
