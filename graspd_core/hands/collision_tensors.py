"""All collision primitives of a hand at once, as tensors: distance of object points to every link.

Boxes and round solids (cylinders; spheres and capsules count as swept points and segments) are exact; hulls are left
to the contact candidates. Gradients are exact where the distance is smooth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from graspd_core.hands.model import HandModel
from graspd_core.se3 import SE3, safe_norm

# Distances at once; each takes some hundred bytes on the way.
_AT_ONCE = 2**21


@dataclass(frozen=True, eq=False)
class CollisionTensors:
    """Primitives in one common form: a box of half extents `core`, swept by `radius`; cylinders are round boxes.

    Attributes:
        rotation, translation: `T_link_primitive` [m].
        core: half extents of a box, or (radius, radius, half length) of a cylinder; zero-width for swept solids [m].
        radius: sweep radius of spheres and capsules, zero for others [m].
        is_round: one where x and y are one radial coordinate.
        link: link of each primitive.
    """

    rotation: Float[Tensor, "solids 3 3"]
    translation: Float[Tensor, "solids 3"]
    core: Float[Tensor, "solids 3"]
    radius: Float[Tensor, "solids"]
    is_round: Float[Tensor, "solids"]
    link: Int[Tensor, "solids"]


def make_collision_tensors(hand: HandModel, device: torch.device | str, dtype: torch.dtype) -> CollisionTensors:
    """The hand's boxes and round solids as tensors; kept like `make_kinematics`."""
    return _make_collision_tensors(hand, torch.device(device), dtype)


@lru_cache(maxsize=8)
def _make_collision_tensors(hand: HandModel, device: torch.device, dtype: torch.dtype) -> CollisionTensors:
    solids = [p for p in hand.primitives if p.kind != "hull"]
    core, radius, is_round = [], [], []
    for p in solids:
        if p.kind == "box":
            core.append(p.size)
        elif p.kind == "cylinder":
            core.append((p.size[0], p.size[0], p.size[1]))
        else:
            core.append((0.0, 0.0, p.size[1] if p.kind == "capsule" else 0.0))
        radius.append(p.size[0] if p.kind in ("sphere", "capsule") else 0.0)
        is_round.append(float(p.kind == "cylinder"))

    def tensor(values: object, shape: tuple[int, ...]) -> Tensor:
        return torch.as_tensor(np.asarray(values, dtype=float).reshape(shape), device=device, dtype=dtype)

    n = len(solids)
    return CollisionTensors(
        rotation=tensor([p.rotation for p in solids], (n, 3, 3)),
        translation=tensor([p.translation for p in solids], (n, 3)),
        core=tensor(core, (n, 3)),
        radius=tensor(radius, (n,)),
        is_round=tensor(is_round, (n,)),
        link=torch.as_tensor([p.link for p in solids], device=device, dtype=torch.long),
    )


def solid_distance(
    solids: CollisionTensors, links: SE3, points: Float[Tensor, "batch points 3"]
) -> Float[Tensor, "batch points solids"]:
    """Signed distance [m] of base-frame points to every solid, negative inside, for the link poses of `forward`."""

    def whole(links: SE3, points: Tensor) -> Tensor:
        return _distance(_to_solids(solids, links, points), solids.core, solids.radius, solids.is_round)

    return _in_parts(whole, len(solids.link), links, points)


def solid_bound(
    solids: CollisionTensors, links: SE3, points: Float[Tensor, "batch points 3"]
) -> Float[Tensor, "batch points solids"]:
    """A cheap lower bound of `solid_distance` [m]: largest coordinate of the offset from the bounding box."""

    def whole(links: SE3, points: Tensor) -> Tensor:
        return (_to_solids(solids, links, points).abs() - (solids.core + solids.radius[:, None])).amax(-1)

    return _in_parts(whole, len(solids.link), links, points)


def _in_parts(whole: Callable[[SE3, Tensor], Tensor], solids: int, links: SE3, points: Tensor) -> Tensor:
    """`whole` of link poses and points, of so many rows of the batch at once as memory is there for."""
    most = max(1, _AT_ONCE // max(1, solids * points.shape[1]))
    if len(points) <= most:
        return whole(links, points)
    parts = [slice(i, i + most) for i in range(0, len(points), most)]
    return torch.cat([whole(links[part], points[part]) for part in parts])


def _to_solids(
    solids: CollisionTensors, links: SE3, points: Float[Tensor, "batch points 3"]
) -> Float[Tensor, "batch points solids 3"]:
    """Base-frame points in the frame of every solid."""
    placed = links[:, solids.link].compose(SE3(solids.rotation, solids.translation))
    columns = placed.rotation.permute(0, 2, 1, 3).flatten(2)
    origin = (placed.translation[:, :, None, :] @ placed.rotation).squeeze(-2)
    return (points @ columns).unflatten(-1, (-1, 3)) - origin[:, None]


def pair_distance(
    solids: CollisionTensors,
    links: SE3,
    points: Float[Tensor, "batch pairs 3"],
    which: Int[Tensor, "batch pairs"],
) -> Float[Tensor, "batch pairs"]:
    """Signed distance [m] of base-frame points each to one solid."""
    rows = torch.arange(len(points), device=points.device)[:, None]
    in_link = links[rows, solids.link[which]].apply_inverse(points[..., None, :])
    local = SE3(solids.rotation, solids.translation)[which].apply_inverse(in_link).squeeze(-2)
    return local_distance(solids, local, which)


def local_distance(
    solids: CollisionTensors, local: Float[Tensor, "*batch 3"], which: Int[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """Signed distance [m] of points in the frame of a solid to it, each to one."""
    return _distance(local, solids.core[which], solids.radius[which], solids.is_round[which])


def _distance(
    local: Float[Tensor, "*batch 3"], core: Tensor, radius: Tensor, is_round: Tensor
) -> Float[Tensor, "*batch"]:
    reach = local.abs()
    radial = safe_norm(reach[..., :2])
    x = torch.where(is_round > 0, radial, reach[..., 0])
    y = torch.where(is_round > 0, torch.zeros_like(radial), reach[..., 1])
    past = torch.stack([x, y, reach[..., 2]], -1) - core
    return safe_norm(past.clamp_min(0.0)) + past.amax(-1).clamp_max(0.0) - radius
