"""Whether a hand holds something, from what real hands tell: joint positions and efforts.

Joints whose squeeze target lies beyond the grasp press. What is in the hand stops them short of it. A joint that
arrived at its target presses on nothing. What slips out lets the joints go on from where they stood when they squeezed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from graspd_cell.robot import JointReading
from graspd_core.hands.model import METRES_PER_RADIAN, HandModel
from graspd_core.types import Grasp

Joints = Float[np.ndarray, "joints"]

# A joint presses whose target is this far beyond the grasp [rad].
_PRESSES = 0.03
# Of the way from the grasp to the target, joints that press on nothing cover more than this share.
_ARRIVED = 0.8
# Of what the joints pressed with after the squeeze, less than this share is left of what slipped out.
_EFFORT_LEFT = 0.2
# Joints of a held thing creep less than this beyond where they stood after the squeeze [rad].
_WENT_ON = 0.2


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
        scale: how much of each joint's unit is a radian [rad/unit].
        touch, target: joint values at the grasp and targets of the squeeze [rad] or [m].
        positions, efforts: of the joints after the squeeze.
    """

    presses: Bool[np.ndarray, "joints"]
    scale: Joints
    touch: Joints
    target: Joints
    positions: Joints
    efforts: Joints


def after_squeeze(hand: HandModel, grasp: Grasp, reading: JointReading) -> Hold:
    """Return what later readings are compared with; `reading` is that of the hand after the squeeze."""
    own = reading.of(hand.joint_names)
    scale = np.where(hand.slides, 1.0 / METRES_PER_RADIAN, 1.0)
    touch, target = (np.clip(p.joint_positions, hand.lower, hand.upper) for p in (grasp.grasp, grasp.squeeze))
    return Hold(np.abs(target - touch) * scale > _PRESSES, scale, touch, target, own.positions, own.efforts)


def grips(hold: Hold) -> Held:
    """Return whether the hand closed on something at all."""
    if not hold.presses.any():
        return Held(True)
    way = (hold.target - hold.touch)[hold.presses]
    covered = (hold.positions - hold.touch)[hold.presses] / way
    if np.median(covered) > _ARRIVED:
        return Held(
            False, f"the fingers closed on nothing: they covered {100 * np.median(covered):.0f} % of the squeeze"
        )
    return Held(True)


def still_holds(hold: Hold, hand: HandModel, reading: JointReading) -> Held:
    """Return whether what the hand gripped is still in it."""
    own = reading.of(hand.joint_names)
    if not hold.presses.any():
        return Held(True)
    toward = np.sign(hold.target - hold.touch)
    on = (toward * (own.positions - hold.positions) * hold.scale)[hold.presses]
    pressed = np.maximum((toward * hold.efforts)[hold.presses], 0.0).sum()
    pressing = np.maximum((toward * own.efforts)[hold.presses], 0.0).sum()
    if pressed > 0 and pressing < _EFFORT_LEFT * pressed:
        return Held(False, f"the joints press with {100 * pressing / pressed:.0f} % of what they did")
    if on.max() > _WENT_ON and np.median(on) > 0.25 * _WENT_ON:
        return Held(False, f"the fingers closed {on.max():.2f} rad further")
    return Held(True)
