"""The trials that planning runs, one row each, in this order. A grasp is verified when it passes all that apply.

One verified grasp in fifty is tried once more at full length: are trials that stop early still right?

One of its pulls, by chance, since all of them take as long as the trials of a dozen grasps.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graspd_core.hands.model import HandModel
from graspd_core.perception.scene import Scene
from graspd_core.types import AuditCount, Grasp, StopHook, TrialResult, TriangleMesh
from graspd_core.verify.hold_trial import STOPPED, hold_trial
from graspd_core.verify.lift_trial import lift_trial
from graspd_core.verify.world import Protocol, World, build_world


@dataclass(frozen=True)
class TrialContext:
    """What the grasps of one scene are tried with.

    Attributes:
        hand: the hand that grasps.
        protocol: physics of the trials.
        alone: world of the object and the hand.
        around: world with support and obstacles too; None where there are none.
    """

    hand: HandModel
    protocol: Protocol
    alone: World
    around: World | None


@dataclass(frozen=True)
class Trial:
    """One trial.

    Attributes:
        name: of its results.
        applies: whether the trial runs in a context.
        run: tries one grasp; polls the hook, and fails where it ends the trial.
    """

    name: str
    applies: Callable[[TrialContext], bool]
    run: Callable[[TrialContext, Grasp, StopHook], TrialResult]


def _hold(context: TrialContext, grasp: Grasp, stop: StopHook) -> TrialResult:
    return hold_trial(context.alone, grasp, context.protocol, stop=stop)


def _lift(context: TrialContext, grasp: Grasp, stop: StopHook) -> TrialResult:
    if context.around is None:
        raise ValueError("the lift trial needs a support or obstacles")
    return lift_trial(context.around, context.hand, grasp, context.protocol, stop=stop)


_ROWS = (
    Trial("hold", lambda context: True, _hold),
    Trial("lift", lambda context: context.around is not None, _lift),
)
TRIALS: dict[str, Trial] = {row.name: row for row in _ROWS}
"""The trials by name, in the order in which they run; a row that is added runs too."""


def build_worlds(scene: Scene, hand: HandModel, parts: Sequence[TriangleMesh], protocol: Protocol) -> TrialContext:
    """Build the worlds; `parts` are the object's convex parts, object frame [m]."""
    around = None
    if scene.support is not None or scene.obstacles:
        around = build_world(hand, scene.object, parts, protocol, scene.support, scene.obstacles)
    return TrialContext(hand, protocol, build_world(hand, scene.object, parts, protocol), around)


def grasp_trials(context: TrialContext, grasp: Grasp, stop: StopHook = lambda: False) -> tuple[TrialResult, ...]:
    """Run the trials that apply, in order, up to the first that the grasp fails."""
    results: list[TrialResult] = []
    for trial in TRIALS.values():
        if trial.applies(context):
            results.append(trial.run(context, grasp, stop))
            if not results[-1].passed:
                break
    return tuple(results)


AUDITED = 50


def audited_trials(
    context: TrialContext, grasp: Grasp, stop: StopHook = lambda: False
) -> tuple[tuple[TrialResult, ...], AuditCount]:
    """Run the trials that apply, up to the first failure; where the grasp is to be audited, once more at full length.

    Results of the full length take the place of those that they contradict. An audit that `stop` ended does not count.
    """
    results = grasp_trials(context, grasp, stop)
    if context.protocol.full_length or not results[-1].passed or not is_audited(grasp):
        return results, AuditCount()
    pulls = context.protocol.pulls
    pull = pulls[_checksum(grasp) // AUDITED % len(pulls)]
    full = replace(context, protocol=replace(context.protocol, full_length=True, pulls=(pull,)))
    again = grasp_trials(full, grasp, stop)
    if again[-1].reason == STOPPED:
        return results, AuditCount()
    agreed = again[-1].passed
    return (results if agreed else again), AuditCount(1, int(not agreed))


def is_audited(grasp: Grasp) -> bool:
    """Whether a grasp is among the one in fifty: by a checksum, so that no order matters."""
    return _checksum(grasp) % AUDITED == 0


def _checksum(grasp: Grasp) -> int:
    """A number by which a grasp draws lots: of its squeeze alone."""
    squeeze = grasp.squeeze
    numbers = np.concatenate([squeeze.position, squeeze.quaternion_wxyz, squeeze.joint_positions])
    return zlib.crc32(np.ascontiguousarray(numbers, dtype="<f8").tobytes())
