"""Closed-form resistance of soft contacts against disturbance wrenches.

For a unit disturbance w the friction-cone-bounded contact forces that resist it best have a closed form at every
contact, so the support function of the grasp wrench space is a sum over contacts (docs/method.md):

    v_ik = w_k,lin + w_k,ang × (x_i − c) / L
    h_k  = Σ_i s_i · max(0, −n_i·v_ik + μ ‖v_ik − (n_i·v_ik) n_i‖)

Gradients are exact, except that the square root of the tangential speed is floored at `_TANGENT_FLOOR`.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

# Floor of the squared tangential speed, relative to the unit disturbance: keeps the square root differentiable.
_TANGENT_FLOOR = 1e-6


def disturbance_directions(count: int, seed: int, dtype: torch.dtype = torch.float64) -> Float[Tensor, "count 6"]:
    """Unit wrenches spread over the sphere in R⁶: the 12 signed axes first, then farthest-of-many random ones."""
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
    arms: Float[Tensor, "batch points 3"],
    normals: Float[Tensor, "batch points 3"],
    activation: Float[Tensor, "batch points"],
    directions: Float[Tensor, "directions 6"],
    friction: float,
) -> Float[Tensor, "batch directions"]:
    """Support h_k of the soft grasp wrench space in each direction; force closure is h_k > 0 for all k.

    Args:
        arms: contact points about the centre of mass over the characteristic length, (x − c) / L.
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
