"""Searches: again from other starts where the ranking expects too few grasps to hold, and only there."""

from __future__ import annotations

from dataclasses import replace

import pytest

from graspd_core.hands.library import load_hand
from graspd_core.optimize.candidates import expected_to_hold, find_candidates
from graspd_core.optimize.loop import Hooks
from graspd_core.optimize.plan_config import METHODS, load_preset, method_row
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
