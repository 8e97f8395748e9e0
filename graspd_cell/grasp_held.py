"""Detection of a held object from joint positions and efforts, which real hands report.

A joint presses if its squeeze target lies beyond its position at the grasp. An object in the hand stops the joint
before the target. A joint that reaches its target presses on nothing, and its effort drops. Joints also stop early if
fingers press on each other. Then points of fingers meet. An unclear reading counts as held, because the hand opens
after an alarm and drops what it holds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from graspd_cell.motion import hand_points
from graspd_cell.robot import JointReading
from graspd_core.hands.model import METRES_PER_RADIAN, HandModel
from graspd_core.types import Grasp

Joints = Float[np.ndarray, "joints"]

# A joint presses if its target is farther than this from its value at the grasp [rad].
_PRESSES = 0.03
# The fingers closed on nothing if they covered more than the fraction `_ARRIVED` of the motion from grasp to target. If
# they press on each other, `_MEETING` is enough. In 130 attempts of two hands (seeds 204 to 208), fingers that held an
# object covered up to 0.72. Fingers that held an object and met covered up to 0.6.
_ARRIVED, _MEETING = 0.85, 0.62
# Two fingers meet if points of theirs were farther apart than `_APART` at the grasp and are within `_NEAR` now [m].
# Points that were farther apart than `_FAR` cannot meet around an object, however little the fingers covered [m].
_APART, _NEAR, _FAR = 0.009, 0.004, 0.04
# As an object slips out, the joints move on and their efforts fall. The object is lost if the fraction covered minus
# the fraction of effort left exceeds this. Objects that turned in the hand, but reached the other bin, had up to 0.48.
_SLIPPED = 0.5


@dataclass(frozen=True, eq=False)
class Hold:
    """State of the hand after the squeeze.

    Attributes:
        presses: True for joints that press, because their squeeze target lies beyond the grasp.
        touch, target: planned joint values of the grasp and of the squeeze [rad] or [m].
        positions, efforts: joint readings after the squeeze [rad] or [m], [N·m] or [N].
    """

    presses: Bool[np.ndarray, "joints"]
    touch: Joints
    target: Joints
    positions: Joints
    efforts: Joints


def after_squeeze(hand: HandModel, grasp: Grasp, reading: JointReading) -> Hold:
    """Return the state of the hand from `reading`, which is taken after the squeeze."""
    own = reading.of(hand.joint_names)
    scale = np.where(hand.slides, 1.0 / METRES_PER_RADIAN, 1.0)
    touch, target = (np.clip(p.joint_positions, hand.lower, hand.upper) for p in (grasp.grasp, grasp.squeeze))
    return Hold(np.abs(target - touch) * scale > _PRESSES, touch, target, own.positions, own.efforts)


def why_not_gripped(hold: Hold, hand: HandModel) -> str:
    """Return why the hand closed on no object, judged by the reading after the squeeze, or "" if it closed on one."""
    covered = _covered(hold, hold.positions)
    if covered > _ARRIVED:
        return f"the fingers closed on nothing: they covered {100 * covered:.0f} % of the squeeze"
    if fingers_meet(hand, hold.touch, hold.positions, _APART if covered > _MEETING else _FAR):
        return "the fingers press on each other"
    return ""


def why_lost(hold: Hold, hand: HandModel, reading: JointReading) -> str:
    """Return why the object is no longer in the hand, judged by a later reading, or "" if the hand still holds it."""
    own, toward = reading.of(hand.joint_names), np.sign(hold.target - hold.touch)
    before, now = (np.maximum((toward * efforts)[hold.presses], 0.0).sum() for efforts in (hold.efforts, own.efforts))
    covered = _covered(hold, own.positions)
    # A hand that reports no efforts pushes the less, the nearer its joints are to their targets.
    left = now / before if before > 0 else 1.0 - covered
    if covered - left > _SLIPPED:
        return f"the fingers covered {100 * covered:.0f} % of the squeeze with {100 * left:.0f} % of their effort left"
    return ""


def _covered(hold: Hold, positions: Joints) -> float:
    """Return the fraction of the way from grasp to target that the median pressing joint covered. 0 if none presses."""
    way, gone = (hold.target - hold.touch)[hold.presses], (positions - hold.touch)[hold.presses]
    return float(np.median(gone / way)) if len(way) else 0.0


def fingers_meet(hand: HandModel, before: Joints, now: Joints, least: float) -> bool:
    """Return True if points of two fingers touch at joint values `now` that were `least` [m] apart at `before`."""
    at, links = hand_points(hand, now)
    one, other = KDTree(at).query_pairs(_NEAR, output_type="ndarray").T
    group = hand.link_group[links]
    apart = (group[one] != group[other]) & ~hand.adjacent[links[one], links[other]]
    was = hand_points(hand, before)[0]
    return bool((np.linalg.norm(was[one[apart]] - was[other[apart]], axis=1) > least).any())
