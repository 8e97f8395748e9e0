"""Transforms from /tf and /tf_static, with a wait for late transforms. Also the restriction to the arm's reach.

ROS or `make setup` installs tf2_msgs. Without tf2_msgs the node works, but has no transforms.
"""

from __future__ import annotations

import time
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from builtin_interfaces.msg import Time
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

from graspd_core.errors import ConfigError, GraspdError, TransformError
from graspd_core.transforms import TransformBuffer
from graspd_core.types import StopHook
from graspd_ros.convert import Matrix, matrix_of_transform, nanoseconds, wxyz_of_matrix
from graspd_ros.request import FrameLookup, Request

if TYPE_CHECKING:
    from graspd_core import Arm, Reach

TRANSFORM_PATIENCE = 1.0  # seconds that the worker waits for a transform
ROBOT_PATIENCE = 10.0  # seconds that the node's start waits for the robot's URDF
_POLL = 0.01  # seconds between two lookups in the buffer
_COMPLAIN_AGAIN = 10.0  # seconds between two log lines about invalid transforms


class TransformListener:
    """Subscriber that fills a buffer from /tf and /tf_static. `available` is False if tf2_msgs is not installed.

    When time jumps back, for example when a bag restarts under simulated time, the moving transforms are deleted.
    Static transforms are kept, because their publishers do not send them again.
    """

    def __init__(self, node: Node, buffer: TransformBuffer) -> None:
        self._node = node
        self._buffer = buffer
        try:
            from tf2_msgs.msg import TFMessage  # pyright: ignore[reportMissingImports]
        except ImportError:
            self.available = False
            node.get_logger().info("tf2_msgs is not installed: without /tf, results stay in the input's frame")
            return
        self.available = True
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(TFMessage, "/tf", lambda message: self._take(message, static=False), 100)
        node.create_subscription(TFMessage, "/tf_static", lambda message: self._take(message, static=True), latched)
        back = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True)
        self._jumps = node.get_clock().create_jump_callback(back, post_callback=self._on_jump)

    def lookup(self, target: str, source: str, stamp: Time) -> Matrix:
        """Return `T_target_source` at `stamp`, or the newest if `stamp` is 0. Raises TransformError if unknown."""
        return self._buffer.lookup(target, source, nanoseconds(stamp) or None)

    def lookup_in_time(self, target: str, source: str, stamp: Time, stop: StopHook) -> Matrix:
        """Return `T_target_source`. Wait for a late transform, because clouds may arrive before their transforms.

        Do not call this in the executor's thread, which must receive the transforms meanwhile. Raises the last
        TransformError after `TRANSFORM_PATIENCE` seconds, or when `stop` returns True.
        """
        end = time.monotonic() + TRANSFORM_PATIENCE
        while True:
            try:
                return self.lookup(target, source, stamp)
            except TransformError:
                if time.monotonic() >= end or stop():
                    raise
            time.sleep(_POLL)

    def _take(self, message: Any, static: bool) -> None:
        for transform in message.transforms:
            try:
                header, T_parent_child = transform.header, matrix_of_transform(transform.transform)
                stamp = nanoseconds(header.stamp)
                self._buffer.add(header.frame_id, transform.child_frame_id, T_parent_child, stamp, static)
            except TransformError as error:
                self._node.get_logger().warning(str(error), throttle_duration_sec=_COMPLAIN_AGAIN)

    def _on_jump(self, jump: TimeJump) -> None:
        self._node.get_logger().info(
            f"time jumped by {jump.delta.nanoseconds * 1e-9:.3f} s: moving transforms are deleted"
        )
        self._buffer.clear()


def reach_of(request: Request, lookup: FrameLookup, robot_description: str = "") -> Reach:
    """Return a restriction, in the object's frame, that allows only grasps within reach of the arm in the settings.

    `lookup` transforms between frames at the request's time. `robot_description` is the URDF of a robot with the arm.
    """
    from graspd_core import Reach

    settings = request.settings
    arm = _arm(settings.arm, robot_description)
    T = request.to_object(settings.arm_base_frame or arm.chain.base_link, np.eye(4), lookup)
    x, y, z = map(float, T[:3, 3])
    qw, qx, qy, qz = map(float, wxyz_of_matrix(T))
    return Reach(arm, (x, y, z), (qw, qx, qy, qz))


# Arms are cached, because an arm's tables take 0.1 s to compute.
@lru_cache(maxsize=2)
def _arm(name: str, robot_description: str) -> Arm:
    from graspd_core import load_arm

    return load_arm(name, robot_description)


def heard_robot(node: Node, arm: str) -> str:
    """Return the URDF from the topic robot_description. Return "" without an arm, or if the arm file names a URDF.

    Call this before the node is spun. Raises GraspdError if no URDF arrives in time, or the URDF lacks the arm.
    """
    if not arm:
        return ""
    from graspd_core.arms.arm import ROBOT_DESCRIPTION, from_robot_description, read_arm_file

    if not from_robot_description(read_arm_file(arm)[1]):
        return ""
    heard: list[String] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    topic = node.create_subscription(String, ROBOT_DESCRIPTION, heard.append, latched)
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    end = time.monotonic() + ROBOT_PATIENCE
    while not heard and time.monotonic() < end:
        executor.spin_once(timeout_sec=0.1)  # in short turns, because Python handles signals between them
    name = topic.topic_name
    executor.remove_node(node)
    executor.shutdown()
    node.destroy_subscription(topic)
    if not heard:
        raise ConfigError(
            f"parameter arm: {arm} needs a URDF from {name}, but none arrived within {ROBOT_PATIENCE:g} s; "
            "start robot_state_publisher first, or give a URDF file as urdf"
        )
    robot = str(heard[-1].data)
    _arm(arm, robot)
    return robot


def check_arm(changed: list[Parameter], robot: str) -> SetParametersResult:
    """Return an unsuccessful result if a changed arm cannot be used. `robot` is the URDF heard at the start, or ""."""
    try:
        for name in (parameter.value for parameter in changed if parameter.name == "arm" and parameter.value):
            # Imported here, because a node without an arm needs nothing of it.
            from graspd_core.arms.arm import ROBOT_DESCRIPTION, from_robot_description, read_arm_file

            if not robot and from_robot_description(read_arm_file(name)[1]):
                told = f"{name} needs a URDF from {ROBOT_DESCRIPTION}, which the node reads only at its start"
                raise ConfigError(f"{told}; start the node with this arm, or give a URDF file as urdf")
            _arm(name, robot)
    except GraspdError as error:
        return SetParametersResult(successful=False, reason=f"parameter arm: {error}")
    return SetParametersResult(successful=True)
