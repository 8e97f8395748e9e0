"""The action server on the worker's queue: feedback, results, cancelling, and what becomes of those in the way."""

from types import SimpleNamespace
from typing import Any

import pytest
from action_msgs.msg import GoalStatus
from graspd_msgs.action import SynthesizeGrasps
from graspd_msgs.msg import GraspArray, GraspRequest
from rclpy.action.client import ActionClient
from rclpy.action.server import RCLError
from rclpy.qos import QoSProfile

from graspd_ros.grasp_node import Goal as OurGoal
from graspd_ros.grasp_node import SynthesizeMessages

SPHERE = {"source": GraspRequest.MESH, "mesh_uri": "sphere.obj"}
FEW = {"num_grasps": 1, "preset": "fast", "time_budget": 100.0}
LONG = {"num_grasps": 256, "preset": "accurate", "time_budget": 600.0}

pytestmark = pytest.mark.timeout(300)


class Goal:
    """One goal as an action client has it."""

    def __init__(self, client, actions: ActionClient, **fields) -> None:
        self._client = client
        self.feedback = []
        goal = SynthesizeGrasps.Goal(request=GraspRequest(**SPHERE, **fields))
        self.handle = client.send_goal(actions, goal, lambda message: self.feedback.append(message.feedback))
        assert self.handle.accepted
        self._result = self.handle.get_result_async()

    def reaches(self, stage: str) -> None:
        self._client.spin_until(lambda: stage in [f.progress.stage for f in self.feedback], f"feedback of {stage}")

    def cancel(self) -> int:
        return len(self._client.done(self.handle.cancel_goal_async(), "answer to a cancel").goals_canceling)

    def end(self) -> tuple[int, GraspArray]:
        ended = self._client.done(self._result, "result")
        return ended.status, ended.result.result


def test_a_goal_that_is_cancelled_in_the_moment_that_it_begins_still_ends():
    """rclpy looks for a cancel, then steps; where one comes in between, rcl refuses the step."""

    class Handle:
        tried = 0

        def execute(self, callback) -> None:
            self.tried += 1
            if self.tried == 1:
                raise RCLError("goal_handle attempted invalid transition from state CANCELING with event EXECUTE")

    handle: Any = Handle()
    node: Any = SimpleNamespace(executor=None)
    goal = OurGoal(node, handle, SynthesizeMessages(), on_end=lambda: None)
    goal.ended(GraspArray())
    assert handle.tried == 2


@pytest.fixture
def actions(client, node):
    actions = client.actions(SynthesizeGrasps, "synthesize")
    yield actions
    actions.destroy()


def test_a_goal_gets_feedback_and_the_same_answer_as_the_topic(client, node, actions):
    goal = Goal(client, actions, id="goal-a", **FEW)
    status, result = goal.end()
    assert status == GoalStatus.STATUS_SUCCEEDED
    assert (result.status, result.request_id, len(result.grasps) > 0) == (GraspArray.SUCCEEDED, "goal-a", True)
    # Feedback comes ten times a second at most, and a stage may take less than that: the first is told always.
    assert "load" in {f.progress.stage for f in goal.feedback}
    assert client.answer("goal-a") == result


def test_a_goal_is_cancelled_while_it_runs_and_while_it_waits(client, node, actions):
    running = Goal(client, actions, **LONG)
    running.reaches("optimise")
    waiting = Goal(client, actions, **LONG)
    for goal in (waiting, running):
        assert goal.cancel() == 1
        status, result = goal.end()
        assert status == GoalStatus.STATUS_CANCELED
        assert result.status == GraspArray.CANCELLED
    assert running.cancel() == 0


def test_a_goal_that_is_refused_or_superseded_is_aborted_and_told_why(client, node, actions):
    status, result = Goal(client, actions, hand="no_such_hand").end()
    assert (status, result.status, result.error_code) == (GoalStatus.STATUS_ABORTED, GraspArray.REFUSED, "WRONG_HAND")
    first = Goal(client, actions, id="first", **LONG)
    first.reaches("load")
    client.set_parameters(busy_policy="reject")
    status, result = Goal(client, actions, **LONG).end()
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, "BUSY")
    client.event(event="refused", code="BUSY")
    client.set_parameters(busy_policy="replace")
    second = Goal(client, actions, **LONG)
    status, result = first.end()
    assert (status, result.status) == (GoalStatus.STATUS_ABORTED, GraspArray.SUPERSEDED)
    client.event(event="superseded", request="first")
    second.reaches("load")
    client.send_cancel("")  # not by its own client: rcl knows no cancelled state for that
    status, result = second.end()
    assert (status, result.status) == (GoalStatus.STATUS_ABORTED, GraspArray.CANCELLED)


def test_each_goal_of_a_burst_gets_its_reply_and_its_result(client, node):
    """A service as rclpy makes it keeps ten requests at a time, and a client ten replies: of fifty, some go."""
    deep = QoSProfile(depth=500)
    qos = {"goal_service_qos_profile": deep, "result_service_qos_profile": deep}
    actions = client.actions(SynthesizeGrasps, "synthesize", **qos)
    goals = [SynthesizeGrasps.Goal(request=GraspRequest(**SPHERE, **FEW, id=f"burst-{k}")) for k in range(50)]
    sent = [actions.send_goal_async(goal) for goal in goals]
    client.spin_until(lambda: all(future.done() for future in sent), "replies to 50 goals")
    handles = [handle for future in sent if (handle := future.result()) is not None]
    assert [handle.accepted for handle in handles] == [True] * 50
    ends = [handle.get_result_async() for handle in handles]
    client.spin_until(lambda: all(future.done() for future in ends), "results of 50 goals")
    codes = [end.result.result.error_code for future in ends if (end := future.result()) is not None]
    assert len(codes) == 50
    assert {code for code in codes if code} == {"BUSY"}
    actions.destroy()
