"""When a hold is over early: the object has come so nearly to rest that the time left cannot carry it to a limit.

Measured on 1,380 grasps of three hands, verdicts against those of trials of full length. The trial that stops early
follows the same states as the long one, so it can verify what the long one would not, never the reverse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from graspd_core.trials.world import Protocol

# Steps from one look at a hold to the next; divides `CHECK_EVERY` and every number of a rule.
LOOK_EVERY = 5
# Steps from one check of the limits to the next.
CHECK_EVERY = 25
# A protocol below either of these creeps: objects begin to slip as late as 1.9 s.
_FIRM_IMPRATIO, _FIRM_FRICTION = 10.0, 0.2


@dataclass(frozen=True)
class StopRule:
    """How a hold is looked at.

    Attributes:
        first: steps before the first look.
        window: steps that the object's speed is taken over.
        safety: how many times that speed the object is supposed to keep until the end.
    """

    first: int
    window: int
    safety: float


FIRM = StopRule(first=25, window=10, safety=4.0)
CREEPING = StopRule(first=100, window=50, safety=16.0)


@dataclass(frozen=True)
class ObjectPose:
    """Where the object is in the world of a trial.

    Attributes:
        center: of mass [m].
        quaternion_wxyz: of its body.
    """

    center: tuple[float, float, float]
    quaternion_wxyz: tuple[float, float, float, float]


def stop_rule(protocol: Protocol) -> StopRule | None:
    """The rule of a protocol, by its friction; None where trials run to their end."""
    if protocol.full_length:
        return None
    firm = protocol.impratio >= _FIRM_IMPRATIO and protocol.friction[0] >= _FIRM_FRICTION
    return FIRM if firm else CREEPING


def drift(rule: StopRule, before: ObjectPose, now: ObjectPose, left: int) -> tuple[float, float]:
    """How far the object may still go in `left` steps: travel [m] and turn [rad], at `safety` times its speed.

    Args:
        rule: of the hold.
        before: the pose `rule.window` steps ago.
        now: the pose.
        left: steps of the hold that are left.
    """
    share = rule.safety * left / rule.window
    cosine = abs(sum(a * b for a, b in zip(before.quaternion_wxyz, now.quaternion_wxyz, strict=True)))
    return share * math.dist(before.center, now.center), share * 2 * math.acos(min(1.0, cosine))


def answer_known(protocol: Protocol, travel: float, turn: float, ahead: tuple[float, float]) -> bool:
    """Whether travel [m] and turn [rad] stay within the limits with what is `ahead`; False for what is not finite."""
    return travel + ahead[0] < protocol.max_displacement and turn + ahead[1] < protocol.max_rotation
