"""Inverse kinematics of many poses at once: damped least squares within the joint limits.

The damping follows the error's own square (T. Sugihara, Solvability-unconcerned inverse kinematics by the
Levenberg-Marquardt method, IEEE T-RO 2011): strong far away and near singular postures, none at the end, where steps
are Newton's. A joint at its limit that the step would push beyond is held there and the step is found without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from graspd_core.arms.arm import Arm
from graspd_core.arms.tip_chain import tip_and_jacobian, tip_chain
from graspd_core.se3 import SE3

# A pose is reached when it is this near [m], [rad].
POSITION_TOLERANCE, ROTATION_TOLERANCE = 1e-4, 1e-3
# One radian counts as so many metres.
RADIAN = 0.3
_WEIGHTS = [1.0, 1.0, 1.0, RADIAN, RADIAN, RADIAN]
# Damping as a share of the error's square, and what is left of it where the error is none [m²].
_DAMPING, _LEAST_DAMPING = 0.05, 1e-7
# No joint turns farther in one step [rad].
_LONGEST_STEP = 0.6
# Entries of a rotation matrix whose differences are the axis; a sine that rounding could make.
_ROWS, _COLUMNS, _TINY = [2, 0, 1], [1, 2, 0], 1e-7
_HALF_TURN = (torch.pi, 0.0, 0.0)


@dataclass(frozen=True)
class Solutions:
    """Joint values, and how far the tip is from where it should be.

    Attributes:
        q: joint values within the limits, the nearest that were found [rad] or [m].
        reached: whether they bring the tip there.
        error: the length of position error and turning error, one radian as `RADIAN` metres [m].
    """

    q: Float[Tensor, "batch joints"]
    reached: Bool[Tensor, "batch"]
    error: Float[Tensor, "batch"]


def pose_error(target: SE3, tip: SE3) -> Float[Tensor, "batch 6"]:
    """What moves and turns the tip to the target, base frame [m], [rad]."""
    return torch.cat([target.translation - tip.translation, rotation_vector(target.rotation, tip.rotation)], -1)


def rotation_vector(
    target: Float[Tensor, "batch 3 3"], current: Float[Tensor, "batch 3 3"]
) -> Float[Tensor, "batch 3"]:
    """Axis times angle of the turn from one orientation to the other, base frame [rad]; half a turn is about x."""
    turn = target @ current.transpose(-1, -2)
    # Twice the sine and twice the cosine of the angle.
    axis = turn[:, _ROWS, _COLUMNS] - turn[:, _COLUMNS, _ROWS]
    sine, cosine = axis.norm(dim=-1), turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0
    tiny = sine < _TINY
    vector = axis * (torch.atan2(sine, cosine) / torch.where(tiny, 1.0, sine))[:, None]
    return torch.where(tiny[:, None], torch.where(cosine[:, None] < 0, axis.new_tensor(_HALF_TURN), 0.5 * axis), vector)


@torch.no_grad()
def solve(
    arm: Arm, target: SE3, start: Float[Tensor, "batch joints"], steps: int, *, limited: bool = True
) -> Solutions:
    """Follow the error from each start to its target, `T_base_tip`; rows that have arrived wait for the others.

    Computed in float32, which is a hundred times finer than the tolerances and takes two thirds of the time.

    Args:
        steps: at most so many.
        limited: whether joints are kept within their limits.
    """
    limits = [torch.as_tensor(limit).float() for limit in (arm.lower, arm.upper)]
    target, now, chain = SE3(target.rotation.float(), target.translation.float()), start.float(), tip_chain(arm)
    q, error, reached = torch.empty(now.shape), torch.empty(len(now)), torch.zeros(len(now), dtype=torch.bool)
    rows = torch.arange(len(now))
    for step in range(steps + 1):
        tip, jacobian = tip_and_jacobian(chain, now)
        wrong = pose_error(target, tip)
        away, turned = wrong[:, :3].norm(dim=-1), wrong[:, 3:].norm(dim=-1)
        there = (away < POSITION_TOLERANCE) & (turned < ROTATION_TOLERANCE)
        if step == steps or there.any():
            q[rows], error[rows], reached[rows] = now, torch.hypot(away, RADIAN * turned), there
            ahead = torch.nonzero(~there).flatten()
            if step == steps or not len(ahead):
                break
            rows, now, wrong, jacobian = (x[ahead] for x in (rows, now, wrong, jacobian))
            target = target[ahead]
        now = now + _step(jacobian, wrong, now, limits if limited else None)
        now = now.clamp(*limits) if limited else now
    q = q.to(start)
    # Rounding may step over a limit.
    q = q.clamp(*map(torch.as_tensor, (arm.lower, arm.upper))) if limited else q
    return Solutions(q, reached, error.to(start))


def _step(
    jacobian: Float[Tensor, "batch 6 joints"],
    wrong: Float[Tensor, "batch 6"],
    q: Float[Tensor, "batch joints"],
    limits: Sequence[Tensor] | None,
) -> Float[Tensor, "batch joints"]:
    """`Jᵀ (J Jᵀ + λ I)⁻¹ e` with rows of turning weighted, without joints that would leave their limits."""
    weight = wrong.new_tensor(_WEIGHTS)
    jacobian, wrong = jacobian * weight[:, None], wrong * weight
    if limits is not None:
        downhill = (jacobian * wrong[..., None]).sum(1)
        held = ((q <= limits[0]) & (downhill < 0)) | ((q >= limits[1]) & (downhill > 0))
        jacobian = torch.where(held[:, None], 0.0, jacobian)
    damping = _DAMPING * (wrong * wrong).sum(-1) + _LEAST_DAMPING
    matrix = jacobian @ jacobian.transpose(1, 2) + damping[:, None, None] * torch.eye(6, dtype=q.dtype)
    solved = torch.linalg.solve_ex(matrix, wrong)[0]
    change = (jacobian * solved[..., None]).sum(1)
    return change / (change.abs().amax(-1, keepdim=True) / _LONGEST_STEP).clamp_min(1.0)
