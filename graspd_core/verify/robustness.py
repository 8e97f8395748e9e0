"""What else may be true of an object that cameras saw: less friction, another place, another shape of a hidden side.

A grasp that holds on the likeliest scene is tried on these too, cheapest first, until one is failed or it is as sure as
asked for. How often such grasps hold on the true object was measured (docs/clouds.md). Trials run on several threads,
and `results_in_order` gives their results in order, the same for any number of threads.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import islice
from typing import TypeVar

from graspd_core.config.planning_config import HELD, HELD_THOUGH_FAILED
from graspd_core.errors import GraspdError
from graspd_core.hands.model import HandModel
from graspd_core.mesh.convex_parts import convex_parts
from graspd_core.perception.reconstruct.merge_views import Evidence
from graspd_core.perception.scene import COARSE_CUTS, ObjectModel, Scene, build_scene
from graspd_core.runtime.worker_process import run_isolated
from graspd_core.types import HYPOTHESES, Grasp, StopHook, TrialResult
from graspd_core.verify.hold_trial import STOPPED, PoseError, displaced, hold_trial, out_of_place, pose_errors
from graspd_core.verify.run_clock import Run
from graspd_core.verify.trial_registry import TrialContext
from graspd_core.verify.world import Protocol, World, altered, at_friction, build_world

Item = TypeVar("Item")
Result = TypeVar("Result")

# How often the stop hook is asked while waiting for a result [s].
_POLL_RESULTS = 0.02


def begin_in_thread(name: str, work: Callable[[], Result]) -> Future[Result]:
    """Begin work in a thread that only who asks for its result, and the process's end, waits for."""
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
    """The result of each item, in their order, until it is over.

    Work that is begun ahead and not asked for any more ends by its stop hook when the iterator is closed.

    Args:
        over: ends it all; asked by the calling thread alone.
        work: done by the calling thread where there is one thread, else by so many others.
        items: what is worked on.
        threads: at least 1.
        needed: how many more results will be asked for at least, so that none of these is begun too early.
        known_over: ends work too; asked by all threads, also while nobody asks for a result.
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
            # As many again as are worked on, and all that are needed: no thread waits for the first in line.
            for item in islice(left, max(2 * threads, needed()) - len(waiting)):
                waiting.append(pool.submit(work, item, lambda: closed.is_set() or known_over()))
            if not waiting:
                return
            while not wait([waiting[0]], timeout=_POLL_RESULTS).done:
                if over():
                    closed.set()
            yield waiting.popleft().result()
    finally:
        closed.set()
        pool.shutdown(cancel_futures=True)


# Of the friction that the scene says.
_LESS_FRICTION = 2 / 3
# Places that the object may be at instead, the same for all grasps; never those that a benchmark tries.
_PLACES, _PLACES_SEED = 3, 0x706C616365
# A guessed shape is not worth a finer distance grid: nodes along an axis.
_RESOLUTION = 24
# How often the stop hook is asked while waiting for a world [s].
_POLL = 0.02
# Name of the threads that make other shapes.
_SHAPES = "graspd-shapes"

# Of trials under some hypotheses, in their order; None where there was none. And how a grasp goes through them.
Results = Generator[TrialResult | None]
HoldUnder = Callable[[Sequence["Hypothesis"], Grasp, StopHook], Results]


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
    """What else a grasp must hold under.

    Attributes:
        stages: place and friction, which are cheap to try, then another shape.
        probability: that a grasp which holds under all of them holds on the true object.
        waited_for: set once a trial waits for its world: there is time for other work.
    """

    stages: tuple[tuple[Hypothesis, ...], ...]
    probability: float
    waited_for: threading.Event = field(default_factory=threading.Event)


def begin_other_world(
    run: Run, scene: Scene, hand: HandModel, protocol: Protocol, probability: float
) -> Future[World | None] | None:
    """Begin the world of another shape of the object, in a thread; None where grasps need not be tried in one.

    Its result is None where there is no other shape, or the run was over before.
    """
    rules = _rules_needed(scene.evidence, probability)

    def make() -> World | None:
        for rule in rules:
            if run.known_over():
                break
            if (world := _other_world(scene, hand, protocol, rule)) is not None:
                return world
        return None

    return begin_in_thread(_SHAPES, make) if rules else None


def hypotheses_of(
    scene: Scene, other: Future[World | None] | None, trials: TrialContext, probability: float
) -> Hypotheses | None:
    """All that a grasp must hold under to be as sure as asked for, `other` from `begin_other_world`; None: nothing."""
    if scene.evidence is None or probability <= HELD[0]:
        return None
    places = [
        Hypothesis(f"place {number}", partial(_hold_displaced, trials, error))
        for number, error in enumerate(pose_errors(_PLACES_SEED, _PLACES), 1)
    ]
    slippery = at_friction(trials.protocol, _LESS_FRICTION * Protocol.friction[0])
    world = altered(trials.alone, friction=slippery.friction)
    less = Hypothesis(
        f"friction {slippery.friction[0]:.2g}", lambda grasp, stop: hold_trial(world, grasp, slippery, stop=stop)
    )
    if other is None:
        # Where nothing was hidden no more can be doubted.
        return Hypotheses(((*places, less),), HELD[1] if scene.evidence.hidden else HELD[-1])
    waited_for = threading.Event()
    shape = Hypothesis("another shape of the hidden side", partial(_hold_in, other, trials.protocol, waited_for))
    return Hypotheses(((*places, less), (shape,)), HELD[-1], waited_for)


def one_by_one(items: Sequence[Hypothesis], grasp: Grasp, stop: StopHook) -> Results:
    """The trials of a grasp under each, none begun before its result is asked for."""
    for item in items:
        yield item.hold(grasp, stop)


def try_hypotheses(
    hypotheses: Hypotheses,
    grasp: Grasp,
    stop: StopHook,
    hold_under: HoldUnder = one_by_one,
) -> tuple[TrialResult, float]:
    """Hold trials of a grasp under each in turn, until one is failed; and how likely it is to hold in truth.

    The result tells the greatest travel and turn of the trials that were passed. `hold_under` is given a stage at a
    time.
    """
    travel = turn = 0.0
    for items, though_failed in zip(hypotheses.stages, HELD_THOUGH_FAILED[: len(hypotheses.stages)], strict=True):
        with closing(hold_under(items, grasp, stop)) as results:
            for item, result in zip(items, results, strict=False):
                if stop() or result is None:
                    continue
                if not result.passed:
                    reason = f"fails under {item.name}: {result.reason}"
                    return TrialResult(HYPOTHESES, False, travel, turn, reason), though_failed
                travel, turn = max(travel, result.displacement), max(turn, result.rotation)
        if stop():
            return TrialResult(HYPOTHESES, False, travel, turn, STOPPED), though_failed
    return TrialResult(HYPOTHESES, True, travel, turn, ""), hypotheses.probability


def _rules_needed(evidence: Evidence | None, probability: float) -> tuple[str, ...]:
    if evidence is None or probability <= HELD[1]:
        return ()
    from graspd_core.perception.reconstruct.hidden_side import other_rules

    return other_rules(evidence)


def _hold_in(
    other: Future[World | None], protocol: Protocol, waited_for: threading.Event, grasp: Grasp, stop: StopHook
) -> TrialResult | None:
    if not other.done():
        waited_for.set()
    while not wait([other], timeout=_POLL).done:
        if stop():
            return None
    world = other.result()
    return None if world is None else hold_trial(world, grasp, out_of_place(protocol), stop=stop)


def _hold_displaced(trials: TrialContext, error: PoseError, grasp: Grasp, stop: StopHook) -> TrialResult:
    there = displaced(grasp, *error, trials.alone.center_of_mass)
    return hold_trial(trials.alone, there, out_of_place(trials.protocol), stop=stop)


@lru_cache(maxsize=4)
def _begun(evidence: Evidence) -> dict[str, Future[Scene | None]]:
    return {}


def begin_other_shape(probability: float, likeliest: ObjectModel, evidence: Evidence) -> None:
    """Begin the other shape that grasps of a scene to come will be tried on, if any, in a thread beside.

    For `scene_from_views`: it is made while the distance grid of the likeliest shape is built.
    """
    for rule in _rules_needed(evidence, probability)[:1]:
        work = partial(run_isolated, other_scene, evidence, rule, likeliest)
        _begun(evidence)[rule] = begin_in_thread(_SHAPES, work)


@lru_cache(maxsize=4)
def _other_world(scene: Scene, hand: HandModel, protocol: Protocol, rule: str) -> World | None:
    """The world of another shape of the object's own mass and friction; None where there is no such shape."""
    assert scene.evidence is not None
    # Taken out: if making it failed, as where memory was short, it is made again the next time.
    begun = _begun(scene.evidence).pop(rule, None)
    other = run_isolated(other_scene, scene.evidence, rule, scene.object) if begun is None else begun.result()
    if other is None:
        return None
    # A call of its own: the likeliest shape, which every grasp is tried on first, may be cut before.
    parts = run_isolated(convex_parts, other.object.mesh, other.sdf, **COARSE_CUTS)
    return build_world(hand, other.object, parts, protocol)


def other_scene(evidence: Evidence, rule: str, likeliest: ObjectModel) -> Scene | None:
    """An object of the same mass and friction whose hidden side is guessed by a rule; None where there is none."""
    from graspd_core.perception.reconstruct.hidden_side import other_shape

    mesh = other_shape(evidence, rule, likeliest.mesh)
    if mesh is None:
        return None
    named = {"source": likeliest.source, "mass": likeliest.mass, "friction": likeliest.friction}
    try:
        return build_scene(mesh, resolution=_RESOLUTION, **named)
    except GraspdError:
        return None
