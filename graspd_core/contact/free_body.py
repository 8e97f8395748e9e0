"""One step of a free rigid body under contact forces: the whole simulation of Grasp'D (no gravity, hand kinematic).

Semi-implicit Euler: velocities first, from the forces at the start; positions with the new velocities, which nothing
here asks for. SI units, all in the object's frame; torques and angular velocities about the centre of mass. Gradients
are exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


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
    """The body as tensors. Thin objects keep a least radius of gyration of a tenth of `length` about every axis."""
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
    forces: Float[Tensor, "batch points simulations 3"], arms: Float[Tensor, "batch points 3"]
) -> tuple[Float[Tensor, "batch simulations 3"], Float[Tensor, "batch simulations 3"]]:
    """Sum of forces [N] and of their torques Σ r × f [N·m] for every simulation; `arms` from the centre of mass [m]."""
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
    """Linear [m/s] and angular [rad/s] velocity after `time_step` [s] of a force [N] and a torque [N·m]."""
    gyroscopic = torch.linalg.cross(angular, angular @ body.inertia)
    return (
        linear + (time_step / body.mass) * force,
        angular + time_step * ((torque - gyroscopic) @ body.inverse_inertia),
    )


def speed_left(
    body: FreeBody, linear: Float[Tensor, "*batch 3"], angular: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """Squared speed ‖v‖² + ‖L ω‖² of a body [m²/s²]."""
    return (linear * linear).sum(-1) + body.length**2 * (angular * angular).sum(-1)
