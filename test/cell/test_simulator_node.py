"""The simulated cell as a process of its own, and a client that speaks to it over DDS as to a real one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTolerance
from rclpy.action.client import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from graspd_cell.controller import JointLimits, MotionState, Tolerances, TrajectoryController
from graspd_cell.layout import layout_of
from graspd_cell.robot_description import CAMERA_FRAME, robot_description
from graspd_cell.simulator_node import MotionServer, SimulatorNode
from graspd_core.arms.arm import load_arm, tip_hand
from graspd_core.hands.library import load_hand
from graspd_core.hands.readers.urdf import read_urdf
from graspd_core.hands.readers.xml_io import parse_xml
from graspd_core.io.messages import depth_from_message
from graspd_core.transforms import TransformBuffer
from graspd_ros.convert import duration_of, matrix_of_transform, nanoseconds

PATIENCE = 100.0
ARM, HAND = "ur5e_like", "parallel_gripper"
Result = FollowJointTrajectory.Result


class CellClient:
    """Hears what the cell publishes and sends motions."""

    def __init__(self, domain: int) -> None:
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node("cell_client", context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self.heard: dict[str, list[Any]] = {}
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for kind, name, qos in (
            (JointState, "/joint_states", 50),
            (TFMessage, "/tf", 50),
            (TFMessage, "/tf_static", latched),
            (String, "/robot_description", latched),
            (String, "/cell/referee", latched),
            (Image, "/camera/depth/image_raw", 5),
            (CameraInfo, "/camera/depth/camera_info", 5),
            (Clock, "/clock", 50),
        ):
            self.heard[name] = []
            self.node.create_subscription(kind, name, self.heard[name].append, qos)
        self.actions = {
            part: ActionClient(self.node, FollowJointTrajectory, f"/{part}_controller/follow_joint_trajectory")
            for part in ("arm", "hand")
        }

    def until(self, condition: Callable[[], Any], what: str) -> Any:
        end = time.monotonic() + PATIENCE
        while not (found := condition()):
            if time.monotonic() > end:
                pytest.fail(f"no {what} within {PATIENCE:.0f} s")
            self._executor.spin_once(timeout_sec=0.02)
        return found

    def newest(self, name: str) -> Any:
        """The next message of a topic that comes from now on, or the latched one."""
        if "static" not in name and name != "/robot_description":
            self.heard[name].clear()
        return self.until(lambda: self.heard[name], name)[-1]

    def positions(self) -> dict[str, float]:
        state = self.newest("/joint_states")
        return dict(zip(state.name, state.position, strict=True))

    def send(self, part: str, goal: FollowJointTrajectory.Goal, feedback: list[Any] | None = None) -> Any:
        """Send a goal; its handle."""
        self.until(self.actions[part].server_is_ready, f"server of the {part}")
        tell = (lambda message: feedback.append(message.feedback)) if feedback is not None else None
        future = self.actions[part].send_goal_async(goal, feedback_callback=tell)
        self.until(future.done, "answer to the goal")
        handle: Any = future.result()
        assert handle.accepted
        return handle

    def result(self, handle: Any) -> Any:
        future = handle.get_result_async()
        self.until(future.done, "result")
        return future.result().result

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


def goal_of(names: tuple[str, ...], *points: tuple[float, list[float]]) -> FollowJointTrajectory.Goal:
    """A goal through points at some times [s]."""
    rows = [JointTrajectoryPoint(positions=values, time_from_start=duration_of(at)) for at, values in points]
    return FollowJointTrajectory.Goal(trajectory=JointTrajectory(joint_names=list(names), points=rows))


@pytest.fixture(scope="module")
def cell(domain: int, simulator: None) -> Iterator[CellClient]:
    """A client of the cell."""
    client = CellClient(domain)
    client.newest("/joint_states")
    yield client
    client.close()


def test_the_cell_publishes_what_drivers_publish(cell: CellClient):
    arm, hand = load_arm(ARM), load_hand(HAND)
    state = cell.newest("/joint_states")
    assert tuple(state.name) == arm.joint_names + hand.joint_names
    assert len(state.effort) == len(state.position) == len(state.name)
    # The arm carries its own weight.
    assert abs(state.effort[1]) > 5.0
    assert robot_description(arm, hand) == cell.newest("/robot_description").data
    info, image = cell.newest("/camera/depth/camera_info"), cell.newest("/camera/depth/image_raw")
    assert (info.width, info.height, info.header.frame_id) == (640, 480, CAMERA_FRAME)
    depth = depth_from_message(image)
    assert depth.shape == (480, 640)
    assert 0.5 < np.median(depth[depth > 0]) < 1.2
    buffer = TransformBuffer()
    for message in (cell.newest("/tf_static"), cell.newest("/tf")):
        for moved in message.transforms:
            matrix, stamp = matrix_of_transform(moved.transform), nanoseconds(moved.header.stamp)
            buffer.add(moved.header.frame_id, moved.child_frame_id, matrix, stamp, False)
    np.testing.assert_allclose(buffer.lookup("base_link", CAMERA_FRAME, None), layout_of(arm).T_base_camera, atol=1e-6)
    assert np.isfinite(buffer.lookup("base_link", "hand_left_jaw_link", None)).all()
    first = cell.newest("/clock").clock
    cell.until(lambda: nanoseconds(cell.heard["/clock"][-1].clock) > nanoseconds(first), "later clock")
    told = json.loads(cell.newest("/cell/referee").data)
    assert told["places"] == {"pear 0": "pick bin"}


def test_the_robots_description_is_a_robot_with_the_hand_where_it_is_mounted(tmp_path: Path):
    for arm_name, hand_name in ((ARM, HAND), ("panda_like", "leap_right"), ("ur5e_like", "allegro_right")):
        arm, hand = load_arm(arm_name), load_hand(hand_name)
        text = robot_description(arm, hand)
        path = tmp_path / "robot.urdf"
        whole = read_urdf(path, parse_xml(path, text))
        assert whole.joint_names == arm.joint_names + hand.joint_names
        assert f"hand_{hand.base_link}" in whole.link_names
        # The mount's turn is what the arm says, whatever angles stand for it.
        base = whole.link_index[f"hand_{hand.base_link}"]
        mount = tip_hand(arm, hand)
        np.testing.assert_allclose(whole.link_offset_rotation[base], mount.rotation.numpy(), atol=1e-6)
        np.testing.assert_allclose(whole.link_offset_translation[base], mount.translation.numpy(), atol=1e-6)


def test_the_robots_description_names_meshes_by_their_address(tmp_path: Path):
    arm, hand = load_arm(ARM), load_hand(HAND)
    text = Path(arm.chain.urdf).read_text()
    visual = '<visual><geometry><mesh filename="meshes/{0}.stl"/></geometry></visual></link>'
    for place, name in enumerate(("arm", "hand")):
        own = text if name == "arm" else Path(hand.urdf).read_text()
        (tmp_path / f"{name}.urdf").write_text(own.replace("</link>", visual.format(place), 1))
    arm = replace(arm, chain=replace(arm.chain, urdf=str(tmp_path / "arm.urdf")))
    whole = robot_description(arm, replace(hand, urdf=str(tmp_path / "hand.urdf")))
    for place in range(2):
        assert f'filename="{(tmp_path / "meshes" / f"{place}.stl").as_uri()}"' in whole


def test_links_above_the_hands_base_are_not_in_the_robots_description(tmp_path: Path):
    box = '<collision><geometry><box size=".08 .02 .02"/></geometry></collision>'
    finger = '<joint name="j{0}" type="prismatic"><parent link="base"/><child link="f{0}"/>'
    finger += '<axis xyz="{0} 0 0"/><limit lower="0" upper=".03" effort="9" velocity="1"/></joint><link name="f{0}"/>'
    text = f'<robot name="h"><link name="world"/><link name="base">{box}</link>{finger.format(1)}{finger.format(-1)}'
    text += '<joint name="w" type="fixed"><parent link="world"/><child link="base"/></joint></robot>'
    (tmp_path / "h.urdf").write_text(text)
    palm = "palm: {center: [0, 0, 0.01], normal: [0, 0, 1]}"
    postures = "open: {j1: 0.03, j-1: 0.03}\nclosed: {j1: 0, j-1: 0}"
    (tmp_path / "h.yaml").write_text(f"urdf: h.urdf\nmount: {{parent: tool}}\n{palm}\n{postures}\n")
    arm, hand = load_arm(ARM), load_hand(tmp_path / "h.yaml")
    path = tmp_path / "robot.urdf"
    whole = read_urdf(path, parse_xml(path, robot_description(arm, hand)))
    assert whole.joint_names == arm.joint_names + hand.joint_names


def test_motions_reach_their_goals_with_feedback(cell: CellClient):
    arm, hand = load_arm(ARM), load_hand(HAND)
    start, feedback = cell.positions(), list[Any]()
    target = [start[name] + 0.2 for name in arm.joint_names]
    handle = cell.send("arm", goal_of(arm.joint_names, (1.5, target)), feedback)
    # Both controllers work at the same time; the names may come in any order.
    closing = cell.send("hand", goal_of(hand.joint_names, (0.8, [0.01])))
    assert cell.result(handle).error_code == Result.SUCCESSFUL
    assert cell.result(closing).error_code == Result.SUCCESSFUL
    now = cell.positions()
    np.testing.assert_allclose([now[name] for name in arm.joint_names], target, atol=0.02)
    assert now["left_jaw"] == pytest.approx(0.01, abs=0.003)
    assert feedback
    assert tuple(feedback[0].joint_names) == arm.joint_names
    backwards = arm.joint_names[::-1]
    handle = cell.send("arm", goal_of(backwards, (1.5, [start[name] for name in backwards])))
    assert cell.result(handle).error_code == Result.SUCCESSFUL


def test_a_newer_goal_takes_the_place_of_the_one_before_and_a_cancel_holds(cell: CellClient):
    names = load_arm(ARM).joint_names
    start = cell.positions()
    far = goal_of(names, (20.0, [start[name] + 0.5 for name in names]))
    first = cell.send("arm", far)
    second = cell.send("arm", far)
    result = cell.result(first)
    assert (result.error_code, result.error_string) == (Result.INVALID_GOAL, "a newer goal took its place")
    cell.until(lambda: cell.positions()[names[0]] > start[names[0]] + 0.02, "motion")
    future = second.cancel_goal_async()
    cell.until(future.done, "cancel")
    assert cell.result(second).error_string == "cancelled"
    cell.newest("/clock")
    settled = nanoseconds(cell.heard["/clock"][-1].clock) + 5 * 10**8
    cell.until(lambda: nanoseconds(cell.newest("/clock").clock) > settled, "half a second")
    still = cell.positions()
    assert start[names[0]] + 0.01 < still[names[0]] < start[names[0]] + 0.45
    cell.newest("/clock")
    assert abs(cell.positions()[names[0]] - still[names[0]]) < 1e-3
    back = cell.send("arm", goal_of(names, (1.5, [start[name] for name in names])))
    assert cell.result(back).error_code == Result.SUCCESSFUL


def test_a_goal_that_makes_no_sense_is_aborted_with_a_reason_and_the_cell_lives_on(cell: CellClient):
    names = load_arm(ARM).joint_names
    now = cell.positions()
    here = [now[name] for name in names]
    bad = {
        "valid: all of shoulder_pan": goal_of(("elbow",), (1.0, [0.0])),
        "point 0 has 1 positions": goal_of(names, (1.0, [0.0])),
        "a motion's positions": goal_of(names, (1.0, [float("nan")] * 6)),
        "a motion's times": goal_of(names),
        "strictly increasing": goal_of(names, (1.0, here), (0.5, here)),
        "beyond its limits": goal_of(names, (30.0, [*here[:2], 9.0, *here[3:]])),
        "would move at": goal_of(names, (0.01, [value + 1.0 for value in here])),
    }
    for reason, goal in bad.items():
        result = cell.result(cell.send("arm", goal))
        assert reason in result.error_string
        assert result.error_code == (Result.INVALID_JOINTS if "all of" in reason else Result.INVALID_GOAL)
    tight = goal_of(names, (0.5, [value + 0.3 for value in here]))
    tight.path_tolerance = [JointTolerance(name=names[0], position=1e-7)]
    result = cell.result(cell.send("arm", tight))
    assert result.error_code == Result.PATH_TOLERANCE_VIOLATED
    assert result.error_string.startswith(f"joint '{names[0]}' left its path by")
    back = cell.send("arm", goal_of(names, (1.5, here)))
    assert cell.result(back).error_code == Result.SUCCESSFUL


def test_a_wrong_option_is_one_line():
    command = [sys.executable, "-m", "graspd_cell.simulator_node", "--things", "nothing"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("graspd_cell_simulator: unknown thing 'nothing'; valid: ")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("method", ["step", "view_of"])
def test_a_failure_while_it_runs_ends_the_simulator_with_1(domain: int, tmp_path: Path, method: str):
    program = f"""
from graspd_cell import simulated_robot, simulator_node
def fail(*arguments): raise RuntimeError("broken on purpose")
def settled(self, *arguments): simulated_robot.SimulatedRobot.{method} = fail
simulator_node.SimulatorNode._publish = settled
raise SystemExit(simulator_node.main(["--arm", "{ARM}", "--hand", "{HAND}", "--things", "family:pear:0"]))
"""
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.returncode == 1, done.stderr
    assert "RuntimeError: broken on purpose" in done.stderr


class SlowRobot:
    """A robot whose state takes a while to publish, as on a busy machine."""

    world = SimpleNamespace(model=SimpleNamespace(opt=SimpleNamespace(timestep=0.002)))

    def __init__(self) -> None:
        self.time = 0.0

    def step(self, steps: int) -> None:
        self.time += 0.002 * steps


@pytest.mark.parametrize(("speed", "seconds"), [(1.0, 0.25), (50.0, 0.0)])
def test_a_simulation_that_cannot_keep_up_goes_on(speed: float, seconds: float):
    cell: Any = SimulatorNode.__new__(SimulatorNode)
    cell.robot, cell._speed, cell._lock, cell._stop = SlowRobot(), speed, threading.Lock(), threading.Event()
    rounds: list[float] = []

    def publish(due: dict[str, float]) -> None:
        rounds.append(cell.robot.time)
        time.sleep(seconds)
        if len(rounds) == 4:
            cell._stop.set()

    cell._publish = publish
    cell.simulate()
    assert rounds[1:] == pytest.approx([rounds[0] + 0.2 * k for k in (1, 2, 3)], abs=0.05)


class BusyCell:
    """A cell whose controller runs one motion, and whose first motion leaves its path if `fails`."""

    def __init__(self, fails: bool) -> None:
        self.node, self.stopped, self.begun, self.fails = None, False, list[Any](), fails
        self.running = threading.Event()

    def begin(self, controller: Any, motion: Any) -> None:
        self.begun.append(motion)
        self.running.set()

    def hold(self, controller: Any) -> None:
        self.running.clear()

    def progress(self, controller: Any) -> tuple[MotionState, str, np.ndarray, np.ndarray]:
        if self.fails and len(self.begun) == 1:
            self.fails = False
            self.between()
            return MotionState.LEFT_PATH, "left its path", np.zeros(1), np.zeros(1)
        return MotionState.RUNNING, "", np.zeros(1), np.zeros(1)

    def between(self) -> None:
        """What happens between the look at the first motion and its end."""


@pytest.mark.parametrize("fails", [False, True])
def test_the_end_of_an_older_goal_does_not_stop_a_newer_one(fails: bool):
    limits = JointLimits(("joint",), np.zeros(1), np.ones(1), np.ones(1))
    cell: Any = BusyCell(fails)
    server: Any = MotionServer.__new__(MotionServer)
    server._cell, server._controller, server._newest = cell, TrajectoryController(limits, Tolerances(), np.zeros(1)), 0
    server._lock, server._result = threading.Lock(), Result
    done = {name: lambda *_: None for name in ("abort", "canceled", "succeed", "publish_feedback")}
    goal = goal_of(("joint",), (1.0, [0.5]))
    newer = SimpleNamespace(request=goal, is_cancel_requested=False, **done)
    thread = threading.Thread(target=server._execute, args=(newer,))

    def begin_newer() -> bool:
        thread.start()
        while len(cell.begun) < 2:
            time.sleep(0.001)
        return True

    class Older(SimpleNamespace):
        is_cancel_requested = property(lambda self: not fails and begin_newer())

    cell.between = begin_newer
    server._execute(Older(request=goal, **done))
    # The newer motion still runs. Without it, its goal would be reported as reached.
    assert cell.running.is_set()
    cell.stopped = True
    thread.join(PATIENCE)
