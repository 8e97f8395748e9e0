"""Frames: /tf and /tf_static into a TransformBuffer, poses as matrices, results moved to another frame.

`T_a_b` maps coordinates in frame b to frame a. tf2_msgs comes with ROS, or from `make setup`: without it
the node works, and knows no transforms.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Pose, Quaternion, Transform, TransformStamped
from jaxtyping import Float
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from scipy.spatial.transform import Rotation

from graspd_core.errors import TransformError
from graspd_core.transforms import TransformBuffer
from graspd_core.types import Contact, Grasp, GraspResult, Plane, Posture
from graspd_ros.outputs.status_json import pose_of

_POLL = 0.01  # seconds between two looks at the buffer
_ROUNDED = 0.05  # quaternions written by hand are off their unit length by this much, those that are wrong by more
_COMPLAIN_AGAIN = 10.0  # seconds between two log lines about transforms that make no sense


class TransformListener:
    """Fills a buffer from /tf and /tf_static for as long as the node lives. `available`: whether it can.

    Where time jumps back, as when a bag starts anew under sim time, everything is forgotten.
    """

    def __init__(self, node: Node, buffer: TransformBuffer) -> None:
        self._node = node
        self._buffer = buffer
        try:
            from tf2_msgs.msg import TFMessage  # pyright: ignore[reportMissingImports]
        except ImportError:
            self.available = False
            node.get_logger().info("tf2_msgs is not installed: /tf is not heard, results stay in their input's frame")
            return
        self.available = True
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(TFMessage, "/tf", lambda message: self._take(message, static=False), 100)
        node.create_subscription(TFMessage, "/tf_static", lambda message: self._take(message, static=True), latched)
        back = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True)
        self._jumps = node.get_clock().create_jump_callback(back, post_callback=self._on_jump)

    def _take(self, message: Any, static: bool) -> None:
        for transform in message.transforms:
            try:
                learn(self._buffer, transform, static)
            except TransformError as error:
                self._node.get_logger().warning(str(error), throttle_duration_sec=_COMPLAIN_AGAIN)

    def _on_jump(self, jump: TimeJump) -> None:
        self._node.get_logger().info(f"time jumped by {jump.delta.nanoseconds * 1e-9:.3f} s: transforms are forgotten")
        self._buffer.clear()


def learn(buffer: TransformBuffer, transform: TransformStamped, static: bool) -> None:
    """Put one message into the buffer. Raises TransformError: it makes no sense."""
    stamp = transform.header.stamp
    T_parent_child = matrix_of_transform(transform.transform)
    nanoseconds = stamp.sec * 1_000_000_000 + stamp.nanosec
    buffer.add(transform.header.frame_id, transform.child_frame_id, T_parent_child, nanoseconds, static)


def wait_for_transform(
    buffer: TransformBuffer,
    target: str,
    source: str,
    stamp: int | None,
    timeout: float,
    stop: Callable[[], bool] = lambda: False,
) -> Float[np.ndarray, "4 4"]:
    """`T_target_source` at `stamp` [ns] (None: the newest), waited for: transforms come a little later than clouds.

    For a thread other than the executor's, which has to receive them meanwhile. Gives up after `timeout` seconds, or
    when `stop` says so.

    Raises:
        TransformError: what the buffer said last.
    """
    end = time.monotonic() + timeout
    while True:
        try:
            return buffer.lookup(target, source, stamp)
        except TransformError:
            if time.monotonic() >= end or stop():
                raise
        time.sleep(_POLL)


def matrix_of_pose(pose: Pose) -> Float[np.ndarray, "4 4"]:
    """A pose as a matrix. Raises TransformError: not finite, or no rotation."""
    return _matrix(pose.position, pose.orientation)


def matrix_of_transform(transform: Transform) -> Float[np.ndarray, "4 4"]:
    """A transform as a matrix. Raises TransformError: not finite, or no rotation."""
    return _matrix(transform.translation, transform.rotation)


def pose_of_matrix(T: Float[np.ndarray, "4 4"]) -> Pose:
    """The pose that a matrix stands for."""
    x, y, z = map(float, T[:3, 3])
    qx, qy, qz, qw = map(float, Rotation.from_matrix(T[:3, :3]).as_quat())
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def moved_result(result: GraspResult, T_new_old: Float[np.ndarray, "4 4"]) -> GraspResult:
    """A result in another frame: postures, contacts, the support and the next view; all else has no frame."""
    return replace(
        result,
        grasps=tuple(moved_grasp(grasp, T_new_old) for grasp in result.grasps),
        support=None if result.support is None else _moved_plane(result.support, T_new_old),
        next_view=None if result.next_view is None else T_new_old @ result.next_view,
    )


def moved_grasp(grasp: Grasp, T: Float[np.ndarray, "4 4"]) -> Grasp:
    """A grasp in another frame."""
    return replace(
        grasp,
        pregrasp=_moved_posture(grasp.pregrasp, T),
        grasp=_moved_posture(grasp.grasp, T),
        squeeze=_moved_posture(grasp.squeeze, T),
        contacts=tuple(_moved_contact(contact, T) for contact in grasp.contacts),
    )


def _moved_posture(posture: Posture, T: Float[np.ndarray, "4 4"]) -> Posture:
    pose = T @ matrix_of_pose(pose_of(posture))
    turn = pose_of_matrix(pose).orientation
    return replace(posture, position=pose[:3, 3], quaternion_wxyz=np.array([turn.w, turn.x, turn.y, turn.z]))


def _moved_contact(contact: Contact, T: Float[np.ndarray, "4 4"]) -> Contact:
    x, y, z = map(float, T[:3, :3] @ contact.position + T[:3, 3])
    nx, ny, nz = map(float, T[:3, :3] @ contact.normal)
    return replace(contact, position=(x, y, z), normal=(nx, ny, nz))


def _moved_plane(plane: Plane, T: Float[np.ndarray, "4 4"]) -> Plane:
    normal = T[:3, :3] @ plane.normal
    return Plane(normal, plane.offset + float(normal @ T[:3, 3]))


def _matrix(place: Any, turn: Any) -> Float[np.ndarray, "4 4"]:
    """In plain numbers: robots send thousands of transforms a second, and small arrays are slow."""
    x, y, z, w = turn.x, turn.y, turn.z, turn.w
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not (math.isfinite(place.x) and math.isfinite(place.y) and math.isfinite(place.z)):
        raise TransformError(f"position {[place.x, place.y, place.z]}: not finite")
    if not abs(length - 1) <= _ROUNDED:
        raise TransformError(f"quaternion x y z w {[x, y, z, w]}: its length is {length:.3g}; it must be 1")
    x, y, z, w = x / length, y / length, z / length, w / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), place.x],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), place.y],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), place.z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
