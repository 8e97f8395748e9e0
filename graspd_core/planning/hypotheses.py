"""What else may be true of an object whose hidden side was guessed: less friction, another place, another shape.

A grasp that holds on the likeliest scene is tried on these too, cheapest first. How often grasps that held under so
many hold on the true object was measured (docs/clouds.md).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import lru_cache, partial

from graspd_core.config.certainty_config import HELD_AFTER
from graspd_core.errors import GraspdError
from graspd_core.hands.model import HandModel
from graspd_core.planning.run_clock import Run
from graspd_core.runtime.worker_process import run_isolated
from graspd_core.scene.scene import Scene, build_scene, object_parts
from graspd_core.trials.hold_trial import STOPPED, hold_trial
from graspd_core.trials.noisy_trial import PoseError, displaced, pose_errors
from graspd_core.trials.trial_registry import TrialContext
from graspd_core.trials.world import Protocol, World, at_friction, build_world
from graspd_core.types import HYPOTHESES, Grasp, StopHook, TrialResult

# Of the friction that the scene says.
_LESS_FRICTION = 2 / 3
# Places that the object may be at instead, the same for all grasps; never those that a benchmark tries.
_PLACES, _PLACES_SEED = 3, 0x706C616365
# How often the stop hook is asked while waiting for a world [s].
_POLL = 0.02


@dataclass(frozen=True)
class Hypothesis:
    """One other thing that may be true.

    Attributes:
        name: what it is, for people.
        hold: the hold trial of a grasp if it is; None where it cannot be, or the hook says to stop.
    """

    name: str
    hold: Callable[[Grasp, StopHook], TrialResult | None]


@dataclass(frozen=True)
class Hypotheses:
    """All that else may be true, and under how many of them a verified grasp may fail."""

    items: tuple[Hypothesis, ...]
    allowed: int


def hypotheses_of(
    run: Run, scene: Scene, hand: HandModel, trials: TrialContext, probability: float
) -> Hypotheses | None:
    """Those that a grasp must hold under to be as sure as asked for, cheapest first; None where none is needed.

    The shapes are made by a thread of their own, from now on: trials wait for each when they need it.
    """
    allowed = sum(held >= probability for held in HELD_AFTER) - 1
    if scene.evidence is None or allowed + 1 == len(HELD_AFTER):
        return None
    from graspd_core.reconstruction.other_shapes import other_rules

    protocol = trials.protocol
    slippery = at_friction(protocol, _LESS_FRICTION * Protocol.friction[0])
    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="graspd-shapes")

    def later(name: str, physics: Protocol, build: Callable[[], World | None]) -> Hypothesis:
        world = pool.submit(lambda: None if run.known_over() else build())
        return Hypothesis(name, partial(_hold_in, world, physics))

    found = [later(f"friction {slippery.friction[0]:.2g}", slippery, partial(_own_world, scene, hand, slippery))]
    for number, error in enumerate(pose_errors(_PLACES_SEED, _PLACES), 1):
        found.append(Hypothesis(f"place {number}", partial(_hold_displaced, trials, error)))
    for rule in other_rules(scene.evidence):
        name = f"hidden side by {rule}" if rule else "hidden side closed smoothly"
        found.append(later(name, protocol, partial(_other_world, scene, hand, protocol, rule)))
    pool.shutdown(wait=False)
    return Hypotheses(tuple(found), allowed)


def try_hypotheses(hypotheses: Hypotheses, grasp: Grasp, stop: StopHook) -> tuple[TrialResult, float]:
    """Hold trials of a grasp under each in turn, until it fails under too many; and how likely it is to hold in truth.

    The result tells the greatest travel and turn of the trials that it passed.
    """
    worst, failed, tried = [0.0, 0.0], [], 0
    for item in hypotheses.items:
        result = item.hold(grasp, stop)
        if stop():
            return TrialResult(HYPOTHESES, False, worst[0], worst[1], STOPPED), HELD_AFTER[-1]
        if result is None:
            continue
        tried += 1
        if result.passed:
            worst = [max(worst[0], result.displacement), max(worst[1], result.rotation)]
            continue
        failed.append(f"{item.name}: {result.reason}")
        if len(failed) > hypotheses.allowed:
            break
    passed = len(failed) <= hypotheses.allowed
    reason = "" if passed else f"fails under {len(failed)} of the {tried} hypotheses tried ({'; '.join(failed)})"
    return TrialResult(HYPOTHESES, passed, worst[0], worst[1], reason), HELD_AFTER[
        min(len(failed), len(HELD_AFTER) - 1)
    ]


def _hold_in(world: Future[World | None], protocol: Protocol, grasp: Grasp, stop: StopHook) -> TrialResult | None:
    while not wait([world], timeout=_POLL).done:
        if stop():
            return None
    found = world.result()
    return None if found is None else hold_trial(found, grasp, protocol, stop=stop)


def _hold_displaced(trials: TrialContext, error: PoseError, grasp: Grasp, stop: StopHook) -> TrialResult:
    center = trials.alone.center_of_mass + trials.alone.origin
    return hold_trial(trials.alone, displaced(grasp, *error, center), trials.protocol, stop=stop)


# Worlds are kept for the last few scenes and hands, which are hashed by identity.
@lru_cache(maxsize=4)
def _own_world(scene: Scene, hand: HandModel, protocol: Protocol) -> World:
    return build_world(hand, scene.object, object_parts(scene.object), protocol)


@lru_cache(maxsize=16)
def _other_world(scene: Scene, hand: HandModel, protocol: Protocol, rule: str) -> World | None:
    """The world of another shape of the object's own mass and friction; None where there is no such shape."""
    from graspd_core.reconstruction.other_shapes import other_shape

    mesh = run_isolated(other_shape, scene.evidence, rule, scene.object.mesh)
    if mesh is None:
        return None
    target = scene.object
    try:
        other = build_scene(mesh, source=target.source, mass=target.mass, friction=target.friction).object
    except GraspdError:
        return None
    return build_world(hand, other, object_parts(other), protocol)
