"""One verified grasp in fifty is tried at full length, and disagreements are counted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graspd_core.types import AuditCount, Grasp, StopHook, TrialResult
from graspd_core.verify import hold_trial
from graspd_core.verify import trial_registry as audit
from graspd_core.verify.trial_registry import TrialContext, audited_trials, grasp_trials, is_audited
from graspd_core.verify.world import PROTOCOLS, Protocol, build_world

STANDARD = replace(PROTOCOLS["standard"], slide_stiffness=500.0, slide_damping=10.0)


@pytest.fixture
def context(gripper, cube) -> TrialContext:
    return TrialContext(gripper, STANDARD, build_world(gripper, cube, (cube.mesh,), STANDARD), None)


@pytest.fixture
def all_audited(monkeypatch) -> None:
    monkeypatch.setattr(audit, "is_audited", lambda grasp: True)


@pytest.fixture
def firm(closing) -> Grasp:
    return closing(0.015, 0.025, (0.04, 0.04))


def test_a_planted_disagreement_is_counted_and_the_grasp_fails(context, closing, all_audited, monkeypatch):
    # Nothing holds it, and it sinks 5.4 cm in 2 s; who ends at the first look does not see that.
    model, lost = context.alone.model, closing(0.0, 0.0, (0.0, 0.0), height=-0.145)
    model.opt.viscosity = STANDARD.pull * 0.1 / (3 * np.pi * 0.04 * 0.027)
    assert audited_trials(context, lost)[1] == AuditCount(0, 0)  # fails as it is: nothing to audit
    monkeypatch.setattr(hold_trial, "answer_known", lambda *_: True)
    (hold,), count = audited_trials(context, lost)
    assert count == AuditCount(1, 1)
    assert not hold.passed
    assert hold.reason.startswith("the object moved 5.")


def test_an_audit_is_one_pull_at_full_length_and_each_pull_has_its_turn(context, closing, all_audited, monkeypatch):
    tried: dict[Protocol, int] = {}

    def count(context: TrialContext, grasp: Grasp, stop: StopHook) -> tuple[TrialResult, ...]:
        world = replace(context.alone, watch=lambda data: steps.append(1))
        steps: list[int] = []
        results = grasp_trials(replace(context, alone=world), grasp, stop)
        tried[context.protocol] = len(steps)
        return results

    monkeypatch.setattr(audit, "grasp_trials", count)
    for width in np.linspace(0.0, 0.04, 40):
        audited_trials(context, closing(0.015, 0.025, (width, 0.04)))
    del tried[STANDARD]
    assert {protocol.pulls for protocol in tried} == {(pull,) for pull in range(6)}
    seconds = 2 * STANDARD.stage_time + STANDARD.hold_time
    assert set(tried.values()) == {round(seconds / STANDARD.timestep)}


def test_an_audit_that_agrees_changes_nothing(context, firm, all_audited):
    results, count = audited_trials(context, firm)
    assert count == AuditCount(1, 0)
    assert results == (hold_trial.hold_trial(context.alone, firm, STANDARD),)


def test_what_is_not_chosen_or_runs_at_full_length_is_not_audited(context, firm, monkeypatch):
    assert audited_trials(context, firm)[1] == AuditCount(int(is_audited(firm)), 0)
    full = replace(context, protocol=replace(STANDARD, full_length=True))
    monkeypatch.setattr(audit, "is_audited", lambda grasp: True)
    assert audited_trials(full, firm)[1] == AuditCount(0, 0)
    monkeypatch.setattr(audit, "is_audited", lambda grasp: False)
    assert audited_trials(context, firm)[1] == AuditCount(0, 0)


def test_an_audit_that_is_stopped_does_not_count(context, firm, all_audited, monkeypatch):
    asked = 0

    def stop() -> bool:
        nonlocal asked
        asked += 1
        return asked > polls

    polls = 10**6
    short = audited_trials(context, firm, stop)[0]
    enough, asked = asked, 0
    polls = enough - 5  # the audit is the second half, and by far the longer
    assert audited_trials(context, firm, stop) == (short, AuditCount(0, 0))


def test_one_grasp_in_fifty_is_chosen_whatever_its_score(closing):
    widths = np.random.default_rng(0).uniform(0.0, 0.04, (5000, 2))
    grasps = [closing(0.015, 0.025, tuple(pair)) for pair in widths]
    chosen = [is_audited(grasp) for grasp in grasps]
    assert sum(chosen) == pytest.approx(100, abs=40)  # four standard deviations of chance
    assert chosen == [is_audited(replace(grasp, score=1.0, metrics=None)) for grasp in grasps]
