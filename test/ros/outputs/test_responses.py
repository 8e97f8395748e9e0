"""What is published of a request that has ended: everything or one error, and exactly one answer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import rclpy
import rclpy.node
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from graspd_msgs.msg import GraspArray
from rclpy.context import Context
from visualization_msgs.msg import MarkerArray

from graspd_core.errors import MeshError
from graspd_core.hands.library import load_hand
from graspd_core.perception.scene import Scene
from graspd_core.types import Contact, Grasp, GraspResult, Outcome, Posture, Progress, Stage, Timing, TrialResult
from graspd_ros.inputs.requests import Request
from graspd_ros.outputs.responses import Responses
from graspd_ros.parameters import Settings
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


def load_scene() -> Scene:
    raise MeshError("it ended before it began")


class Publishers:
    """Keeps what is published."""

    def __init__(self) -> None:
        self.published: list = []
        self.events: list[str] = []

    def publish(self, message) -> None:
        self.published.append(message)

    def tell(self, event: str, *_, **__) -> None:
        self.events.append(event)


class Broken:
    """A listener that cannot be told anything."""

    def progressed(self, message) -> None:
        raise RuntimeError("gone")

    ended = progressed


@pytest.fixture(scope="module")
def node() -> Iterator[rclpy.node.Node]:
    context = Context()
    rclpy.init(context=context)
    node = rclpy.create_node("graspd_answers", context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


def published(node, report: Report[Planned], listener=None) -> tuple[list, list[str]]:
    answers: Any = Responses(node, HAND)
    publishers = answers.publishers = Publishers()
    answers.finished(Request("r", "mesh", "object", Time(), Settings(), load_scene, listener=listener), report)
    return publishers.published, publishers.events


def done(*grasps: Grasp) -> Report[Planned]:
    return Report(WorkerEnding.DONE, value=Planned(GraspResult(Outcome.SUCCEEDED, grasps, Timing(), 0, "")))


@pytest.mark.parametrize("culprit", NOT_A_NUMBER)
def test_a_result_that_holds_a_nan_is_an_error_and_nothing_of_it_is_published(node, culprit):
    messages, events = published(node, done(GRASP, replace(GRASP, **NOT_A_NUMBER[culprit])))
    (answer,) = messages
    assert (answer.status, answer.error_code, list(answer.grasps)) == (GraspArray.FAILED, "INTERNAL", [])
    assert f"grasp 1: not finite: {culprit}" in answer.message
    assert events == ["error"]


@pytest.mark.parametrize("listener", [None, Broken()])
def test_a_result_is_answered_once_whatever_its_listener_does(node, listener):
    messages, events = published(node, done(GRASP), listener)
    assert [answer.status for answer in messages if isinstance(answer, GraspArray)] == [GraspArray.SUCCEEDED]
    assert {type(message) for message in messages} >= {PoseStamped, MarkerArray}
    assert isinstance(messages[-1], GraspArray)
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
    messages, events = published(node, overdue())
    assert [(type(message), message.error_code) for message in messages] == [(GraspArray, "DEADLINE")]
    assert events == ["result"]


def test_markers_draw_what_is_asked_for_and_a_hand_without_its_files_as_it_collides(node, tmp_path):
    responses, visual = Responses(node, HAND), Settings()
    assert responses.drawn(replace(visual, marker_geometry="collision")) is HAND.primitives
    assert responses.drawn(visual) is not HAND.primitives
    gone = Responses(node, replace(HAND, urdf=str(tmp_path / "gone.urdf")))
    assert gone.drawn(visual) is gone._hand.primitives
