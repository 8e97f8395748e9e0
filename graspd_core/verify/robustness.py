"""Check the robustness of grasps of objects that cameras saw: other poses, less friction, other shapes.

A grasp that holds on the likeliest scene, the best guess from the clouds, must also pass these checks. The hidden side
may be guessed wrong, so the grasp must also hold on up to two other shapes. On these shapes, the limit of rotation is
two thirds of the usual limit. docs/clouds.md reports how often grasps that pass all checks hold on the true object.
Trials run on several threads. The number of threads changes neither results nor order (`results_in_order`).
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import islice
from typing import TypeVar

from graspd_core.config.planning_config import (
    DOUBTED_SHARE,
    MASS_ASSUMED,
    MASS_KNOWN,
    HeldShares,
    light_end,
    share_as_light,
)
from graspd_core.errors import GraspdError
from graspd_core.hands.model import HandModel
from graspd_core.mesh.convex_parts import convex_parts
from graspd_core.perception.reconstruct.merge_views import Evidence
from graspd_core.perception.scene import COARSE_CUTS, ObjectModel, Scene, build_scene
from graspd_core.runtime.worker_process import run_isolated
from graspd_core.types import ROBUSTNESS, Grasp, StopHook, TrialResult
from graspd_core.verify.hold_trial import STOPPED, PoseError, displaced, hold_trial, out_of_place, pose_errors
from graspd_core.verify.run_clock import Run
from graspd_core.verify.trial_registry import TrialContext
from graspd_core.verify.world import Protocol, World, altered, at_friction, build_world

Item = TypeVar("Item")
Result = TypeVar("Result")

# Interval at which stop hooks and deadlines are polled while waiting for a result or a world [s].
POLL = 0.02


def begin_in_thread(name: str, work: Callable[[], Result]) -> Future[Result]:
    """Start `work` in a new thread and return its future. Before the process exits, it waits for the thread."""
    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix=name)
    begun = pool.submit(work)
    pool.shutdown(wait=False)
    return begun


def results_in_order(
    over: StopHook,
    work: Callable[[Item, StopHook], Result],
    items: Sequence[Item],
    threads: int,
    needed: Callable[[], int] = lambda: 0,
    *,
    known_over: StopHook = lambda: False,
) -> Generator[Result]:
    """Yield the result of each item in order, until `over` returns true or the caller closes the iterator.

    Then running work is told to stop: the stop hook that `work` received returns true.

    Args:
        over: function that returns true to end the iteration. Only the calling thread calls it.
        work: function of an item and a stop hook. With one thread, the calling thread runs it. Otherwise a pool does.
        items: the items to work on.
        threads: number of threads, at least 1.
        needed: returns the least number of results that the caller still needs. At least this many items are queued.
        known_over: function that returns true to stop running work. All threads call it. Not called with one thread.
    """
    if min(threads, len(items)) <= 1:
        for item in items:
            if over():
                return
            yield work(item, over)
        return
    closed = threading.Event()
    pool = ThreadPoolExecutor(max_workers=threads, thread_name_prefix="graspd-trials")
    waiting, left = deque[Future[Result]](), iter(items)
    try:
        while not over():
            # Queue at least twice as many items as threads, so that no thread is idle. Queue all needed items.
            for item in islice(left, max(2 * threads, needed()) - len(waiting)):
                waiting.append(pool.submit(work, item, lambda: closed.is_set() or known_over()))
            if not waiting:
                return
            while not wait([waiting[0]], timeout=POLL).done:
                if over():
                    closed.set()
            yield waiting.popleft().result()
    finally:
        closed.set()
        pool.shutdown(cancel_futures=True)


# The check with less friction multiplies the friction by this factor.
_LESS_FRICTION = 2 / 3
# Factor on the limit of rotation on other shapes. Grasps that fail on the true object mostly turn it a little too far.
_LESS_TURN = 2 / 3
# Number and seed of the displaced poses, equal for all grasps. No benchmark uses this seed.
_PLACES, _PLACES_SEED = 3, 0x706C616365
# Number of nodes of another shape's distance grid along an axis. The shape is guessed, so a finer grid would not help.
_RESOLUTION = 24
# Name of the threads that build other shapes.
_SHAPES = "graspd-shapes"


@dataclass(frozen=True)
class RobustnessCheck:
    """One robustness check: a variant of the scene that may be the true scene.

    Attributes:
        name: name of the variant, for messages.
        hold: function that runs a grasp's hold trial. It returns None if the variant is impossible or was stopped.
    """

    name: str
    hold: Callable[[Grasp, StopHook], TrialResult | None]


@dataclass(frozen=True)
class CheckStage:
    """Robustness checks of one kind. A grasp must pass all that are possible.

    Attributes:
        items: the checks, in the order in which they run.
        though_failed: probability that a grasp holds on the true object although it fails this stage.
    """

    items: tuple[RobustnessCheck, ...]
    though_failed: float


class LaterWorld:
    """A world (MuJoCo model of a trial) that a thread builds on the first request. None if building failed."""

    def __init__(self, make: Callable[[], World | None]):
        self._make, self._begun, self._lock = make, None, threading.Lock()

    def begin(self) -> Future[World | None]:
        """Start to build the world, unless an earlier call did so. Return the future of the world."""
        with self._lock:
            self._begun = self._begun or begin_in_thread(_SHAPES, self._make)
            return self._begun

    def altered(self, mass: float) -> LaterWorld:
        """Return the same world with another object mass [kg]. It is also built on the first request."""
        return LaterWorld(lambda: (world := self.begin().result()) and altered(world, mass=mass))


@dataclass(frozen=True)
class RobustnessChecks:
    """The robustness checks that a grasp must pass.

    Attributes:
        stages: first the checks with other shapes, because they refuse most grasps. Then the checks with less friction
            and displaced poses.
        probability: probability that a grasp holds on the true object if it passes all stages.
        waited_for: event that is set once a trial waits for its world, so that other trials may start.
        doubts: reasons to doubt the scene or the object's mass. If there is a doubt, no grasp passes.
    """

    stages: tuple[CheckStage, ...]
    probability: float
    waited_for: threading.Event = field(default_factory=threading.Event)
    doubts: tuple[str, ...] = ()


def begin_other_worlds(
    run: Run, scene: Scene, hand: HandModel, protocol: Protocol, probability: float
) -> tuple[LaterWorld, ...]:
    """Return worlds (MuJoCo models) with other possible shapes of the object. Empty if no other shape is needed.

    For each world, another rule guesses the hidden side. Threads now build the worlds. A world is None if its rule
    gives no other shape, or the run ended.
    """
    making = threading.Lock()

    def make(rule: str) -> World | None:
        with making:
            return None if run.known_over() else _other_world(scene, hand, protocol, rule)

    rules = _rules_needed(scene.evidence, probability, held_shares(scene.object))
    worlds = tuple(LaterWorld(partial(make, rule)) for rule in rules)
    for world in worlds:
        world.begin()
    return worlds


def robustness_checks_of(
    scene: Scene, others: Sequence[LaterWorld], trials: TrialContext, probability: float
) -> RobustnessChecks | None:
    """Return the checks that a grasp must pass to reach the requested `probability`. None if no check is needed.

    `others` comes from `begin_other_worlds`. If the mass is known, the grasp must also hold with less friction.
    """
    shares, doubts = held_shares(scene.object), scene.evidence.doubts if scene.evidence else ()
    if doubts:
        surest = DOUBTED_SHARE ** len(doubts)
        places = _places(scene, trials, surest * shares.fails_shapes / shares.places)
        return RobustnessChecks((places,) if probability > shares.likeliest else (), surest, doubts=doubts)
    if scene.evidence is None or probability <= shares.likeliest:
        return None
    stages = list[CheckStage]()
    # If no side was hidden, there are no other shapes to check.
    surest = shares.shapes if others or not scene.evidence.hidden else shares.places
    waited_for = threading.Event()
    if others:
        shapes = tuple(
            RobustnessCheck(f"other shape {number}", partial(_hold_in, world, trials.protocol, waited_for))
            for number, world in enumerate(others, 1)
        )
        stages.append(CheckStage(shapes, shares.fails_shapes))
    # Without other shapes, grasps that fail a displacement hold in 0.64 (mass assumed) and 0.61 (known) of cases.
    stages.append(_places(scene, trials, shares.fails_places if others else shares.fails_shapes))
    return RobustnessChecks(tuple(stages), surest, waited_for)


def _places(scene: Scene, trials: TrialContext, though_failed: float) -> CheckStage:
    """Return the checks with displaced poses of the hand and, if the mass is known, the check with less friction."""
    places = [
        RobustnessCheck(f"displaced pose {number}", partial(_hold_displaced, trials, error))
        for number, error in enumerate(pose_errors(_PLACES_SEED, _PLACES), 1)
    ]
    if scene.object.mass_assumed:
        return CheckStage(tuple(places), though_failed)
    slippery = at_friction(trials.protocol, _LESS_FRICTION * Protocol.friction[0])
    world = altered(trials.alone, friction=slippery.friction)
    work = lambda grasp, stop: hold_trial(world, grasp, slippery, stop=stop)  # noqa: E731
    # Most of the grasps that fail here fail with less friction.
    places.insert(0, RobustnessCheck(f"friction {slippery.friction[0]:.2g}", work))
    return CheckStage(tuple(places), though_failed)


def doubted_if_weak(checks: RobustnessChecks, most: float, heavy: float) -> RobustnessChecks:
    """Replace the checks by a doubt if too many objects of the same volume weigh more than the payload `most` [kg].

    `heavy` is the greatest plausible mass for the object's volume [kg]. If there are doubts already, change nothing.
    """
    if checks.doubts or most >= light_end(heavy):
        return checks
    doubt = f"the grasp lifts {most:.2g} kg, and too many objects of this volume weigh more"
    return RobustnessChecks((), MASS_ASSUMED.likeliest if checks.stages else checks.probability, doubts=(doubt,))


def less_sure(checks: RobustnessChecks, most: float, heavy: float) -> RobustnessChecks:
    """Scale all probabilities by the fraction of objects of equal volume that weigh at most the payload `most` [kg].

    First, `doubted_if_weak` may replace the checks by a doubt. `heavy` is the greatest plausible mass [kg].
    """
    checks, share = doubted_if_weak(checks, most, heavy), share_as_light(most, heavy)
    stages = tuple(replace(stage, though_failed=share * stage.though_failed) for stage in checks.stages)
    return replace(checks, stages=stages, probability=share * checks.probability)


def try_robustness(
    checks: RobustnessChecks, grasp: Grasp, stop: StopHook, threads: int = 1
) -> tuple[TrialResult, float]:
    """Run the robustness checks of a grasp, stage by stage, until one fails. `threads` run the checks of a stage.

    Return the combined result and the probability that the grasp holds on the true object. The combined result holds
    the greatest travel and rotation of all passed trials.
    """
    travel = turn = 0.0
    for stage in checks.stages:
        reason = ""
        with closing(_results(stage, grasp, stop, threads)) as results:
            for item, result in zip(stage.items, results, strict=False):
                if stop() or result is None:
                    continue
                if not result.passed:
                    reason = f"fails with {item.name}: {result.reason}"
                    break
                travel, turn = max(travel, result.displacement), max(turn, result.rotation)
        reason = STOPPED if stop() else reason
        if reason:
            return TrialResult(ROBUSTNESS, False, travel, turn, reason), stage.though_failed
    return TrialResult(ROBUSTNESS, not checks.doubts, travel, turn, *checks.doubts[:1]), checks.probability


def _results(stage: CheckStage, grasp: Grasp, stop: StopHook, threads: int) -> Generator[TrialResult | None]:
    return results_in_order(stop, lambda item, ended: item.hold(grasp, ended), stage.items, threads)


def held_shares(target: ObjectModel) -> HeldShares:
    """Return the measured fractions of grasps that hold, depending on whether the object's mass is assumed or known."""
    return MASS_ASSUMED if target.mass_assumed else MASS_KNOWN


def _rules_needed(evidence: Evidence | None, probability: float, shares: HeldShares) -> tuple[str, ...]:
    if evidence is None or evidence.doubts or probability <= shares.places:
        return ()
    from graspd_core.perception.reconstruct.hidden_side import other_rules

    return other_rules(evidence)


def _hold_in(
    other: LaterWorld, protocol: Protocol, waited_for: threading.Event, grasp: Grasp, stop: StopHook
) -> TrialResult | None:
    begun = other.begin()
    if not begun.done():
        waited_for.set()
    while not wait([begun], timeout=POLL).done:
        if stop():
            return None
    world = begun.result()
    steady = replace(out_of_place(protocol), max_rotation=_LESS_TURN * protocol.max_rotation)
    return None if world is None else hold_trial(world, grasp, steady, stop=stop)


def _hold_displaced(trials: TrialContext, error: PoseError, grasp: Grasp, stop: StopHook) -> TrialResult:
    there = displaced(grasp, *error, trials.alone.center_of_mass)
    return hold_trial(trials.alone, there, out_of_place(trials.protocol), stop=stop)


@lru_cache(maxsize=4)
def _begun(evidence: Evidence) -> dict[str, Future[Scene | None]]:
    return {}


def begin_other_shapes(probability: float, likeliest: ObjectModel, evidence: Evidence) -> None:
    """Start background threads that build the other shapes on which every grasp will be tried.

    `scene_from_views` calls this function before it builds the distance grid of the likeliest shape.
    """
    for rule in _rules_needed(evidence, probability, held_shares(likeliest)):
        work = partial(run_isolated, other_scene, evidence, rule, likeliest)
        _begun(evidence)[rule] = begin_in_thread(_SHAPES, work)


@lru_cache(maxsize=16)
def _other_world(scene: Scene, hand: HandModel, protocol: Protocol, rule: str) -> World | None:
    """Return the world of another shape with the object's mass and friction. None if the rule gives no other shape."""
    assert scene.evidence is not None
    # Remove the future. If building the shape failed, e.g. for lack of memory, the next call builds the shape again.
    begun = _begun(scene.evidence).pop(rule, None)
    other = run_isolated(other_scene, scene.evidence, rule, scene.object) if begun is None else begun.result()
    if other is None:
        return None
    # Cutting is a separate call, so that the likeliest shape can be cut before. Every grasp needs that shape first.
    parts = run_isolated(convex_parts, other.object.mesh, other.sdf, **COARSE_CUTS)
    return build_world(hand, other.object, parts, protocol)


def other_scene(evidence: Evidence, rule: str, likeliest: ObjectModel) -> Scene | None:
    """Return the scene in which `rule` guesses the hidden side, or None. Keep the mass and friction of `likeliest`."""
    from graspd_core.perception.reconstruct.hidden_side import other_shape

    mesh = other_shape(evidence, rule, likeliest.mesh)
    if mesh is None:
        return None
    named = {"source": likeliest.source, "mass": likeliest.mass, "friction": likeliest.friction}
    try:
        return build_scene(mesh, resolution=_RESOLUTION, **named)
    except GraspdError:
        return None
