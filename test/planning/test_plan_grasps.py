"""`plan_grasps`, end to end on a cylinder: verdicts, limits, reproducibility, and every way for a run to end early."""

import inspect
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from expected import refused, some

from graspd_core import load_preset, load_scene, override, plan_grasps
from graspd_core.errors import ConfigError
from graspd_core.hands.model import Primitive
from graspd_core.hands.surface_points import surface_points
from graspd_core.mesh.convex_parts import hull_surface
from graspd_core.planning.plan_grasps import check_request
from graspd_core.runtime import disk_cache as cache
from graspd_core.types import Grasp, GraspResult, Outcome, Plane, Progress, Stage, Verdict
from graspd_core.verify import verification

# A search that nobody waits for.
ENDLESS = replace(load_preset("fast"), settings=replace(load_preset("fast").settings, refine_steps=10**7))


@pytest.fixture(scope="module")
def scene():
    return load_scene("shape:cylinder")


@pytest.fixture(scope="module")
def told() -> list[Progress]:
    """What the run of `result` reported."""
    return []


@pytest.fixture(scope="module")
def result(scene, hand, told) -> GraspResult:
    return plan_grasps(scene, hand, count=2, seed=3, preset="fast", progress=told.append)


def arrays(grasp: Grasp) -> list[np.ndarray]:
    postures = (grasp.pregrasp, grasp.grasp, grasp.squeeze)
    return [a for p in postures for a in (p.position, p.quaternion_wxyz, p.joint_positions)]


def test_grasps_called_verified_have_passed_and_come_first(result):
    assert result.outcome is Outcome.SUCCEEDED
    assert result.message == Outcome.SUCCEEDED.value
    verdicts = [grasp.verdict for grasp in result.tried]
    assert verdicts == sorted(verdicts, key=[Verdict.VERIFIED, Verdict.FAILED].index)
    assert verdicts.count(Verdict.VERIFIED) == 2
    for grasp in result.tried:
        (hold,) = grasp.trials
        assert hold.passed == (grasp.verdict is Verdict.VERIFIED) == (grasp.reason == "")
        assert grasp.metrics is not None
        assert grasp.contacts


def test_grasps_are_those_that_were_asked_for_and_failed_ones_stand_apart(result):
    assert [grasp.verdict for grasp in result.grasps] == [Verdict.VERIFIED] * 2
    assert all(grasp.verdict is Verdict.FAILED and grasp.reason for grasp in result.failed)
    assert result.tried == (*result.grasps, *result.failed)
    # More than were asked for may pass where several are tried at once.
    held = result.grasps[0]
    more = replace(result, tried=(held, held, held, *result.failed))
    assert (more.grasps, more.count) == ((held, held), 2)
    assert replace(more, count=None).grasps == (held,) * 3


def test_the_full_length_gives_the_verdicts_of_the_usual_trials(scene, hand, result):
    full = plan_grasps(scene, hand, count=2, seed=3, preset="fast", verify="full")
    late, soon = ([(g.score, g.verdict, g.reason) for g in run.tried] for run in (full, result))
    assert late == soon
    holds = [(a.trials[0], b.trials[0]) for a, b in zip(full.tried, result.tried, strict=True)]
    assert all(a.displacement >= b.displacement for a, b in holds)


def test_on_a_table_a_verified_grasp_has_passed_both_trials(scene, hand, result):
    table = Plane(np.array([0.0, 0.0, 1.0]), float(scene.object.mesh.vertices[:, 2].min()))
    on_table = plan_grasps(replace(scene, support=table), hand, count=1, seed=3, preset="fast")
    assert on_table.outcome is Outcome.SUCCEEDED
    assert on_table.support is table
    best = on_table.tried[0]
    assert best.verdict is Verdict.VERIFIED
    assert [(trial.name, trial.passed) for trial in best.trials] == [("hold", True), ("lift", True)]
    assert result.support is None
    assert {trial.name for grasp in result.tried for trial in grasp.trials} == {"hold"}


def test_joint_limits_hold_exactly_and_quaternions_are_unit(result, hand):
    for grasp in result.tried:
        for posture in (grasp.pregrasp, grasp.grasp, grasp.squeeze):
            assert ((hand.lower <= posture.joint_positions) & (posture.joint_positions <= hand.upper)).all()
            # float32 arithmetic
            assert np.linalg.norm(posture.quaternion_wxyz) == pytest.approx(1.0, abs=1e-6)


def test_stages_are_reported_in_order(told, result):
    order = [Stage.OPTIMISE, Stage.VERIFY, Stage.DONE]
    stages = [progress.stage for progress in told]
    assert stages == sorted(stages, key=order.index)
    assert set(stages) == set(order)
    assert [p.elapsed for p in told] == sorted(p.elapsed for p in told)
    assert [p.verified for p in told] == sorted(p.verified for p in told)
    assert told[-1].verified == 2
    assert all(0 < p.step <= p.of for p in told)


def test_times_add_up(result):
    timing = result.timing
    parts = timing.load + timing.sdf + timing.optimise + timing.verify
    assert timing.total == pytest.approx(parts, abs=0.01)
    assert timing.load + timing.sdf + timing.optimise < some(timing.first_verified) <= timing.total


def test_the_same_seed_gives_the_same_grasps_and_another_others(scene, hand, result):
    again = plan_grasps(scene, hand, count=2, seed=3, preset="fast")
    assert len(again.tried) == len(result.tried)
    for one, other in zip(again.tried, result.tried, strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(arrays(one), arrays(other), strict=True))
        assert (one.score, one.metrics, one.trials) == (other.score, other.metrics, other.trials)
    different = plan_grasps(scene, hand, count=2, seed=4, preset="fast", verify="none")
    assert not np.array_equal(different.tried[0].grasp.position, result.tried[0].grasp.position)
    assert len(different.tried) == 2
    assert all(g.verdict is Verdict.UNVERIFIED and not g.trials and g.metrics for g in different.tried)


def test_cancelling_ends_the_run_within_a_step(scene, hand, result):
    stop = threading.Event()
    steps: list[int] = []

    def progress(report: Progress) -> None:
        if report.stage is Stage.OPTIMISE:
            steps.append(report.step)
            time.sleep(0.3)
            stop.set()

    cancelled = plan_grasps(scene, hand, count=8, preset=ENDLESS, progress=progress, stop=stop.is_set)
    assert cancelled.outcome is Outcome.CANCELLED
    assert cancelled.tried == ()
    # It went into the search, which left nothing to try.
    assert cancelled.timing.optimise >= 0.3
    assert len(steps) == 1


def test_cancelling_while_verifying_keeps_what_is_verified(scene, hand):
    verified: list[int] = []

    def progress(report: Progress) -> None:
        verified.append(report.verified)

    result = plan_grasps(
        scene, hand, count=3, seed=3, preset="fast", progress=progress, stop=lambda: bool(verified and verified[-1])
    )
    assert result.outcome is Outcome.CANCELLED
    assert sum(g.verdict is Verdict.VERIFIED for g in result.tried) == 1


@pytest.mark.parametrize("verify", ["standard", "none"])
def test_a_deadline_is_kept(scene, hand, result, verify: str):
    told: list[Progress] = []
    late = plan_grasps(scene, hand, count=2, preset=ENDLESS, deadline=0.2, verify=verify, progress=told.append)
    assert late.outcome is Outcome.DEADLINE
    assert late.tried == ()
    # Neither are all steps done, nor is any grasp tried.
    assert {report.stage for report in told} <= {Stage.OPTIMISE, Stage.DONE}
    assert all(report.step < report.of for report in told[:-1])


def test_a_run_that_is_over_before_it_begins_begins_nothing(scene, hand):
    told: list[Stage] = []
    cancelled = plan_grasps(scene, hand, count=1, progress=lambda p: told.append(p.stage), stop=lambda: True)
    late = plan_grasps(scene, hand, count=1, progress=lambda p: told.append(p.stage), deadline=1e-9)
    assert (cancelled.outcome, late.outcome) == (Outcome.CANCELLED, Outcome.DEADLINE)
    assert cancelled.tried == late.tried == ()
    assert told == [Stage.DONE, Stage.DONE]


def test_collision_parts_of_cancelled_runs_do_not_pile_up(scene, hand, result):
    fresh = replace(scene, object=replace(scene.object, sha256="of nobody else"))
    stop = threading.Event()
    before = set(threading.enumerate())
    with verification._CUTTING:
        cancelled = plan_grasps(fresh, hand, count=1, progress=lambda _: stop.set(), stop=stop.is_set)
    assert cancelled.outcome is Outcome.CANCELLED
    # The thread that waited for its turn ends at once, and nothing was cut.
    for thread in set(threading.enumerate()) - before:
        thread.join(5)
        assert not thread.is_alive()
    assert "parts-of nobody else" not in cache._memory


def test_what_held_in_an_earlier_round_stays_told(scene, hand):
    config = load_preset("fast")
    # The least that a round keeps is eight, so that nine take two.
    short = replace(config.settings, explore_steps=3, refine_steps=3, polish_steps=3, keep_per_grasp=0.5)
    told: list[Progress] = []
    plan_grasps(scene, hand, count=9, preset=replace(config, settings=short), verify="none", progress=told.append)
    assert [p.verified for p in told] == sorted(p.verified for p in told)
    assert 0 < told[-2].verified <= told[-1].verified


def test_nobody_waits_for_collision_parts_that_come_too_late(scene, hand, monkeypatch: pytest.MonkeyPatch):
    release = threading.Event()
    # They come only once the run has ended; who waited for them would wait for ever.
    monkeypatch.setattr(verification, "trial_context", lambda *_: release.wait())
    short = replace(load_preset("fast").settings, explore_steps=3, refine_steps=3, polish_steps=3)
    try:
        late = plan_grasps(scene, hand, count=1, preset=replace(load_preset("fast"), settings=short), deadline=0.5)
    finally:
        release.set()
    assert late.outcome is Outcome.DEADLINE
    assert late.tried == ()


@pytest.mark.parametrize(
    ("wrong", "culprit"),
    [
        ({"count": 0}, "count: 0"),
        ({"count": 2000}, "1 to 1024"),
        ({"seed": -1}, "seed: -1"),
        ({"verify": "maybe"}, "'maybe'; valid: standard, hard, full, hard_full, none"),
        ({"deadline": -1.0}, "deadline: -1.0"),
        ({"deadline": float("nan")}, "deadline: nan"),
        ({"device": "abacus"}, "'abacus'; valid on this machine: cpu"),
        ({"preset": "best"}, "unknown preset 'best'"),
    ],
)
def test_a_wrong_request_is_refused(scene, hand, wrong: dict, culprit: str):
    with refused(ConfigError, culprit):
        plan_grasps(scene, hand, **wrong)


@pytest.mark.parametrize("wrong", [{"count": 1.5}, {"seed": 0.5}])
def test_a_number_that_is_not_whole_is_refused(wrong: dict):
    unchecked = inspect.unwrap(check_request)  # the tests check types before the function is called
    with pytest.raises(ConfigError, match=f"{next(iter(wrong))}: .*; valid"):
        unchecked(**{"count": 1, "seed": 0, "verify": "none", "deadline": None, "device": "cpu"} | wrong)


def test_a_candidate_that_touches_nothing_is_no_grasp_where_no_trial_is_asked_for(scene, hand):
    """A search of three steps leaves some hands off the object. They do not count, and the answer says so."""
    steps = {f"closed_form.{stage}_steps": 1 for stage in ("explore", "refine", "polish")}
    config = override(load_preset("fast"), {"rounds.most": 1, **steps})
    result = plan_grasps(scene, hand, count=16, preset=config, verify="none", measure=False)
    off = [grasp for grasp in result.tried if not grasp.contacts]
    assert off
    assert not any(grasp.usable for grasp in off)
    assert all(grasp.usable for grasp in result.tried if grasp.contacts)
    told = f"{len(off)} of {len(result.tried)} untried candidates do not touch the object"
    assert (result.outcome, result.message) == (Outcome.TOO_FEW, told)


def test_a_hand_of_meshes_does_not_grasp_through_the_wall_of_a_mug(hand):
    def hull(solid: Primitive) -> Primitive:
        shape = hull_surface(surface_points(solid, 200, np.random.default_rng(0))[0])
        return Primitive(solid.link, "hull", np.eye(3), np.zeros(3), (), shape.vertices, shape.faces)

    meshes = replace(hand, primitives=tuple(hull(solid) for solid in hand.primitives))
    result = plan_grasps(load_scene("shape:mug"), meshes, count=2, preset="fast", measure=False)
    assert result.outcome is Outcome.SUCCEEDED
