"""A method is added by one row; presets, ablations and budgets change what they name; searches go on where few hold."""

import sys
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest
import torch
from expected import refused
from hypothesis import given
from hypothesis import strategies as st

from graspd_bench.study import Request
from graspd_bench.suites import main_suite
from graspd_core import Grasp, Verdict, draw_starts, load_hand, load_scene, plan_grasps
from graspd_core.cli import build_parser
from graspd_core.errors import ConfigError
from graspd_core.optimize.candidates import PlannerInput, PlannerOutput, expected_to_hold, find_candidates
from graspd_core.optimize.closed_form.closed_form import ClosedForm
from graspd_core.optimize.closed_form.closed_form_config import ClosedFormConfig, LossWeights
from graspd_core.optimize.loop import Hooks, pack
from graspd_core.optimize.losses import hard_contact, soft_contact
from graspd_core.optimize.plan_config import METHODS, Method, PlanConfig, load_preset, override, plan_config, to_mapping


@dataclass(frozen=True)
class DummyConfig:
    starts: int = 3


def plan(task: PlannerInput) -> PlannerOutput:
    count = task.config.settings.starts
    return PlannerOutput(draw_starts(task.scene, task.hand, count, task.seed, task.device, task.dtype))


@pytest.fixture
def dummy(monkeypatch: pytest.MonkeyPatch) -> str:
    module = ModuleType("dummy_method")
    module.plan = plan  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "dummy_method", module)
    monkeypatch.setitem(METHODS, "dummy", Method("dummy_method", DummyConfig, "a dummy", "#123456", "*", 2))
    return "dummy"


def test_a_preset_file_sets_a_new_method(dummy: str, tmp_path: Path):
    path = tmp_path / "mine.yaml"
    path.write_text("method: dummy\ndummy: {starts: 5}\n")
    config = load_preset(str(path))
    assert config == PlanConfig(method=dummy, settings=DummyConfig(5))
    assert plan_config(to_mapping(config)) == config
    assert override(config, {"dummy.starts": 7}).settings == DummyConfig(7)
    assert config.at_budget(0.5) == config


def test_plan_grasps_runs_a_new_method_and_a_pose_that_is_not_finite_costs_no_other_pose(dummy: str, hand, monkeypatch):
    def spoilt(task: PlannerInput) -> PlannerOutput:
        poses = plan(task).poses
        poses.translation[0, 0], poses.joints[1, 0], poses.quaternion[2] = torch.nan, torch.inf, 0.0
        return PlannerOutput(poses)

    monkeypatch.setattr(sys.modules["dummy_method"], "plan", spoilt)
    config = PlanConfig(method=dummy, settings=DummyConfig(5))
    result = plan_grasps(load_scene("shape:sphere", resolution=16), hand, count=5, preset=config, verify="none")
    assert result.method == dummy
    assert 0 < len(result.grasps) <= 2 * config.rounds.most
    assert {grasp.verdict for grasp in result.grasps} == {Verdict.UNVERIFIED}


def test_the_command_line_and_the_benchmark_know_a_new_method(dummy: str, tmp_path: Path):
    options = build_parser().parse_args(["synthesize", "shape:box", "--out", "x.json", "--method", dummy])
    assert options.method == dummy
    path = tmp_path / "mine.yaml"
    path.write_text("method: dummy\n")
    cells = main_suite(Request(presets=(str(path),), objects=("shape:box",)))
    assert {cell.count for cell in cells if cell.kind == "raw"} == {2}


@pytest.mark.parametrize(
    ("values", "culprits"),
    [
        ({"method": "magic"}, ["'magic'", *METHODS]),
        ({"method": ["a"]}, ["method", "closed_form"]),
        ({"graspd2022": {}}, ["graspd2022", "method: closed_form"]),
    ],
)
def test_a_method_that_is_not_there_or_not_chosen_is_named(values: dict, culprits: list[str]):
    with refused(ConfigError, *culprits):
        plan_config(values)


def test_settings_of_another_method_are_refused():
    with pytest.raises(ConfigError, match="settings of annealing: ClosedFormConfig; valid: AnnealingConfig"):
        PlanConfig(method="annealing", settings=PlanConfig().settings)


DEFAULT = ClosedFormConfig()
DOUBLE = torch.float64


@pytest.mark.parametrize(
    ("preset", "expected"),
    [
        ("closed_form_no_coarse_to_fine", replace(DEFAULT, radius_start=0.0, delta_start=DEFAULT.delta_end)),
        ("closed_form_hard_contact", replace(DEFAULT, activation="hard")),
        (
            "closed_form_no_self_collision",
            replace(
                DEFAULT,
                weights=replace(DEFAULT.weights, self_collision=0.0),
                polish_weights=replace(DEFAULT.polish_weights, self_collision=0.0),
            ),
        ),
    ],
)
def test_an_ablation_changes_only_what_it_names(preset: str, expected: ClosedFormConfig):
    assert load_preset(preset) == replace(load_preset("balanced"), settings=expected)


@pytest.mark.parametrize("method", ["annealing", "random_closure"])
def test_baselines_have_a_preset_that_changes_the_method_alone(method: str):
    assert load_preset(method) == load_preset("balanced").with_method(method)


def test_a_hard_contact_is_one_within_its_width_and_zero_beyond_without_gradient():
    distance = torch.tensor([[-0.005, -0.004, 0.0, 0.003, 0.0041]], dtype=DOUBLE, requires_grad=True)
    radius = torch.zeros(1, dtype=DOUBLE)
    assert hard_contact(distance, radius, 0.004).tolist() == [[0.0, 1.0, 1.0, 1.0, 0.0]]
    assert not hard_contact(distance, radius, 0.004).requires_grad
    assert soft_contact(distance, radius, 0.004).requires_grad
    assert hard_contact(distance, radius + 0.004, 0.001).tolist() == [[0.0, 0.0, 0.0, 1.0, 1.0]]


def test_the_hard_solver_looks_no_farther_than_the_end_width(hand, scenes, problem_of):
    problem = problem_of("box", DOUBLE)
    starts = draw_starts(scenes["box"], hand, 2, 0, "cpu", DOUBLE)
    # From the start, centimetres off and without padding, no candidate is within 4 mm: the task has no slope at all.
    only_task = LossWeights(wrench_resistance=1.0, distance=0.0, penetration=0.0, self_collision=0.0, posture=0.0)
    config = replace(DEFAULT, activation="hard", weights=only_task)
    x = pack(replace(starts, translation=starts.translation + 0.2))
    radius = x.new_zeros(len(x))
    hard = ClosedForm(config, 2).value_and_gradient(problem, x, radius, config.delta_end, fine=False, sharp=False)[1]
    soft = ClosedForm(replace(config, activation="soft"), 2)
    assert hard.abs().max() == 0
    assert soft.value_and_gradient(problem, x, radius, config.delta_start, fine=False, sharp=False)[1].abs().max() > 0


CONFIG = load_preset("balanced")


def search_of(scale: float, searches: int, hooks: Hooks) -> PlannerInput:
    """The search for four grasps of a ball of 70 mm times that scale."""
    config = replace(CONFIG, settings=replace(CONFIG.settings, searches=searches))
    scene = load_scene("shape:sphere", scale=scale, resolution=config.resolution)
    hand = load_hand("allegro_right", candidates=config.problem.fine_candidates)
    return PlannerInput(scene, hand, count=4, seed=0, config=config, hooks=hooks)


@cache
def searched(scale: float, searches: int) -> tuple[Grasp, ...]:
    return find_candidates(search_of(scale, searches, Hooks()))


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

    hooks = Hooks(report=lambda step, of, loss: steps.append(step), stop=stop, interval=0.0)
    found = find_candidates(search_of(0.25, 3, hooks))
    assert steps.count(max(steps)) == 1
    assert scores(found) == scores(once)


@pytest.mark.parametrize("name", sorted(set(METHODS) - {"closed_form"}))
def test_other_methods_search_once_as_published(name: str):
    assert METHODS[name].searches(METHODS[name].config()) == 1


def test_no_score_is_too_far_for_a_probability():
    (grasp, *_) = searched(1.0, 1)
    far = [expected_to_hold([replace(grasp, score=score)]) for score in (-1e5, -800.0, 0.0, 800.0, 1e5)]
    assert far == [0.0, 0.0, 0.5, 1.0, 1.0]


USUAL = PlanConfig()
STEPS, STARTS = ("explore_steps", "refine_steps", "polish_steps"), ("starts_per_grasp", "keep_per_grasp")


def figures(config: PlanConfig, names: tuple[str, ...]) -> list[float]:
    return [getattr(config.settings, name) for name in names]


def test_half_the_budget_is_half_the_steps_and_twice_is_twice_the_starts():
    assert USUAL.at_budget(1.0) == USUAL
    assert figures(USUAL.at_budget(0.5), STEPS) == [25, 40, 40]
    assert figures(USUAL.at_budget(2.0), STARTS) == [16.0, 4.0]
    # With less than the budget there is one search, and a stage without steps stays so.
    assert [USUAL.at_budget(budget).settings.searches for budget in (0.9, 1.0, 2.0)] == [1, 3, 3]
    without = replace(USUAL, settings=replace(USUAL.settings, polish_steps=0))
    assert without.at_budget(0.3).settings.polish_steps == 0


def test_more_than_the_usual_budget_draws_the_whole_hand_to_the_object():
    usual, more = USUAL.settings, USUAL.at_budget(2.0).settings
    assert (more.polish_steps, more.fine_steps) > (usual.polish_steps, usual.fine_steps)
    assert more.polish_weights.distance > usual.polish_weights.distance
    # What a preset already does more is kept, and twice more multiplies nothing but the starts.
    rich = load_preset("contact_rich")
    assert rich.at_budget(2.0).settings == replace(rich.settings, starts_per_grasp=32.0, keep_per_grasp=8.0)
    twice = USUAL.at_budget(2.0).at_budget(2.0).settings
    assert twice == replace(more, starts_per_grasp=32.0, keep_per_grasp=8.0)


@given(st.floats(0.01, 10.0), st.floats(0.01, 10.0))
def test_more_budget_is_never_less_of_anything(one: float, other: float):
    small, large = (USUAL.at_budget(budget) for budget in sorted((one, other)))
    for names in (STEPS, STARTS):
        assert all(a <= b for a, b in zip(figures(small, names), figures(large, names), strict=True))
    assert min(figures(small, STEPS)) >= 1
