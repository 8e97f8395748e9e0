"""Why a pose is out of reach: the joint whose limit is in the way, or that no posture gets there at all."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.arms.arm import Arm
from graspd_core.arms.inverse_kinematics import solve
from graspd_core.arms.start_table import nearest_postures, start_table
from graspd_core.se3 import SE3

# Starts of each pose, and steps of each.
_STARTS, _STEPS = 3, 10
_TOO_FAR, _NOWHERE = "farther than the arm reaches", "that no posture of the arm reaches"


def why_unreached(arm: Arm, target: SE3, start: Float[Tensor, "batch joints"]) -> list[str]:
    """Why each of the poses `T_base_tip` is not reached; found without limits, from `start` and from near postures.

    Of the postures that would get there the one counts that breaks its limits least, and of its joints the one that
    breaks its own most. Empty where a posture within the limits gets there after all.
    """
    if not len(start):
        return []
    table = start_table(arm)
    starts = torch.cat([start[:, None], nearest_postures(table, target, _STARTS - 1)], 1)
    count = starts.shape[1]
    solved = solve(
        arm, target[torch.arange(len(start)).repeat_interleave(count)], starts.flatten(0, 1), _STEPS, limited=False
    )
    beyond = _beyond(arm, solved.q).unflatten(0, (-1, count))
    total = torch.where(solved.reached.unflatten(0, (-1, count)), beyond.sum(-1), torch.inf)
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
    """How far each joint is beyond its limits [rad] or [m], turned by full turns to where that is least."""
    lower, upper = torch.as_tensor(arm.lower), torch.as_tensor(arm.upper)
    turns = ((0.5 * (lower + upper) - q) / (2 * np.pi)).round() * (2 * np.pi)
    q = torch.where(torch.as_tensor(arm.chain.slides), q, q + turns)
    return torch.maximum(q - upper, lower - q).clamp_min(0.0)
