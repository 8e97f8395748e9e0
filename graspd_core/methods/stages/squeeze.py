"""The squeeze: balanced contact forces, and the joint targets that make them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from graspd_core.config import GraspStagesConfig
from graspd_core.hands.kinematics import forward
from graspd_core.methods.poses import Poses
from graspd_core.methods.problem import Problem
from graspd_core.methods.stages.contact_set import ContactSet

_CONE_EDGES = 8
# Weights of an even spread of the load and of normal forces that sum to one, against balance.
_RIDGE, _SUM = 0.5, 10.0
# Newton's method ends at this squared slope; it takes ten steps at most, but for what is not a number.
_CONVERGED, _NEWTON_STEPS = 1e-22, 60


@dataclass(frozen=True)
class Squeeze:
    """Balanced contact forces and the joint targets that make them.

    Attributes:
        joints: position targets [rad] or [m].
        forces: on the object, one per link [N].
        imbalance: norm of the net wrench over the sum of forces; one where there is no balance to be had.
    """

    joints: Float[Tensor, "batch joints"]
    forces: Float[Tensor, "batch slots 3"]
    imbalance: Float[Tensor, "batch"]


def squeeze(
    problem: Problem, poses: Poses, contact_set: ContactSet, effort: Float[Tensor, "joints"], config: GraspStagesConfig
) -> Squeeze:
    """Forces in the friction cones with zero net wrench (non-negative least squares), as joint offsets JᵀF / kp."""
    unit_forces, imbalance = balanced_forces(
        (contact_set.position - problem.object.center).double().cpu().numpy(),
        contact_set.normal.double().cpu().numpy(),
        contact_set.active.cpu().numpy(),
        problem.object.length,
        problem.friction,
    )
    forces = torch.as_tensor(unit_forces).to(problem.hand.lower)
    torque = joint_torques(problem, poses, contact_set, forces)
    limit = (effort * config.effort_share / torque.abs().clamp_min(1e-9)).amin(-1)
    scale = limit.clamp(max=config.grip_force)[:, None]
    stiffness = torch.where(problem.hand.joint_scale == 1.0, config.stiffness, config.slide_stiffness)
    targets = (poses.joints + scale * torque / stiffness).clamp(problem.hand.lower, problem.hand.upper)
    return Squeeze(targets, scale[..., None] * forces, torch.as_tensor(imbalance).to(problem.hand.lower))


def joint_torques(
    problem: Problem, poses: Poses, contact_set: ContactSet, forces: Float[Tensor, "batch slots 3"]
) -> Float[Tensor, "batch joints"]:
    """τ = JᵀF [N·m], of sliding joints [N]: the gradient of Σ F·x(q) over the hand's points at the contacts."""
    base = poses.base
    x = base.apply_inverse(contact_set.position)
    joints = poses.joints.detach().requires_grad_(True)
    links = forward(problem.hand.kinematics, joints)[:, contact_set.link]
    with torch.no_grad():
        material = links.rotation.transpose(-1, -2) @ (x - links.translation)[..., None]
    moved = (links.rotation @ material).squeeze(-1) + links.translation
    (torque,) = torch.autograd.grad((moved * (forces @ base.rotation)).sum(), joints)
    return torque


def balanced_forces(
    arms: Float[np.ndarray, "batch slots 3"],
    normals: Float[np.ndarray, "batch slots 3"],
    active: Bool[np.ndarray, "batch slots"],
    length: float,
    friction: float,
) -> tuple[Float[np.ndarray, "batch slots 3"], Float[np.ndarray, "batch"]]:
    """Contact forces on the object with normal components summing to one and the least net wrench.

    Args:
        arms: contact points about the centre of mass [m].
        normals: outward unit normals.
        active: which links touch.
        length: scale of torques [m].
        friction: Coulomb coefficient of the cones.

    Returns:
        Forces, and the norm of their net wrench (torque over `length`).
    """
    active = active & (active.sum(-1, keepdims=True) > 1)
    # The active slots of every row first, as many columns as the row with most of them has.
    order = np.argsort(~active, axis=-1, kind="stable")[:, : int(active.sum(-1).max(initial=0))]
    rows = np.arange(len(arms))[:, None]
    touching = active[rows, order]
    edges = _cone_edges(normals[rows, order], friction) * touching[..., None, None]
    torques = np.cross(arms[rows, order][:, :, None], edges) / length
    wrenches = np.concatenate([edges, torques], -1).reshape(len(arms), -1, 6)
    weights = _balancing_weights(wrenches, np.repeat(touching, _CONE_EDGES, -1))
    weights /= weights.sum(-1, keepdims=True).clip(1e-9)
    forces, imbalance = np.zeros_like(arms), np.ones(len(arms))
    forces[rows, order] = (weights.reshape(*order.shape, _CONE_EDGES, 1) * edges).sum(2)
    balanced = touching.any(-1)
    imbalance[balanced] = np.linalg.norm((weights[..., None] * wrenches).sum(1), axis=-1)[balanced]
    return forces, imbalance


def _cone_edges(
    normals: Float[np.ndarray, "batch slots 3"], friction: float
) -> Float[np.ndarray, "batch slots edges 3"]:
    """Forces with a normal component of one along the edges of every contact's friction cone."""
    angles = np.arange(_CONE_EDGES) * 2 * np.pi / _CONE_EDGES
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(-1)])
    first /= np.linalg.norm(first, axis=-1, keepdims=True).clip(1e-12)
    second = np.cross(normals, first)
    tangents = np.cos(angles)[:, None] * first[:, :, None] + np.sin(angles)[:, None] * second[:, :, None]
    return friction * tangents - normals[:, :, None]


def _balancing_weights(
    wrenches: Float[np.ndarray, "batch edges 6"], allowed: Bool[np.ndarray, "batch edges"]
) -> Float[np.ndarray, "batch edges"]:
    """The least ‖W x‖² + 10² (Σ x − 1)² + ridge² ‖x‖² of x ≥ 0, exactly.

    With the six wrenches and the sum as rows of G and t = (0, …, 0, 10) the dual has seven unknowns, the residual
    r = t − G x: it is the least of ‖r‖²/2 + ‖max(Gᵀr, 0)‖² / 2 ridge² − t·r, and x = max(Gᵀr, 0) / ridge². Newton's
    method with halved steps ends after a few, since the second derivative changes only where an edge comes or goes.
    """
    batch, count, _ = wrenches.shape
    g = np.concatenate([wrenches, np.full((batch, count, 1), _SUM)], -1) * allowed[..., None]
    target, gain = np.array([0.0] * 6 + [_SUM]), 1 / _RIDGE**2
    r = np.zeros((batch, 7))
    r[:, 6] = _SUM / (1 + _SUM**2 * gain * allowed.sum(-1))

    def value(r: np.ndarray) -> np.ndarray:
        pressed = (g @ r[..., None])[..., 0].clip(0.0)
        return 0.5 * (r * r).sum(-1) + 0.5 * gain * (pressed * pressed).sum(-1) - r @ target

    for _ in range(_NEWTON_STEPS):
        pressed = (g @ r[..., None])[..., 0].clip(0.0)
        downhill = target - r - gain * (pressed[:, None] @ g)[:, 0]
        if (downhill * downhill).sum(-1).max(initial=0.0) < _CONVERGED:
            break
        chosen = g * (pressed > 0)[..., None]
        way = np.linalg.solve(np.eye(7) + gain * chosen.transpose(0, 2, 1) @ chosen, downhill[..., None])[..., 0]
        now, slope, step = value(r), (downhill * way).sum(-1), np.ones(batch)
        while (worse := (value(r + step[:, None] * way) > now - 1e-4 * step * slope + 1e-14) & (step > 1e-8)).any():
            step[worse] /= 2
        r = r + step[:, None] * way
    return gain * (g @ r[..., None])[..., 0].clip(0.0)
