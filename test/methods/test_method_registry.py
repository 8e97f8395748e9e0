"""A method is added by one row: presets, planning, the command line and the charts take it from there."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import pytest

from graspd_bench.charts import draw_charts
from graspd_bench.study import Request
from graspd_bench.suites import main_suite
from graspd_core.cli import build_parser
from graspd_core.errors import ConfigError
from graspd_core.optimize.candidates import PlannerInput, PlannerOutput, initial_poses_of, problem_of
from graspd_core.optimize.plan_config import METHODS, Method, PlanConfig, load_preset, override, plan_config, to_mapping
from graspd_core.perception.load_scene import load_scene
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.types import Verdict

RECORD = {
    "kind": "raw",
    "object": "box",
    "hand": "allegro_right",
    "seed": 0,
    "count": 2,
    "given": 2,
    "held": 1,
    "error": "",
    "code": "0.1.0+abc",
    "machine": "2 cores",
    "cpu": {"scene": 1.0, "optimise": 2.0, "standard": 3.0},
    "wall": {"scene": 2.0, "optimise": 4.0, "standard": 6.0},
    "cell_cpu": 12.0,
    "peak_mb": 600.0,
    "grasps": [{"standard": {"passed": passed}, "metrics": {"penetration": 1e-3}} for passed in (True, False)],
}


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


def test_the_charts_draw_a_new_method(dummy: str, tmp_path: Path):
    records = [
        {**RECORD, "name": name, "method": method} for name, method in (("mine", dummy), ("fast", "closed_form"))
    ]
    drawn = draw_charts(records, tmp_path / "chart")
    text = drawn["speed"].with_suffix(".svg").read_text()
    assert "a dummy" in text
    assert "#123456" in text


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
