"""The way of the hand through a grasp, as closely spaced poses: retreat, pregrasp, grasp, lift."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.se3 import SE3, rotation_from_quaternion
from graspd_core.types import Grasp, Posture

# The hand comes straight along its approach from as far as this, and goes up by as much [m].
RETREAT, LIFT = 0.1, 0.1
# Steps from retreat to pregrasp, pregrasp to grasp, grasp to lift: about 2 cm each.
STEPS = (5, 2, 5)
# Rows of the way at the ends of these steps.
STAGE_ROWS = (0, STEPS[0], STEPS[0] + STEPS[1], sum(STEPS))


def hand_ways(grasps: Sequence[Grasp], approach: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]) -> SE3:
    """`T_scene_hand` along the way of each grasp: a batch of grasps by waypoints.

    Args:
        grasps: some; positions between pregrasp and grasp are on a line, turns between them the shortest.
        approach: unit direction in which the hand moves towards an object, hand frame.
        up: unit direction of the lift, scene frame.
    """
    before, there = (_stacked([getattr(grasp, stage) for grasp in grasps]) for stage in ("pregrasp", "grasp"))
    back = -RETREAT * (rotation_from_quaternion(before[1]) @ torch.as_tensor(approach)[:, None]).squeeze(-1)
    # Both signs of a quaternion are one rotation: the nearer is turned to.
    sign = torch.where((before[1] * there[1]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    raised = there[0] + LIFT * torch.as_tensor(up)
    corners = torch.stack([before[0] + back, before[0], there[0], raised], 1)
    turns = torch.stack([before[1], before[1], sign * there[1], sign * there[1]], 1)
    shares = torch.as_tensor(_SHARES)
    return SE3(rotation_from_quaternion(shares @ turns), shares @ corners)


def _stacked(postures: Sequence[Posture]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"]]:
    position, quaternion = (
        torch.as_tensor(np.stack([getattr(posture, key) for posture in postures]), dtype=torch.float64)
        for key in ("position", "quaternion_wxyz")
    )
    return position, quaternion


def _shares() -> Float[np.ndarray, "way 4"]:
    """What each of the four stages contributes to each waypoint."""
    along = np.concatenate([[0.0], *(k + np.arange(1, steps + 1) / steps for k, steps in enumerate(STEPS))])
    return np.maximum(1.0 - np.abs(along[:, None] - np.arange(len(STAGE_ROWS))), 0.0)


_SHARES = _shares()
