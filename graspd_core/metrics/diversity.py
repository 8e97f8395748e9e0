"""How different the grasps of one run are: many copies of one grasp are one grasp."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from graspd_core.hands.model import HandModel
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import Grasp

# Grasps are two where their palms are this far apart [m], or look or roll this far apart [rad].
APART, TURNED = 0.02, float(np.deg2rad(20.0))


def distinct(grasps: Sequence[Grasp], hand: HandModel) -> tuple[Grasp, ...]:
    """The grasps, in their order, without those that are copies of one kept before.

    A copy has the middle of its palm within 20 mm and its base turned by less than 20° of the other's, in the object's
    frame. What the object looks like plays no part: to grasp a ball from the left and from the right is two grasps,
    because a robot that cannot come from one side may come from the other.
    """
    kept: list[Grasp] = []
    palms, turns = np.zeros((0, 3)), np.zeros((0, 3, 3))
    for grasp in grasps:
        posture = grasp.grasp
        turn = rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz, dtype=torch.float64)).numpy()
        palm = posture.position + turn @ hand.palm_center
        # The angle between two rotations, from the trace of one undone by the other.
        cosine = (np.einsum("nij,ij->n", turns, turn) - 1.0) / 2.0
        near = np.linalg.norm(palms - palm, axis=1) < APART
        if not (near & (cosine > np.cos(TURNED))).any():
            kept.append(grasp)
            palms, turns = np.concatenate([palms, palm[None]]), np.concatenate([turns, turn[None]])
    return tuple(kept)
