"""Desired contact forces: the variables that Grasp'D relaxes physics with (after contact-invariant optimisation).

For every hand point and every simulation there is a force f̂ on the object that the pose does not have to supply.
Whether it stops the object is a constraint, L_task; whether the pose supplies it is a cost, L_phys. Gradients are
exact; `into_cone` is a projection and carries none.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.contact.free_body import FreeBody, euler_step, net_wrench, speed_left
from graspd_core.se3 import EPSILON


def actual(
    forces: Float[Tensor, "batch points simulations 3"],
    arms: Float[Tensor, "batch points 3"],
    length: float,
    components: int,
) -> Float[Tensor, "batch points simulations components"]:
    """Contact forces as what desired ones are compared with: forces (3), or wrenches with torques over `length` (6)."""
    if components == 3:
        return forces
    torques = torch.linalg.cross(arms[:, :, None] / length, forces)
    return torch.cat([forces, torques], -1)


def physics(
    desired: Float[Tensor, "batch points simulations components"],
    supplied: Float[Tensor, "batch points simulations components"],
) -> Float[Tensor, "batch"]:
    """L_phys: squared differences of desired and supplied forces, over all points and simulations [N²]."""
    difference = (desired - supplied).flatten(1)
    return (difference * difference).sum(-1)


def motion_left(
    body: FreeBody,
    forces: Float[Tensor, "batch points simulations components"],
    arms: Float[Tensor, "batch points 3"],
    velocities: Float[Tensor, "simulations 3"],
    time_step: float,
) -> Float[Tensor, "batch simulations"]:
    """Squared speed of the object after one step, over the mean of its squares before (one: nothing was stopped).

    Forces with six components bring their own torques, over the body's length.
    """
    if forces.shape[-1] == 3:
        force, torque = net_wrench(forces, arms)
    else:
        force, torque = forces.sum(1).split(3, -1)
        torque = torque * body.length
    linear, angular = euler_step(body, velocities, torch.zeros_like(velocities), force, torque, time_step)
    return speed_left(body, linear, angular) / (velocities * velocities).sum(-1).mean()


@torch.no_grad()
def into_cone(
    forces: Float[Tensor, "batch points simulations 3"], normals: Float[Tensor, "batch points 3"], friction: float
) -> Float[Tensor, "batch points simulations 3"]:
    """The nearest forces that only push on a surface with outward `normals`, within Coulomb friction."""
    along = -(forces * normals[:, :, None]).sum(-1)
    across = forces + along[..., None] * normals[:, :, None]
    side = across.norm(dim=-1)
    # Inside the cone nothing moves; else the nearest point of its rim, or its apex.
    rim = ((along + friction * side) / (1 + friction**2)).clamp_min(0.0)
    inside = side <= friction * along
    push = torch.where(inside, along, rim)
    share = torch.where(inside, torch.ones_like(side), friction * rim / side.clamp_min(EPSILON))
    return share[..., None] * across - push[..., None] * normals[:, :, None]
