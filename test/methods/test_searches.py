"""How much is searched: steps and starts by the budget, and again where too few grasps are expected to hold."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd_core.hands.library import load_hand
from graspd_core.optimize.candidates import expected_to_hold, find_candidates
from graspd_core.optimize.loop import Hooks
from graspd_core.optimize.plan_config import METHODS, PlanConfig, load_preset, method_row
from graspd_core.perception.load_scene import load_scene
from graspd_core.types import Grasp

CONFIG = load_preset("balanced")


def searched(scale: float, searches: int, hooks: Hooks | None = None) -> tuple[Grasp, ...]:
    """Candidates for four grasps of a ball of 70 mm times that scale."""
    config = replace(CONFIG, settings=replace(CONFIG.settings, searches=searches))
    scene = load_scene("shape:sphere", scale=scale, resolution=config.resolution)
    hand = load_hand("allegro_right", candidates=config.problem.fine_candidates)
    return find_candidates(scene, hand, count=4, seed=0, config=config, hooks=hooks or Hooks()).grasps


def scores(grasps: tuple[Grasp, ...]) -> list[float]:
    return [grasp.score for grasp in grasps]


def test_an_ordinary_object_is_searched_once():
    once, thrice = searched(1.0, 1), searched(1.0, 3)
    assert expected_to_hold(once[:4]) >= 3.6
    assert scores(once) == scores(thrice)


def test_a_small_one_is_searched_again_and_the_best_of_all_come_first():
    once, twice = searched(0.25, 1), searched(0.25, 2)
    assert expected_to_hold(once[:4]) < 3.6
    assert set(scores(once)) < set(scores(twice))
    assert scores(twice) == sorted(scores(twice), reverse=True)
    assert expected_to_hold(twice[:4]) > expected_to_hold(once[:4])


def test_a_search_that_is_cancelled_is_the_last():
    steps: list[int] = []
    once, stops = searched(0.25, 1), iter([True])

    def stop() -> bool:
        """Once, when a second search has begun."""
        return len(steps) > 1 and steps[-1] < steps[-2] and next(stops, False)

    found = searched(0.25, 3, Hooks(report=lambda step, of, loss: steps.append(step), stop=stop, interval=0.0))
    assert steps.count(max(steps)) == 1
    assert scores(found) == scores(once)


@pytest.mark.parametrize("name", sorted(set(METHODS) - {"closed_form"}))
def test_other_methods_search_once_as_published(name: str):
    assert method_row(name).searches(method_row(name).config()) == 1


def test_no_score_is_too_far_for_a_probability():
    (grasp, *_) = searched(1.0, 1)
    far = [expected_to_hold([replace(grasp, score=score)]) for score in (-1e5, -800.0, 0.0, 800.0, 1e5)]
    assert far == [0.0, 0.0, 0.5, 1.0, 1.0]


DEFAULTS = PlanConfig()
STEPS, STARTS = ("explore_steps", "refine_steps", "polish_steps"), ("starts_per_grasp", "keep_per_grasp")


def figures(config: PlanConfig, names: tuple[str, ...]) -> list[float]:
    return [getattr(config.settings, name) for name in names]


def test_half_the_budget_is_half_the_steps_and_twice_is_twice_the_starts():
    assert DEFAULTS.at_budget(1.0) == DEFAULTS
    assert figures(DEFAULTS.at_budget(0.5), STEPS) == [25, 40, 40]
    assert figures(DEFAULTS.at_budget(2.0), STARTS) == [16.0, 4.0]
    # With less than the budget there is one search, and a stage without steps stays so.
    assert [DEFAULTS.at_budget(budget).settings.searches for budget in (0.9, 1.0, 2.0)] == [1, 3, 3]
    without = replace(DEFAULTS, settings=replace(DEFAULTS.settings, polish_steps=0))
    assert without.at_budget(0.3).settings.polish_steps == 0


@given(st.floats(0.01, 10.0), st.floats(0.01, 10.0))
def test_more_budget_is_never_less_of_anything(one: float, other: float):
    small, large = (DEFAULTS.at_budget(budget) for budget in sorted((one, other)))
    for names in (STEPS, STARTS):
        assert all(a <= b for a, b in zip(figures(small, names), figures(large, names), strict=True))
    assert min(figures(small, STEPS)) >= 1
