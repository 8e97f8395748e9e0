"""Budget: fewer steps below one, more starts above it, and nothing else."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from graspd_core.optimize.plan_config import PlanConfig

CONFIG = PlanConfig()
STEPS, STARTS = ("explore_steps", "refine_steps", "polish_steps"), ("starts_per_grasp", "keep_per_grasp")


def figures(config: PlanConfig, names: tuple[str, ...]) -> list[float]:
    return [getattr(config.settings, name) for name in names]


def test_an_budget_of_one_is_the_settings():
    assert CONFIG.at_budget(1.0) == CONFIG


def test_half_the_budget_is_half_the_steps_and_twice_is_twice_the_starts():
    assert figures(CONFIG.at_budget(0.5), STEPS) == [25, 40, 40]
    assert figures(CONFIG.at_budget(2.0), STARTS) == [16.0, 4.0]


def test_less_than_the_budget_searches_once():
    assert [CONFIG.at_budget(budget).settings.searches for budget in (0.9, 1.0, 2.0)] == [1, 3, 3]


@given(st.floats(0.01, 10.0), st.floats(0.01, 10.0))
def test_more_budget_is_never_less_of_anything(one: float, other: float):
    small, large = (CONFIG.at_budget(budget) for budget in sorted((one, other)))
    for names in (STEPS, STARTS):
        assert all(a <= b for a, b in zip(figures(small, names), figures(large, names), strict=True))
    assert min(figures(small, STEPS)) >= 1


def test_a_stage_without_steps_stays_so():
    without = replace(CONFIG, settings=replace(CONFIG.settings, polish_steps=0))
    assert without.at_budget(0.3).settings.polish_steps == 0
