"""Compute the loss terms of the closed-form relaxation. Each term is a pure function with values of order one.

For a unit disturbance w, the best resisting force in the friction cone of a contact has a closed form. So the support
function of the grasp wrench space is a sum over contacts (docs/method.md, symbols as in `wrench_support`):

    v_ik = w_k,lin + w_k,ang × (x_i − c) / L
    h_k  = Σ_i s_i · max(0, −n_i·v_ik + μ ‖v_ik − (n_i·v_ik) n_i‖)

Gradients are exact where a term is smooth, except that the squared tangential speed has the floor `_TANGENT_FLOOR`.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.optimize.loop import Distances, Joints, Points, Values

# Floor of the squared tangential speed, relative to the unit disturbance. So the square root is differentiable.
_TANGENT_FLOOR = 1e-6
# Units in which the terms measure lengths [m].
_CENTIMETRE, _MILLIMETRE = 0.01, 0.001
# Added to h_k / μ, so that a start without any contact has a finite loss.
_SUPPORT_FLOOR = 1e-3


def disturbance_directions(count: int, seed: int, dtype: torch.dtype = torch.float64) -> Float[Tensor, "count 6"]:
    """Return unit wrenches spread over the sphere in R⁶: the 12 signed axes, then random wrenches far apart."""
    axes = torch.cat([torch.eye(6, dtype=dtype), -torch.eye(6, dtype=dtype)])
    chosen = axes[:count]
    pool = torch.randn(64 * max(count, 1), 6, generator=torch.Generator().manual_seed(seed), dtype=dtype)
    pool = pool / pool.norm(dim=-1, keepdim=True)
    nearest = (pool @ chosen.T).amax(-1)
    while len(chosen) < count:
        pick = nearest.argmin()
        chosen = torch.cat([chosen, pool[pick : pick + 1]])
        nearest = torch.maximum(nearest, pool @ pool[pick])
    return chosen


def wrench_support(
    arms: Points, normals: Points, activation: Distances, directions: Float[Tensor, "directions 6"], friction: float
) -> Float[Tensor, "batch directions"]:
    """Return the support h_k of the soft grasp wrench space in each direction. Force closure is h_k > 0 for all k.

    Args:
        arms: contact points relative to the centre of mass, divided by the characteristic length: (x − c) / L.
        normals: outward unit normals of the object.
        activation: soft contact weight s_i ≥ 0 of each point.
        directions: unit wrenches (linear, angular).
        friction: Coulomb coefficient μ.
    """
    linear, angular = directions[:, :3], directions[:, 3:]
    # n·v and |v|² are linear in small feature vectors of the contact, so both are matrix products.
    normal_speed = torch.cat([normals, torch.linalg.cross(arms, normals)], -1) @ directions.T
    x, y, z = arms.unbind(-1)
    features = torch.stack([x, y, z, x * x, y * y, z * z, x * y, x * z, y * z], -1)
    a, b, c = angular.unbind(-1)
    # |ω×r|² = |ω|²|r|² − (ω·r)², expanded in the six products of r.
    quadratic = torch.stack(
        [b * b + c * c, a * a + c * c, a * a + b * b, -2 * a * b, -2 * a * c, -2 * b * c], -1
    )  # fmt: skip
    weights = torch.cat([2 * torch.linalg.cross(linear, angular), quadratic], -1)
    squared_speed = (linear * linear).sum(-1) + features @ weights.T
    tangential = (squared_speed - normal_speed * normal_speed).clamp_min(_TANGENT_FLOOR).sqrt()
    resistance = (friction * tangential - normal_speed).clamp_min(0.0)
    return (activation[..., None, :] @ resistance).squeeze(-2)


def soft_contact(distance: Distances, radius: Values, delta: float) -> Distances:
    """Return exp(−|`distance` − `radius`| / `delta`). It is 1 at distance `radius` and decays on both sides."""
    return (-(distance - radius[:, None]).abs() / delta).exp()


def hard_contact(distance: Distances, radius: Values, delta: float) -> Distances:
    """Return 1 within `delta` [m] of distance `radius`, else 0. An ablation study replaces `soft_contact` by it."""
    return ((distance - radius[:, None]).abs() <= delta).to(distance)


def wrench_resistance(support: Float[Tensor, "batch directions"], friction: float, sharpness: float = 4.0) -> Values:
    """Return the soft maximum of −log(h_k / μ + `_SUPPORT_FLOOR`). It is high if a disturbance is hardly resisted."""
    resisted = -(support / friction + _SUPPORT_FLOOR).log()
    count = support.shape[-1]
    return (torch.logsumexp(sharpness * resisted, -1) - torch.log(torch.tensor(float(count)))) / sharpness


def touch(gap: Float[Tensor, "batch groups"], reach: Float[Tensor, "groups"]) -> Values:
    """Return the mean distance [cm] of link groups from the padded surface. Distances saturate beyond `reach` [m].

    Groups with a long reach (fingertips) are attracted from afar. Other groups are attracted only if already near.
    """
    size = gap.abs()
    return (size * reach / (size + reach)).mean(-1) / _CENTIMETRE


def penetration(distance: Distances, radius: Values) -> Values:
    """Return a tenth of the summed squared depths below distance `radius` [mm²], nearly linear far above 10 mm."""
    depth = (radius[:, None] - distance).clamp_min(0.0) / _MILLIMETRE
    return (depth * depth / (1.0 + 0.1 * depth)).sum(-1) / 10.0


def self_collision(
    centers: Float[Tensor, "batch spheres 3"], radii: Float[Tensor, "spheres"], weight: Float[Tensor, "spheres spheres"]
) -> Values:
    """Return a tenth of the sum of squared overlap depths (R² − d²) / 2R of spheres of non-adjacent links [mm²].

    R is the sum of the radii, d the distance of the centres. `weight` is 1 / 2R [1/m], zero for unchecked pairs.
    """
    inner = (radii * radii - (centers * centers).sum(-1))[..., None]
    ones, r = torch.ones_like(inner), radii.expand(len(centers), -1)[..., None]
    # R² − |a − b|² = 2 a·b + 2 rₐr_b + (rₐ² − |a|²) + (r_b² − |b|²) is one matrix product.
    left = torch.cat([2 * centers, 2 * r, inner, ones], -1)
    right = torch.cat([centers, r, ones, inner], -1)
    depth = ((left @ right.transpose(-1, -2)) * (weight / _MILLIMETRE)).relu().flatten(1)
    return (depth * depth).sum(-1) / 10.0


def posture(joints: Joints, lower: Float[Tensor, "joints"], upper: Float[Tensor, "joints"]) -> Values:
    """Return the sum of the joints' squared distances from mid-range. A distance of half the range counts as 1."""
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    return (((joints - middle) / half) ** 2).sum(-1)
