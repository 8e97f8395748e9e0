"""Rounds of growing effort, ranking by robustness, runs that are watched, and grasps from elsewhere that are tried."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from expected import some
from made_meshes import box_between

from graspd_bench.studies.robust_ranking import correlation, orders
from graspd_core import TriangleMesh, load_hand, load_scene, make_shape, plan_grasps, verify_grasps
from graspd_core.config import CertaintyConfig, RobustConfig
from graspd_core.errors import ConfigError
from graspd_core.io.grasps_json import result_document
from graspd_core.optimize.plan_config import PlanConfig, load_preset, override
from graspd_core.perception.scene import Obstacle, Scene, make_obstacle, object_parts
from graspd_core.planning import rounds as planning_rounds
from graspd_core.planning.rounds import RoundsResult, rounds_of
from graspd_core.types import Grasp, GraspMetrics, Outcome, Plane, Posture, Progress, Snapshot, Stage, Verdict
from graspd_core.verify.hold_trial import noisy_share, pose_errors
from graspd_core.verify.prepared_grasp import arrival, make_metrics_context, placed_hand
from graspd_core.verify.run_clock import Run
from graspd_core.verify.verification import Prefetched, VerificationContext, most_robust_first, trial_context
from graspd_core.verify.world import PROTOCOLS, build_world


@pytest.fixture(scope="module")
def scene():
    return load_scene("shape:box", resolution=16)


def rounds(scene: Scene, verify: str = "standard") -> list[tuple[int, float]]:
    """Exploring steps and starts a grasp of each round, where the settings are 50 and 8."""
    found = [config.settings for config in rounds_of(scene, PlanConfig(), verify)]
    return [(config.explore_steps, config.starts_per_grasp) for config in found]


def test_a_known_object_alone_begins_cheaply(scene):
    assert rounds(scene) == [(25, 8.0), (50, 8.0), (50, 16.0)]


def test_without_a_trial_or_with_something_about_it_the_first_round_has_all_steps(scene):
    all_steps = [(50, 8.0), (50, 16.0), (50, 16.0)]
    neighbour = Obstacle(make_shape("box"), scene.sdf)
    assert rounds(scene, "none") == all_steps
    assert rounds(replace(scene, support=Plane(np.array([0.0, 0.0, 1.0]), -0.045))) == all_steps
    assert rounds(replace(scene, obstacles=(neighbour,))) == all_steps
    assert rounds(replace(scene, confidence=torch.ones(scene.sdf.field.shape[1:]))) == [(50, 16.0)] * 3


def test_where_nothing_is_found_more_is_sought_however_few_are_asked_for(scene, monkeypatch):
    asked = []

    def none_found(task, searches):
        asked.append(task.count)
        return ()

    monkeypatch.setattr(planning_rounds, "find_candidates", none_found)
    plan_grasps(scene, load_hand("parallel_gripper"), count=1)
    # The first round has one search, each other round three.
    assert asked == [1, *6 * [8]]
    asked.clear()
    plan_grasps(scene, load_hand("parallel_gripper"), count=20)
    assert asked == [2, *7 * [20]]


def test_after_weak_grasps_of_a_mesh_only_the_round_with_the_most_effort_follows(scene, monkeypatch):
    searched, find = [], planning_rounds.find_candidates

    def noted(task, searches):
        searched.append(task.config)
        return find(task, searches=searches)

    monkeypatch.setattr(planning_rounds, "find_candidates", noted)
    heavy = replace(scene, object=replace(scene.object.at_mass(30.0), mass_assumed=True))
    config = override(PlanConfig(), {"closed_form.searches": 1})
    assert plan_grasps(heavy, load_hand("allegro_right"), count=8, preset=config).outcome is Outcome.TOO_FEW
    first, _, last = rounds_of(heavy, config, "standard")
    # The small first batch, the rest of the first round, then the last round.
    assert searched == [first, first, last]


def test_a_cancel_is_noticed_while_grasps_are_weighed_for_a_lower_mass(scene, monkeypatch):
    cancelled = []

    def weigh(context, grasps, stop):
        cancelled.append(stop())
        return [1.0 for _ in grasps]

    monkeypatch.setattr(planning_rounds, "payloads", weigh)
    run, settings = Run(0.0, None, None, lambda: True), CertaintyConfig()
    # It is not looked at, because the run ends before.
    ahead = object.__new__(Prefetched)
    context = VerificationContext(trial_context(scene, load_hand("parallel_gripper"), "standard"), None)
    state = RoundsResult(0.0, (Grasp(POSTURE, POSTURE, POSTURE),), context)
    assert planning_rounds._tried_lighter(run, scene, ahead, state, settings, 1) is state
    assert cancelled == [True]


POSTURE = Posture(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(1))


def test_a_run_that_ends_in_the_trials_at_a_lower_mass_keeps_the_grasps_it_tried(monkeypatch):
    """They failed at the assumed mass, and the result says so."""
    gripper, scene, cancelled, lighter = (
        load_hand("parallel_gripper"),
        load_scene("shape:box"),
        [],
        planning_rounds.lighter,
    )

    def cancelling(*given):
        cancelled.append(True)
        return lighter(*given)

    monkeypatch.setattr(planning_rounds, "lighter", cancelling)
    weak = replace(gripper, effort=np.full(gripper.num_joints, 4.0))
    result = plan_grasps(scene, weak, count=4, preset="fast", stop=lambda: bool(cancelled))
    assert result.outcome is Outcome.CANCELLED
    assert len(result.failed) > 0
    assert all(grasp.reason for grasp in result.failed)
    assert (result.mass, result.tried_mass) == (None, scene.object.mass)


def order(shares: dict[float, float | None]) -> list[float]:
    """Scores of grasps in the order that the given shares bring about."""
    measured = [GraspMetrics({"robustness": share}) for share in shares.values()]
    grasps = [Grasp(POSTURE, POSTURE, POSTURE, (), s, m) for s, m in zip(shares, measured, strict=True)]
    return [grasp.score for grasp in most_robust_first(grasps)]


def test_the_most_robust_come_first_and_level_ones_keep_their_order():
    assert order({5.0: 0.5, 4.0: 1.0, 3.0: 0.125, 2.0: 1.0}) == [4.0, 2.0, 5.0, 3.0]
    assert order({5.0: 0.25, 4.0: None, 3.0: 0.75}) == [3.0, 4.0, 5.0]
    assert order({5.0: None, 4.0: None}) == [5.0, 4.0]


def test_a_plan_is_put_in_order_and_says_by_what():
    hand, scene = load_hand("allegro_right"), load_scene("shape:box")
    config = replace(load_preset("fast"), robust=RobustConfig(rank=True, trials=2, hold_time=0.1))
    told: list[Progress] = []
    result = plan_grasps(scene, hand, count=2, preset=config, progress=told.append)
    assert result.outcome is Outcome.SUCCEEDED
    verified = [g.metrics for g in result.grasps if g.metrics and g.verdict is Verdict.VERIFIED]
    shares = [share for metrics in verified if (share := metrics["robustness"]) is not None]
    assert len(shares) == 2
    assert shares == sorted(shares, reverse=True)
    assert set(shares) <= {0.0, 0.5, 1.0}
    assert [p.stage for p in told[-3:]] == [Stage.VERIFY, Stage.VERIFY, Stage.DONE]
    document = result_document(result, scene.object, hand, config)
    assert [g["metrics"]["robustness"] for g in document["grasps"]][:2] == shares
    assert document["config"]["robust"] == {"rank": True, "trials": 2, "hold_time": 0.1, "friction": False}
    # A trial that is cut short says nothing.
    world = build_world(hand, scene.object, object_parts(scene.object), PROTOCOLS["standard"])
    errors = pose_errors(0, 2)
    assert noisy_share(world, result.grasps[0], PROTOCOLS["standard"], errors, stop=lambda: True) is None
    # Nor do none at all.
    assert noisy_share(world, result.grasps[0], PROTOCOLS["standard"], []) is None


def test_the_preset_and_only_it_ranks():
    assert load_preset("robust") == replace(load_preset("balanced"), robust=RobustConfig(rank=True))
    assert not load_preset("balanced").robust.rank


def test_figures_of_the_benchmark():
    rows = [
        {"shares": [0.5, 1.0, 0.0], "ranked_by": [0.5, 1.0, 0.25], "score": [3.0, 2.0, 1.0]},
        {"shares": [1.0, 0.0], "ranked_by": [0.0, 1.0], "score": [2.0, 1.0]},
    ]
    by_score, by_noise, best = orders(rows)
    assert by_score.tolist() == [0.75, 0.5]
    assert by_noise.tolist() == [0.5, 0.75]
    assert best.tolist() == [1.0, 0.25]
    # Ranks (2, 3, 1) against (3, 2, 1): one half; and of two, the same way or the other.
    assert correlation(rows, "score") == pytest.approx((0.5 + 1.0) / 2)
    assert correlation(rows, "ranked_by") == pytest.approx((1.0 - 1.0) / 2)


@pytest.mark.parametrize("preset", ["fast", "random_closure"])
def test_a_watched_run_ends_as_one_that_nobody_watches(preset: str):
    scene, hand, seen = load_scene("shape:box"), load_hand("parallel_gripper"), list[Snapshot]()
    watched = plan_grasps(scene, hand, count=3, preset=preset, measure=False, watch=seen.append)
    alone = plan_grasps(scene, hand, count=3, preset=preset, measure=False)
    assert [g.grasp.position.tolist() for g in watched.tried] == [g.grasp.position.tolist() for g in alone.tried]
    starts = [s for s in seen if not s.verdicts]
    # The last of each round: the next has other candidates.
    tried = [s for s, after in pairwise([*seen, starts[0]]) if s.verdicts and not after.verdicts]
    assert starts
    assert all(np.isfinite(s.positions).all() and s.joint_positions.shape[1] == hand.num_joints for s in starts)
    told = [verdict for s in tried for verdict in s.verdicts if verdict is not Verdict.UNVERIFIED]
    assert sorted(told) == sorted(g.verdict for g in watched.tried)


def test_hands_are_seen_where_the_object_is_though_it_is_planned_on_about_its_own_centre():
    shape, far = make_shape("box"), np.array([40.0, 0.0, 0.0])
    scene, seen = load_scene(TriangleMesh(shape.vertices + far, shape.faces)), list[Snapshot]()
    plan_grasps(scene, load_hand("parallel_gripper"), count=1, preset="fast", measure=False, watch=seen.append)
    assert {bool(s.verdicts) for s in seen} == {True, False}
    assert all(np.abs(s.positions - far).max() < 1.0 for s in seen)


HAND = load_hand("parallel_gripper")

# Half of what the jaws leave between them [m]: the box is 60 mm wide.
CLEAR, TOUCH, PRESS = 0.05, 0.03, 0.02


def gripper_at(height: float) -> Grasp:
    """The jaws about a box at the origin, from above."""
    down = np.array([0.0, 1.0, 0.0, 0.0])
    clear, touch, press = (
        Posture(np.array([0.0, 0.0, height]), down, np.array([jaw])) for jaw in (CLEAR, TOUCH, PRESS)
    )
    return Grasp(clear, touch, press)


def test_a_grasp_that_holds_and_one_that_misses_come_back_in_their_order():
    scene = load_scene("shape:box")
    missed, held = verify_grasps(scene, HAND, [gripper_at(0.4), gripper_at(0.15)])
    assert (missed.verdict, held.verdict) == (Verdict.FAILED, Verdict.VERIFIED)
    assert missed.reason
    assert some(missed.metrics)["contact_area"] == 0
    # Both pads, each 24 mm wide and 69 mm along the box.
    assert some(held.metrics)["contact_area"] == pytest.approx(2 * 0.024 * 0.069, rel=0.35)


def test_what_is_not_asked_for_is_not_done_and_an_unknown_trial_is_refused():
    tried = replace(gripper_at(0.15), score=3.0)
    (grasp,) = verify_grasps(load_scene("shape:box"), HAND, [tried], verify="none", measure=False)
    assert (grasp.verdict, grasp.metrics, grasp.score) == (Verdict.UNVERIFIED, None, 3.0)
    with pytest.raises(ConfigError, match="verify: 'soft'; valid: standard"):
        verify_grasps(load_scene("shape:box"), HAND, [], verify="soft")


@pytest.mark.parametrize(
    ("change", "culprit"),
    [
        ({"joint_positions": np.zeros(16)}, r"grasp 1: squeeze.joint_positions .*; valid: 1 finite"),
        ({"position": np.array([0.0, np.nan, 0.0])}, "grasp 1: squeeze.position .*; valid: 3 finite"),
        ({"quaternion_wxyz": np.array([0.0, 2.0, 0.0, 0.0])}, "grasp 1: squeeze.quaternion_wxyz has length 2"),
        ({"position": np.full(3, 9.0)}, "grasp 1: the base in squeeze has another pose than in grasp"),
    ],
)
def test_a_posture_that_fits_no_hand_is_refused(change: dict, culprit: str):
    good = gripper_at(0.15)
    bad = replace(good, squeeze=replace(good.squeeze, **change))
    with pytest.raises(ConfigError, match=culprit):
        verify_grasps(load_scene("shape:box"), HAND, [good, bad])


def test_postures_of_lists_are_refused_in_one_line():
    given = gripper_at(0.15)
    # The type checks of the tests would refuse a list before.
    object.__setattr__(given.pregrasp, "position", [0.0, 0.0, 0.2])
    with pytest.raises(
        ConfigError, match=r"grasp 0: pregrasp.position is \[0.0, 0.0, 0.2\]; valid: 3 finite numbers in an array"
    ):
        verify_grasps(load_scene("shape:box"), HAND, [given])


def test_an_arrival_posture_stays_clear_of_obstacles():
    """A wall stands where the open hand would arrive, but neither before nor after."""
    scene, hand = load_scene("shape:box", mass=0.1), load_hand("allegro_right")
    context = make_metrics_context(scene.object, hand)
    ways = [sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)]

    def extent(posture: Posture) -> np.ndarray:
        return (placed_hand(context, posture).points @ np.column_stack(ways)).max(0)

    grasps = plan_grasps(scene, hand, count=6, preset="fast", measure=False).grasps
    free = [(grasp, posture) for grasp in grasps if (posture := arrival(context, grasp, None)) is not None]
    beyond = [extent(posture) - np.maximum(extent(g.grasp), extent(g.pregrasp)) for g, posture in free]
    place, way = np.unravel_index(np.argmax(beyond), np.shape(beyond))
    (grasp, posture), outward = free[place], ways[way]
    assert beyond[place][way] > 2e-3
    begin = float(extent(posture)[way] - beyond[place][way] + 5e-4)
    low, high = np.full(3, -0.3), np.full(3, 0.3)
    axis, end = int(np.abs(outward).argmax()), begin + 0.05
    low[axis], high[axis] = sorted(outward[axis] * np.array([begin, end]))
    clear = arrival(context, grasp, None, (make_obstacle(box_between(low, high)),))
    assert clear is None or extent(clear)[way] < begin + 1e-3
