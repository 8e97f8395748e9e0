"""Define the trials of planning in a registry, and run them in order. `types.Grasp.verdict` derives the verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from graspd_core.hands.model import HandModel
from graspd_core.perception.scene import Scene
from graspd_core.types import Grasp, StopHook, TrialResult, TriangleMesh
from graspd_core.verify.hold_trial import hold_trial
from graspd_core.verify.lift_trial import lift_trial
from graspd_core.verify.world import Protocol, World, build_world


@dataclass(frozen=True)
class TrialContext:
    """Worlds (MuJoCo models) and physics settings for the trials of one scene.

    Attributes:
        protocol: physics settings of the trials.
        alone: world with only the hand and the object.
        around: world that also has the support and the obstacles. None if the scene has neither.
    """

    hand: HandModel
    protocol: Protocol
    alone: World
    around: World | None


@dataclass(frozen=True)
class Trial:
    """Definition of one trial.

    Attributes:
        name: name in the trial results.
        applies: function that returns whether the trial runs in a context.
        run: function that tries one grasp. It polls a stop hook. If the stop hook returns true, the trial fails.
    """

    name: str
    applies: Callable[[TrialContext], bool]
    run: Callable[[TrialContext, Grasp, StopHook], TrialResult]


def _lift(context: TrialContext, grasp: Grasp, stop: StopHook) -> TrialResult:
    if context.around is None:
        raise ValueError("the lift trial needs a scene with a support or obstacles")
    return lift_trial(context.around, context.hand, grasp, context.protocol, stop=stop)


_ROWS = (
    Trial("hold", lambda context: True, lambda c, grasp, stop: hold_trial(c.alone, grasp, c.protocol, stop=stop)),
    Trial("lift", lambda context: context.around is not None, _lift),
)
TRIALS: dict[str, Trial] = {row.name: row for row in _ROWS}
"""The trials by name, in the order in which they run."""


def build_worlds(scene: Scene, hand: HandModel, parts: Sequence[TriangleMesh], protocol: Protocol) -> TrialContext:
    """Build the worlds of a scene's trials. `parts` are the object's convex parts, object frame [m]."""
    around = None
    if scene.support is not None or scene.obstacles:
        around = build_world(hand, scene.object, parts, protocol, scene.support, scene.obstacles)
    return TrialContext(hand, protocol, build_world(hand, scene.object, parts, protocol), around)


def grasp_trials(context: TrialContext, grasp: Grasp, stop: StopHook = lambda: False) -> tuple[TrialResult, ...]:
    """Run the trials that apply, in order. Stop after the first failed trial."""
    results: list[TrialResult] = []
    for trial in TRIALS.values():
        if trial.applies(context):
            results.append(trial.run(context, grasp, stop))
            if not results[-1].passed:
                break
    return tuple(results)
