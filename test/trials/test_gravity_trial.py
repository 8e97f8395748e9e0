"""The drop trial on grasps whose fate can be told beforehand."""

from __future__ import annotations

import numpy as np
import pytest

from graspd_core.trials.gravity_trial import LOST, gravity_trial
from graspd_core.trials.world import PROTOCOLS, World, build_world

STANDARD = PROTOCOLS["standard"]


@pytest.fixture(scope="module")
def world(gripper, cube) -> World:
    return build_world(gripper, cube, (cube.mesh,), STANDARD)


def test_a_firm_squeeze_gives_no_more_than_its_springs(world, closing):
    # Both fingers yield to 0.98 N along y by 0.98 N over both springs, and friction holds the rest.
    springs = 0.98 / (2 * STANDARD.slide_stiffness)
    assert gravity_trial(world, closing(0.015, 0.0249, (0.033, 0.033)), STANDARD) < springs + 0.001


def test_an_object_out_of_reach_is_lost(world, closing):
    assert gravity_trial(world, closing(0.015, 0.025, (0.03, 0.03), height=-0.3), STANDARD) == pytest.approx(LOST)


def test_a_start_that_the_hold_trial_refuses_is_lost(world, closing):
    assert gravity_trial(world, closing(0.04, 0.04, (0.04, 0.04)), STANDARD) == LOST


def test_an_open_hand_stops_the_object_in_the_directions_where_it_stands(world, closing):
    # Fingers 5 mm off either side along y; the palm 10 mm below. Nothing along ±x and +z.
    moved = gravity_trial(world, closing(0.02, 0.02, (0.02, 0.02), height=-0.03), STANDARD)
    assert moved == pytest.approx((3 * LOST + 2 * 0.005 + 0.01) / 6, abs=0.002)


def test_the_same_trial_gives_the_same_figure_and_can_be_stopped(world, closing):
    grasp = closing(0.015, 0.025, (0.026, 0.026))
    assert gravity_trial(world, grasp, STANDARD) == gravity_trial(world, grasp, STANDARD)
    assert np.isfinite(gravity_trial(world, grasp, STANDARD, stop=lambda: True))
