"""Robot over ROS: joint states, a depth camera, and FollowJointTrajectory actions for arm and hand.

Set other topic names to drive another cell. A background thread receives messages. Every wait runs in the caller's
thread and has a timeout.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTolerance
from rclpy.action.client import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from graspd_cell.robot import DepthView, JointMotion, JointReading, MotionAborted, never
from graspd_core.errors import GraspdError
from graspd_core.io.messages import depth_from_message
from graspd_core.transforms import TransformBuffer
from graspd_ros.convert import duration_of, nanoseconds
from graspd_ros.inputs.tf_listener import TransformListener

_POLL = 0.005
_RESULT = FollowJointTrajectory.Result


class RobotSilentError(GraspdError):
    """A topic or an action server does not answer. The error names topic or server, and the timeout."""


@dataclass(frozen=True)
class RobotTopics:
    """Topics, actions and frame of a cell, and the timeout.

    Attributes:
        joint_states: topic of positions and efforts. Several publishers may each send part of the joints.
        depth, camera_info: topics of the camera.
        controllers: names of the action servers of the arm and of the hand.
        base_frame: base frame of the arm.
        patience: timeout of a silent topic or server [s].
    """

    joint_states: str = "/joint_states"
    depth: str = "/camera/depth/image_raw"
    camera_info: str = "/camera/depth/camera_info"
    controllers: tuple[str, str] = (
        "/arm_controller/follow_joint_trajectory",
        "/hand_controller/follow_joint_trajectory",
    )
    base_frame: str = "base_link"
    patience: float = 10.0


@dataclass
class _Heard:
    """Newest messages. `joints_at`, `image_at`: stamps. `heard_at`: monotonic time of the last joint state [s]."""

    joints: dict[str, tuple[float, float]] = field(default_factory=dict)
    joints_at: float = 0.0
    heard_at: float = 0.0
    info: CameraInfo | None = None
    image: Image | None = None
    image_at: float = 0.0


class RosRobot:
    """Implementation of `Robot` over ROS.

    Args:
        node: rclpy node. This class spins it until `close`.
        arm_joints, hand_joints: joints of the two controllers.
        topics: names and timeout. None for the defaults.
    """

    def __init__(
        self, node: Node, arm_joints: tuple[str, ...], hand_joints: tuple[str, ...], topics: RobotTopics | None = None
    ) -> None:
        self._node, self._topics, self._heard = node, topics or RobotTopics(), _Heard()
        self._names, self._lock = (arm_joints, hand_joints), threading.Lock()
        self._buffer = TransformBuffer()
        TransformListener(node, self._buffer)
        names = self._topics
        node.create_subscription(JointState, names.joint_states, self._on_joints, 10)
        node.create_subscription(CameraInfo, names.camera_info, self._on_info, qos_profile_sensor_data)
        node.create_subscription(Image, names.depth, self._on_image, qos_profile_sensor_data)
        self._clients = [ActionClient(node, FollowJointTrajectory, name) for name in names.controllers]
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True, name="ros_robot")
        self._thread.start()

    def close(self) -> None:
        """Stop receiving messages. The caller destroys the node."""
        self._closed.set()
        self._thread.join(2.0)
        self._executor.shutdown(timeout_sec=1.0)

    def joints(self) -> JointReading:
        """Return the latest reading of all joints. See `Robot`."""
        wanted = (*self._names[0], *self._names[1])
        missing = lambda: [name for name in wanted if name not in self._heard.joints]  # noqa: E731
        self._until(lambda: not missing(), lambda: f"{self._topics.joint_states} with joint {missing()[0]!r}")
        with self._lock:
            rows = np.array([self._heard.joints[name] for name in wanted])
            return JointReading(self._heard.joints_at, wanted, rows[:, 0], rows[:, 1])

    def look(self) -> DepthView:
        """Return a depth image that was taken after this call. See `Robot`."""
        # Stamps of joint states and images come from the same clock.
        begun = self.joints().time
        topics, heard = self._topics, self._heard
        self._until(lambda: heard.info is not None, lambda: topics.camera_info)
        self._until(
            lambda: heard.image is not None and heard.image_at > begun, lambda: f"a new image on {topics.depth}"
        )
        with self._lock:
            image, info, at = heard.image, heard.info, heard.image_at
        assert image is not None
        assert info is not None
        pose: list[np.ndarray] = []

        def known() -> bool:
            try:
                pose.append(self._buffer.lookup(topics.base_frame, image.header.frame_id, None))
            except GraspdError:
                return False
            return True

        self._until(known, lambda: f"transform from {topics.base_frame} to {image.header.frame_id} on /tf")
        depth = depth_from_message(image).astype(np.float32)
        return DepthView(at, depth, np.array(info.k, dtype=float).reshape(3, 3), pose[0])

    def follow(self, motion: JointMotion, timeout: float, stop: Callable[[], bool] = never) -> JointReading:
        """Execute a motion and return the joint reading at its end. See `Robot`."""
        end, parts = self.joints().time + timeout, self._parts(motion)
        sent: list[Any] = []
        try:
            for client, part in parts:
                sent.append(self._send(client, part))
            for goal in sent:
                self._wait_for(goal, end, stop)
            handles = [goal.result() for goal in sent]
            if not all(handle.accepted for handle in handles):
                raise MotionAborted("a controller rejected the motion; its log gives the reason")
            results = [self._begun(handle.get_result_async) for handle in handles]
            for result in results:
                self._wait_for(result, end, stop, watched=results)
        except (MotionAborted, RobotSilentError):
            self._cancel(sent)
            raise
        # The last reading may be older than the results.
        last = self._heard.joints_at
        self._until(lambda: self._heard.joints_at > last, lambda: self._topics.joint_states)
        return self.joints()

    def wait(self, seconds: float) -> None:
        """Wait for `seconds` of robot time. See `Robot`."""
        end = self.joints().time + seconds
        self._until(lambda: self._heard.joints_at >= end, lambda: self._topics.joint_states, extra=10 * seconds)

    def _parts(self, motion: JointMotion) -> list[tuple[ActionClient, JointMotion]]:
        """Return each controller with its part of the motion. Raises MotionAborted: a joint has no controller."""
        parts = []
        for client, names in zip(self._clients, self._names, strict=True):
            if set(names) <= set(motion.names):
                parts.append((client, motion.part(names)))
        driven = [name for _, part in parts for name in part.names]
        unknown = [name for name in motion.names if name not in driven]
        if unknown or not parts:
            told = f"joint {unknown[0]!r}" if unknown else "no joint"
            raise MotionAborted(f"a motion of {told}; valid: all joints of the arm, of the hand, or of both")
        return parts

    def _send(self, client: ActionClient, motion: JointMotion) -> Any:
        name = self._topics.controllers[self._clients.index(client)]
        if not client.wait_for_server(timeout_sec=self._topics.patience):
            raise RobotSilentError(f"no action server {name} within {self._topics.patience:g} s")
        return self._begun(client.send_goal_async, goal_of(motion))

    def _wait_for(self, future: Any, end: float, stop: Callable[[], bool], watched: Any = ()) -> None:
        """Wait for `future` until `end` [s]. Raises MotionAborted: stop, timeout, no joint states, failed action."""
        while not future.done() or watched:
            if stop():
                raise MotionAborted("the motion was stopped")
            for result in (one.result() for one in watched if one.done()):
                if result.result.error_code != _RESULT.SUCCESSFUL:
                    raise MotionAborted(result.result.error_string or f"error {result.result.error_code}")
                # The result of a cancelled goal has no error code.
                if result.status != GoalStatus.STATUS_SUCCEEDED:
                    raise MotionAborted("a controller ended the motion early, because another client cancelled it")
            if future.done():
                return
            if self._heard.joints_at > end:
                raise MotionAborted("the motion took longer than its timeout")
            if time.monotonic() - self._heard.heard_at > self._topics.patience:
                raise MotionAborted(f"no message came on {self._topics.joint_states} for {self._topics.patience:g} s")
            time.sleep(_POLL)

    def _begun(self, request: Callable[..., Any], *arguments: Any) -> Any:
        """Return the future of a request to a controller. The thread that receives the answer sends the request.

        If another thread sends the request, rclpy 7.1 fails when the answer arrives early.
        """
        task = self._executor.create_task(request, *arguments)
        self._until(task.done, lambda: "the executor's turn to send a request to a controller")
        return task.result()

    def _cancel(self, sent: list[Any]) -> None:
        """Cancel the goals and wait for the confirmations, at most `patience` seconds.

        A controller may accept a goal late, so first wait for the answer to each goal.
        """
        end, left, waiting = time.monotonic() + self._topics.patience, list(sent), list[Any]()
        while (left or not all(one.done() for one in waiting)) and time.monotonic() < end:
            handles = [goal.result() for goal in left if goal.done()]
            left = [goal for goal in left if not goal.done()]
            waiting += [self._begun(handle.cancel_goal_async) for handle in handles if handle.accepted]
            time.sleep(_POLL)

    def _until(self, condition: Callable[[], bool], what: Callable[[], str], extra: float = 0.0) -> None:
        end = time.monotonic() + self._topics.patience + extra
        while not condition():
            if time.monotonic() > end:
                raise RobotSilentError(f"not received within {self._topics.patience + extra:g} s: {what()}")
            time.sleep(_POLL)

    def _on_joints(self, message: JointState) -> None:
        with self._lock:
            efforts = message.effort or [0.0] * len(message.name)
            for name, position, effort in zip(message.name, message.position, efforts, strict=False):
                self._heard.joints[name] = (float(position), float(effort))
            self._heard.joints_at = 1e-9 * nanoseconds(message.header.stamp)
            self._heard.heard_at = time.monotonic()

    def _on_info(self, message: CameraInfo) -> None:
        self._heard.info = message

    def _on_image(self, message: Image) -> None:
        with self._lock:
            self._heard.image, self._heard.image_at = message, 1e-9 * nanoseconds(message.header.stamp)

    def _spin(self) -> None:
        while not self._closed.is_set():
            self._executor.spin_once(timeout_sec=0.05)


def goal_of(motion: JointMotion) -> FollowJointTrajectory.Goal:
    """Return the FollowJointTrajectory goal of a motion."""
    points = []
    for row, at in enumerate(motion.times.tolist()):
        point = JointTrajectoryPoint(positions=motion.positions[row].tolist(), time_from_start=duration_of(at))
        if motion.velocities is not None:
            point.velocities = motion.velocities[row].tolist()
        points.append(point)
    goal = FollowJointTrajectory.Goal(trajectory=JointTrajectory(joint_names=list(motion.names), points=points))
    for allowed, field_ in ((motion.path_tolerance, "path_tolerance"), (motion.goal_tolerance, "goal_tolerance")):
        if allowed is not None:
            widths = zip(motion.names, np.broadcast_to(allowed, len(motion.names)).tolist(), strict=True)
            setattr(goal, field_, [JointTolerance(name=name, position=width) for name, width in widths])
    # A duration of zero takes the controller's default.
    goal.goal_time_tolerance = duration_of(motion.goal_time or 0.0)
    return goal
