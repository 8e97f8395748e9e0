"""Where the hand is on its way: from the retreat over the pregrasp and the grasp to the squeeze."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.hands.kinematics import forward, link_poses, make_kinematics
from graspd_core.hands.model import HandModel
from graspd_core.se3 import SE3, quaternion_from_rotation, rotation_from_quaternion
from graspd_core.trials.lift_trial import retreat_posture
from graspd_core.types import Grasp, Posture, Snapshot

STAGES = ("retreat", "pregrasp", "grasp", "squeeze")


def posture_at(hand: HandModel, grasp: Grasp, at: float) -> Posture:
    """The posture at `at`, 0 for the retreat to 3 for the squeeze; between two stages on the straight way."""
    stages = (retreat_posture(hand, grasp.pregrasp), grasp.pregrasp, grasp.grasp, grasp.squeeze)
    first = min(max(int(at), 0), len(stages) - 2)
    share = min(max(at - first, 0.0), 1.0)
    start, end = stages[first], stages[first + 1]
    # The shorter way round: a quaternion and its negative are the same rotation.
    sign = 1.0 if start.quaternion_wxyz @ end.quaternion_wxyz >= 0 else -1.0
    quaternion = (1 - share) * start.quaternion_wxyz + share * sign * end.quaternion_wxyz
    return Posture(
        (1 - share) * start.position + share * end.position,
        quaternion / np.linalg.norm(quaternion),
        (1 - share) * start.joint_positions + share * end.joint_positions,
    )


def placed_links(
    hand: HandModel, posture: Posture
) -> tuple[Float[np.ndarray, "links 3"], Float[np.ndarray, "links 4"]]:
    """Position [m] and quaternion (wxyz) of every link in the object's frame."""
    rotations, translations = link_poses(hand, posture.joint_positions)
    base = rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz).double()).numpy()
    quaternions = quaternion_from_rotation(torch.as_tensor(base @ rotations)).numpy()
    return translations @ base.T + posture.position, quaternions


def skeletons(hand: HandModel, seen: Snapshot) -> Float[np.ndarray, "hands bones 2 3"]:
    """Every hand as lines from each link's origin to its parent's, object frame [m]."""
    joints = torch.as_tensor(seen.joint_positions).float()
    links = forward(make_kinematics(hand), joints).translation
    quaternions = torch.as_tensor(seen.quaternions_wxyz).float()
    base = SE3(rotation_from_quaternion(quaternions), torch.as_tensor(seen.positions).float())
    origins = base.apply(links).numpy()
    ends = np.flatnonzero(hand.link_parent >= 0)
    return np.stack([origins[:, hand.link_parent[ends]], origins[:, ends]], 2)
