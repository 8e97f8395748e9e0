"""When a hold is over early: the object is at rest, and its drift cannot carry it to a limit in the time that is left.

A trial that stops early goes through the same states as one of full length, so it can verify what that would not, never
the reverse. What slides slowly may come to an edge and snap away, and what jitters on its contacts may be thrown off
them much later: hence the large safety, and the demand for rest. Numbers are from trajectories of pulls of four hands;
`graspd bench early` measures what they come to.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from graspd_core.trials.world import Protocol

# Steps from one look at a hold to the next; divides `CHECK_EVERY` and every number of steps in a rule.
LOOK_EVERY = 5
# Steps from one check of the limits to the next.
CHECK_EVERY = 25


@dataclass(frozen=True)
class StopRule:
    """How a hold is looked at.

    Attributes:
        first: steps before the first look.
        window: steps that the drift is taken over.
        safety: how many times that drift the object is supposed to keep until the end.
        speed: what is slower is at rest [m/s].
        spin: what turns slower is at rest [rad/s].
    """

    first: int
    window: int
    safety: float
    speed: float
    spin: float


FIRM = StopRule(first=25, window=10, safety=16.0, speed=0.005, spin=math.radians(5.0))
SLIPPERY = StopRule(first=25, window=10, safety=16.0, speed=0.002, spin=math.radians(2.0))
# Objects begin to slip as late as 1.9 s.
CREEPING = StopRule(first=100, window=50, safety=16.0, speed=0.002, spin=math.radians(2.0))
# Between fewer ends of fingers an object turns about the line that joins them, as late as it slips.
_FEWEST_FINGERS = 3
# The least impedance ratio and sliding friction of each, CREEPING below them all; measured at 0.6 and 0.3.
_RULES = ((FIRM, 10.0, 0.6), (SLIPPERY, 10.0, 0.3))


@dataclass(frozen=True)
class ObjectState:
    """Where the object is in the world of a trial, and how fast.

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
    """The rule of a protocol, by its friction, and of a hand; None where trials run to their end."""
    if protocol.full_length:
        return None
    if fingers < _FEWEST_FINGERS:
        return CREEPING
    fits = (r for r, ratio, friction in _RULES if protocol.impratio >= ratio and protocol.friction[0] >= friction)
    return next(fits, CREEPING)


def answer_known(
    rule: StopRule, protocol: Protocol, states: Sequence[ObjectState], moved: tuple[float, float], left: int
) -> bool:
    """Whether a hold need not go on; False where anything is not finite.

    Args:
        rule: of the hold.
        protocol: has the limits.
        states: of the last `rule.window` steps, from its first to its last look.
        moved: travel [m] and turn [rad] so far.
        left: steps that are left.
    """
    if not all(state.speed < rule.speed and state.spin < rule.spin for state in states):
        return False
    drift, turned = drifted(states[0], states[-1])
    share = rule.safety * left / rule.window
    return moved[0] + share * drift < protocol.max_displacement and moved[1] + share * turned < protocol.max_rotation


def drifted(before: ObjectState, now: ObjectState) -> tuple[float, float]:
    """Travel [m] and turn [rad] from one state to another."""
    cosine = abs(sum(a * b for a, b in zip(before.quaternion_wxyz, now.quaternion_wxyz, strict=True)))
    return math.dist(before.center, now.center), 2 * math.acos(min(1.0, cosine))
