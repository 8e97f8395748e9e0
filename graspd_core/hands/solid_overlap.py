"""Compute the overlap depth of solids of links that are not adjacent, by the separating axis test.

A separating axis of two boxes is a face normal, or the cross product of two edges. For boxes the least overlap along
these fifteen directions is the exact depth. Round solids need three more directions. If an edge meets a rim, the depth
is slightly too large. Hulls are excluded. Gradients are exact if a single direction has the least overlap.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from graspd_core.hands.link_distance import CollisionTensors
from graspd_core.hands.model import HandModel
from graspd_core.se3 import SE3

# Least sine of the angle between two edges that give a direction, and least length of other directions [m].
_PARALLEL, _SHORTEST = 1e-3, 1e-6
# An edge direction is chosen only if its depth is less than that of every face by this [m]. It avoids rounding effects.
_RATHER_FACES = 1e-6


def solid_pairs(hand: HandModel) -> Int[np.ndarray, "pairs 2"]:
    """Return the pairs of solids whose links are not adjacent. Hulls are not counted as solids here."""
    link = np.array([p.link for p in hand.primitives if p.kind != "hull"], dtype=np.int64)
    return np.argwhere(np.triu(~hand.adjacent[np.ix_(link, link)], 1))


def solid_overlaps(
    solids: CollisionTensors, pairs: Int[Tensor, "pairs 2"], links: SE3
) -> tuple[Int[Tensor, "overlaps"], Float[Tensor, "overlaps"]]:
    """Return the batch row and the depth [m] of every overlapping pair. The depth is differentiable."""
    placed = links[:, solids.link].compose(SE3(solids.rotation, solids.translation))
    apart = placed.translation[:, pairs[:, 0]] - placed.translation[:, pairs[:, 1]]
    reach = (solids.core.norm(dim=-1) + solids.radius)[pairs].sum(-1)
    row, pair = ((apart * apart).sum(-1) < reach * reach).nonzero(as_tuple=True)
    sides, apart = pairs[pair].unbind(-1), apart[row, pair]
    axes = [placed.rotation[row, side].transpose(-1, -2) for side in sides]
    edges = torch.linalg.cross(axes[0][:, :, None], axes[1][:, None, :]).flatten(1, 2)
    across = [apart - (apart * of[:, 2]).sum(-1, keepdim=True) * of[:, 2] for of in axes]
    directions = torch.cat([*axes, edges, torch.stack([apart, *across], 1)], 1)
    swept = [(solids.is_round[side] > 0) | (solids.core[side, 0] == 0) for side in sides]
    length = (directions * directions).sum(-1).clamp_min(1e-24).sqrt()
    usable = length > torch.cat([length.new_full((15,), _PARALLEL), length.new_full((3,), _SHORTEST)])
    usable[:, 15:] &= (swept[0] | swept[1])[:, None]
    directions = directions / length[..., None]
    widths = sum(_width(solids, side, directions @ of.transpose(-1, -2)) for side, of in zip(sides, axes, strict=True))
    depth = torch.where(usable, widths - (directions * apart[:, None]).sum(-1).abs(), torch.inf)
    rated = depth.detach() + _RATHER_FACES * (torch.arange(18, device=depth.device) >= 6)
    least = depth.gather(1, rated.argmin(-1, keepdim=True))[:, 0]
    return row[least > 0], least[least > 0]


def _width(
    solids: CollisionTensors, which: Int[Tensor, "n"], local: Float[Tensor, "n directions 3"]
) -> Float[Tensor, "n directions"]:
    """Return half the extent of each solid [m] along directions given in the solid's frame."""
    core, round_one = solids.core[which][:, None], solids.is_round[which][:, None] > 0
    x, y, z = local.abs().unbind(-1)
    radial = (x * x + y * y).clamp_min(1e-24).sqrt()
    flat = torch.where(round_one, core[..., 0] * radial, core[..., 0] * x + core[..., 1] * y)
    return flat + core[..., 2] * z + solids.radius[which][:, None]
