"""Adaptive fidelity: a cheap first round where a trial tells, more effort in each further one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from graspd_core.config import RoundsConfig
from graspd_core.hands.library import load_hand
from graspd_core.mesh.shapes import make_shape
from graspd_core.optimize.candidates import Candidates
from graspd_core.optimize.plan_config import PlanConfig, load_preset
from graspd_core.perception.load_scene import load_scene
from graspd_core.perception.scene import Obstacle, Scene
from graspd_core.planning import rounds as planning_rounds
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.planning.rounds import rounds_of
from graspd_core.types import Plane


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
    assert rounds(replace(scene, confidence=torch.ones(scene.sdf.field.shape[1:]))) == all_steps


def test_rounds_are_a_setting(scene):
    steady = PlanConfig(rounds=RoundsConfig(most=2, first_budget=1.0, growth=1.0))
    assert rounds_of(scene, steady, "standard") == [steady, steady]
    for name in ("fast", "accurate"):
        assert rounds_of(scene, load_preset(name), "standard")[0] == load_preset(name)


def test_where_nothing_is_found_more_is_sought_however_few_are_asked_for(scene, monkeypatch):
    asked = []

    def none_found(scene, hand, *, count, **settings):
        asked.append(count)
        return Candidates((), "")

    monkeypatch.setattr(planning_rounds, "find_candidates", none_found)
    plan_grasps(scene, load_hand("parallel_gripper"), count=1)
    assert asked == [1, 8, 8]
    asked.clear()
    plan_grasps(scene, load_hand("parallel_gripper"), count=20)
    assert asked == [2, 20, 20, 20]
