"""Loss terms of the closed-form relaxation: pure functions of arrays, one value per start, each of order one.

Weights live in `closed_form_config.LossWeights`. Gradients are exact where a term is smooth.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

# Lengths that make a term one [m].
_CENTIMETRE = 0.01
_MILLIMETRE = 0.001
# Added to h so that a start without any contact has a finite task loss.
_SUPPORT_FLOOR = 1e-3


def soft_contact(
    distance: Float[Tensor, "batch points"], radius: Float[Tensor, "batch"], delta: float
) -> Float[Tensor, "batch points"]:
    """Contact activation s = exp(−|φ − r| / δ): one on the padded surface, never with a zero gradient off it."""
    return (-(distance - radius[:, None]).abs() / delta).exp()


def hard_contact(
    distance: Float[Tensor, "batch points"], radius: Float[Tensor, "batch"], delta: float
) -> Float[Tensor, "batch points"]:
    """The ablation of `soft_contact`: one within δ of the padded surface, zero elsewhere, without any gradient."""
    return ((distance - radius[:, None]).abs() <= delta).to(distance)


def wrench_resistance(
    support: Float[Tensor, "batch directions"], friction: float, sharpness: float = 4.0
) -> Float[Tensor, "batch"]:
    """Soft maximum over disturbances of −log(h_k / μ + h₀): how badly the worst disturbance is resisted."""
    resisted = -(support / friction + _SUPPORT_FLOOR).log()
    count = support.shape[-1]
    return (torch.logsumexp(sharpness * resisted, -1) - torch.log(torch.tensor(float(count)))) / sharpness


def touch(gap: Float[Tensor, "batch groups"], reach: Float[Tensor, "groups"]) -> Float[Tensor, "batch"]:
    """Distance of each group of links from the padded surface, either side, saturating beyond the group's reach [m].

    Groups with a long reach (fingertips) are drawn from afar, the others only finish a contact that is already near.
    """
    size = gap.abs()
    return (size * reach / (size + reach)).mean(-1) / _CENTIMETRE


def penetration(distance: Float[Tensor, "batch points"], radius: Float[Tensor, "batch"]) -> Float[Tensor, "batch"]:
    """Depth below the padded surface: sum of squares in mm², tempered to grow linearly for deep points."""
    depth = (radius[:, None] - distance).clamp_min(0.0) / _MILLIMETRE
    return (depth * depth / (1.0 + 0.1 * depth)).sum(-1) / 10.0


def self_collision(
    centers: Float[Tensor, "batch spheres 3"],
    radii: Float[Tensor, "spheres"],
    weight: Float[Tensor, "spheres spheres"],
) -> Float[Tensor, "batch"]:
    """Overlap of proxy spheres of non-adjacent links [mm²]: depth as (R² − d²) / 2R, exact where spheres just touch.

    `weight` is 1 / 2R [1/m] for each checked pair, R the sum of its radii, once, and zero for every other.
    """
    inner = (radii * radii - (centers * centers).sum(-1))[..., None]
    ones, r = torch.ones_like(inner), radii.expand(len(centers), -1)[..., None]
    # R² − |a − b|² = 2 a·b + 2 rₐr_b + (rₐ² − |a|²) + (r_b² − |b|²), one matrix product.
    left = torch.cat([2 * centers, 2 * r, inner, ones], -1)
    right = torch.cat([centers, r, ones, inner], -1)
    depth = ((left @ right.transpose(-1, -2)) * (weight / _MILLIMETRE)).relu().flatten(1)
    return (depth * depth).sum(-1) / 10.0


def posture(
    joints: Float[Tensor, "batch joints"], lower: Float[Tensor, "joints"], upper: Float[Tensor, "joints"]
) -> Float[Tensor, "batch"]:
    """Squared distance of the joints from mid-range, in half ranges."""
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    return (((joints - middle) / half) ** 2).sum(-1)
