"""The node's publishers. Safe from any thread: results come from the worker's, refusals from the executor's."""

from __future__ import annotations

import threading
from typing import Any

from geometry_msgs.msg import PoseStamped
from graspd_msgs.msg import GraspArray, GraspProgress
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from graspd_ros.outputs import status_json as convert

SHOWN = {
    JointState: "~/joint_states",
    PoseStamped: "~/grasp_pose",
    JointTrajectory: "~/trajectory",
    MarkerArray: "~/markers",
}
# Late joiners get the last of these.
LATCHED = {GraspArray: "~/grasps", **SHOWN}


class Publishers:
    """One publisher for each type of message."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._lock = threading.Lock()
        self._closed = False
        self._publishers: dict[type, Any] = {
            # Latched: who is discovered after the start, or after a restart, still hears that the node is ready.
            String: node.create_publisher(
                String, "~/status", QoSProfile(depth=50, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            ),
            GraspProgress: node.create_publisher(GraspProgress, "~/progress", 50),
        }
        self._publishers |= {kind: self._latched(kind) for kind in LATCHED}

    def _latched(self, kind: type) -> Any:
        return self._node.create_publisher(
            kind,
            LATCHED[kind],
            QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def publish(self, message: Any) -> None:
        """Publish on the topic of the message's type; nothing after `close`."""
        with self._lock:
            if not self._closed:
                self._publishers[type(message)].publish(message)

    def tell(self, event: str, request_id: str, source: str, **details: Any) -> None:
        """One event on ~/status."""
        stamp = self._node.get_clock().now().nanoseconds * 1e-9
        line = {"event": event, "request": request_id, "source": source, "stamp": stamp, **details}
        self.publish(String(data=convert.status_line(line)))

    def forget(self) -> None:
        """Late joiners get none of the poses, joint values and markers from before now.

        Answers stay: a new publisher has to be found by its readers first, and those that follow at once were lost.
        """
        with self._lock:
            for kind in SHOWN:
                self._node.destroy_publisher(self._publishers[kind])
                self._publishers[kind] = self._latched(kind)

    def close(self) -> None:
        """Publish no more."""
        with self._lock:
            self._closed = True
