"""Compute signed distances of points to the collision primitives of links [m], negative inside.

Distances to boxes, spheres, capsules and cylinders are exact. Their gradients are exact where they exist. On a centre
or an axis the gradient is zero (see `se3.safe_norm`). There are two approximations. Inside a union, the result is the
greatest depth in a single primitive, which may be too small. For a hull, the result is the greatest distance to its
face planes. It is exact inside the hull, and may be too small outside near edges and corners.

`CollisionTensors` holds the primitives of a hand, to compute the distance of object points to every link. Each hull is
replaced by a box with round edges that fills the hull as well as possible. The distance does not see object points
between this box and the hull's surface. There, only contact candidates detect the object, and may miss a thin wall.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from graspd_core.hands.model import HandModel, Primitive
from graspd_core.mesh.topology import scaled_normals
from graspd_core.runtime import disk_cache as cache
from graspd_core.se3 import SE3, safe_norm

# Points and their distances [m].
_Places, _Distances = Float[Tensor, "*batch 3"], Float[Tensor, "*batch"]
# Planes and bounds of this many primitives are cached. No hand may have more primitives.
_MOST = 2048
# Number of linear programs that fit a box into a hull.
_FILLS = 4


def primitive_sdf(primitive: Primitive, points: _Places) -> _Distances:
    """Return the signed distance [m] of points to one primitive. Points are in the link frame."""
    rotation, translation = (torch.as_tensor(a).to(points) for a in (primitive.rotation, primitive.translation))
    local = (points - translation) @ rotation
    if primitive.kind == "hull":
        normals, offsets = (torch.as_tensor(a).to(points) for a in hull_planes(primitive))
        return (local @ normals.T - offsets).amax(-1)
    core, radius = core_of(primitive)
    return _distance(local, local.new_tensor(core), radius, torch.tensor(primitive.kind == "cylinder"))


def core_of(primitive: Primitive) -> tuple[tuple[float, ...], float]:
    """Return the core and the radius of a primitive [m], as in `CollisionTensors`. For a hull, return zeros."""
    size = primitive.size
    if primitive.kind == "hull":
        return (0.0, 0.0, 0.0), 0.0
    if primitive.kind == "box":
        return size, 0.0
    if primitive.kind == "cylinder":
        return (size[0], *size), 0.0
    return (0.0, 0.0, *size[1:], 0.0)[:3], size[0]


def depth_inside(hand: HandModel, link: int, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points"]:
    """Return the depth [m] of link-frame points inside the union of a link's primitives. 0 outside."""
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
    """Return True for each link-frame point within `margin` [m] of the bounding box of the primitives."""
    if not primitives:
        return np.zeros(len(points), dtype=bool)
    low, high = _bounds_of_all(tuple(primitives))
    return np.all((points >= low - margin) & (points <= high + margin), axis=1)


@lru_cache(maxsize=_MOST)
def _bounds_of_all(primitives: tuple[Primitive, ...]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    low, high = zip(*(bounds(primitive) for primitive in primitives), strict=True)
    return np.min(low, axis=0), np.max(high, axis=0)


@lru_cache(maxsize=_MOST)
def bounds(primitive: Primitive) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return the least and the greatest coordinates of a primitive in the link frame [m]."""
    if primitive.kind == "hull":
        corners = primitive.vertices @ primitive.rotation.T + primitive.translation
        return corners.min(0), corners.max(0)
    core, radius = core_of(primitive)
    reach = np.abs(primitive.rotation) @ (np.array(core) + radius)
    return primitive.translation - reach, primitive.translation + reach


@lru_cache(maxsize=_MOST)
def hull_planes(primitive: Primitive) -> tuple[Float[np.ndarray, "planes 3"], Float[np.ndarray, "planes"]]:
    """Return the distinct face planes `n·x = d` of a hull in its own frame: outward unit normals and offsets [m]."""
    cross = scaled_normals(primitive.vertices, primitive.faces)
    area = np.linalg.norm(cross, axis=1)
    keep = area > 1e-14
    normals = cross[keep] / area[keep, None]
    planes = np.column_stack([normals, (normals * primitive.vertices[primitive.faces[keep, 0]]).sum(1)])
    # Coplanar triangles give one plane. Planes are compared after rounding to 1e-9, far below a mesh file's resolution.
    planes = planes[np.unique(np.round(planes, 9), axis=0, return_index=True)[1]]
    return planes[:, :3], planes[:, 3]


def box_inside(hull: Primitive) -> Float[np.ndarray, "16"]:
    """Return a large box with round edges inside a hull, in the link frame.

    The box is along the principal axes of the corners. Linear programs first find the largest sphere (radius only).
    Then they increase the product of the three widths. The result holds the rotation (9) and translation (3) of
    `T_link_box`, the half extents of the core (3), and the radius (1) [m].
    """
    from scipy.optimize import linprog

    normals, offsets = hull_planes(hull)
    axes = np.linalg.svd(hull.vertices - hull.vertices.mean(0))[2].T
    axes = axes * [1.0, 1.0, np.linalg.det(axes)]
    # For a box with centre c, core e and radius r, the farthest point along a normal n is n·c + |n·axes|·e + r.
    farthest = np.hstack([normals, np.abs(normals @ axes), np.ones((len(normals), 1))])
    slope, best = np.eye(7)[6], np.zeros(7)
    for _ in range(_FILLS):
        found = linprog(-slope, A_ub=farthest, b_ub=offsets, bounds=[(None, None)] * 3 + [(0, None)] * 4).x
        mixed = best + np.linspace(0.0, 1.0, 33)[:, None] * (found - best) if best.any() else found[None]
        best = mixed[(mixed[:, 3:6] + mixed[:, 6:]).prod(1).argmax()]
        gain = 1.0 / (best[3:6] + best[6])
        slope = np.array([0.0, 0.0, 0.0, *gain, gain.sum()])
    return np.array([*(hull.rotation @ axes).flat, *(hull.rotation @ best[:3] + hull.translation), *best[3:]])


def _boxes_inside(hulls: Sequence[Primitive]) -> Float[np.ndarray, "hulls 16"]:
    """Return `box_inside` of each hull, cached on disk. A hull takes milliseconds, and a hand may have hundreds."""
    shape = (len(hulls), 16)
    build = lambda: {"boxes": np.reshape([box_inside(hull) for hull in hulls], shape)}  # noqa: E731
    valid = lambda found: [array.shape for array in found.values()] == [shape]  # noqa: E731
    return cache.remember(f"boxes-{cache.digest(hulls)}", build, valid)["boxes"]


# Number of distances computed at once on a CPU and on an accelerator. Each distance needs a few hundred bytes.
_AT_ONCE, _AT_ONCE_ELSEWHERE = 2**21, 2**25


@dataclass(frozen=True, eq=False)
class CollisionTensors:
    """Primitives in one common form: a core, which is a box or a cylinder, grown by `radius` on all sides.

    Attributes:
        rotation, translation: `T_link_primitive` [m].
        core: half extents of a box, or (radius, radius, half length) of a cylinder [m]. A capsule has the core
            (0, 0, half length), a sphere (0, 0, 0).
        radius: radius of spheres and capsules, zero for others [m].
        is_round: one for cylinders, whose x and y are one radial coordinate. Zero for others.
        link: link of each primitive.
    """

    rotation: Float[Tensor, "solids 3 3"]
    translation: Float[Tensor, "solids 3"]
    core: Float[Tensor, "solids 3"]
    radius: Float[Tensor, "solids"]
    is_round: Float[Tensor, "solids"]
    link: Int[Tensor, "solids"]


@lru_cache(maxsize=8)
def make_collision_tensors(hand: HandModel, device: torch.device | str, dtype: torch.dtype) -> CollisionTensors:
    """Return the hand's primitives as tensors, each hull as a box inside it. The most recent results are cached."""
    solids = hand.primitives
    n, hull = len(solids), [p.kind == "hull" for p in solids]
    rows = np.reshape([[*p.rotation.flat, *p.translation, *core_of(p)[0], core_of(p)[1]] for p in solids], (n, 16))
    if any(hull):
        rows[hull] = _boxes_inside([p for p in solids if p.kind == "hull"])
    values = torch.as_tensor(rows, device=device, dtype=dtype)
    return CollisionTensors(
        rotation=values[:, :9].reshape(n, 3, 3),
        translation=values[:, 9:12].contiguous(),
        core=values[:, 12:15].contiguous(),
        radius=values[:, 15].contiguous(),
        is_round=torch.as_tensor([p.kind == "cylinder" for p in solids], device=device, dtype=dtype),
        link=torch.as_tensor([p.link for p in solids], device=device, dtype=torch.long),
    )


def solid_distance(
    solids: CollisionTensors, links: SE3, points: Float[Tensor, "batch points 3"]
) -> Float[Tensor, "batch points solids"]:
    """Return the signed distance [m] of base-frame points to every primitive. `links` are the poses of `forward`."""
    return _in_parts(solids, links, points, lambda local: _distance(local, solids.core, solids.radius, solids.is_round))


def solid_bound(
    solids: CollisionTensors, links: SE3, points: Float[Tensor, "batch points 3"]
) -> Float[Tensor, "batch points solids"]:
    """Return a lower bound of `solid_distance` [m]: the greatest signed distance to a plane of the solid's box."""
    box = solids.core + solids.radius[:, None]
    return _in_parts(solids, links, points, lambda local: (local.abs() - box).amax(-1))


def _in_parts(
    solids: CollisionTensors, links: SE3, points: Tensor, measure: Callable[[Tensor], Tensor]
) -> Float[Tensor, "batch points solids"]:
    """Apply `measure` to the points in the frame of every primitive. Large batches are split to save memory."""
    at_once = _AT_ONCE if points.device.type == "cpu" else _AT_ONCE_ELSEWHERE
    most = max(1, at_once // max(1, len(solids.link) * points.shape[1]))
    if len(points) <= most:
        return measure(_to_solids(solids, links, points))
    parts = [slice(i, i + most) for i in range(0, len(points), most)]
    return torch.cat([measure(_to_solids(solids, links[part], points[part])) for part in parts])


def _to_solids(
    solids: CollisionTensors, links: SE3, points: Float[Tensor, "batch points 3"]
) -> Float[Tensor, "batch points solids 3"]:
    placed = links[:, solids.link].compose(SE3(solids.rotation, solids.translation))
    columns = placed.rotation.permute(0, 2, 1, 3).flatten(2)
    origin = (placed.translation[:, :, None, :] @ placed.rotation).squeeze(-2)
    return (points @ columns).unflatten(-1, (-1, 3)) - origin[:, None]


def pair_distance(
    solids: CollisionTensors, links: SE3, points: Float[Tensor, "batch pairs 3"], which: Int[Tensor, "batch pairs"]
) -> Float[Tensor, "batch pairs"]:
    """Return the signed distance [m] of each base-frame point to its primitive, whose index is in `which`."""
    rows = torch.arange(len(points), device=points.device)[:, None]
    in_link = links[rows, solids.link[which]].apply_inverse(points[..., None, :])
    local = SE3(solids.rotation, solids.translation)[which].apply_inverse(in_link).squeeze(-2)
    return _distance(local, solids.core[which], solids.radius[which], solids.is_round[which])


def _distance(local: _Places, core: Tensor, radius: Tensor | float, is_round: Tensor) -> _Distances:
    reach = local.abs()
    radial = safe_norm(reach[..., :2])
    x = torch.where(is_round > 0, radial, reach[..., 0])
    y = torch.where(is_round > 0, torch.zeros_like(radial), reach[..., 1])
    past = torch.stack([x, y, reach[..., 2]], -1) - core
    # Three orthogonal faces meet in a corner. Outside the corner, the distance is Euclidean.
    return safe_norm(past.clamp_min(0.0)) + past.amax(-1).clamp_max(0.0) - radius
