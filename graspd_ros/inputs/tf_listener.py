"""Transforms of /tf and /tf_static into a TransformBuffer, and waiting for those that come late.

tf2_msgs comes with ROS, or from `make setup`: without it the node works, and knows no transforms.
"""

from __future__ import annotations

import time
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from graspd_core.errors import TransformError
from graspd_core.transforms import TransformBuffer
from graspd_core.types import StopHook
from graspd_ros.convert import Matrix, matrix_of_transform, nanoseconds

TRANSFORM_PATIENCE = 1.0  # seconds that the worker waits for a transform
_POLL = 0.01  # seconds between two looks at the buffer
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

    def lookup(self, target: str, source: str, stamp: Time) -> Matrix:
        """Return `T_target_source` at a time, 0 for the newest. Raises TransformError: it is not known."""
        return self._buffer.lookup(target, source, nanoseconds(stamp) or None)

    def lookup_in_time(self, target: str, source: str, stamp: Time, stop: StopHook) -> Matrix:
        """Return the same for the worker's thread, after waiting for what comes late."""
        return wait_for_transform(self._buffer, target, source, nanoseconds(stamp) or None, TRANSFORM_PATIENCE, stop)

    def _take(self, message: Any, static: bool) -> None:
        for transform in message.transforms:
            try:
                add_transform(self._buffer, transform, static)
            except TransformError as error:
                self._node.get_logger().warning(str(error), throttle_duration_sec=_COMPLAIN_AGAIN)

    def _on_jump(self, jump: TimeJump) -> None:
        self._node.get_logger().info(f"time jumped by {jump.delta.nanoseconds * 1e-9:.3f} s: transforms are forgotten")
        self._buffer.clear()


def add_transform(buffer: TransformBuffer, transform: TransformStamped, static: bool) -> None:
    """Put one message into the buffer. Raises TransformError: it makes no sense."""
    header, T_parent_child = transform.header, matrix_of_transform(transform.transform)
    buffer.add(header.frame_id, transform.child_frame_id, T_parent_child, nanoseconds(header.stamp), static)


def wait_for_transform(
    buffer: TransformBuffer,
    target: str,
    source: str,
    stamp: int | None,
    timeout: float,
    stop: StopHook = lambda: False,
) -> Matrix:
    """Return `T_target_source` at `stamp` [ns] (None: the newest), waited for: transforms come later than clouds.

    For a thread other than the executor's, which has to receive them meanwhile. Raises TransformError, what the buffer
    said last, after `timeout` seconds or when `stop` says so.
    """
    end = time.monotonic() + timeout
    while True:
        try:
            return buffer.lookup(target, source, stamp)
        except TransformError:
            if time.monotonic() >= end or stop():
                raise
        time.sleep(_POLL)
