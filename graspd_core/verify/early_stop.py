"""The end of a hold whose answer is known: the object's drift cannot carry it to a limit in the time that is left.

A trial that stops early goes through the same states as one of full length. It can verify what a full one would not,
never the reverse. A slowly sliding object may come to an edge and snap away, hence the safety factor. Jitter on the
contacts hides the drift within a few steps, so the drift is taken over several spans, and one of them suffices. At low
friction or with few fingers, the object has to be at rest as well. The numbers come from trajectories of pulls of four
hands on eleven shapes and ten scans. `graspd bench early` measures their effect.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from graspd_core.verify.world import Protocol

# Steps from one look at a hold to the next. This divides `CHECK_EVERY` and every number of steps in a rule.
LOOK_EVERY = 5
# Steps from one check of the limits to the next.
CHECK_EVERY = 25


@dataclass(frozen=True)
class StopRule:
    """How a hold is checked.

    Attributes:
        first: steps before the first look.
        windows: steps that the drift is taken over. One of them is enough.
        safety: how many times that drift the object is supposed to keep until the end.
        speed: a slower object is at rest [m/s], infinite if rest is not asked for.
        spin: an object that turns slower is at rest [rad/s], likewise.
    """

    first: int
    windows: tuple[int, ...]
    safety: float
    speed: float = math.inf
    spin: float = math.inf


FIRM = StopRule(first=10, windows=(5, 10, 20, 40), safety=8.0)
SLIPPERY = StopRule(first=10, windows=(5, 10, 20, 40), safety=16.0)
# Objects begin to slip as late as 1.9 s. What moves at 1 mm/s until then may let go at once.
CREEPING = StopRule(first=100, windows=(50,), safety=16.0, speed=0.0005, spin=math.radians(0.5))
# Between fewer ends of fingers an object turns about the line that joins them, as late as it slips.
_FEWEST_FINGERS = 3
# The least impedance ratio and sliding friction of each, CREEPING below them all. Measured at 0.6 and 0.3.
_RULES = ((FIRM, 10.0, 0.6), (SLIPPERY, 10.0, 0.3))


@dataclass(frozen=True)
class ObjectState:
    """Pose and speed of the object in the world of a trial.

    Attributes:
        center: of mass [m].
        quaternion_wxyz: of its body.
        speed: of its origin [m/s].
        spin: [rad/s].
    """

    center: tuple[float, ...]
    quaternion_wxyz: tuple[float, ...]
    speed: float
    spin: float


def stop_rule(protocol: Protocol, fingers: int) -> StopRule | None:
    """Return the rule of a protocol, by its friction, and of a hand, None if trials run to their end."""
    if protocol.full_length:
        return None
    if fingers < _FEWEST_FINGERS:
        return CREEPING
    fits = (r for r, ratio, friction in _RULES if protocol.impratio >= ratio and protocol.friction[0] >= friction)
    return next(fits, CREEPING)


def answer_known(
    rule: StopRule, protocol: Protocol, states: Sequence[ObjectState], moved: tuple[float, float], left: int
) -> bool:
    """Tell whether a hold need not go on. False if anything is not finite.

    Args:
        rule: of the hold.
        protocol: has the limits.
        states: of the last checks, oldest first. Windows that reach back further are left out.
        moved: travel [m] and turn [rad] so far.
        left: steps that are left.
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
    """Return travel [m] and turn [rad] from one state to another."""
    cosine = abs(sum(a * b for a, b in zip(before.quaternion_wxyz, now.quaternion_wxyz, strict=True)))
    return math.dist(before.center, now.center), 2 * math.acos(min(1.0, cosine))
