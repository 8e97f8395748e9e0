"""Whether a hand holds something, from what real hands tell: joint positions and efforts.

Joints whose squeeze target lies beyond the grasp press. What is in the hand stops them short of it. A joint that
arrived at its target presses on nothing, and its effort is gone. Fingers that meet press on each other: they cover only
a part of the way too, and a thing that turns between two jaws lets them cover as much. Their places tell both apart.
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

# A joint presses whose target is this far beyond the grasp [rad].
_PRESSES = 0.03
# Of the way from the grasp to the target, joints that press on nothing cover more than this share. Those of things held
# covered up to 0.37 in 38 lifts, and 0.57 where a thing turned between jaws.
_ARRIVED = 0.6
# Fingers that press on each other cover more than this share.
_MEETING = 0.4
# Surface points of two fingers that were so far apart at the grasp, and are so near now, meet [m].
_APART, _NEAR = 0.009, 0.004
# Of what the joints pressed with after the squeeze, less than this share is left of what slipped out.
_EFFORT_LEFT = 0.2


@dataclass(frozen=True, eq=False)
class Held:
    """What was decided, and of what.

    Attributes:
        held: whether something is in the hand.
        reason: what speaks against it; empty where it is held.
    """

    held: bool
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Hold:
    """A hand that squeezed.

    Attributes:
        presses: which joints press.
        touch, target: joint values at the grasp and targets of the squeeze [rad] or [m].
        positions, efforts: of the joints after the squeeze.
    """

    presses: Bool[np.ndarray, "joints"]
    touch: Joints
    target: Joints
    positions: Joints
    efforts: Joints


def after_squeeze(hand: HandModel, grasp: Grasp, reading: JointReading) -> Hold:
    """Return what later readings are compared with; `reading` is that of the hand after the squeeze."""
    own = reading.of(hand.joint_names)
    scale = np.where(hand.slides, 1.0 / METRES_PER_RADIAN, 1.0)
    touch, target = (np.clip(p.joint_positions, hand.lower, hand.upper) for p in (grasp.grasp, grasp.squeeze))
    return Hold(np.abs(target - touch) * scale > _PRESSES, touch, target, own.positions, own.efforts)


def grips(hold: Hold, hand: HandModel) -> Held:
    """Return whether the hand closed on something at all."""
    return _stopped(hold, hand, hold.positions)


def still_holds(hold: Hold, hand: HandModel, reading: JointReading) -> Held:
    """Return whether what the hand gripped is still in it."""
    own, toward = reading.of(hand.joint_names), np.sign(hold.target - hold.touch)
    before, now = (np.maximum((toward * efforts)[hold.presses], 0.0).sum() for efforts in (hold.efforts, own.efforts))
    if before > 0 and now < _EFFORT_LEFT * before:
        return Held(False, f"the joints press with {100 * now / before:.0f} % of what they did")
    return _stopped(hold, hand, own.positions)


def _stopped(hold: Hold, hand: HandModel, positions: Joints) -> Held:
    """Return whether something stops the joints short of their targets that is not the hand."""
    if not hold.presses.any():
        return Held(True)
    way = (hold.target - hold.touch)[hold.presses]
    covered = float(np.median((positions - hold.touch)[hold.presses] / way))
    if covered > _ARRIVED:
        return Held(False, f"the fingers closed on nothing: they covered {100 * covered:.0f} % of the squeeze")
    if covered > _MEETING and fingers_meet(hand, hold.touch, positions):
        return Held(False, "the fingers press on each other")
    return Held(True)


def fingers_meet(hand: HandModel, before: Joints, now: Joints) -> bool:
    """Return whether links touch at some joint values that were apart before."""
    at, links = hand_points(hand, now)
    one, other = KDTree(at).query_pairs(_NEAR, output_type="ndarray").T
    group = hand.link_group[links]
    apart = (group[one] != group[other]) & ~hand.adjacent[links[one], links[other]]
    was = hand_points(hand, before)[0]
    return bool((np.linalg.norm(was[one[apart]] - was[other[apart]], axis=1) > _APART).any())
