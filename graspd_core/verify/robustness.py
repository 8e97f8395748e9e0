"""Robustness checks of an object that cameras saw: another place, less friction, other shapes of its hidden side.

A grasp that holds on the likeliest scene is tried on these too, until it is as sure as asked for or cannot be. Two of
the other shapes must hold it, which finds objects whose hidden side was guessed wrong. How often such grasps hold on
the true object was measured (docs/clouds.md). Trials run on several threads. `results_in_order` gives their results in
order, the same for any number of threads.
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

from graspd_core.config.planning_config import DOUBTED_SHARE, LEAST_LIGHT, MASS_ASSUMED, MASS_KNOWN, HeldShares
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
    """Begin work in a thread of its own. Only a request for its result, and the process's end, wait for it."""
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
    """Yield the result of each item, in their order, until it is over.

    Work that was begun ahead ends by its stop hook when the iterator is closed.

    Args:
        over: ends it all. Only the calling thread asks it.
        work: done by the calling thread if there is one thread, else by `threads` others.
        items: what is worked on.
        threads: at least 1.
        needed: how many more results will be asked for at least, so that none of these is begun too early.
        known_over: ends work too. All threads ask it, also while nobody asks for a result.
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
# Places that the object may be at instead, the same for all grasps. No benchmark tries them.
_PLACES, _PLACES_SEED = 3, 0x706C616365
# How many places must hold a grasp whose trials ask for more than most things weigh, and how many other shapes.
_LEAST_PLACES, LEAST_SHAPES = 2, 2
# A guessed shape is not worth a finer distance grid: nodes along an axis.
_RESOLUTION = 24
# How often the stop hook is asked while waiting for a world [s].
_POLL = 0.02
# Name of the threads that make other shapes.
_SHAPES = "graspd-shapes"

# Results of some checks in order, None for an impossible one. And a function that tries a grasp under a stage.
Results = Generator[TrialResult | None]
HoldUnder = Callable[["HypothesisStage", Grasp, StopHook], Results]


@dataclass(frozen=True)
class Hypothesis:
    """One robustness check: another possible state of the scene.

    Attributes:
        name: what it is, for people.
        hold: the hold trial of a grasp in that state, None if it is impossible or the hook says to stop.
    """

    name: str
    hold: Callable[[Grasp, StopHook], TrialResult | None]


@dataclass(frozen=True)
class HypothesisStage:
    """Robustness checks of one kind.

    Attributes:
        items: in the order in which they are tried.
        least: how many of them must hold a grasp, all of them if there are fewer.
        though_failed: probability that a grasp which fails here holds on the true object.
    """

    items: tuple[Hypothesis, ...]
    least: int
    though_failed: float


class LaterWorld:
    """A world that a thread makes on the first request and that is then kept. None if there is no such world."""

    def __init__(self, make: Callable[[], World | None]):
        self._make, self._begun, self._asked = make, None, threading.Lock()

    def begin(self) -> Future[World | None]:
        """Begin to make it, if that is not begun."""
        with self._asked:
            self._begun = self._begun or begin_in_thread(_SHAPES, self._make)
            return self._begun

    def altered(self, mass: float) -> LaterWorld:
        """Return the world with an object of another mass [kg]."""
        return LaterWorld(lambda: (world := self.begin().result()) and altered(world, mass=mass))


@dataclass(frozen=True)
class Hypotheses:
    """The robustness checks that a grasp must pass.

    Attributes:
        stages: places, which are cheap to try, then other shapes.
        probability: that a grasp which holds under all of them holds on the true object.
        waited_for: set once a trial waits for its world: there is time for other work.
        doubts: what speaks against the scene or its mass. No grasp is tried under anything else then, and none passes.
    """

    stages: tuple[HypothesisStage, ...]
    probability: float
    waited_for: threading.Event = field(default_factory=threading.Event)
    doubts: tuple[str, ...] = ()


def begin_other_worlds(
    run: Run, scene: Scene, hand: HandModel, protocol: Protocol, probability: float
) -> tuple[LaterWorld, ...]:
    """Return the worlds of other shapes of the object, none if grasps need not be tried in one.

    Those that every grasp is tried in are begun, one at a time. A world is None if there is no such shape, or if the
    run was over before.
    """
    making = threading.Lock()

    def make(rule: str) -> World | None:
        with making:
            return None if run.known_over() else _other_world(scene, hand, protocol, rule)

    rules = _rules_needed(scene.evidence, probability, held_shares(scene.object))
    worlds = tuple(LaterWorld(partial(make, rule)) for rule in rules)
    for world in worlds[:LEAST_SHAPES]:
        world.begin()
    return worlds


def hypotheses_of(
    scene: Scene, others: Sequence[LaterWorld], trials: TrialContext, probability: float
) -> Hypotheses | None:
    """Return the checks that a grasp must pass to be as sure as asked for, None for none.

    `others` comes from `begin_other_worlds`. With a known mass, a grasp must hold in all places, and with less
    friction.
    """
    shares = held_shares(scene.object)
    if scene.evidence is not None and scene.evidence.doubts:
        return Hypotheses((), DOUBTED_SHARE, doubts=scene.evidence.doubts)
    if scene.evidence is None or probability <= shares.likeliest:
        return None
    places = [
        Hypothesis(f"place {number}", partial(_hold_displaced, trials, error))
        for number, error in enumerate(pose_errors(_PLACES_SEED, _PLACES), 1)
    ]
    least = _LEAST_PLACES
    if not scene.object.mass_assumed:
        slippery = at_friction(trials.protocol, _LESS_FRICTION * Protocol.friction[0])
        world = altered(trials.alone, friction=slippery.friction)
        work = lambda grasp, stop: hold_trial(world, grasp, slippery, stop=stop)  # noqa: E731
        places.append(Hypothesis(f"friction {slippery.friction[0]:.2g}", work))
        least = len(places)
    stages = [HypothesisStage(tuple(places), least, shares.fails_places)]
    # Where nothing was hidden no more can be doubted.
    surest = shares.shapes if others or not scene.evidence.hidden else shares.places
    waited_for = threading.Event()
    if others:
        shapes = tuple(
            Hypothesis(f"other shape {number}", partial(_hold_in, world, trials.protocol, waited_for))
            for number, world in enumerate(others, 1)
        )
        stages.append(HypothesisStage(shapes, LEAST_SHAPES, shares.fails_shapes))
    return Hypotheses(tuple(stages), surest, waited_for)


def less_sure(hypotheses: Hypotheses, share: float, most: float) -> Hypotheses:
    """Return the checks of an object that weighs at most the payload `most` [kg] with the probability `share`."""
    if share < LEAST_LIGHT:
        told = f"the hand lifts {most:.2g} kg, and most objects of this volume weigh more"
        return Hypotheses((), share * MASS_KNOWN.likeliest, doubts=(told,))
    stages = tuple(replace(stage, though_failed=share * stage.though_failed) for stage in hypotheses.stages)
    return replace(hypotheses, stages=stages, probability=share * hypotheses.probability)


def one_by_one(stage: HypothesisStage, grasp: Grasp, stop: StopHook) -> Results:
    """Yield the trials of a grasp under each check, none begun before its result is asked for."""
    for item in stage.items:
        yield item.hold(grasp, stop)


def try_hypotheses(
    hypotheses: Hypotheses,
    grasp: Grasp,
    stop: StopHook,
    hold_under: HoldUnder = one_by_one,
) -> tuple[TrialResult, float]:
    """Try a grasp under each check in turn, until enough hold or too many fail.

    Returns result and probability. The result holds the greatest travel and turn of the passed trials. `hold_under` is
    given a stage at a time.
    """
    travel = turn = 0.0
    if hypotheses.doubts:
        return TrialResult(HYPOTHESES, False, travel, turn, hypotheses.doubts[0]), hypotheses.probability
    for stage in hypotheses.stages:
        held, reasons = 0, []
        with closing(hold_under(stage, grasp, stop)) as results:
            for item, result in zip(stage.items, results, strict=False):
                if stop() or result is None:
                    continue
                if result.passed:
                    held += 1
                    travel, turn = max(travel, result.displacement), max(turn, result.rotation)
                else:
                    reasons.append(f"fails under {item.name}: {result.reason}")
                if held == stage.least or len(reasons) > len(stage.items) - stage.least:
                    break
        if stop():
            return TrialResult(HYPOTHESES, False, travel, turn, STOPPED), stage.though_failed
        if held < min(stage.least, held + len(reasons)):
            return TrialResult(HYPOTHESES, False, travel, turn, reasons[0]), stage.though_failed
    return TrialResult(HYPOTHESES, True, travel, turn, ""), hypotheses.probability


def held_shares(target: ObjectModel) -> HeldShares:
    """Return the probabilities of grasps of an object that hold under robustness checks."""
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
    while not wait([begun], timeout=_POLL).done:
        if stop():
            return None
    world = begun.result()
    return None if world is None else hold_trial(world, grasp, out_of_place(protocol), stop=stop)


def _hold_displaced(trials: TrialContext, error: PoseError, grasp: Grasp, stop: StopHook) -> TrialResult:
    there = displaced(grasp, *error, trials.alone.center_of_mass)
    return hold_trial(trials.alone, there, out_of_place(trials.protocol), stop=stop)


@lru_cache(maxsize=4)
def _begun(evidence: Evidence) -> dict[str, Future[Scene | None]]:
    return {}


def begin_other_shapes(probability: float, likeliest: ObjectModel, evidence: Evidence) -> None:
    """Begin the other shapes that all grasps of a scene to come will be tried on, if any, in other threads.

    `scene_from_views` calls this, so that they are made while the distance grid of the likeliest shape is built.
    """
    for rule in _rules_needed(evidence, probability, held_shares(likeliest))[:LEAST_SHAPES]:
        work = partial(run_isolated, other_scene, evidence, rule, likeliest)
        _begun(evidence)[rule] = begin_in_thread(_SHAPES, work)


@lru_cache(maxsize=16)
def _other_world(scene: Scene, hand: HandModel, protocol: Protocol, rule: str) -> World | None:
    """Return the world of another shape of the object's own mass and friction, None if there is no such shape."""
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
    """Return an object of the same mass and friction whose hidden side is guessed by a rule, None for no guess."""
    from graspd_core.perception.reconstruct.hidden_side import other_shape

    mesh = other_shape(evidence, rule, likeliest.mesh)
    if mesh is None:
        return None
    named = {"source": likeliest.source, "mass": likeliest.mass, "friction": likeliest.friction}
    try:
        return build_scene(mesh, resolution=_RESOLUTION, **named)
    except GraspdError:
        return None
