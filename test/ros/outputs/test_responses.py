"""Answers, events, poses, joint values and health."""

import dataclasses
import json
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import rclpy
import rclpy.node
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from graspd_msgs.msg import GraspArray
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from visualization_msgs.msg import MarkerArray

from graspd_core import Grasp, GraspResult, Outcome, Posture, Progress, Scene, TrialResult, Verdict, load_hand
from graspd_core.errors import MeshError
from graspd_core.types import Contact, GraspMetrics, Stage, Timing
from graspd_ros.outputs import responses
from graspd_ros.outputs.responses import Health, Responses, health_message, resident_memory
from graspd_ros.parameters import Settings
from graspd_ros.request import Request
from graspd_ros.request_planner import Planned, overdue
from graspd_ros.worker import Report, WorkerEnding

HAND = load_hand("allegro_right", candidates=200)
POSTURE = Posture(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), HAND.open_posture)
GRASP = Grasp(POSTURE, POSTURE, POSTURE, (), 1.0, trials=(TrialResult("hold", True, 0.0, 0.0),))
NOT_A_NUMBER = {
    "grasp's position": {"grasp": replace(POSTURE, position=np.array([0.0, np.nan, 0.0]))},
    "squeeze's joint_positions": {"squeeze": replace(POSTURE, joint_positions=np.full(16, np.inf))},
    "contact of tip": {"contacts": (Contact("tip", (0.0, np.nan, 0.0), (0.0, 0.0, 1.0)),)},
}
GOOD = Health(name="/graspd", hand="allegro_right", ready=True, worker_alive=True, queue_size=4)


def load_scene() -> Scene:
    raise MeshError("it ended before it began")


class Publishers:
    """Keeps what is published."""

    def __init__(self) -> None:
        self.published: list = []
        self.events: list[str] = []

    def publish(self, message) -> None:
        self.published.append(message)

    def emit(self, event: str, *_, **__) -> None:
        self.events.append(event)


class Broken:
    """A listener that cannot be told anything."""

    def progressed(self, message) -> None:
        raise RuntimeError("gone")

    ended = progressed


@pytest.fixture
def node(make_node) -> rclpy.node.Node:
    return make_node()


def published(node, report: Report[Planned], listener=None) -> tuple[list, list[str]]:
    answers: Any = Responses(node, HAND)
    publishers = answers.publishers = Publishers()
    answers.finished(Request("r", "mesh", "object", Time(), Settings(), load_scene, listener=listener), report)
    return publishers.published, publishers.events


def done(*grasps: Grasp) -> Report[Planned]:
    return Report(WorkerEnding.DONE, value=Planned(GraspResult(Outcome.SUCCEEDED, grasps, Timing(), 0, "")))


@pytest.mark.parametrize("culprit", NOT_A_NUMBER)
def test_a_result_that_holds_a_nan_is_an_error_and_nothing_of_it_is_published(node, culprit):
    told, events = published(node, done(GRASP, replace(GRASP, **NOT_A_NUMBER[culprit])))
    (answer,) = told
    assert (answer.status, answer.error_code, list(answer.grasps)) == (GraspArray.FAILED, "INTERNAL", [])
    assert f"grasp 1: not finite: {culprit}" in answer.message
    assert events == ["error"]


@pytest.mark.parametrize("listener", [None, Broken()])
def test_a_result_is_answered_once_whatever_its_listener_does(node, listener):
    told, events = published(node, done(GRASP), listener)
    assert [answer.status for answer in told if isinstance(answer, GraspArray)] == [GraspArray.SUCCEEDED]
    assert {type(message) for message in told} >= {PoseStamped, MarkerArray}
    assert isinstance(told[-1], GraspArray)
    assert events == ["result"]


def test_progress_is_told_at_the_rate_that_is_set(node):
    answers: Any = Responses(node, HAND)
    publishers = answers.publishers = Publishers()
    settings = Settings(progress_rate=1e-4)  # once in three hours
    tell = answers.progress_hook(Request("r", "mesh", "object", Time(), settings, load_scene))
    for step in range(100):
        tell(Progress(Stage.OPTIMISE, step, 100, 0.0, 0, 0.0))
    assert [message.step for message in publishers.published] == [0]
    assert publishers.events == ["progress"]


def test_a_request_that_was_never_worked_on_leaves_the_markers_as_they_are(node):
    told, events = published(node, overdue())
    assert [(type(message), message.error_code) for message in told] == [(GraspArray, "DEADLINE")]
    assert events == ["result"]


def test_markers_draw_what_is_asked_for_and_a_hand_without_its_files_as_it_collides(node, tmp_path):
    answers, visual = Responses(node, HAND), Settings()
    assert answers.drawn(replace(visual, marker_geometry="collision")) is HAND.primitives
    assert answers.drawn(visual) is not HAND.primitives
    gone = Responses(node, replace(HAND, urdf=str(tmp_path / "gone.urdf")))
    assert gone.drawn(visual) is HAND.primitives


def a_grasp(verdict: Verdict) -> Grasp:
    posture = Posture(np.array([1.0, 2.0, 3.0]), np.array([0.5, 0.1, -0.7, 0.5]), np.array([0.25, -1.0]))
    hold = TrialResult("hold", verdict is Verdict.VERIFIED, 0.002, 0.01)
    trials = () if verdict is Verdict.UNVERIFIED else (hold,)
    touch, metrics = Contact("tip", (1.0, 2.0, 3.0), (0.0, 0.0, 1.0)), GraspMetrics({"penetration": 0.001})
    return Grasp(posture, posture, posture, (touch,), score=1.5, metrics=metrics, trials=trials)


def a_result(*grasps: Grasp) -> GraspResult:
    return GraspResult(Outcome.TOO_FEW, grasps, Timing(total=1.0), seed=0, method="closed_form")


def test_a_grasp_known_to_be_bad_is_not_presented():
    good, unknown, bad = (a_grasp(v) for v in (Verdict.VERIFIED, Verdict.UNVERIFIED, Verdict.FAILED))
    assert responses.presentable(a_result(good, bad)) is good
    assert responses.presentable(a_result(unknown)) is unknown
    assert responses.presentable(a_result(bad)) is None
    assert responses.presentable(a_result()) is None
    event = responses.result_event(a_result(bad))
    assert (event["best"], event["grasps"], event["verified"]) == (None, 1, 0)


def test_every_event_is_one_line_of_json_without_nan():
    odd = {"a": np.nan, "b": [np.float32(1.5), np.inf], "c": {"d": np.int64(3)}, "e": "two\nlines", "f": Stage.LOAD}
    line = responses.status_line(odd)
    assert "\n" not in line
    assert json.loads(line) == {"a": None, "b": [1.5, None], "c": {"d": 3}, "e": "two\nlines", "f": "load"}
    progress = Progress(Stage.OPTIMISE, 5, 10, float("inf"), 0, 0.5)
    assert json.loads(responses.status_line(responses.progress_event(progress)))["fraction"] == 0.5
    summary = json.loads(responses.status_line(responses.result_event(a_result(a_grasp(Verdict.VERIFIED)))))
    assert summary["best"]["metrics"]["penetration_mm"] == 1.0
    assert summary["best"]["metrics"]["epsilon"] is None
    assert summary["best"]["trials"] == [
        {"name": "hold", "passed": True, "displacement": 0.002, "rotation": 0.01, "reason": ""}
    ]
    assert summary["outcome"] == "too_few"


def status(health: Health, memory: int = 300_000_000) -> DiagnosticStatus:
    message = health_message(health, Time(sec=9), memory)
    assert message.header.stamp.sec == 9
    (found,) = message.status
    return found


def values(health: Health, memory: int = 300_000_000) -> dict[str, str]:
    return {pair.key: pair.value for pair in status(health, memory).values}


@pytest.mark.parametrize(
    ("change", "level", "said"),
    [
        ({}, DiagnosticStatus.OK, "waits for requests"),
        ({"running": "mesh-3"}, DiagnosticStatus.OK, "works on mesh-3"),
        ({"ready": False}, DiagnosticStatus.WARN, "warming up"),
        ({"waiting": 4}, DiagnosticStatus.WARN, "the queue is full: 4 wait"),
        ({"waiting": 3}, DiagnosticStatus.OK, "waits for requests"),
        ({"queue_size": 0}, DiagnosticStatus.OK, "waits for requests"),
        ({"failed_in_a_row": 1, "last_error": "no such file"}, DiagnosticStatus.WARN, "the last request failed: no su"),
        ({"failed_in_a_row": 3}, DiagnosticStatus.WARN, "the last 3 requests failed"),
        ({"counts": {"requests failed": 9}}, DiagnosticStatus.OK, "waits for requests"),  # long past
        ({"worker_alive": False, "ready": False}, DiagnosticStatus.ERROR, "restart the node"),
    ],
)
def test_the_level_is_that_of_the_worst_that_holds(change: dict, level: bytes, said: str):
    found = status(dataclasses.replace(GOOD, **change))
    assert found.level == level
    assert said in found.message


def test_every_field_is_told():
    """Change one field at a time: something in the message changes with it."""
    other = {int: 7, bool: False, str: "other", float: 1.25, dict: {"clouds received": 1}}
    before = status(GOOD)
    # diagnostic_aggregator groups by what comes before the colon
    assert (before.name, before.hardware_id) == ("graspd: grasp synthesis", "allegro_right")
    for field in dataclasses.fields(Health):
        value = getattr(GOOD, field.name)
        changed = other[float] if value is None else other[type(value)]
        changed = not value if isinstance(value, bool) else changed
        assert status(dataclasses.replace(GOOD, **{field.name: changed})) != before, field.name


def test_figures_are_readable_and_absent_where_unknown():
    found = values(
        dataclasses.replace(GOOD, last_latency=2.34567, counts={"grasps verified": 12, "clouds superseded": 5})
    )
    assert found["last latency [s]"] == "2.346"
    assert found["last first verified [s]"] == ""
    assert (found["grasps verified"], found["clouds superseded"]) == ("12", "5")
    assert found["memory [MB]"] == "300"
    assert values(GOOD, memory=0)["memory [MB]"] == ""


WORDS = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=20)  # DDS strings end at a zero


@given(st.builds(Health, name=WORDS, hand=WORDS, running=WORDS, last_error=WORDS))
def test_any_health_goes_through_the_middleware(health: Health):
    message = health_message(health, Time(), 1)
    assert deserialize_message(serialize_message(message), DiagnosticArray) == message


def test_memory_is_that_of_a_process_and_its_children():
    # In fresh processes: the heap of this one depends on the tests before.
    holds = "ballast = b'x' * 60_000_000; print(flush=True); input()"
    starts = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {holds!r}])"
    with subprocess.Popen([sys.executable, "-c", starts], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        memory = resident_memory(child.pid)
        assert 65_000_000 < memory < 120_000_000  # two interpreters beside it
        assert resident_memory() > memory + 10_000_000
        child.communicate(b"\n")
    assert resident_memory(child.pid) == 0
