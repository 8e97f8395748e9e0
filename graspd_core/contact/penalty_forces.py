"""The penalty contact of Grasp'D (Turpin et al., ECCV 2022): what hand points that sink in do to the object.

    f_n = k_n min(φ − r, 0) ∇φ        f_t = −min(k_f ‖v_t‖, μ ‖f_n‖) v̂_t

φ is the object's signed distance at the hand's point, r the level set that counts as its surface, v_t the object's
velocity against the hand, less its part along ∇φ. Forces are those on the object [N].

Gradients are exact with two exceptions. `leaky_min` leaks on purpose: out of contact its value is zero and its slope is
not. The tangential speed is floored at `_SLIP_FLOOR`, so that friction is smooth where nothing slides.
"""

from __future__ import annotations

from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor

# Floor of the squared tangential speed [m²/s²]: a micrometre a second is no motion.
_SLIP_FLOOR = 1e-12


class LeakyMin(torch.autograd.Function):
    """min(x, 0) whose slope is one below zero and `leak`, not zero, above: the leaky gradient of Grasp'D."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, leak: float) -> Tensor:
        ctx.save_for_backward(x < 0)
        ctx.leak = leak
        return x.clamp(max=0.0)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (touching,) = ctx.saved_tensors
        return torch.where(touching, gradients[0], ctx.leak * gradients[0]), None


def leaky_min(x: Float[Tensor, "*shape"], leak: float) -> Float[Tensor, "*shape"]:
    """min(x, 0), with slope `leak` where x ≥ 0; zero makes it the plain minimum."""
    return cast(Tensor, LeakyMin.apply(x, leak))


def contact_forces(
    height: Float[Tensor, "batch points"],
    normals: Float[Tensor, "batch points 3"],
    velocities: Float[Tensor, "simulations 3"],
    *,
    stiffness: float,
    friction_stiffness: float,
    friction: float,
    leak: float,
) -> Float[Tensor, "batch points simulations 3"]:
    """Forces on the object at every hand point, once for each velocity of the object [N].

    Args:
        height: of the hand's points above the level set, φ − r [m].
        normals: ∇φ there; zero gives no normal force.
        velocities: of the object against the hand, without rotation [m/s].
        stiffness: k_n [N/m].
        friction_stiffness: k_f [N·s/m].
        friction: Coulomb coefficient μ.
        leak: slope of the depth out of contact.
    """
    push = stiffness * leaky_min(height, leak)
    along = normals @ velocities.T
    slip = ((velocities * velocities).sum(-1) - along * along).clamp_min(_SLIP_FLOOR).sqrt()
    # A force per tangential speed; v_t = v − (n·v) n is put together below, in one go with the normal force.
    drag = (-friction * push[..., None] / slip).clamp(max=friction_stiffness)
    return (push[..., None] + drag * along)[..., None] * normals[:, :, None] - drag[..., None] * velocities
