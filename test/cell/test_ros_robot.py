"""The picker's robot over DDS: it looks, moves both controllers, and stops, in a simulated cell of its own process."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import rclpy
from action_msgs.srv import CancelGoal
from control_msgs.action import FollowJointTrajectory
from rclpy.action.server import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.executors import MultiThreadedExecutor
from sensor_msgs.msg import JointState

from graspd_cell.controller import JointLimits, Tolerances, TrajectoryController
from graspd_cell.grasp_source import cloud_of
from graspd_cell.layout import layout_of
from graspd_cell.robot import JointMotion, MotionAborted
from graspd_cell.ros_robot import RobotSilentError, RobotTopics, RosRobot, goal_of
from graspd_cell.simulator_node import motion_of
from graspd_core.arms.arm import load_arm
from graspd_core.hands.library import load_hand

PATIENCE = 100.0
ARM, HAND = load_arm("ur5e_like"), load_hand("parallel_gripper")


@pytest.fixture(scope="module")
def robot(domain: int, simulator: None) -> Iterator[RosRobot]:
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node("picker", context=context)
    driven = RosRobot(node, ARM.joint_names, HAND.joint_names, RobotTopics(patience=PATIENCE))
    yield driven
    driven.close()
    node.destroy_node()
    rclpy.shutdown(context=context)


def to(robot: RosRobot, change: float, seconds: float) -> JointMotion:
    """A motion of all arm joints by so much."""
    goal = robot.joints().of(ARM.joint_names).positions + change
    return JointMotion(ARM.joint_names, np.array([seconds]), goal[None], np.zeros((1, len(goal))))


@pytest.mark.parametrize("late", [None, 3.5])
def test_a_goal_carries_the_whole_motion(late: float | None):
    times, rows = np.array([0.5, 2.0]), np.array([[0.01], [0.05]])
    motion = JointMotion(HAND.joint_names[:1], times, rows, 0 * rows, np.array([0.2]), np.array([0.1]), late)
    limits = JointLimits(motion.names, np.zeros(1), np.ones(1), np.ones(1))
    back = motion_of(goal_of(motion), TrajectoryController(limits, Tolerances(), rows[0]))
    assert (back.names, back.goal_time) == (motion.names, late)
    for name in ("times", "positions", "velocities", "path_tolerance", "goal_tolerance"):
        np.testing.assert_allclose(getattr(back, name), getattr(motion, name))


def test_a_look_shows_the_thing_in_the_bin_where_the_layout_has_it(robot: RosRobot):
    robot.wait(1.0)
    before = robot.joints().time
    view, layout = robot.look(), layout_of(ARM)
    assert view.time > before
    np.testing.assert_allclose(view.T_base_camera, layout.T_base_camera, atol=1e-6)
    points = cloud_of(view).points
    inside = (np.abs(points[:, :2] - layout.pick.center) < layout.pick.half - 0.02).all(1) & (points[:, 2] > 0.02)
    assert inside.sum() > 300


def test_a_motion_of_arm_and_hand_reaches_both_goals(robot: RosRobot):
    arm = robot.joints().of(ARM.joint_names).positions + 0.1
    rows = np.array([[*robot.joints().of(ARM.joint_names).positions, 0.06], [*arm, 0.02]])
    reading = robot.follow(JointMotion((*ARM.joint_names, *HAND.joint_names), np.array([0.5, 2.0]), rows), 10.0)
    np.testing.assert_allclose(reading.of(ARM.joint_names).positions, arm, atol=0.02)
    assert reading.of(HAND.joint_names).positions[0] == pytest.approx(0.02, abs=0.004)


def test_a_stop_leaves_the_arm_still(robot: RosRobot):
    begun = robot.joints()
    with pytest.raises(MotionAborted, match="stopped"):
        robot.follow(to(robot, -0.8, 4.0), 20.0, lambda: robot.joints().time > begun.time + 1.0)
    robot.wait(0.5)
    held = robot.joints().of(ARM.joint_names).positions
    robot.wait(1.0)
    assert np.abs(robot.joints().of(ARM.joint_names).positions - held).max() < 2e-3
    assert 0.01 < np.abs(held - begun.of(ARM.joint_names).positions).max() < 0.7


def test_what_the_controller_refuses_says_why_and_timeouts_end_a_motion(robot: RosRobot):
    with pytest.raises(MotionAborted, match="would move at"):
        robot.follow(to(robot, 0.5, 0.02), 5.0)
    with pytest.raises(MotionAborted, match="timeout"):
        robot.follow(to(robot, 0.3, 6.0), 0.5)
    with pytest.raises(MotionAborted, match="no joint; valid: all joints of the arm"):
        robot.follow(JointMotion((), np.array([1.0]), np.zeros((1, 0))), 1.0)


def test_a_silent_topic_is_named(domain: int):
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node("deaf", context=context)
    deaf = RosRobot(node, ("a",), ("b",), RobotTopics(joint_states="/nobody", patience=0.2))
    with pytest.raises(RobotSilentError, match=r"not received within 0\.2 s: /nobody with joint 'a'"):
        deaf.joints()
    deaf.close()
    node.destroy_node()
    rclpy.shutdown(context=context)


class Controllers:
    """Controllers of an arm (joint a) and a hand (joint b), whose goals run until they are cancelled."""

    def __init__(self, domain: int, *parts: str) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node("controllers", context=self.context)
        self.executor = MultiThreadedExecutor(4, context=self.context)
        self.executor.add_node(self.node)
        self.asked, self.may_accept, self.ended = threading.Event(), threading.Event(), threading.Event()
        self.goals, self.cancelled, self.group = dict[str, Any](), set[str](), ReentrantCallbackGroup()
        self.may_accept.set()
        self.servers = [self.serve(part) for part in parts]
        states = self.node.create_publisher(JointState, "/own/joint_states", 10)
        self.node.create_timer(0.01, lambda: states.publish(self.state()), callback_group=self.group)
        self.thread = threading.Thread(target=self.executor.spin, daemon=True)
        self.thread.start()

    def state(self) -> JointState:
        state = JointState(name=["a", "b"], position=[0.0, 0.0])
        state.header.stamp = self.node.get_clock().now().to_msg()
        return state

    def serve(self, part: str) -> ActionServer:
        def accept(_: Any) -> GoalResponse:
            self.asked.set()
            self.may_accept.wait(PATIENCE)
            return GoalResponse.ACCEPT

        def execute(handle: Any) -> Any:
            self.goals[part] = handle
            while not handle.is_cancel_requested and not self.ended.wait(0.005):
                pass
            if handle.is_cancel_requested:
                self.cancelled.add(part)
                handle.canceled()
            return FollowJointTrajectory.Result()

        calls = {"goal_callback": accept, "cancel_callback": lambda _: CancelResponse.ACCEPT}
        calls |= {"callback_group": self.group}
        return ActionServer(self.node, FollowJointTrajectory, f"/own/{part}", execute, **calls)

    def close(self) -> None:
        self.ended.set()
        self.may_accept.set()
        self.executor.shutdown()
        self.thread.join(PATIENCE)
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def driven(domain: int) -> Iterator[Callable[..., tuple[Controllers, RosRobot]]]:
    """Makes controllers of some parts, and the robot that they drive."""
    closed: list[Callable[[], None]] = []

    def make(*parts: str) -> tuple[Controllers, RosRobot]:
        own = Controllers(domain, *parts)
        topics = RobotTopics("/own/joint_states", controllers=("/own/arm", "/own/hand"), patience=PATIENCE)
        node = rclpy.create_node("driver", context=own.context)
        robot = RosRobot(node, ("a",), ("b",), topics)
        closed.extend((robot.close, node.destroy_node, own.close))
        return own, robot

    yield make
    for close in closed:
        close()


BOTH = JointMotion(("a", "b"), np.array([1.0]), np.ones((1, 2)))


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_a_motion_that_another_client_cancels_has_not_reached_its_goal(driven):
    own, robot = driven("arm", "hand")
    client, asked = own.node.create_client(CancelGoal, "/own/arm/_action/cancel_goal"), []

    def cancel_once() -> bool:
        if len(own.goals) == 2 and client.service_is_ready() and not asked:
            asked.append(client.call_async(CancelGoal.Request()))  # without an id it cancels every goal
        return False

    with pytest.raises(MotionAborted, match="another client cancelled"):
        robot.follow(BOTH, PATIENCE, cancel_once)
    until(lambda: own.cancelled == {"arm", "hand"})


def test_a_stop_before_the_controllers_accept_the_motion_cancels_it_too(driven):
    own, robot = driven("arm", "hand")
    own.may_accept.clear()

    def stop() -> bool:
        if own.asked.is_set():
            own.may_accept.set()
        return own.asked.is_set()

    with pytest.raises(MotionAborted, match="stopped"):
        robot.follow(BOTH, PATIENCE, stop)
    until(lambda: own.cancelled == {"arm", "hand"})


def test_the_arm_does_not_move_on_if_the_hand_has_no_controller(driven):
    own, robot = driven("arm")
    robot._clients[1].wait_for_server = lambda timeout_sec: False
    with pytest.raises(RobotSilentError, match="no action server /own/hand"):
        robot.follow(BOTH, PATIENCE)
    until(lambda: own.cancelled == {"arm"})
