"""Simulate one step of the object under the penalty contact of Grasp'D (Turpin et al., ECCV 2022).

Hand points that sink in push the object:

    f_n = k_n min(φ − r, 0) ∇φ        f_t = −min(k_f ‖v_t‖, μ ‖f_n‖) v̂_t

φ is the object's signed distance at the hand's point, r the level set that counts as its surface, v_t the object's
velocity against the hand, less its part along ∇φ. Forces are those on the object [N].

The whole simulation is one semi-implicit Euler step of a free rigid body, without gravity. Only velocities are asked
for. All is in SI units and in the object's frame, torques and angular velocities about the centre of mass.

Gradients are exact with two exceptions. `leaky_min` leaks on purpose: out of contact its value is zero and its slope is
not. The tangential speed is floored at `_SLIP_FLOOR`, so that friction is smooth where nothing slides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.optimize.loop import Distances, Points

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
    """Return min(x, 0), with slope `leak` where x ≥ 0."""
    return cast(Tensor, LeakyMin.apply(x, leak))


def contact_forces(
    height: Distances,
    normals: Points,
    velocities: Float[Tensor, "simulations 3"],
    *,
    stiffness: float,
    friction_stiffness: float,
    friction: float,
    leak: float,
) -> Float[Tensor, "batch points simulations 3"]:
    """Compute forces on the object at every hand point, once for each velocity of the object [N].

    Args:
        height: of the hand's points above the level set, φ − r [m].
        normals: ∇φ there. Zero gives no normal force.
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


@dataclass(frozen=True)
class FreeBody:
    """The object as a rigid body.

    Attributes:
        mass: [kg].
        inertia: about the centre of mass [kg·m²].
        inverse_inertia: its inverse.
        center: centre of mass [m].
        length: what angular velocities are multiplied by to be compared with linear ones [m].
    """

    mass: float
    inertia: Float[Tensor, "3 3"]
    inverse_inertia: Float[Tensor, "3 3"]
    center: Float[Tensor, "3"]
    length: float


def make_body(
    mass: float,
    inertia: Float[np.ndarray, "3 3"],
    center: Float[np.ndarray, "3"],
    length: float,
    device: torch.device | str,
    dtype: torch.dtype,
) -> FreeBody:
    """Lay the body out. Thin objects keep a radius of gyration of at least a tenth of `length` about every axis."""
    moments, axes = np.linalg.eigh(inertia)
    moments = np.maximum(moments, mass * (0.1 * length) ** 2)
    options: dict[str, Any] = {"device": device, "dtype": dtype}
    return FreeBody(
        mass=mass,
        inertia=torch.as_tensor(axes @ np.diag(moments) @ axes.T, **options),
        inverse_inertia=torch.as_tensor(axes @ np.diag(1 / moments) @ axes.T, **options),
        center=torch.as_tensor(center, **options),
        length=length,
    )


def net_wrench(
    forces: Float[Tensor, "batch points simulations 3"], arms: Points
) -> tuple[Float[Tensor, "batch simulations 3"], Float[Tensor, "batch simulations 3"]]:
    """Return Σ f [N] and Σ r × f [N·m] for every simulation, with `arms` r from the centre of mass [m]."""
    # Σ rᵢ fⱼ in one matrix product; the torque is what is antisymmetric in it.
    products = (arms.transpose(1, 2) @ forces.flatten(2)).unflatten(2, forces.shape[2:])
    x, y, z = products.unbind(1)
    torque = torch.stack([y[..., 2] - z[..., 1], z[..., 0] - x[..., 2], x[..., 1] - y[..., 0]], -1)
    return forces.sum(1), torque


def euler_step(
    body: FreeBody,
    linear: Float[Tensor, "*#batch 3"],
    angular: Float[Tensor, "*#batch 3"],
    force: Float[Tensor, "*#batch 3"],
    torque: Float[Tensor, "*#batch 3"],
    time_step: float,
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
    """Return linear [m/s] and angular [rad/s] velocity after `time_step` [s] of a force [N] and a torque [N·m]."""
    gyroscopic = torch.linalg.cross(angular, angular @ body.inertia)
    return (
        linear + (time_step / body.mass) * force,
        angular + time_step * ((torque - gyroscopic) @ body.inverse_inertia),
    )


def speed_left(
    body: FreeBody, linear: Float[Tensor, "*batch 3"], angular: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """Return the squared speed ‖v‖² + ‖L ω‖² of a body [m²/s²]."""
    return (linear * linear).sum(-1) + body.length**2 * (angular * angular).sum(-1)
