"""`graspd_view` follows a node: what the topics say is on the page."""

import math
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from graspd_msgs.msg import GraspArray, GraspProgress
from std_msgs.msg import Header

from graspd_core import load_hand
from graspd_core.types import Contact, Grasp, GraspMetrics, Posture, TrialResult
from graspd_ros.outputs.messages import grasp_message
from graspd_ros.parameters import Settings
from graspd_ros.view_node import Follower, grasp_of, main

HAND = load_hand("parallel_gripper")


class Watched:
    """A viewer that keeps what it is to show."""

    def __init__(self) -> None:
        self.sessions: list = []
        self.lines: list[str] = []

    def show(self, session) -> None:
        self.sessions.append(session)

    def do(self, kind, work) -> None:
        work()

    def show_progress(self, line: str, share: float) -> None:
        self.lines.append(line)


def a_grasp() -> Grasp:
    def posture(x: float, share: float) -> Posture:
        joints = HAND.lower + share * (HAND.upper - HAND.lower)
        return Posture(np.array([x, 0.02, -0.1]), np.array([0.5, 0.5, -0.5, 0.5]), joints)

    trial = TrialResult("hold", False, math.inf, 0.2, "the simulation diverged")
    contact = Contact(HAND.link_names[1], (0.01, 0.0, 0.02), (0.0, 0.0, 1.0))
    metrics = GraspMetrics({"epsilon": 0.25})
    return Grasp(posture(0.0, 0.1), posture(0.1, 0.5), posture(0.1, 0.6), (contact,), 1.5, metrics, (trial,))


def an_answer(grasp: Grasp) -> Any:
    header = Header(frame_id="camera", stamp=Time())
    answer = GraspArray(header=header, request_id="can-1", message="all is well")
    answer.grasps = [grasp_message(grasp, 0, "can-1", header, HAND, Settings())]
    return answer


def test_a_grasp_comes_back_from_its_message():
    grasp = a_grasp()
    back = grasp_of(an_answer(grasp).grasps[0], HAND.joint_names)
    for name in ("pregrasp", "grasp", "squeeze"):
        for one, other in zip(vars(getattr(back, name)).values(), vars(getattr(grasp, name)).values(), strict=True):
            assert one == pytest.approx(other)
    assert (back.contacts, back.trials, back.reason) == (grasp.contacts, grasp.trials, grasp.reason)
    assert dict(back.metrics or {}) == {"epsilon": 0.25}


def test_what_a_node_publishes_is_shown(client):
    viewer = Watched()
    Follower(client.node, viewer, "/followed")
    answers = client.kept(GraspArray, "/followed/grasps")
    progress = client.node.create_publisher(GraspProgress, "/followed/progress", 50)
    answers.publish(an_answer(a_grasp()))
    (session,) = client.spin_until(lambda: viewer.sessions, "session")
    assert session.title == "request can-1"
    assert session.hand.name == "parallel_gripper"
    assert session.grasps[0].reason == "the simulation diverged"
    client.spin_until(progress.get_subscription_count, "match")

    def told() -> bool:
        progress.publish(GraspProgress(request_id="can-2", stage="optimise", step=3, of=9))
        return any(line.startswith("can-2: optimise 3 of 9") for line in viewer.lines)

    client.spin_until(told, "progress")


def test_the_hand_of_a_node_with_a_prefix_is_shown(client):
    viewer = Watched()
    Follower(client.node, viewer, "/left/graspd")
    answer = an_answer(a_grasp())
    (grasp,) = answer.grasps
    grasp.base_link = f"left_{HAND.base_link}"
    for joints in (grasp.pregrasp_joints, grasp.grasp_joints, grasp.squeeze_joints):
        joints.name = [f"left_{name}" for name in joints.name]
    client.kept(GraspArray, "/left/graspd/grasps").publish(answer)
    client.spin_until(lambda: answer.message in viewer.lines, "an answer")
    (session,) = viewer.sessions
    assert session.hand.joint_names == tuple(f"left_{name}" for name in HAND.joint_names)


def test_answers_that_cannot_be_shown_are_left_out(client):
    viewer = Watched()
    Follower(client.node, viewer, "/followed_too")
    answers = client.kept(GraspArray, "/followed_too/grasps")
    path, joints, nan = an_answer(a_grasp()), an_answer(a_grasp()), an_answer(a_grasp())
    path.grasps[0].hand = "/etc/hand.urdf"
    joints.grasps[0].grasp_joints.name[0] = "another"
    nan.grasps[0].grasp_pose.position.x = math.nan
    for number, answer in enumerate((path, joints, nan, GraspArray())):
        answer.message = f"answer {number}"
        answers.publish(answer)
        client.spin_until(lambda: answer.message in viewer.lines, "an answer")  # noqa: B023
    assert viewer.sessions == []


@pytest.mark.parametrize(
    ("arguments", "culprit"), [(["--port", "x"], "--port"), (["--object", "shape:cube"], "unknown shape 'cube'")]
)
def test_bad_arguments_end_the_start_with_one_line(capfd, arguments, culprit):
    assert main(arguments) == 2
    line = capfd.readouterr().err
    assert line.startswith("graspd_view: ")
    assert culprit in line
    assert line.count("\n") == 1
