"""The drop trial on grasps whose fate can be told beforehand."""

from __future__ import annotations

import pytest

from graspd_bench.trials import LOST, gravity_trial
from graspd_core.verify.world import PROTOCOLS

STANDARD = PROTOCOLS["standard"]


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


def test_the_same_trial_gives_the_same_figure_whatever_was_tried_between(world, closing):
    grasp = closing(0.015, 0.025, (0.026, 0.026))
    first = gravity_trial(world, grasp, STANDARD)
    assert 0 < first < LOST
    assert gravity_trial(world, closing(0.015, 0.025, (0.03, 0.03), height=-0.3), STANDARD) > first
    assert gravity_trial(world, grasp, STANDARD) == first


def test_a_direction_that_is_cut_short_counts_with_what_it_came_to(world, closing):
    far = closing(0.015, 0.025, (0.03, 0.03), height=-0.3)
    assert gravity_trial(world, far, STANDARD, stop=lambda: True) == 0.0
    # After 0.2 s, two looks, the object has fallen 20 cm and is lost; the other directions are not begun.
    looks = iter([False, False])
    assert gravity_trial(world, far, STANDARD, stop=lambda: next(looks, True)) == pytest.approx(LOST / 6)
