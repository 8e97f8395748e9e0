"""Run rounds: each round runs the optimiser, then tries the candidates, with more effort from round to round."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

from graspd_core.config import CertaintyConfig
from graspd_core.config.planning_config import light_end
from graspd_core.errors import ResourceError
from graspd_core.hands.model import HandModel
from graspd_core.optimize.candidates import PlannerInput, find_candidates
from graspd_core.optimize.loop import Hooks, Poses
from graspd_core.optimize.plan_config import PlanConfig, method_row
from graspd_core.optimize.restrictions import UNRESTRICTED, BoundRestrictions
from graspd_core.perception.scene import Scene
from graspd_core.types import Grasp, Snapshot, Stage, Verdict
from graspd_core.verify.limits import LEAST_PAYLOAD, payload
from graspd_core.verify.run_clock import Run
from graspd_core.verify.verification import (
    Prefetched,
    TriedGrasps,
    VerificationContext,
    lighter,
    make_trial_context,
    measured,
    payloads,
    run_trials,
    surest_first,
)

# Parts of torch's messages when memory runs out, on the CPU or on CUDA. In both cases torch raises a RuntimeError.
_TORCH_SAYS = ("can't allocate memory", "not enough memory", "out of memory")


@contextmanager
def enough_memory(what: str) -> Iterator[None]:
    """Raise ResourceError if the work inside the context runs out of memory. `what` names the work."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, MemoryError) or any(words in str(error) for words in _TORCH_SAYS):
            raise ResourceError(f"{what}: not enough memory; ask for fewer grasps, or use a faster preset") from None
        raise


def rounds_of(scene: Scene, config: PlanConfig, verify: str) -> list[PlanConfig]:
    """Return the settings of all rounds, with increasing effort.

    The first round has less effort for an object of known shape without support or obstacles. For such an object, hold
    trials show quickly whether more effort is needed. If cameras saw the object, the first round has the effort of a
    second round, because few grasps pass all robustness checks.
    """
    rounds = config.rounds
    cheap = verify != "none" and scene.support is None and not scene.obstacles and scene.confidence is None
    first = rounds.first_budget if cheap else 1.0
    if scene.confidence is not None:
        first = rounds.growth
    most = rounds.first_budget * rounds.growth ** (rounds.most - 1)
    efforts = (min(first * rounds.growth**attempt, max(first, most)) for attempt in range(rounds.most))
    return [config.at_budget(effort) for effort in efforts]


# Difference between the seeds of two batches.
_SEED_STEP = 1_000_003
# If `_MANY` or more grasps are requested, the first batch seeks only `_FIRST_BATCH`, so that the first answer comes
# early. If a batch finds no grasp, the next batch seeks at least `_MANY`.
_MANY, _FIRST_BATCH = 8, 2

# Used if no grasp holds the object: number of grasps whose payload is measured, and tried mass as a fraction of
# the greatest payload. The tried mass is at most `light_end`, the least mass at which a grasp may be verified.
_WEIGHED, _LIFTED = 60, 0.8
# If none of at least this many tried grasps lifts `light_end`, only a round with more effort follows. On views of
# `graspd bench cameras` (seeds 80 to 89), later rounds with equal effort verified a grasp in none of 41 such cases.
_ENOUGH = 20


@dataclass(frozen=True)
class RoundsResult:
    """The results of the rounds of a run.

    Attributes:
        began: start of the first round, a `time.perf_counter()` value.
        grasps: the found grasps: first verified, then unverified, then failed grasps.
        context: context of the trials. None if no grasp was tried.
        optimise_time: time spent in the optimiser [s].
        first: time at which the first grasp was verified, a `time.perf_counter()` value. None if none was verified.
        refused: number of candidates that restrictions refused, by reason.
        lowered: lower mass for a second trial of the best grasps [kg]. None without a second trial.
    """

    began: float
    grasps: tuple[Grasp, ...] = ()
    context: VerificationContext | None = None
    optimise_time: float = 0.0
    first: float | None = None
    refused: Counter[str] = field(default_factory=Counter)
    lowered: float | None = None

    @property
    def mass(self) -> float | None:
        """Object mass in the trials [kg] if this mass is below the assumed mass, else None."""
        if self.lowered and not self.good:
            return self.lowered
        return self.context.mass if self.context and self.context.heavy else None

    @property
    def good(self) -> int:
        """Number of verified grasps. If no trial was requested, number of grasps with a contact."""
        return sum(grasp.usable for grasp in self.grasps)


def _hooks(run: Run, good: int) -> Hooks:
    def show(poses: Poses) -> None:
        run.show(Snapshot(*(rows.detach().double().cpu().numpy() for rows in vars(poses).values())))

    return Hooks(
        report=lambda step, of, loss: run.report(Stage.OPTIMISE, step, of, loss, good),
        # When the run is over, stop at once, because the poses of an unfinished search are no grasps.
        stop=run.over,
        watch=None if run.watch is None else show,
    )


def run_rounds(
    run: Run,
    scene: Scene,
    hand: HandModel,
    rounds: list[PlanConfig],
    prefetched: Prefetched | None,
    restrictions: BoundRestrictions = UNRESTRICTED,
    *,
    count: int,
    seed: int,
    device: str,
    measure: bool = True,
) -> RoundsResult:
    """Find and try candidates, round by round, until `count` grasps are good (`RoundsResult.good`).

    If many grasps are requested, the first batch is small, so that the first answer comes early. If too few grasps
    hold, the next batch starts from other initial poses. Candidates that a restriction refuses are not tried.
    `prefetched` holds the worlds of the trials. If `prefetched` is None, no candidate is tried.
    """
    state, weak = RoundsResult(time.perf_counter()), False
    for attempt, batch in enumerate(_batches(scene, rounds, count, prefetched is not None)):
        if weak and batch.config != rounds[-1]:
            continue
        enough, good, began = min(batch.most + state.good, count), state.good, time.perf_counter()
        options = {"config": batch.config, "hooks": _hooks(run, good), "device": device, "restrictions": restrictions}
        seek = enough - good if good or not attempt else max(enough, _MANY)
        with enough_memory(f"{seek} grasps at once"):
            task = PlannerInput(scene, hand, seek, seed + _SEED_STEP * attempt, **options)
            candidates = find_candidates(task, searches=batch.searches)
        # Count the time here, because the loop below does not run if the search found nothing.
        state, began = _searched_since(state, began), time.perf_counter()
        for some in _in_rank_order(candidates, enough - good, restrictions):
            admitted, refused = restrictions.admit(some)
            state = replace(_searched_since(state, began), refused=state.refused + refused)
            tried = TriedGrasps()
            if prefetched is None:
                first = admitted[: enough - state.good]
                tried = TriedGrasps(measured(scene, hand, first) if measure else first)
            elif admitted:
                if state.context is None:
                    asked = {"measure": measure, "friction": batch.config.robust.friction}
                    context = make_trial_context(run, scene, hand, prefetched, batch.config.certainty, **asked)
                    state = replace(state, context=context)
                if state.context is not None:
                    tried = run_trials(run, state.context, admitted, enough - state.good, state.good)
            grasps = surest_first((*state.grasps, *tried.grasps))
            state = replace(state, grasps=grasps, first=state.first or tried.first)
            began = time.perf_counter()
            if state.good >= enough or run.over():
                break
        if state.good >= count or run.over():
            break
        if batch.ends_round and _unheld(state) and prefetched is not None and state.lowered is None:
            last = batch.ends_round == len(rounds)
            state, weak = _weighed(run, scene, prefetched, state, batch.config.certainty, count, last=last)
            if state.good >= count or last or (weak and batch.config == rounds[-1]) or run.over():
                break
    return state


@dataclass(frozen=True)
class _Batch:
    """Candidates that are tried together.

    Attributes:
        config: settings of the round.
        most: greatest number of grasps to find.
        searches: greatest number of optimiser runs (searches) for the candidates. None for the method's setting.
        ends_round: number (from 1) of the round whose last batch this is. 0 for any other batch.
    """

    config: PlanConfig
    most: int
    searches: int | None
    ends_round: int


def _batches(scene: Scene, rounds: Sequence[PlanConfig], count: int, tried: bool) -> Iterator[_Batch]:
    """Yield the batches of all rounds. If many grasps are requested, a small batch comes first.

    `tried` says whether trials run. If so, each search is a batch, because trials show early whether another search is
    needed. In a scene with doubts, trials show little. So there is one round, and its searches form one batch.
    """
    doubted = scene.evidence is not None and bool(scene.evidence.doubts)
    once = tried and not doubted
    if tried and count >= _MANY:
        yield _Batch(rounds[0], _FIRST_BATCH, 1 if once else None, 0)
    for number, config in enumerate(rounds[:1] if doubted else rounds, 1):
        for left in reversed(range(method_row(config.method).searches(config.settings) if once else 1)):
            yield _Batch(config, count, 1 if once else None, 0 if left else number)


def _unheld(state: RoundsResult) -> bool:
    """Return True if no grasp passed. At a mass below the assumed mass, a grasp that only fails its lift counts too."""
    if state.context is not None and state.context.heavy is not None:
        return not any(grasp.trials and grasp.trials[0].passed for grasp in state.grasps)
    return all(grasp.verdict is Verdict.FAILED for grasp in state.grasps)


def _searched_since(state: RoundsResult, began: float) -> RoundsResult:
    return replace(state, optimise_time=state.optimise_time + time.perf_counter() - began)


def _weighed(
    run: Run,
    scene: Scene,
    prefetched: Prefetched,
    state: RoundsResult,
    certainty: CertaintyConfig,
    count: int,
    *,
    last: bool,
) -> tuple[RoundsResult, bool]:
    """Try grasps with a lower mass if the mass is assumed. Return also whether all are too weak, if a round follows.

    After weak grasps, only the rounds with the greatest effort are worth their time, because their grasps lift most.
    """
    before = state
    if scene.object.mass_assumed:
        state = _tried_lighter(run, scene, prefetched, state, certainty, count)
    unneeded = last or state.good >= count or run.over()
    return state, not unneeded and _too_weak(run, scene, before, state.lowered)


def _tried_lighter(
    run: Run, scene: Scene, prefetched: Prefetched, state: RoundsResult, certainty: CertaintyConfig, count: int
) -> RoundsResult:
    """Repeat the trials of the best grasps with a lower mass, which the strongest grasp can lift.

    The strongest grasp is tried first. `light_end` is the least mass at which a grasp may be verified. If even the
    strongest grasp cannot lift `light_end`, later rounds try grasps at `light_end`.
    """
    if state.context is None:
        return state
    heavy = scene.object.mass
    best, others = state.grasps[:_WEIGHED], state.grasps[_WEIGHED:]
    lifted = payloads(state.context, best, run.over)
    most = max(lifted, default=0.0)
    mass = min(_LIFTED * most, light_end(heavy))
    if most <= LEAST_PAYLOAD or mass >= state.context.mass or run.over():
        return state
    context = lighter(scene, prefetched, state.context, certainty, mass, most)
    strongest = sorted(range(len(best)), key=lambda place: -lifted[place])
    tried = run_trials(run, context, tuple(replace(best[place], trials=()) for place in strongest), count, 0)
    if run.over() and all(grasp.verdict is Verdict.FAILED for grasp in tried.grasps):
        # The run ended before a grasp held the lower mass. The grasps keep their earlier trials.
        return state
    if context.checks is not None and context.checks.doubts:
        context = lighter(scene, prefetched, context, certainty, light_end(heavy), heavy)
    grasps = surest_first((*tried.grasps, *others))
    return replace(state, context=context, lowered=mass, grasps=grasps, first=tried.first)


def _too_weak(run: Run, scene: Scene, state: RoundsResult, lowered: float | None) -> bool:
    """Return True if no grasp lifts `light_end` of the object's mass. Then no later round is likely to verify a grasp.

    Return False if too few grasps were tried. With a given mass, also return False if no robustness check needs a
    margin, or if no grasp can be verified.
    `lowered` is the lower mass that the strongest grasp lifts, if `_tried_lighter` weighed the grasps [kg].
    """
    context, least = state.context, light_end(scene.object.mass)
    if context is None or len(state.grasps) < _ENOUGH:
        return False
    if scene.object.mass_assumed:
        return lowered is not None and lowered < _LIFTED * least
    if context.checks is None or context.checks.doubts:
        return False
    world, protocol = context.trials.alone, context.trials.protocol
    lifts = (payload(world, grasp, protocol, least=least, stop=run.over) for grasp in state.grasps[:_WEIGHED])
    return not any(run.over() or lifted for lifted in lifts)


def _in_rank_order(
    candidates: tuple[Grasp, ...], wanted: int, restrictions: BoundRestrictions
) -> Iterator[tuple[Grasp, ...]]:
    some = 2 * max(wanted, _FIRST_BATCH) if restrictions.each else len(candidates)
    while candidates:
        yield candidates[:some]
        candidates, some = candidates[some:], 2 * some
