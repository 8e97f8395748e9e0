"""Grasps ranked by how they hold out of place: order, share, deadline, and what of it leaves graspd."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graspd_bench.studies.robust_ranking import correlation, orders
from graspd_core.config import RobustConfig
from graspd_core.hands.library import load_hand
from graspd_core.io.grasps_json import result_document
from graspd_core.optimize.plan_config import load_preset
from graspd_core.perception.load_scene import load_scene
from graspd_core.perception.scene import object_parts
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.types import Grasp, GraspMetrics, Outcome, Posture, Progress, Stage, Verdict
from graspd_core.verify.hold_trial import noisy_share, pose_errors
from graspd_core.verify.verification import most_robust_first
from graspd_core.verify.world import PROTOCOLS, build_world

POSTURE = Posture(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(1))


def order(shares: dict[float, float | None]) -> list[float]:
    """Scores of grasps in the order that the given shares bring about."""
    measured = [GraspMetrics({"robustness": share}) for share in shares.values()]
    grasps = [Grasp(POSTURE, POSTURE, POSTURE, (), s, m) for s, m in zip(shares, measured, strict=True)]
    return [grasp.score for grasp in most_robust_first(grasps)]


def test_the_most_robust_come_first_and_level_ones_keep_their_order():
    assert order({5.0: 0.5, 4.0: 1.0, 3.0: 0.125, 2.0: 1.0}) == [4.0, 2.0, 5.0, 3.0]


def test_those_nobody_tried_stand_between_good_and_bad():
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
    assert document["config"]["robust"] == {"rank": True, "trials": 2, "hold_time": 0.1}
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
