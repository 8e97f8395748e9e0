"""`graspd_view`: show the grasps of a running node in a browser, on any machine in the node's ROS domain.

graspd_view [--node /graspd] [--object OBJECT] [--hand FILE] [--host H] [--port P] [--ros-args -r points:=/seen]
"""

from __future__ import annotations

import argparse
import sys
import threading
from functools import lru_cache
from typing import Any

import numpy as np

from graspd_core.errors import GraspdError, HandError, Parser
from graspd_core.types import Contact, Grasp, GraspMetrics, Posture, TrialResult
from graspd_ros.node import run_command


def main(args: list[str] | None = None) -> int:
    """Follow a node until a signal. Return 0 when stopped, 2 for bad input."""
    return run_command("graspd_view", args, _parse, _serve)


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = Parser(prog="graspd_view", description="Show the grasps of a graspd node in a browser.")
    parser.add_argument("--node", default="/graspd", help="name of the node (default /graspd)")
    parser.add_argument("--object", default=None, metavar="OBJECT", help="object file, in the answers' frame")
    parser.add_argument("--hand", default=None, metavar="NAME|PATH", help="show this hand, not the answers' hand")
    parser.add_argument("--host", default="127.0.0.1", help="address to serve at (default: for this machine only)")
    parser.add_argument("--port", type=int, default=8080, help="port, or the next free one (default 8080)")
    return parser.parse_args(arguments)


def _serve(options: argparse.Namespace, stop: threading.Event) -> None:
    import rclpy

    from graspd_core import load_hand, load_scene
    from graspd_viewer.viewer import Viewer

    scene = load_scene(options.object) if options.object else None
    if options.hand:
        load_hand(options.hand)
    viewer = Viewer(host=options.host, port=options.port, plan=False)
    try:
        node = rclpy.create_node("graspd_view")
        Follower(node, viewer, options.node, scene=scene, hand=options.hand)
        print(f"{viewer.url} shows the grasps of {options.node}; Ctrl-C ends it", flush=True)
        while not stop.is_set():
            rclpy.spin_once(node, timeout_sec=0.1)
        node.destroy_node()
    finally:
        viewer.close()


class Follower:
    """Subscriber to the node `name` that shows the newest answer in a viewer.

    Args:
        scene: the object in the frame of the answers. None if unknown.
        hand: name or path of a hand. If None, the hand named in the answer is used.
    """

    def __init__(self, node: Any, viewer: Any, name: str, *, scene: Any = None, hand: str | None = None) -> None:
        from graspd_msgs.msg import GraspArray, GraspProgress
        from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
        from sensor_msgs.msg import PointCloud2

        self._node, self._viewer, self._scene, self._hand = node, viewer, scene, hand
        self._cloud: Any = None
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(GraspArray, f"{name}/grasps", self._on_answer, latched)
        node.create_subscription(GraspProgress, f"{name}/progress", self._on_progress, 50)
        node.create_subscription(PointCloud2, "points", self._on_cloud, qos_profile_sensor_data)

    def _on_cloud(self, message: Any) -> None:
        self._cloud = message  # the points are read only when an answer is shown

    def _on_progress(self, message: Any) -> None:
        line = f"{message.request_id}: {message.stage} {message.step} of {message.of}, {message.verified} verified"
        self._viewer.do("progress", lambda: self._viewer.show_progress(line, min(message.fraction, 0.99)))

    def _on_answer(self, message: Any) -> None:
        from graspd_core import PlanConfig
        from graspd_viewer.session import Session, make_session

        ending = message.message or f"{len(message.grasps)} grasps"
        self._viewer.do("progress", lambda: self._viewer.show_progress(ending, 1.0))
        if not message.grasps:
            return
        try:
            first = message.grasps[0]
            hand = _hand(self._hand or first.hand, first.base_link, named_by_message=self._hand is None)
            grasps = tuple(grasp_of(grasp, hand.joint_names) for grasp in message.grasps)
        except (GraspdError, ValueError) as error:
            self._node.get_logger().warning(f"the answer to {message.request_id} is not shown: {error}")
            return
        title, notes = f"request {message.request_id}", (ending, *message.warnings)
        seen = self._seen(message.header.frame_id)
        if self._scene is None:
            self._viewer.show(Session(title, hand, grasps, seen=seen, notes=notes))
        else:
            about = self._scene, PlanConfig(), seen, notes
            self._viewer.show(make_session(title, hand, grasps, *about, mass=message.mass or None))

    def _seen(self, frame: str) -> np.ndarray:
        """Return the points of the newest cloud [m], or no points if the cloud is not in the answer's frame."""
        from graspd_core.io.messages import points_from_message

        if self._cloud is None or self._cloud.header.frame_id != frame:
            return np.zeros((0, 3))
        try:
            points = points_from_message(self._cloud)
        except GraspdError as error:
            self._node.get_logger().warning(f"the cloud is not shown: {error}")
            return np.zeros((0, 3))
        return points[np.isfinite(points).all(1)]


@lru_cache(maxsize=4)
def _hand(name: str, base_link: str, *, named_by_message: bool) -> Any:
    """Return a hand with the node's `hand_prefix`, which is the start of `base_link` in the message."""
    from graspd_core import hand_names, load_hand

    if named_by_message and name not in hand_names():
        raise HandError(f"hand {name[:80]!r} is not one of {', '.join(hand_names())}; give its file with --hand")
    hand = load_hand(name)
    prefix = base_link.removesuffix(hand.base_link)
    return load_hand(name, prefix=prefix) if prefix and prefix != base_link else hand


def grasp_of(message: Any, joint_names: tuple[str, ...]) -> Grasp:
    """Return the grasp in a message. Raises ValueError if a joint is missing or a number is not finite."""
    from graspd_ros.convert import array_of, wxyz_of

    def posture(pose: Any, joints: Any) -> Posture:
        values = dict(zip(joints.name, joints.position, strict=True))
        missing = [name for name in joint_names if name not in values]
        if missing:
            raise ValueError(f"joint {missing[0]} has no value")
        made = array_of(pose.position), wxyz_of(pose.orientation), np.array([values[name] for name in joint_names])
        if not all(np.isfinite(numbers).all() for numbers in made) or not 0.9 < np.linalg.norm(made[1]) < 1.1:
            raise ValueError("a posture has a number that is not finite, or no unit quaternion")
        return Posture(*made)

    def triple(values: Any) -> tuple[float, float, float]:
        return values.x, values.y, values.z

    def moved(value: float) -> float:
        return value if value >= 0 else float("inf")  # -1 means that the simulation diverged

    return Grasp(
        pregrasp=posture(message.pregrasp_pose, message.pregrasp_joints),
        grasp=posture(message.grasp_pose, message.grasp_joints),
        squeeze=posture(message.grasp_pose, message.squeeze_joints),
        contacts=tuple(
            Contact(c.link, triple(c.position), triple(c.normal), triple(c.force) if any(triple(c.force)) else None)
            for c in message.contacts
        ),
        score=message.score,
        metrics=GraspMetrics({metric.name: metric.value for metric in message.metrics}),
        trials=tuple(
            TrialResult(t.name, t.passed, moved(t.displacement), moved(t.rotation), t.reason) for t in message.trials
        ),
    )


if __name__ == "__main__":
    sys.exit(main())
