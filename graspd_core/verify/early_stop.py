"""End a hold early, once the object drifts too slowly to reach a limit. A hold is a pull, or the wait after a lift.

Up to the stop, a shortened trial and a full trial are identical. A grasp may pass the shortened trial although it would
fail the full trial. The opposite never happens. The drift is the object's motion in a window, the last few steps. A
slowly sliding object may reach an edge and slip suddenly, so the drift is multiplied by a safety factor. In short
windows, contact jitter exceeds the drift. So windows of several lengths are checked. The hold ends if the drift in any
window is small enough. At low friction or with few fingers, the object must also be at rest. The rules were chosen from
simulated pulls with four hands, on eleven shapes and ten scans. `graspd bench early` counts the verdicts that change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from graspd_core.verify.world import Protocol

# Steps between two checks for an early stop. `CHECK_EVERY` and all step numbers in a `StopRule` are its multiples.
LOOK_EVERY = 5
# Steps between two checks of the limits on travel and rotation.
CHECK_EVERY = 25


@dataclass(frozen=True)
class StopRule:
    """Rule for the early stop of a hold.

    Attributes:
        first: number of steps before the first check.
        windows: window lengths for the drift, in steps. A hold stops if the drift of one window is small enough.
        safety: factor by which the measured drift is multiplied when it is extrapolated to the end.
        speed: speed below which the object is at rest [m/s]. Infinite if the object need not be at rest.
        spin: angular speed below which the object is at rest [rad/s]. Infinite if the object need not be at rest.
    """

    first: int
    windows: tuple[int, ...]
    safety: float
    speed: float = math.inf
    spin: float = math.inf


FIRM = StopRule(first=10, windows=(5, 10, 20, 40), safety=8.0)
# `payload` uses ROUGH to save a third of the steps. Only 4 of 719 pulls above 1.03 times the payload seemed to hold.
ROUGH = replace(FIRM, safety=2.0)
SLIPPERY = StopRule(first=10, windows=(5, 10, 20, 40), safety=16.0)
# At low friction, an object may creep at 1 mm/s and suddenly slip after 1.9 s. So CREEPING requires an object at rest.
CREEPING = StopRule(first=100, windows=(50,), safety=16.0, speed=0.0005, spin=math.radians(0.5))
# Between one or two fingertips, an object may begin to turn after 1.9 s. Hands with fewer fingers use CREEPING.
_FEWEST_FINGERS = 3
# Rows: stop rule, and least impedance ratio and friction at which it is used. If no row fits, CREEPING is used.
_RULES = ((FIRM, 10.0, 0.6), (SLIPPERY, 10.0, 0.3))


@dataclass(frozen=True)
class ObjectState:
    """Pose and speed of the object at one time of a trial, world frame.

    Attributes:
        center: centre of mass [m].
        quaternion_wxyz: orientation of the object's body.
        speed: speed of the body's origin [m/s].
        spin: angular speed [rad/s].
    """

    center: tuple[float, ...]
    quaternion_wxyz: tuple[float, ...]
    speed: float
    spin: float


def stop_rule(protocol: Protocol, fingers: int, *, rough: bool = False) -> StopRule | None:
    """Return the stop rule for a protocol and a number of fingers. Return None if the protocol forbids early stops.

    If `rough` is set, `ROUGH` replaces `FIRM` at high friction. `ROUGH` stops sooner but may miss a late slip.
    """
    if protocol.full_length:
        return None
    if fingers < _FEWEST_FINGERS:
        return CREEPING
    fits = (r for r, ratio, friction in _RULES if protocol.impratio >= ratio and protocol.friction[0] >= friction)
    rule = next(fits, CREEPING)
    return ROUGH if rough and rule is FIRM else rule


def answer_known(
    rule: StopRule, protocol: Protocol, states: Sequence[ObjectState], moved: tuple[float, float], left: int
) -> bool:
    """Return True if a hold can stop, because the object will stay within limits. Return False for non-finite states.

    Args:
        rule: stop rule of the hold.
        protocol: protocol with the limits.
        states: object states at the last checks, oldest first. Windows that are longer than this history are skipped.
        moved: travel [m] and rotation [rad] of the object so far.
        left: number of remaining steps.
    """
    spans = ((window, states[-(window // LOOK_EVERY + 1) :]) for window in rule.windows)
    return any(
        all(state.speed < rule.speed and state.spin < rule.spin for state in span)
        and _stays(protocol, moved, drifted(span[0], span[-1]), rule.safety * left / window)
        for window, span in spans
        if len(span) > window // LOOK_EVERY
    )


def _stays(protocol: Protocol, moved: tuple[float, float], drift: tuple[float, float], times: float) -> bool:
    travel, turn = (so_far + times * more for so_far, more in zip(moved, drift, strict=True))
    return travel < protocol.max_displacement and turn < protocol.max_rotation


def drifted(before: ObjectState, now: ObjectState) -> tuple[float, float]:
    """Return the object's travel [m] and rotation [rad] from one state to another."""
    cosine = abs(sum(a * b for a, b in zip(before.quaternion_wxyz, now.quaternion_wxyz, strict=True)))
    return math.dist(before.center, now.center), 2 * math.acos(min(1.0, cosine))
