"""What else may be true of an object that cameras saw: less friction, another place, another shape of a hidden side.

A grasp that holds on the likeliest scene is tried on these too, cheapest first. How often grasps that held under so
many hold on the true object was measured (docs/clouds.md).
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import closing
from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

from graspd_core.config.certainty_config import HELD_AFTER
from graspd_core.errors import GraspdError
from graspd_core.hands.model import HandModel
from graspd_core.mesh.convex_parts import convex_parts
from graspd_core.planning.run_clock import Run
from graspd_core.reconstruction.evidence import Evidence
from graspd_core.runtime.worker_process import run_isolated
from graspd_core.scene.scene import COARSE_CUTS, ObjectModel, Scene, build_scene
from graspd_core.trials.hold_trial import STOPPED, hold_trial
from graspd_core.trials.noisy_trial import PoseError, displaced, pose_errors
from graspd_core.trials.trial_registry import TrialContext
from graspd_core.trials.world import Protocol, World, at_friction, build_world
from graspd_core.types import HYPOTHESES, Grasp, StopHook, TrialResult, TriangleMesh

# Of the friction that the scene says.
_LESS_FRICTION = 2 / 3
# Places that the object may be at instead, the same for all grasps; never those that a benchmark tries.
_PLACES, _PLACES_SEED = 3, 0x706C616365
# A guessed shape is not worth a finer distance grid: nodes along an axis.
_RESOLUTION = 24
# How often the stop hook is asked while waiting for a world [s].
_POLL = 0.02

# Of trials under some hypotheses, in their order; None where there was none. And how a grasp goes through them.
Results = Generator[TrialResult | None]
HoldUnder = Callable[[Sequence["Hypothesis"], Grasp, StopHook], Results]

# An object of another shape and its convex parts.
OtherObject = tuple[ObjectModel, tuple[TriangleMesh, ...]]


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
    """All that else may be true.

    Attributes:
        items: in the order in which grasps are tried under them.
        allowed: under how many of them a verified grasp may fail.
        failed: called with how many a grasp has failed under, while it may still be verified: it needs others to hold
            under in their place, which can be begun.
        waited_for: set once a trial waits for its world: there is time for other work.
    """

    items: tuple[Hypothesis, ...]
    allowed: int
    failed: Callable[[int], None] = lambda count: None
    waited_for: threading.Event = field(default_factory=threading.Event)


class OtherWorlds:
    """The worlds of other shapes of the object, made one after another by a thread.

    As many are begun at once as a grasp that holds under all else must be tried in, one more for each that it fails
    under, or that cannot be made, and others when they are asked for.
    """

    def __init__(self, run: Run, scene: Scene, hand: HandModel, protocol: Protocol, rules: Sequence[str], begun: int):
        self.rules, self.protocol = rules, protocol
        self._run, self._lock = run, threading.Lock()
        self._make_world = lambda rule: _other_world(scene, hand, protocol, rule)
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="graspd-shapes")
        self._made: list[Future[World | None]] = []
        self.waited_for = threading.Event()
        self._least = begun
        self._begin(begun)

    def world(self, index: int, stop: StopHook) -> World | None:
        """One of them; None where it cannot be made, or the hook says to stop."""
        self._begin(index + 1)
        if not self._made[index].done():
            self.waited_for.set()
        while not wait([self._made[index]], timeout=_POLL).done:
            if stop():
                return None
        return self._made[index].result()

    def begin_after(self, failed: int) -> None:
        """Begin those that a grasp must be tried in that failed under so many hypotheses."""
        if self._least:
            self._begin(self._least + failed)

    def _begin(self, count: int) -> None:
        with self._lock:
            for rule in self.rules[len(self._made) : count]:
                self._made.append(self._pool.submit(self._make, rule))

    def _make(self, rule: str) -> World | None:
        if self._run.known_over():
            return None
        made = self._make_world(rule)
        if made is None:
            self._begin(len(self._made) + 1)
        return made


def other_worlds(run: Run, scene: Scene, hand: HandModel, protocol: Protocol, probability: float) -> OtherWorlds | None:
    """Those that grasps must be tried in to be as sure as asked for; None where none is needed."""
    allowed = _allowed_failures(probability)
    if scene.evidence is None or allowed + 1 == len(HELD_AFTER):
        return None
    from graspd_core.reconstruction.other_shapes import other_rules

    rules = other_rules(scene.evidence)
    return OtherWorlds(run, scene, hand, protocol, rules, max(len(rules) - allowed, 0))


def hypotheses_of(others: OtherWorlds, trials: TrialContext, probability: float) -> Hypotheses:
    """All that a grasp is tried under, cheapest first."""
    places = [
        Hypothesis(f"place {number}", partial(_hold_displaced, trials, error))
        for number, error in enumerate(pose_errors(_PLACES_SEED, _PLACES), 1)
    ]
    slippery = at_friction(trials.protocol, _LESS_FRICTION * Protocol.friction[0])
    world = _with_friction(trials.alone, slippery.friction)
    less = Hypothesis(
        f"friction {slippery.friction[0]:.2g}", lambda grasp, stop: hold_trial(world, grasp, slippery, stop=stop)
    )
    shapes = [
        Hypothesis(f"hidden side by {rule}" if rule else "hidden side closed smoothly", partial(_hold_in, others, k))
        for k, rule in enumerate(others.rules)
    ]
    return Hypotheses((*places, less, *shapes), _allowed_failures(probability), others.begin_after, others.waited_for)


def _allowed_failures(probability: float) -> int:
    return sum(held >= probability for held in HELD_AFTER) - 1


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
    """Hold trials of a grasp under each in turn, until the answer is known; and how likely it is to hold in truth.

    A trial that was not needed counts as failed for that probability. The result tells the greatest travel and turn of
    the trials that were passed. `hold_under` is given all that the grasp has to be tried under if it is to be verified.
    """
    worst, failed, tried, left = [0.0, 0.0], [], 0, len(hypotheses.items)
    while len(failed) <= hypotheses.allowed < len(failed) + left:
        first = len(hypotheses.items) - left
        needed = hypotheses.items[first : first + len(failed) + left - hypotheses.allowed]
        with closing(hold_under(needed, grasp, stop)) as results:
            for item, result in zip(needed, results, strict=False):
                if stop():
                    break
                left -= 1
                if result is None:
                    continue
                tried += 1
                if result.passed:
                    worst = [max(worst[0], result.displacement), max(worst[1], result.rotation)]
                    continue
                failed.append(f"{item.name}: {result.reason}")
                if len(failed) > hypotheses.allowed:
                    break
                hypotheses.failed(len(failed))
        if stop():
            return TrialResult(HYPOTHESES, False, worst[0], worst[1], STOPPED), HELD_AFTER[-1]
    passed = len(failed) <= hypotheses.allowed
    reason = "" if passed else f"fails under {len(failed)} of the {tried} hypotheses tried ({'; '.join(failed)})"
    worst_case = min(len(failed) + left if passed else len(HELD_AFTER), len(HELD_AFTER) - 1)
    return TrialResult(HYPOTHESES, passed, worst[0], worst[1], reason), HELD_AFTER[worst_case]


def _hold_in(worlds: OtherWorlds, index: int, grasp: Grasp, stop: StopHook) -> TrialResult | None:
    world = worlds.world(index, stop)
    return None if world is None else hold_trial(world, grasp, worlds.protocol, stop=stop)


def _with_friction(world: World, friction: tuple[float, float, float]) -> World:
    """The same world with other coefficients of friction, without building it anew."""
    model = copy(world.model)
    model.geom_friction[:] = friction
    return replace(world, model=model, spare=deque())


def _hold_displaced(trials: TrialContext, error: PoseError, grasp: Grasp, stop: StopHook) -> TrialResult:
    center = trials.alone.center_of_mass + trials.alone.origin
    return hold_trial(trials.alone, displaced(grasp, *error, center), trials.protocol, stop=stop)


@lru_cache(maxsize=4)
def _begun(evidence: Evidence) -> dict[str, Future[OtherObject | None]]:
    """Objects of other shapes that `begin_other_shape` has begun, by their rules."""
    return {}


def begin_other_shape(probability: float, likeliest: ObjectModel, evidence: Evidence) -> None:
    """Begin the first other shape that grasps of a scene to come will be tried on, if any, in a thread beside.

    For `scene_from_views`: it is made while the distance grid of the likeliest shape is built.
    """
    from graspd_core.reconstruction.other_shapes import other_rules

    rules, allowed = other_rules(evidence), _allowed_failures(probability)
    if allowed + 1 < len(HELD_AFTER) and len(rules) > allowed:
        pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="graspd-shapes")
        _begun(evidence)[rules[0]] = pool.submit(run_isolated, other_object, evidence, rules[0], likeliest)
        pool.shutdown(wait=False)


@lru_cache(maxsize=16)
def _other_world(scene: Scene, hand: HandModel, protocol: Protocol, rule: str) -> World | None:
    """The world of another shape of the object's own mass and friction; None where there is no such shape."""
    assert scene.evidence is not None
    # Taken out: if making it failed, as where memory was short, it is made again the next time.
    begun = _begun(scene.evidence).pop(rule, None)
    made = run_isolated(other_object, scene.evidence, rule, scene.object) if begun is None else begun.result()
    return None if made is None else build_world(hand, *made, protocol)


def other_object(evidence: Evidence, rule: str, likeliest: ObjectModel) -> OtherObject | None:
    """An object of the same mass and friction whose hidden side is guessed by a rule, and its convex parts.

    None where there is no such shape.
    """
    from graspd_core.reconstruction.other_shapes import other_shape

    mesh = other_shape(evidence, rule, likeliest.mesh)
    if mesh is None:
        return None
    named = {"source": likeliest.source, "mass": likeliest.mass, "friction": likeliest.friction}
    try:
        scene = build_scene(mesh, resolution=_RESOLUTION, **named)
    except GraspdError:
        return None
    return scene.object, convex_parts(scene.object.mesh, scene.sdf, **COARSE_CUTS)
