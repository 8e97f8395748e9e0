"""The way of the hand through a grasp, as closely spaced poses: retreat, pregrasp, grasp, lift."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

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
    positions, quaternions = zip(*(_way(grasp, approach, up) for grasp in grasps), strict=True)
    rotation = rotation_from_quaternion(torch.as_tensor(np.stack(quaternions), dtype=torch.float64))
    return SE3(rotation, torch.as_tensor(np.stack(positions), dtype=torch.float64))


def _way(
    grasp: Grasp, approach: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "way 3"], Float[np.ndarray, "way 4"]]:
    before, there = grasp.pregrasp, grasp.grasp
    back = -RETREAT * _rotation(before) @ approach
    # Both signs of a quaternion are one rotation: the nearer is turned to.
    sign = 1.0 if before.quaternion_wxyz @ there.quaternion_wxyz >= 0 else -1.0
    turned = sign * np.asarray(there.quaternion_wxyz)
    corners = [
        (before.position + back, before.quaternion_wxyz),
        (before.position, before.quaternion_wxyz),
        (there.position, turned),
        (there.position + LIFT * up, turned),
    ]
    positions, quaternions = [corners[0][0]], [corners[0][1]]
    for (p, a), (q, b), steps in zip(corners, corners[1:], STEPS, strict=False):
        for share in np.arange(1, steps + 1) / steps:
            positions.append((1 - share) * p + share * q)
            quaternions.append((1 - share) * a + share * b)
    return np.stack(positions), np.stack(quaternions)


def _rotation(posture: Posture) -> Float[np.ndarray, "3 3"]:
    return rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz, dtype=torch.float64)).numpy()
