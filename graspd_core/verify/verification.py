"""Try grasps in MuJoCo: build the models (worlds) once, try candidates in rank order, sort the verified grasps.

`verify_grasps` tries and measures given grasps, for example from another planner or from a file.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import chain, repeat

import numpy as np
import torch

from graspd_core.config import VERIFICATIONS, CertaintyConfig, RobustConfig
from graspd_core.config.planning_config import MASS_ASSUMED, light_end
from graspd_core.errors import ConfigError, short_repr
from graspd_core.hands.model import HandModel
from graspd_core.perception.scene import Scene, moved_grasp, near_scene, object_parts
from graspd_core.types import Grasp, GraspMetrics, Snapshot, Stage, StopHook, Verdict, stacked
from graspd_core.verify import metrics
from graspd_core.verify.hold_trial import noisy_share, pose_errors
from graspd_core.verify.limits import FINENESS, LEAST_PAYLOAD, least_friction, payload
from graspd_core.verify.metrics import measure
from graspd_core.verify.prepared_grasp import MetricsContext, make_metrics_context
from graspd_core.verify.robustness import (
    POLL,
    LaterWorld,
    RobustnessChecks,
    begin_in_thread,
    begin_other_worlds,
    doubted_if_weak,
    less_sure,
    results_in_order,
    robustness_checks_of,
    try_robustness,
)
from graspd_core.verify.run_clock import Run
from graspd_core.verify.trial_registry import TrialContext, build_worlds, grasp_trials
from graspd_core.verify.world import PROTOCOLS, altered, at_friction

# Only one object at a time is cut into convex parts.
_CUTTING = threading.Lock()
# Sorting uses this robustness for verified grasps whose robustness was not measured.
_UNKNOWN = 0.5

# First part of the seed of the pose errors in `rank_by_robustness`. No other pose errors have this seed.
_NOISE = 0x6E6F697365


@dataclass(frozen=True)
class VerificationContext:
    """Worlds, metrics and robustness checks of a run.

    Attributes:
        trials: worlds and physics settings of the trials.
        metrics: function that returns the context for measuring metrics. None if metrics are not measured.
        checks: robustness checks. None if grasps need no such check.
        friction: whether to measure the least friction.
        heavy: the assumed mass [kg], if the trials use a lower mass. None otherwise.
    """

    trials: TrialContext
    metrics: Callable[[], MetricsContext] | None
    checks: RobustnessChecks | None = None
    friction: bool = False
    heavy: float | None = None

    @property
    def mass(self) -> float:
        """Object mass in the trials [kg]."""
        return float(self.trials.alone.model.body_mass[self.trials.alone.object_body])


@dataclass(frozen=True)
class Prefetched:
    """Worlds of the trials, which background threads build while the optimiser runs.

    Attributes:
        worlds: future of the worlds of the likeliest scene. The result is None if the run ended before they were built.
        others: worlds with other possible shapes of the object. Empty if grasps are not tried on other shapes.
    """

    worlds: Future[TrialContext | None]
    others: tuple[LaterWorld, ...]


def prefetch(run: Run, scene: Scene, hand: HandModel, verify: str, certainty: CertaintyConfig) -> Prefetched:
    """Start to build the trial worlds in background threads. Building takes about as long as the optimiser.

    Only one object at a time is cut into convex parts. Objects of ended runs are skipped, so that no work piles up.
    """

    def build() -> TrialContext | None:
        with _CUTTING:
            return None if run.known_over() else trial_context(scene, hand, verify)

    worlds = begin_in_thread("graspd-parts", build)
    protocol = at_friction(PROTOCOLS[verify], scene.object.friction)
    return Prefetched(worlds, begin_other_worlds(run, scene, hand, protocol, certainty.probability))


def make_trial_context(
    run: Run,
    scene: Scene,
    hand: HandModel,
    prefetched: Prefetched,
    certainty: CertaintyConfig,
    *,
    measure: bool,
    friction: bool = False,
) -> VerificationContext | None:
    """Wait for the worlds and return the context of the trials. Return None if the run ends first."""
    while not run.over() and not wait([prefetched.worlds], timeout=POLL).done:
        pass
    if run.over() or (worlds := prefetched.worlds.result()) is None:
        return None
    make = lambda: replace(_metrics_context(scene, hand), world=worlds.alone)  # noqa: E731
    context = VerificationContext(worlds, make if measure else None, friction=friction)
    seen = scene.evidence
    if seen is not None and scene.object.mass_assumed and not (seen.doubts or seen.piled):
        # Few grasps of a guessed shape hold the assumed mass, and few objects weigh as much. In a doubted scene, no
        # other shape sorts out weak grasps. In a pile, objects lie on each other. There the assumed mass is a margin.
        heavy = scene.object.mass
        return lighter(scene, prefetched, context, certainty, light_end(heavy), heavy)
    checks = robustness_checks_of(scene, prefetched.others, worlds, certainty.probability)
    return replace(context, checks=checks)


def lighter(
    scene: Scene, ahead: Prefetched, context: VerificationContext, certainty: CertaintyConfig, mass: float, most: float
) -> VerificationContext:
    """Return the context for trials at `mass` [kg], which is below the assumed mass.

    A grasp then gets a lower probability, because the object may weigh more than the grasp can lift. `most` is the
    greatest payload of any grasp [kg]. If `most` is too low for any grasp to be verified, no robustness check runs.
    """
    trials, others = context.trials, [world.altered(mass) for world in ahead.others]
    for world in others:
        world.begin()
    around = trials.around and altered(trials.around, mass=mass)
    trials = replace(trials, alone=altered(trials.alone, mass=mass), around=around)
    # Without checks, the probability is the measured fraction for the likeliest shape.
    bare = RobustnessChecks((), 1.0 if scene.evidence is None else MASS_ASSUMED.likeliest)
    checks = robustness_checks_of(scene, others, trials, certainty.probability) or bare
    heavy = scene.object.mass
    return replace(context, trials=trials, checks=doubted_if_weak(checks, most, heavy), heavy=heavy)


def payloads(context: VerificationContext, grasps: Sequence[Grasp], stop: StopHook) -> list[float]:
    """Return each grasp's payload [kg], or 0 if it is not at least 10 % above the payloads of all preceding grasps."""
    trials, found = context.trials, list[float]()
    for grasp in grasps:
        least = FINENESS * max(found, default=LEAST_PAYLOAD)
        found.append(payload(trials.alone, grasp, trials.protocol, least=max(least, LEAST_PAYLOAD), stop=stop))
    return found


# The cache keeps the last four pairs of scene and hand. Scenes and hands are hashed by identity.
@lru_cache(maxsize=4)
def trial_context(scene: Scene, hand: HandModel, verify: str) -> TrialContext:
    """Build the worlds of the `verify` trials at the object's friction, for a scene near the origin (`near_scene`)."""
    protocol = at_friction(PROTOCOLS[verify], scene.object.friction)
    return build_worlds(scene, hand, object_parts(scene.object), protocol)


@lru_cache(maxsize=4)
def _metrics_context(scene: Scene, hand: HandModel) -> MetricsContext:
    return make_metrics_context(scene.object, hand)


def measured(scene: Scene, hand: HandModel, candidates: tuple[Grasp, ...]) -> tuple[Grasp, ...]:
    """Return the candidates with their metrics, without trials."""
    postures = [grasp.grasp for grasp in candidates]
    with ThreadPoolExecutor(torch.get_num_threads(), thread_name_prefix="graspd-metrics") as pool:
        metrics = list(pool.map(partial(measure, _metrics_context(scene, hand)), postures))
    return tuple(replace(grasp, metrics=one) for grasp, one in zip(candidates, metrics, strict=True))


def _measured(trials: TrialContext, context: MetricsContext, friction: bool, grasp: Grasp) -> GraspMetrics:
    """Measure a grasp that passed its trials: metrics, payload and, if `friction` is set, least friction."""
    world = trials.alone
    mass = float(world.model.body_mass[world.object_body])
    most = payload(world, grasp, trials.protocol, least=mass, held=True)
    found = {**measure(context, grasp.grasp), "payload": most}
    if friction:
        found["least_friction"] = least_friction(trials.alone, grasp, trials.protocol)
    return GraspMetrics(found)


@dataclass(frozen=True)
class TriedGrasps:
    """Candidates with their trial results.

    Attributes:
        grasps: the tried grasps, verified grasps first.
        first: time at which the first grasp was verified, a `time.perf_counter()` value. None if none was verified.
    """

    grasps: tuple[Grasp, ...] = ()
    first: float | None = None


def run_trials(
    run: Run, context: VerificationContext, candidates: tuple[Grasp, ...], count: int, before: int
) -> TriedGrasps:
    """Try candidates in rank order until `count` are verified, and measure each verified grasp.

    `before` is the number of grasps that earlier rounds verified. As many trials run in parallel as torch has threads.
    This number changes neither verdicts nor order. Grasps are measured in parallel with the next trials.
    """
    verified: list[Grasp] = []
    others: list[Grasp] = []
    metrics: list[Future[GraspMetrics]] = []
    threads, doubted = torch.get_num_threads(), 0
    # If there is a doubt, no grasp can be verified. Then `count` grasps whose only fault is the doubt are enough.
    doubts = context.checks.doubts[:1] if context.checks is not None else ()
    first = None
    seen = None
    if run.watch is not None:
        seen = Snapshot(*stacked([one.grasp for one in candidates]), (Verdict.UNVERIFIED,) * len(candidates))
    # The first answer comes sooner if the best candidate runs several robustness checks in parallel.
    alone = context.checks is not None and not before
    # No trial gives more than one verified grasp.
    trials = _tried(run, context, candidates, alone, lambda: count - len(verified))
    with closing(trials), ThreadPoolExecutor(threads, thread_name_prefix="graspd-metrics") as pool:
        for index, tried in enumerate(trials):
            passed = tried.verdict is Verdict.VERIFIED
            if run.over() and not passed:
                # An interrupted trial says nothing about the grasp.
                break
            first = first or (time.perf_counter() if passed else None)
            found = tried if passed else None
            run.report(Stage.VERIFY, index + 1, len(candidates), 0.0, before + len(verified) + passed, found)
            if seen is not None:
                seen = replace(seen, verdicts=(*seen.verdicts[:index], tried.verdict, *seen.verdicts[index + 1 :]))
                run.show(seen)
            doubted += tried.verdict is Verdict.UNVERIFIED and tried.reason in doubts
            enough = len(verified) + passed + doubted == count
            if enough:
                # Stop the trials that were started ahead, so that they do not slow down measuring.
                trials.close()
            # Measure after the report, because measuring takes longer than a trial. Failed grasps are not measured.
            if passed and context.metrics is not None:
                metrics.append(pool.submit(_measured, context.trials, context.metrics(), context.friction, tried))
                # A run that ends now still measures its waiting grasps. Limit their number to that of the threads.
                wait(metrics[: 1 - threads or None])
            (verified if passed else others).append(tried)
            if enough:
                break
    if metrics:
        verified = [replace(grasp, metrics=one.result()) for grasp, one in zip(verified, metrics, strict=True)]
    return TriedGrasps(surest_first((*verified, *others)), first)


def _tried(
    run: Run, context: VerificationContext, candidates: tuple[Grasp, ...], alone: bool, needed: Callable[[], int]
) -> Generator[Grasp]:
    """Yield the candidates with their trial results, in order.

    If `alone` is set, the first candidate runs several robustness checks in parallel. The other candidates start when
    the first one waits for a world or is done.
    """
    threads, checks = torch.get_num_threads(), context.checks
    work = partial(_all_trials, context, 1)
    if alone and checks is not None:
        work = partial(_best_first, context, checks, candidates[0], threads)
    return results_in_order(run.over, work, candidates, threads, needed, known_over=run.known_over)


def _best_first(
    context: VerificationContext, checks: RobustnessChecks, best: Grasp, threads: int, grasp: Grasp, stop: StopHook
) -> Grasp:
    """Try a candidate. Candidates other than `best` first wait until `best` is done or waits for a world."""
    if grasp is not best:
        while not checks.waited_for.wait(POLL) and not stop():
            pass
        return _all_trials(context, 1, grasp, stop)
    try:
        return _all_trials(context, threads, grasp, stop)
    finally:
        checks.waited_for.set()


def _all_trials(context: VerificationContext, threads: int, grasp: Grasp, stop: StopHook) -> Grasp:
    results = grasp_trials(context.trials, grasp, stop)
    checks, trials = context.checks, context.trials
    if not results[-1].passed or checks is None:
        return replace(grasp, trials=results)
    if context.heavy is not None:
        least, most = context.mass, context.heavy
        lifted = payload(trials.alone, grasp, trials.protocol, least=least, most=most, held=True, stop=stop)
        checks = less_sure(checks, lifted, most)
    under, probability = try_robustness(checks, grasp, stop, threads)
    return replace(grasp, trials=(*results, under), probability=probability)


def surest_first(grasps: Sequence[Grasp]) -> tuple[Grasp, ...]:
    """Return verified, then unverified, then failed grasps. Each group is sorted by probability, then by score."""
    place = {Verdict.VERIFIED: 0, Verdict.UNVERIFIED: 1, Verdict.FAILED: 2}
    return tuple(sorted(grasps, key=lambda g: (place[g.verdict], -(g.probability or 0.0), -g.score)))


def rank_by_robustness(
    run: Run, context: VerificationContext, grasps: tuple[Grasp, ...], config: RobustConfig, seed: int
) -> tuple[Grasp, ...]:
    """Sort the verified grasps by robustness: the fraction of noisy hold trials that a grasp passes.

    The robustness is added to each verified grasp's metrics. If the run ends early, a grasp without noisy trials is
    sorted as if its robustness were 0.5. Unverified and failed grasps follow unchanged.
    """
    verified = [grasp for grasp in grasps if grasp.verdict is Verdict.VERIFIED]
    measured: list[Grasp] = []
    # All grasps get the same errors, so that luck does not rank them. No benchmark uses these errors.
    errors = pose_errors((_NOISE, seed), config.trials)
    protocol = replace(context.trials.protocol, hold_time=config.hold_time)

    def share_held(grasp: Grasp, stop: StopHook) -> float | None:
        return noisy_share(context.trials.alone, grasp, protocol, errors, stop=stop)

    threads, needed = torch.get_num_threads(), lambda: len(verified)
    shares = results_in_order(run.over, share_held, verified, threads, needed, known_over=run.known_over)
    with closing(shares):
        # Grasps that are left when the run ends get None.
        for index, (grasp, share) in enumerate(zip(verified, chain(shares, repeat(None)), strict=False)):
            metrics = GraspMetrics({**(grasp.metrics or {}), "robustness": share})
            measured.append(replace(grasp, metrics=metrics))
            run.report(Stage.VERIFY, index + 1, len(verified), 0.0, len(verified))
    return (*most_robust_first(measured), *grasps[len(verified) :])


def most_robust_first(verified: Sequence[Grasp]) -> list[Grasp]:
    """Sort grasps by descending robustness, 0.5 where it was not measured. Equal grasps keep their order."""

    def share(grasp: Grasp) -> float:
        known = grasp.metrics.get("robustness") if grasp.metrics else None
        return _UNKNOWN if known is None else known

    return sorted(verified, key=share, reverse=True)


# Greatest deviation of a quaternion's length from 1.
_UNIT_TOLERANCE = 0.01
# Greatest distance between the base in the grasp and in the squeeze [m], and of the quaternions' product from 1.
_SQUEEZE_TOLERANCE = 1e-4


def verify_grasps(
    scene: Scene, hand: HandModel, grasps: Sequence[Grasp], *, verify: str = "standard", measure: bool = True
) -> tuple[Grasp, ...]:
    """Try and measure the given grasps. Return all of them in order.

    If cameras saw the object and no mass was given, the trials use `light_end` of the assumed mass. In a doubted scene
    or in a pile, they use the assumed mass.

    Args:
        scene: scene with the object. With a support or obstacles, the lift trial runs too. If cameras saw the object,
            the robustness checks run too.
        hand: hand of the postures. Joint values are in the order of `hand.joint_names`.
        grasps: grasps with `pregrasp`, `grasp` and `squeeze`. Earlier metrics and trials are replaced.
        verify: "standard" or "hard" trials, "full" or "hard_full" for the same trials without early stop, or "none".
        measure: whether to measure metrics, also for failed grasps.

    Raises:
        ConfigError: `verify` is unknown, or a posture does not fit the hand, or a posture has non-finite values.
    """
    if verify not in VERIFICATIONS:
        raise ConfigError(f"verify: {verify!r}; valid: {', '.join(VERIFICATIONS)}")
    for index, grasp in enumerate(grasps):
        _refuse_posture(grasp, hand, f"grasp {index}")
    scene, far = near_scene(scene)
    tried = tuple(replace(moved_grasp(grasp, -far), metrics=None, trials=(), probability=None) for grasp in grasps)
    trials = None
    if verify != "none":
        run, certainty = Run(time.perf_counter(), None, None, None), CertaintyConfig()
        context = make_trial_context(
            run, scene, hand, prefetch(run, scene, hand, verify, certainty), certainty, measure=False
        )
        assert context is not None  # the run has no end
        trials = context.trials
        tried = tuple(_all_trials(context, 1, grasp, run.over) for grasp in tried)
    if measure:
        own = replace(_metrics_context(scene, hand), world=trials and trials.alone)
        tried = tuple(
            replace(grasp, metrics=_measured(trials, own, False, grasp))
            if trials and grasp.verdict is Verdict.VERIFIED
            else replace(grasp, metrics=metrics.measure(own, grasp.grasp))
            for grasp in tried
        )
    return tuple(
        replace(given, metrics=found.metrics, trials=found.trials, probability=found.probability)
        for given, found in zip(grasps, tried, strict=True)
    )


def _refuse_posture(grasp: Grasp, hand: HandModel, name: str) -> None:
    for stage in ("pregrasp", "grasp", "squeeze"):
        posture = getattr(grasp, stage)
        joints = len(hand.joint_names)
        for key, size in (("position", 3), ("quaternion_wxyz", 4), ("joint_positions", joints)):
            values = getattr(posture, key)
            numeric = isinstance(values, np.ndarray) and values.dtype.kind in "fiu"
            if not numeric or values.shape != (size,) or not np.isfinite(values).all():
                given = values.tolist() if isinstance(values, np.ndarray) else short_repr(values)
                raise ConfigError(f"{name}: {stage}.{key} is {given}; valid: {size} finite numbers in an array")
        length = float(np.linalg.norm(posture.quaternion_wxyz))
        if abs(length - 1) > _UNIT_TOLERANCE:
            raise ConfigError(f"{name}: {stage}.quaternion_wxyz has length {length:.3g}; valid: 1")
    # Only the fingers squeeze. Files and messages have no other pose for the squeeze.
    base, other = grasp.grasp, grasp.squeeze
    q, p = (posture.quaternion_wxyz / np.linalg.norm(posture.quaternion_wxyz) for posture in (base, other))
    if np.linalg.norm(other.position - base.position) > _SQUEEZE_TOLERANCE or 1 - abs(q @ p) > _SQUEEZE_TOLERANCE:
        raise ConfigError(f"{name}: the base in squeeze has another pose than in grasp; valid: the same pose")
