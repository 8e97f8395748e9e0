"""One place to add a metric or a trial: a row that is added here shows everywhere, with nothing else edited."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from expected import some
from std_msgs.msg import Header

from graspd_bench import tables
from graspd_core import PlanConfig, load_hand, load_scene
from graspd_core.errors import ConfigError
from graspd_core.io.grasps_json import grasps_of, result_document
from graspd_core.types import Contact, Grasp, GraspResult, Outcome, Posture, Timing, TrialResult, Verdict
from graspd_core.verify.metrics import METRICS, Metric, measure
from graspd_core.verify.prepared_grasp import make_metrics_context
from graspd_core.verify.trial_registry import TRIALS, Trial, TrialContext, grasp_trials
from graspd_core.verify.world import PROTOCOLS, build_world
from graspd_ros.outputs.messages import grasp_message
from graspd_ros.outputs.responses import result_event
from graspd_ros.parameters import Settings

ROOT = Path(__file__).parents[1]
HEIGHT = Metric("height", "mm", 1e3, lambda g: float(g.placed.translations[0, 2]), "z of the base link", 1)


@pytest.fixture(scope="module")
def hand():
    return load_hand("parallel_gripper", candidates=8)


@pytest.fixture(scope="module")
def target():
    return load_scene("shape:box", resolution=16).object


@pytest.fixture
def grasp(hand) -> Grasp:
    posture = Posture(np.array([0.0, 0.0, 0.25]), np.array([1.0, 0.0, 0.0, 0.0]), hand.open_posture)
    touch = Contact(hand.base_link, (0.0, 0.0, 0.25), (0.0, 0.0, 1.0))
    return Grasp(posture, posture, posture, (touch,), 1.0)


def document(grasp: Grasp, target: Any, hand: Any) -> dict[str, Any]:
    result = GraspResult(Outcome.TOO_FEW, (grasp,), Timing(), 0, "closed_form")
    return json.loads(json.dumps(result_document(result, target, hand, PlanConfig())))


def message(grasp: Grasp, hand: Any) -> Any:
    return grasp_message(grasp, 0, "one", Header(frame_id="world"), hand, Settings())


def test_a_metric_is_one_row(grasp, hand, target, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(METRICS, "height", HEIGHT)
    measured = replace(grasp, metrics=measure(make_metrics_context(target, hand), grasp.grasp))
    assert some(measured.metrics)["height"] == 0.25
    written = document(measured, target, hand)
    assert written["grasps"][0]["metrics"]["height_mm"] == 250.0
    (read,) = grasps_of(written)
    assert some(read.metrics)["height"] == 0.25
    assert {metric.name: metric.value for metric in message(measured, hand).metrics}["height"] == 0.25
    event = result_event(GraspResult(Outcome.SUCCEEDED, (measured,), Timing(), 0, "closed_form"))
    assert event["best"]["metrics"]["height_mm"] == 250.0
    assert "| `height` | mm | z of the base link |" in tables.metrics_table()


@pytest.mark.parametrize(
    ("measures", "told"), [(lambda g: "tall", "ValueError: could not convert"), (lambda g: g.nothing, "AttributeError")]
)
def test_a_metric_that_gives_no_number_is_named(target, hand, grasp, monkeypatch, measures: Any, told: str):
    monkeypatch.setitem(METRICS, "height", replace(HEIGHT, measure=measures))
    with pytest.raises(ConfigError, match=f"^metric 'height': {told}"):
        measure(make_metrics_context(target, hand), grasp.grasp)


def test_a_trial_is_one_row(grasp, hand, target, monkeypatch: pytest.MonkeyPatch):
    asked: list[Grasp] = []

    def tilt(context: TrialContext, grasp: Grasp, stop: object) -> TrialResult:
        asked.append(grasp)
        return TrialResult("tilt", False, 0.125, 0.5, "the object slid out")

    held = replace(TRIALS["hold"], run=lambda *_: TrialResult("hold", True, 0.001, 0.25))
    monkeypatch.setitem(TRIALS, "hold", held)
    monkeypatch.setitem(TRIALS, "tilt", Trial("tilt", lambda context: context.around is None, tilt))
    protocol = PROTOCOLS["standard"]
    alone = TrialContext(hand, protocol, build_world(hand, target, (target.mesh,), protocol), None)
    tried = replace(grasp, trials=grasp_trials(alone, grasp))
    assert asked == [grasp]
    assert [trial.name for trial in tried.trials] == ["hold", "tilt"]
    assert (tried.verdict, tried.reason) == (Verdict.FAILED, "the object slid out")
    written = document(tried, target, hand)
    assert written["grasps"][0]["verdict"] == "failed"
    assert written["grasps"][0]["trials"][1] == {
        "name": "tilt", "passed": False, "displacement": 0.125, "rotation": 0.5, "reason": "the object slid out"
    }  # fmt: skip
    assert grasps_of(written)[0].trials == tried.trials
    sent = message(tried, hand)
    assert (sent.verdict, sent.reason) == (sent.FAILED, "the object slid out")
    assert [(t.name, t.passed, t.displacement, t.rotation) for t in sent.trials] == [
        ("hold", True, 0.001, 0.25), ("tilt", False, 0.125, 0.5)
    ]  # fmt: skip


def test_the_documented_metrics_are_those_of_the_registry():
    page = (ROOT / "docs" / "metrics.md").read_text()
    table = page.split("<!-- metrics:begin -->\n")[1].split("\n<!-- metrics:end -->")[0]
    assert table == tables.metrics_table(), f"docs/metrics.md is not up to date; the table is\n{tables.metrics_table()}"
