"""Solve the inverse kinematics of an arm for many poses at once, by damped least squares within the joint limits.

Tip pose and Jacobian come from pytorch-kinematics. The damping is proportional to the squared error (T. Sugihara,
Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method, IEEE T-RO 2011). If a step would move a
joint beyond its limit, the step is computed without this joint. This solver is five times faster than that of
pytorch-kinematics, because it starts near the solution and skips reached poses (docs/arms.md).

The starts are those postures of a table that have the nearest tip poses. The table also bounds how far the tip
and points fixed to it can be from the shoulder. A pose beyond these bounds counts as out of reach. For hands around
objects at 0.3 to 0.95 m, the bounds of graspd's two arms accept 99.3 and 99.7 % of reachable poses. They accept 18 and
4 % of unreachable poses. If no posture is found, `why_unreached` says which joint limit is the reason, if any.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from graspd_core.arms.arm import Arm, arm_links, kinematic_chain, placed
from graspd_core.arms.arm_collision import hits_of_self
from graspd_core.se3 import SE3

if TYPE_CHECKING:
    from pytorch_kinematics.chain import SerialChain


# Arms are hashed by identity.
@lru_cache(maxsize=8)
def tip_chain(arm: Arm, dtype: torch.dtype = torch.float32) -> SerialChain:
    """Build the chain from the base to the tip."""
    from pytorch_kinematics.chain import SerialChain

    tip = arm.chain.link_names[arm.tip]
    return SerialChain(kinematic_chain(arm), tip, dtype=torch.float64).to(dtype=dtype)


# A pose counts as reached if position [m] and rotation [rad] are within these tolerances.
POSITION_TOLERANCE, ROTATION_TOLERANCE = 1e-4, 1e-3
# In the solver's error, one radian counts as much as this length [m].
RADIAN = 0.3
_WEIGHTS = [1.0, 1.0, 1.0, RADIAN, RADIAN, RADIAN]
# The damping is `_DAMPING` times the squared error plus `_LEAST_DAMPING` [m²].
_DAMPING, _LEAST_DAMPING = 0.05, 1e-7
# Greatest change of a joint in one step [rad].
_LONGEST_STEP = 0.6
# Rows and columns of the matrix entries whose differences give the rotation axis. A sine below `_TINY` is rounding.
_ROWS, _COLUMNS, _TINY = [2, 0, 1], [1, 2, 0], 1e-7
_HALF_TURN = (torch.pi, 0.0, 0.0)


def pose_error(target: SE3, tip: SE3) -> Float[Tensor, "batch 6"]:
    """Return translation [m] and rotation vector [rad] from the tip to the target, base frame."""
    return torch.cat([target.translation - tip.translation, rotation_vector(target.rotation, tip.rotation)], -1)


def rotation_vector(
    target: Float[Tensor, "batch 3 3"], current: Float[Tensor, "batch 3 3"]
) -> Float[Tensor, "batch 3"]:
    """Return the rotation vector from `current` to `target`, base frame [rad]. A half turn gets the axis x."""
    turn = target @ current.transpose(-1, -2)
    # `sine` and `cosine` are twice the sine and twice the cosine of the angle.
    axis = turn[:, _ROWS, _COLUMNS] - turn[:, _COLUMNS, _ROWS]
    sine, cosine = axis.norm(dim=-1), turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0
    tiny = sine < _TINY
    vector = axis * (torch.atan2(sine, cosine) / torch.where(tiny, 1.0, sine))[:, None]
    return torch.where(tiny[:, None], torch.where(cosine[:, None] < 0, axis.new_tensor(_HALF_TURN), 0.5 * axis), vector)


@torch.no_grad()
def solve(
    arm: Arm, target: SE3, start: Float[Tensor, "batch joints"], steps: int, *, limited: bool = True
) -> tuple[Float[Tensor, "batch joints"], Bool[Tensor, "batch"]]:
    """Iterate from each start towards its target `T_base_tip`.

    Return the joint values at the last step [rad] or [m], and whether each target is reached within tolerance. A start
    that has reached its target is no longer computed. The solver uses float32, whose rounding is a hundred times below
    the tolerances. This takes two thirds of the time of float64.

    Args:
        steps: greatest number of steps.
        limited: whether joints stay within their limits.
    """
    limits = [torch.as_tensor(limit) for limit in (arm.lower, arm.upper)]
    if not limited:
        limits = [torch.full_like(limit, sign * torch.inf) for limit, sign in zip(limits, (-1, 1), strict=True)]
    low, high = (limit.float() for limit in limits)
    target, now, chain = SE3(target.rotation.float(), target.translation.float()), start.float(), tip_chain(arm)
    q, reached = torch.empty(now.shape), torch.zeros(len(now), dtype=torch.bool)
    rows = torch.arange(len(now))
    for step in range(steps + 1):
        # The rows of the Jacobian are linear, then angular, in the base frame.
        jacobian, tip = chain.jacobian_tensor(now, ret_eef_pose=True)
        wrong = pose_error(target, SE3(tip[:, :3, :3], tip[:, :3, 3]))
        away, turned = wrong[:, :3].norm(dim=-1), wrong[:, 3:].norm(dim=-1)
        there = (away < POSITION_TOLERANCE) & (turned < ROTATION_TOLERANCE)
        if step == steps or there.any():
            q[rows], reached[rows] = now, there
            ahead = torch.nonzero(~there).flatten()
            if step == steps or not len(ahead):
                break
            rows, now, wrong, jacobian = (x[ahead] for x in (rows, now, wrong, jacobian))
            target = target[ahead]
        now = (now + _step(jacobian, wrong, now, low, high)).clamp(low, high)
    # Conversion from float32 may exceed a limit by rounding.
    return q.to(start).clamp(*limits), reached


def _step(
    jacobian: Float[Tensor, "batch 6 joints"],
    wrong: Float[Tensor, "batch 6"],
    q: Float[Tensor, "batch joints"],
    low: Float[Tensor, "joints"],
    high: Float[Tensor, "joints"],
) -> Float[Tensor, "batch joints"]:
    """Return the step `Jᵀ (J Jᵀ + λ I)⁻¹ e` with weighted J and e = `wrong`. Joints at a limit do not pass it."""
    weight = wrong.new_tensor(_WEIGHTS)
    jacobian, wrong = jacobian * weight[:, None], wrong * weight
    downhill = (jacobian * wrong[..., None]).sum(1)
    held = ((q <= low) & (downhill < 0)) | ((q >= high) & (downhill > 0))
    jacobian = torch.where(held[:, None], 0.0, jacobian)
    damping = _DAMPING * (wrong * wrong).sum(-1) + _LEAST_DAMPING
    matrix = jacobian @ jacobian.transpose(1, 2) + damping[:, None, None] * torch.eye(6, dtype=q.dtype)
    solved = torch.linalg.solve_ex(matrix, wrong)[0]
    change = (jacobian * solved[..., None]).sum(1)
    return change / (change.abs().amax(-1, keepdim=True) / _LONGEST_STEP).clamp_min(1.0)


# Number of postures drawn for the start table. Postures with self-collision are then dropped.
_ENTRIES = 4000
# Points fixed to the tip whose distances from the shoulder are bounded, tip frame [m].
_POINTS = [[0, 0, 0], [0, 0, -0.1], [0, 0, -0.2], [0.1, 0, -0.1], [-0.1, 0, -0.1], [0, 0.1, -0.1], [0, -0.1, -0.1]]
# In `tip_features`, a change of 1 in a rotation matrix entry counts as this length [m]. One radian counts as 0.28 m.
_PER_ENTRY = 0.2


@dataclass(frozen=True)
class StartTable:
    """A table of arm postures without self-collision, to find postures whose tip poses are near a given pose.

    Attributes:
        q: joint values of each posture [rad] or [m].
        features: position and scaled rotation matrix of the tip, base frame [m] (`tip_features`).
        shoulder: point of the first joint's axis that is nearest to the second joint, base frame [m].
        away: distances from the shoulder to seven points that are fixed to the tip [m].
        start, end: end points of the arm's capsules, base frame [m].
    """

    q: Float[Tensor, "entries joints"]
    features: Float[Tensor, "entries 12"]
    shoulder: Float[Tensor, "3"]
    away: Float[Tensor, "entries points"]
    start: Float[Tensor, "entries capsules 3"]
    end: Float[Tensor, "entries capsules 3"]


# Arms are hashed by identity.
@lru_cache(maxsize=8)
def start_table(arm: Arm) -> StartTable:
    """Return the start table of an arm. The table is deterministic and cached."""
    q = random_postures(arm, _ENTRIES, torch.Generator().manual_seed(0))
    hits = hits_of_self(arm, arm_links(arm, q))
    q = q[(hits.depth <= 0).all(-1)] if hits.what else q
    links, shoulder = arm_links(arm, q), _shoulder(arm)
    tip, (start, end, _) = links[:, arm.tip], placed(arm.capsules, links)
    return StartTable(q, tip_features(tip), shoulder, _away(tip, shoulder), start, end)


def _shoulder(arm: Arm) -> Float[Tensor, "3"]:
    links = arm_links(arm, torch.as_tensor(arm.seed)[None])[0]
    first, second = arm.moved_link[0], arm.moved_link[min(1, len(arm.moved_link) - 1)]
    axis = links.rotation[first] @ torch.as_tensor(arm.chain.joint_axis[first])
    return links.translation[first] + axis * (axis @ (links.translation[second] - links.translation[first]))


def _away(tip: SE3, shoulder: Float[Tensor, "3"]) -> Float[Tensor, "batch points"]:
    return (tip.apply(torch.tensor(_POINTS, dtype=torch.float64)) - shoulder).norm(dim=-1)


def random_postures(arm: Arm, count: int, generator: torch.Generator) -> Float[Tensor, "count joints"]:
    """Draw uniform joint values within the limits. A revolute joint stays within half a turn of its mid-range."""
    middle = 0.5 * (arm.lower + arm.upper)
    half = np.where(arm.chain.slides, 0.5 * (arm.upper - arm.lower), np.minimum(0.5 * (arm.upper - arm.lower), np.pi))
    drawn = 2.0 * torch.rand(count, len(middle), generator=generator, dtype=torch.float64) - 1.0
    return torch.as_tensor(middle) + torch.as_tensor(half) * drawn


def tip_features(tip: SE3) -> Float[Tensor, "batch 12"]:
    """Return poses as vectors. The Euclidean distance of two vectors combines position and rotation [m]."""
    return torch.cat([tip.translation, _PER_ENTRY * tip.rotation.flatten(-2)], -1).float()


def nearest_postures(
    table: StartTable, tip: SE3, count: int, usable: Bool[Tensor, "entries"] | None = None
) -> Float[Tensor, "batch count joints"]:
    """Return the `count` postures nearest to each pose `tip`, nearest first. Skip unusable ones if any is `usable`."""
    q, features = table.q, table.features
    if usable is not None and usable.any():
        q, features = q[usable], features[usable]
    return q[torch.cdist(tip_features(tip), features).topk(min(count, len(q)), largest=False).indices]


def reach_bounds(table: StartTable, usable: Bool[Tensor, "entries"]) -> Float[Tensor, "2 points"]:
    """Return the least and the greatest distance of each tip point from the shoulder [m]. NaN without usable entry."""
    away = table.away[usable] if usable.any() else table.away.new_full((1, len(_POINTS)), torch.nan)
    return torch.stack([away.amin(0), away.amax(0)])


def within_reach(table: StartTable, bounds: Float[Tensor, "2 points"], tip: SE3) -> Bool[Tensor, "batch"]:
    """Return True for each `T_base_tip` within the bounds of `reach_bounds`. False for all if no posture is usable."""
    away = _away(tip, table.shoulder)
    return ((away >= bounds[0]) & (away <= bounds[1])).all(-1)


# Number of starts per pose in `why_unreached`, and number of solver steps.
_STARTS, _STEPS = 3, 10
_TOO_FAR, _NOWHERE = "farther than the arm reaches", "that no posture of the arm reaches"


def why_unreached(arm: Arm, target: SE3, start: Float[Tensor, "batch joints"]) -> list[str]:
    """Return why each pose `T_base_tip` is not reached. The reason is "" if a posture within the limits reaches it.

    The poses are solved without limits, from `start` and from near postures. Of all solutions, take the solution that
    exceeds the limits least. The reason names the joint that exceeds its limit most in this solution.
    """
    if not len(start):
        return []
    table = start_table(arm)
    starts = torch.cat([start[:, None], nearest_postures(table, target, _STARTS - 1)], 1)
    count = starts.shape[1]
    q, reached = solve(
        arm, target[torch.arange(len(start)).repeat_interleave(count)], starts.flatten(0, 1), _STEPS, limited=False
    )
    beyond = _beyond(arm, q).unflatten(0, (-1, count))
    total = torch.where(reached.unflatten(0, (-1, count)), beyond.sum(-1), torch.inf)
    longest = table.features[:, :3].norm(dim=-1).max()
    reasons: list[str] = []
    for row, which in enumerate(total.argmin(1).tolist()):
        if total[row, which] == 0:
            reasons.append("")
        elif torch.isfinite(total[row, which]):
            reasons.append(f"beyond {arm.joint_names[int(beyond[row, which].argmax())]}'s limit")
        else:
            reasons.append(_TOO_FAR if target.translation[row].norm() > longest else _NOWHERE)
    return reasons


def _beyond(arm: Arm, q: Float[Tensor, "batch joints"]) -> Float[Tensor, "batch joints"]:
    lower, upper = torch.as_tensor(arm.lower), torch.as_tensor(arm.upper)
    turns = ((0.5 * (lower + upper) - q) / (2 * np.pi)).round() * (2 * np.pi)
    q = torch.where(torch.as_tensor(arm.chain.slides), q, q + turns)
    return torch.maximum(q - upper, lower - q).clamp_min(0.0)
