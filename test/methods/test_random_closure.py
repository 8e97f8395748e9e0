"""The random baseline: from random sides, touching and never sunk in, reproducible, any hand, and it can be stopped."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from graspd_bench.baselines.random_closure import RandomClosureConfig, advance, draw_approaches, plan, touching_groups
from graspd_core.config import ProblemConfig
from graspd_core.hands.kinematics import forward
from graspd_core.hands.library import hand_names, load_hand
from graspd_core.optimize.candidates import PlannerInput, PlannerOutput, find_candidates
from graspd_core.optimize.finger_closing import link_gaps, make_closing
from graspd_core.optimize.loop import Hooks
from graspd_core.optimize.obstacle_distance import obstacle_gaps
from graspd_core.optimize.plan_config import PlanConfig
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import Plane

DOUBLE = torch.float64
CONFIG = PlanConfig(
    method="random_closure",
    settings=RandomClosureConfig(close_steps=30),
    problem=ProblemConfig(candidates=60, features=24, directions=12),
)


def search(scene, hand, *, count: int = 4, seed: int = 0, hooks: Hooks | None = None, config=CONFIG) -> PlannerOutput:
    hooks = Hooks() if hooks is None else hooks
    return plan(PlannerInput(scene, hand, count, seed, config, hooks, dtype=DOUBLE))


def test_what_it_finds_touches_with_enough_links_and_sinks_nowhere(scenes, hand):
    found = search(scenes["cylinder"], hand, count=3)
    closing = make_closing(found.problem, hand, 30)
    assert len(found.poses.joints) == 3
    assert link_gaps(found.problem, found.poses, closing.sphere_links)[:, 0].min() >= 0
    reach = CONFIG.grasp_stages.touch_reach
    assert (touching_groups(found.problem, closing, hand, found.poses, reach) >= 3).all()


def test_approaches_come_from_all_sides_with_the_palm_facing_the_object(problem_of, hand):
    problem = problem_of("box", DOUBLE)
    tries = draw_approaches(problem, hand, 2000, 0)
    normal = rotation_from_quaternion(tries.quaternion) @ torch.as_tensor(hand.palm_normal)
    palm = tries.translation + rotation_from_quaternion(tries.quaternion) @ torch.as_tensor(hand.palm_center)
    off = problem.object.center - palm
    assert ((off * normal).sum(-1) / off.norm(dim=-1)).min() == pytest.approx(1.0, abs=1e-9)
    # 2000 uniform directions: each mean is zero within four standard errors (1 / √(3 · 2000) = 0.013).
    assert normal.mean(0).abs().max() < 0.052
    assert (normal * normal).mean(0).tolist() == pytest.approx([1 / 3] * 3, abs=0.03)


def test_the_advance_ends_at_the_first_touch(problem_of, hand):
    problem = problem_of("sphere", DOUBLE)
    closing = make_closing(problem, hand, 30)
    tries = draw_approaches(problem, hand, 8, 1)
    there = advance(problem, closing, hand, tries)
    gap = link_gaps(problem, there, closing.sphere_links)[:, 0].amin(-1)
    assert link_gaps(problem, tries, closing.sphere_links)[:, 0].min() > 0.01
    assert gap.min() >= 0
    # The palm meets a sphere head on: nothing is grazed, so the tracing comes to its end.
    assert gap.max() < 1e-3


def test_the_same_seed_gives_the_same_hands_and_another_seed_others(scenes, hand):
    first, again, other = (search(scenes["box"], hand, count=2, seed=seed).poses for seed in (3, 3, 4))
    assert torch.equal(first.joints, again.joints)
    assert torch.equal(first.translation, again.translation)
    assert not torch.equal(first.translation, other.translation)


def test_it_stops_when_told_and_at_the_deadline(scenes, hand):
    cancelled = search(scenes["box"], hand, hooks=Hooks(stop=lambda: True))
    late = search(scenes["box"], hand, hooks=Hooks(deadline=time.perf_counter()))
    assert (cancelled.interrupted, len(cancelled.poses.joints)) == ("cancelled", 0)
    assert (late.interrupted, len(late.poses.joints)) == ("deadline", 0)


def test_what_asks_for_more_links_than_touch_gives_nothing(scenes, hand):
    strict = replace(CONFIG, settings=replace(CONFIG.settings, touching=12, rounds=1))
    found = search(scenes["sphere"], hand, count=2, config=strict)
    assert (found.interrupted, len(found.poses.joints)) == ("", 0)


def test_its_poses_become_ranked_grasps(scenes, hand):
    candidates = find_candidates(scenes["cylinder"], hand, count=3, seed=0, config=CONFIG, hooks=Hooks())
    assert 1 <= len(candidates.grasps) <= 3
    scores = [grasp.score for grasp in candidates.grasps]
    assert scores == sorted(scores, reverse=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", hand_names())
def test_it_works_with_every_hand(scenes, name):
    found = search(scenes["sphere"], load_hand(name, candidates=120), count=3)
    assert len(found.poses.joints) >= 1


def test_obstacles_are_kept_clear_of(hand, scenes):
    scene = scenes["cylinder"]
    low = float(scene.object.mesh.vertices[:, 2].min())
    found = search(replace(scene, support=Plane(np.array([0.0, 0.0, 1.0]), low)), hand, count=3)
    obstacles = found.problem.obstacles
    assert obstacles is not None
    gaps = obstacle_gaps(obstacles, found.poses.base, forward(found.problem.hand.kinematics, found.poses.joints))
    assert len(gaps) >= 1
    assert gaps.min() >= 0
