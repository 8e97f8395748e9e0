"""Detection of a held object from joint positions and efforts, which real hands report.

A joint presses if its squeeze target lies beyond its position at the grasp. An object in the hand stops the joint
before the target. A joint that reaches its target presses on nothing, and its effort drops. Joints also stop early if
fingers press on each other, or if an object rotates between jaws. Only in the first case do points of fingers meet.
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
# Joints that press on nothing cover more than this fraction of the motion from grasp to target. With an object held,
# the median joint covered up to 0.75 in 28 lifts, because objects turn in the hand. Without an object, the median joint
# covered at least 0.86 in 19 of 26 cases.
_ARRIVED = 0.8
# Fingers that press on each other cover more than this fraction: `_MEETING` after the squeeze, `_MEETING_LATER` later.
# Fingers that held an object and touched each other covered up to 0.6.
_MEETING, _MEETING_LATER = 0.4, 0.62
# Two fingers meet if points of theirs were farther apart than `_APART` at the grasp and are within `_NEAR` now [m].
_APART, _NEAR = 0.009, 0.004
# If the object slipped out, less than this fraction of the effort after the squeeze is left. With an object in hand,
# at least 0.52 was left in the 28 lifts.
_EFFORT_LEFT = 0.45


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
    """Return why the hand closed on no object, by the reading after the squeeze, or "" if it closed on one."""
    return _why_empty(hold, hand, hold.positions, _MEETING)


def why_lost(hold: Hold, hand: HandModel, reading: JointReading) -> str:
    """Return why the object is no longer in the hand, by a later reading, or "" if the hand still holds it."""
    own, toward = reading.of(hand.joint_names), np.sign(hold.target - hold.touch)
    before, now = (np.maximum((toward * efforts)[hold.presses], 0.0).sum() for efforts in (hold.efforts, own.efforts))
    if before > 0 and now < _EFFORT_LEFT * before:
        return f"the joint efforts fell to {100 * now / before:.0f} % of the efforts after the squeeze"
    return _why_empty(hold, hand, own.positions, _MEETING_LATER)


def _why_empty(hold: Hold, hand: HandModel, positions: Joints, meeting: float) -> str:
    """Return why no object is held, or "". Beyond the fraction `meeting` of the squeeze, fingers must not touch."""
    if not hold.presses.any():
        return ""
    way = (hold.target - hold.touch)[hold.presses]
    covered = float(np.median((positions - hold.touch)[hold.presses] / way))
    if covered > _ARRIVED:
        return f"the fingers closed on nothing: they covered {100 * covered:.0f} % of the squeeze"
    if covered > meeting and fingers_meet(hand, hold.touch, positions):
        return "the fingers press on each other"
    return ""


def fingers_meet(hand: HandModel, before: Joints, now: Joints) -> bool:
    """Return True if two links that were apart at joint values `before` touch at `now`."""
    at, links = hand_points(hand, now)
    one, other = KDTree(at).query_pairs(_NEAR, output_type="ndarray").T
    group = hand.link_group[links]
    apart = (group[one] != group[other]) & ~hand.adjacent[links[one], links[other]]
    was = hand_points(hand, before)[0]
    return bool((np.linalg.norm(was[one[apart]] - was[other[apart]], axis=1) > _APART).any())
