"""A method is added by one row; presets and ablations change what they name and nothing else."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import pytest
import torch

from graspd_bench.baselines.annealing import AnnealingConfig
from graspd_bench.baselines.random_closure import RandomClosureConfig
from graspd_bench.study import Request
from graspd_bench.suites import main_suite
from graspd_core.cli import build_parser
from graspd_core.errors import ConfigError
from graspd_core.optimize.candidates import PlannerInput, PlannerOutput, find_candidates, initial_poses_of, problem_of
from graspd_core.optimize.closed_form.closed_form import ClosedForm
from graspd_core.optimize.closed_form.closed_form_config import ClosedFormConfig, LossWeights
from graspd_core.optimize.graspd2022.graspd2022_config import Graspd2022Config, LevelSetConfig
from graspd_core.optimize.initial_poses import draw_starts
from graspd_core.optimize.loop import Hooks, pack
from graspd_core.optimize.losses import hard_contact, soft_contact
from graspd_core.optimize.plan_config import METHODS, Method, PlanConfig, load_preset, override, plan_config, to_mapping
from graspd_core.perception.load_scene import load_scene
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.types import Verdict


@dataclass(frozen=True)
class DummyConfig:
    starts: int = 3


def plan(task: PlannerInput) -> PlannerOutput:
    problem = problem_of(task)
    return PlannerOutput(problem, initial_poses_of(task, task.config.settings.starts))


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


def test_plan_grasps_runs_a_new_method(dummy: str, hand):
    result = plan_grasps(
        load_scene("shape:sphere", resolution=16), hand, count=2, preset=PlanConfig(method=dummy), verify="none"
    )
    assert result.method == dummy
    assert [grasp.verdict for grasp in result.grasps] == [Verdict.UNVERIFIED] * len(result.grasps)


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
    with pytest.raises(ConfigError) as caught:
        plan_config(values)
    assert all(word in str(caught.value) for word in culprits)


def test_settings_of_another_method_are_refused():
    with pytest.raises(ConfigError, match="ClosedFormConfig is not AnnealingConfig of annealing"):
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


SHORT = {
    "closed_form": (replace(DEFAULT, explore_steps=1, refine_steps=1, polish_steps=1), 3),
    "graspd2022": (Graspd2022Config(steps=4, level_set=LevelSetConfig(coarse_steps=1)), 4),
    "annealing": (AnnealingConfig(steps=5), 5),
    # Fingers close over twice the way from open to closed.
    "random_closure": (RandomClosureConfig(close_steps=6), 12),
}


@pytest.mark.parametrize("method", METHODS)
def test_each_method_takes_its_own_steps(hand, scenes, method: str):
    settings, expected = SHORT[method]
    steps: list[int] = []
    hooks = Hooks(report=lambda _, of, __: steps.append(of), stop=lambda: bool(steps), interval=0.0)
    config = PlanConfig(method=method, settings=settings)
    find_candidates(scenes["sphere"], hand, count=1, seed=0, config=config, hooks=hooks)
    assert steps[0] == expected


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
