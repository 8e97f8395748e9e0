"""Adaptive fidelity: a cheap first round where a trial tells, more effort in each further one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graspd_core.config import RoundsConfig
from graspd_core.methods.plan_config import PlanConfig, load_preset
from graspd_core.planning.rounds import rounds_of
from graspd_core.scene.load_scene import load_scene
from graspd_core.types import Plane


@pytest.fixture(scope="module")
def scene():
    return load_scene("shape:box", resolution=16)


def efforts(*values: float) -> list[PlanConfig]:
    return [PlanConfig().at_budget(value) for value in values]


def test_a_known_object_alone_begins_cheaply(scene):
    assert rounds_of(scene, PlanConfig(), "standard") == efforts(0.5, 1.0, 2.0)


def test_without_a_trial_or_with_something_about_it_the_first_round_has_all_steps(scene):
    table = replace(scene, support=Plane(np.array([0.0, 0.0, 1.0]), -0.045))
    assert rounds_of(scene, PlanConfig(), "none") == efforts(1.0, 2.0, 2.0)
    assert rounds_of(table, PlanConfig(), "standard") == efforts(1.0, 2.0, 2.0)


def test_rounds_are_a_setting(scene):
    steady = PlanConfig(rounds=RoundsConfig(most=2, first_budget=1.0, growth=1.0))
    assert rounds_of(scene, steady, "standard") == [steady, steady]
    for name in ("fast", "accurate"):
        assert rounds_of(scene, load_preset(name), "standard")[0] == load_preset(name)
