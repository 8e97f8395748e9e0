"""Rounds of optimiser and trials: how much effort each takes, and what they find."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

from graspd_core.hands.model import HandModel
from graspd_core.methods.candidates import find_candidates
from graspd_core.methods.loop import Hooks
from graspd_core.methods.plan_config import PlanConfig
from graspd_core.methods.poses import Poses
from graspd_core.planning.memory_errors import enough_memory
from graspd_core.planning.run_clock import Run
from graspd_core.planning.verification import (
    Parts,
    TriedGrasps,
    VerificationContext,
    make_trial_context,
    measured,
    run_trials,
    surest_first,
)
from graspd_core.scene.scene import Scene
from graspd_core.types import AuditCount, Grasp, Snapshot, Stage


def rounds_of(scene: Scene, config: PlanConfig, verify: str) -> list[PlanConfig]:
    """Settings of every round, each with more effort than the last.

    A cheap first round pays where its failures are found out at little cost: by a hold trial, on an object whose shape
    is known and that has nothing about it.
    """
    rounds = config.rounds
    cheap = verify != "none" and scene.support is None and not scene.obstacles and scene.confidence is None
    first = rounds.first_budget if cheap else 1.0
    most = rounds.first_budget * rounds.growth ** (rounds.most - 1)
    efforts = (min(first * rounds.growth**attempt, max(first, most)) for attempt in range(rounds.most))
    return [config.at_budget(effort) for effort in efforts]


# How far apart the seeds of two rounds are.
_SEED_STEP = 1_000_003
# Where so many grasps are asked for, so few are sought first: an answer need not wait until all are found.
_MANY, _FIRST_BATCH = 8, 2


@dataclass(frozen=True)
class RoundsResult:
    """What the rounds of a run found.

    Attributes:
        began: when the first round began, a `time.perf_counter()` value.
        grasps: verified (or untried) ones first, then those that failed.
        context: what grasps are tried with; None where none was tried.
        optimise_time: spent in the method [s].
        first: when the first grasp was verified, a `time.perf_counter()` value.
        audits: of its trials.
    """

    began: float
    grasps: tuple[Grasp, ...] = ()
    context: VerificationContext | None = None
    optimise_time: float = 0.0
    first: float | None = None
    audits: AuditCount = field(default_factory=AuditCount)

    @property
    def good(self) -> int:
        """How many grasps are as sure as was asked for: verified, or found where no trial was asked for."""
        return sum(grasp.usable for grasp in self.grasps)


def poses_seen(poses: Poses) -> Snapshot:
    """The hands of an optimiser."""
    return Snapshot(*(rows.detach().double().cpu().numpy() for rows in vars(poses).values()))


def run_rounds(
    run: Run,
    scene: Scene,
    hand: HandModel,
    rounds: list[PlanConfig],
    parts: Parts | None,
    *,
    count: int,
    seed: int,
    verify: str,
    device: str,
    measure: bool = True,
) -> RoundsResult:
    """Find candidates and try them, round by round, until `count` of them are good.

    Most objects need one round, which begins with a small batch for a first answer. Where too few grasps held, what is
    missing is sought again from other initial poses.
    Without `parts`, the object's convex parts, no trial is run.
    """
    state = RoundsResult(time.perf_counter())
    batches = [(config, count) for config in rounds]
    if rounds and parts is not None and count >= _MANY:
        batches.insert(0, (rounds[0], _FIRST_BATCH))
    for attempt, (config, most) in enumerate(batches):
        wanted, good, began = min(most, count - state.good), state.good, time.perf_counter()
        hooks = Hooks(
            report=lambda step, of, loss, good=good: run.report(Stage.OPTIMISE, step, of, loss, good),
            # An iterate half-way is no grasp, and could not be verified any more: no time is spent on its stages.
            stop=run.over,
            watch=None if run.watch is None else lambda poses: run.show(poses_seen(poses)),
        )
        seeded = seed + _SEED_STEP * attempt
        with enough_memory(f"{wanted} grasps at once"):
            found = find_candidates(scene, hand, count=wanted, seed=seeded, config=config, hooks=hooks, device=device)
        state = replace(state, optimise_time=state.optimise_time + time.perf_counter() - began)
        tried = TriedGrasps()
        if parts is None:
            untried = found.grasps[:wanted]
            tried = TriedGrasps(measured(scene, hand, untried) if measure else untried)
        elif found.grasps:
            if state.context is None:
                context = make_trial_context(run, scene, hand, parts, verify, config.certainty, measure=measure)
                state = replace(state, context=context)
            if state.context is not None:
                tried = run_trials(run, state.context, found.grasps, wanted, good)
        grasps = surest_first((*state.grasps, *tried.grasps))
        state = replace(state, grasps=grasps, first=state.first or tried.first, audits=state.audits + tried.audits)
        if state.good >= count or run.over():
            break
    return state
