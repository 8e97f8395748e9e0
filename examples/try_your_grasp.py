"""Try a grasp of another planner: python examples/try_your_grasp.py [OBJECT].

The other planner gives a gripper's pose and opening width. `verify_grasps` tries the grasp in MuJoCo and measures it
like graspd's own grasps. For a hand with many joints, give all its joint values in the three postures.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graspd_core import Grasp, HandModel, Posture, load_hand, load_scene, verify_grasps

OPENING, PRESS = 0.015, 0.010  # motion of each jaw from the touch: out to the pregrasp, in to the target [m]


@dataclass(frozen=True)
class GripperGrasp:
    """A grasp of another planner.

    Attributes:
        position: origin of the gripper's base in the object's frame [m].
        quaternion_wxyz: orientation of the base. The gripper approaches along z, and the jaws close along y.
        width: distance between the jaws when they touch [m].
    """

    position: tuple[float, float, float]
    quaternion_wxyz: tuple[float, float, float, float]
    width: float


FROM_ABOVE, SIDEWAYS = (0.0, 1.0, 0.0, 0.0), (0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0)
# Grasps of a box of 6 x 6 x 9 cm whose centre is the origin.
GRASPS = {
    "from above": GripperGrasp((0.0, 0.0, 0.15), FROM_ABOVE, 0.06),
    "turned by 90 degrees": GripperGrasp((0.0, 0.0, 0.15), SIDEWAYS, 0.06),
    "beside the middle": GripperGrasp((0.028, 0.0, 0.168), FROM_ABOVE, 0.06),
    "too high": GripperGrasp((0.0, 0.0, 0.30), FROM_ABOVE, 0.06),
}


def as_graspd(grasp: GripperGrasp, hand: HandModel) -> Grasp:
    """Return the grasp as three postures: open and clear of the object, touching the object, and targets that press."""
    touch = grasp.width / 2
    jaws = [np.clip([jaw], hand.lower, hand.upper) for jaw in (touch + OPENING, touch, touch - PRESS)]
    position, quaternion = np.array(grasp.position), np.array(grasp.quaternion_wxyz)
    pregrasp, touching, squeeze = (Posture(position, quaternion, jaw) for jaw in jaws)
    return Grasp(pregrasp, touching, squeeze)


def main(arguments: Sequence[str]) -> int:
    """Return the number of grasps that failed a trial."""
    scene, hand = load_scene(*(arguments or ["shape:box"]), mass=0.2, friction=0.6), load_hand("parallel_gripper")
    tried = verify_grasps(scene, hand, [as_graspd(grasp, hand) for grasp in GRASPS.values()], verify="standard")
    for name, grasp in zip(GRASPS, tried, strict=True):
        moved = ", ".join(
            f"moved {trial.displacement * 100:.1f} cm in the {trial.name} trial" for trial in grasp.trials
        )
        area = (grasp.metrics or {})["contact_area"] or 0.0
        print(f"{name}: {grasp.verdict}; {grasp.reason or moved}; contact area {area * 1e4:.1f} cm²")
    return sum(not trial.passed for grasp in tried for trial in grasp.trials)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
