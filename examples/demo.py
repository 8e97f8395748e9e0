"""Request verified grasps of a mug from the node over DDS, by its mesh and by the cloud of an RGB-D camera.

The program starts the node in another process and uses its topics. It writes to demo/: `mug.obj`, `grasps.json`,
`grasp.png` (grasp of the mesh, two views), `grasp_from_cloud.png` and the node's log.
Run it with `make demo`, or `python examples/demo.py [DIRECTORY]`.
"""

from __future__ import annotations

import array
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.utilities import try_shutdown
from sensor_msgs.msg import JointState, PointCloud2, PointField
from std_msgs.msg import String

from graspd_bench.rendering.render import camera_of_view, look_at, render_depth, render_shaded, save_png
from graspd_core import Posture, TriangleMesh, cloud_from_depth, load_hand, make_shape, save_mesh
from graspd_core.types import joined
from graspd_viewer.grasp_page import placed_hand

GRASPS = 8
TIMEOUT = 180.0  # longest wait for a step [s]. A step takes a few seconds on a quiet machine
CAMERA = camera_of_view(320, 240)
T_MUG_CAMERA = look_at(eye=(0.32, -0.28, 0.25), target=(0.0, 0.0, 0.0))
VIEWS = ((0.35, -0.30, 0.22), (-0.25, 0.40, 0.15))  # camera positions of the pictures, mug frame [m]
MUG_COLOUR, HAND_COLOUR = (0.85, 0.55, 0.25), (0.35, 0.45, 0.60)
DOMAIN = str(1 + os.getpid() % 100)

Event = dict[str, Any]


class DemoError(Exception):
    """The demo cannot continue. The message says why in one line."""


class Robot:
    """Client of the node: it publishes objects and waits for grasps."""

    def __init__(self, node_process: subprocess.Popen) -> None:
        self._process = node_process
        self.node = rclpy.create_node("graspd_demo")
        self.events: list[Event] = []
        self.joints: JointState | None = None
        self.pose: PoseStamped | None = None
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        told = QoSProfile(depth=50, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(String, "/graspd/status", self._on_status, told)
        self.node.create_subscription(JointState, "/graspd/joint_states", self._on_joints, latched)
        self.node.create_subscription(PoseStamped, "/graspd/grasp_pose", self._on_pose, latched)
        self.mesh = self.node.create_publisher(String, "/graspd/mesh", 10)
        self.points = self.node.create_publisher(PointCloud2, "/points", 10)

    def _on_status(self, message: String) -> None:
        self.events.append(json.loads(message.data))

    def _on_joints(self, message: JointState) -> None:
        self.joints = message

    def _on_pose(self, message: PoseStamped) -> None:
        self.pose = message

    def wait_for(self, condition: Callable[[], Any], what: str) -> Any:
        """Spin until the condition returns a true value, and return this value. Raises DemoError: error or timeout."""
        end = time.monotonic() + TIMEOUT
        while not (found := condition()):
            error = next((event for event in self.events if event["event"] == "error"), None)
            if error:
                raise DemoError(f"the node reports: {error['message']}")
            if self._process.poll() is not None:
                raise DemoError(f"the node ended with status {self._process.returncode}")
            if time.monotonic() > end:
                raise DemoError(f"no {what} within {TIMEOUT:.0f} s")
            rclpy.spin_once(self.node, timeout_sec=0.05)
        return found

    def wait_for_event(self, name: str) -> Event:
        return self.wait_for(lambda: next((e for e in self.events if e["event"] == name), None), f"event {name}")

    def request(self, title: str, send: Callable[[], None]) -> tuple[Event, TriangleMesh]:
        """Send an object and print the answers. Return the result event and the mesh of the received hand."""
        self.events.clear()
        self.joints = self.pose = None
        begun = time.monotonic()
        send()
        progress = self.wait_for_event("progress")
        first_progress = time.monotonic() - begun
        result = self.wait_for_event("result")
        elapsed = time.monotonic() - begun
        if result["best"] is None:
            raise DemoError(f"{title}: {result['message']}")
        joints, pose = self.wait_for(lambda: self.joints and self.pose and (self.joints, self.pose), "grasp messages")
        reports = sum(event["event"] == "progress" for event in self.events)
        first_verified = result["timing"]["first_verified"]
        say(f"\n{title} ({progress['request']}, frame {result['frame']!r})")
        say(f"  first progress          {first_progress:6.2f} s   ({reports} reports)")
        if first_verified is not None:
            say(f"  first verified grasp    {first_verified:6.2f} s")
        say(f"  all grasps              {elapsed:6.2f} s")
        say(f"  verified                {result['verified']:3d} of {result['grasps']} tried, {GRASPS} requested")
        say(f"  best: {describe(result['best'])}")
        return result, hand_in_object_frame(joints, pose)


def hand_in_object_frame(joints: JointState, stamped: PoseStamped) -> TriangleMesh:
    """Return the hand's mesh at the received joint values and pose [m]."""
    hand = load_hand("allegro_right")
    value_of = dict(zip(joints.name, joints.position, strict=True))
    at, turn = stamped.pose.position, stamped.pose.orientation
    position, quaternion = np.array([at.x, at.y, at.z]), np.array([turn.w, turn.x, turn.y, turn.z])
    return placed_hand(hand, Posture(position, quaternion, np.array([value_of[name] for name in hand.joint_names])))


def say(line: str) -> None:
    print(line, flush=True)


def describe(best: dict[str, Any]) -> str:
    parts = [best["verdict"], f"{len(best['links'])} links touch"]
    if best["metrics"]["penetration_mm"] is not None:
        parts.append(f"penetration {best['metrics']['penetration_mm']:.1f} mm")
    parts += [f"moved {trial['displacement'] * 100:.2f} cm in the {trial['name']} trial" for trial in best["trials"]]
    return ", ".join(parts)


def cloud_of(mug: TriangleMesh) -> PointCloud2:
    """Return a cloud of the mug on a table, as a depth camera sees it, in the camera's optical frame."""
    corners = [(x, y, mug.vertices[:, 2].min()) for x, y in ((-0.3, -0.3), (0.3, -0.3), (0.3, 0.3), (-0.3, 0.3))]
    scene = joined(mug, TriangleMesh(np.array(corners), np.array([[0, 1, 2], [0, 2, 3]])))
    points = cloud_from_depth(render_depth(scene, CAMERA, T_MUG_CAMERA), CAMERA).points.astype("<f4")
    fields = [PointField(name=n, offset=4 * i, datatype=PointField.FLOAT32, count=1) for i, n in enumerate("xyz")]
    cloud = PointCloud2(height=1, width=len(points), fields=fields, point_step=12, row_step=12 * len(points))
    cloud.header.frame_id = "camera_optical_frame"
    cloud.data = array.array("B", points.tobytes())  # assigning a numpy array takes a thousand times longer
    return cloud


def to_mug_frame(mesh: TriangleMesh) -> TriangleMesh:
    """Return a mesh in the camera's frame moved to the mug's frame."""
    return TriangleMesh(mesh.vertices @ T_MUG_CAMERA[:3, :3].T + T_MUG_CAMERA[:3, 3], mesh.faces)


def picture(mug: TriangleMesh, hand: TriangleMesh, path: Path) -> None:
    """Write a picture with two views side by side."""
    scene = [(mug, MUG_COLOUR), (hand, HAND_COLOUR)]
    views = [render_shaded(scene, T_world_camera=look_at(eye, (0.0, 0.0, 0.0))) for eye in VIEWS]
    save_png(path, np.hstack(views))


def start_node(directory: Path) -> subprocess.Popen:
    """Start `graspd_node` in another process. Its output goes to node.log in `directory`."""
    parameters = [f"num_grasps:={GRASPS}", "mesh_roots:=['.']", "output_dir:=results"]
    arguments = [part for parameter in parameters for part in ("-p", parameter)]
    with (directory / "node.log").open("w") as log:
        command = [sys.executable, "-m", "graspd_ros.node", "--ros-args", *arguments]
        return subprocess.Popen(command, cwd=directory, stdout=log, stderr=subprocess.STDOUT)


def stop_node(process: subprocess.Popen) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        process.wait(5.0)
    except subprocess.TimeoutExpired:
        process.kill()


def run(directory: Path, process: subprocess.Popen) -> None:
    """Send both requests and write the files."""
    begun = time.monotonic()
    robot = Robot(process)
    robot.wait_for_event("ready")
    robot.wait_for(lambda: robot.mesh.get_subscription_count() and robot.points.get_subscription_count(), "match")
    time.sleep(0.3)  # messages sent right after the discovery can still be lost
    say(f"node ready after {time.monotonic() - begun:.1f} s")
    mug = make_shape("mug")
    save_mesh(directory / "mug.obj", mug)

    result, hand = robot.request("a mug as a mesh path", lambda: robot.mesh.publish(String(data="mug.obj")))
    shutil.copy(directory / result["file"], directory / "grasps.json")
    picture(mug, hand, directory / "grasp.png")

    cloud = cloud_of(mug)
    _, hand = robot.request(f"the mug as a cloud of {cloud.width} points", lambda: robot.points.publish(cloud))
    picture(mug, to_mug_frame(hand), directory / "grasp_from_cloud.png")
    say(f"\nwritten to {os.path.relpath(directory)}: grasps.json, grasp.png, grasp_from_cloud.png")
    graspd = os.path.relpath(Path(sys.executable).with_name("graspd"))
    say(f"look at the grasps in a browser: {graspd} view {os.path.relpath(directory / 'grasps.json')}")


def main() -> int:
    """Return 0 if both requests gave a grasp, 1 if not, 130 if interrupted."""
    directory = Path(sys.argv[1] if len(sys.argv) > 1 else "demo").resolve()
    directory.mkdir(parents=True, exist_ok=True)
    os.environ.update(ROS_DOMAIN_ID=DOMAIN, ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
    process = start_node(directory)
    try:
        rclpy.init()
        run(directory, process)
    except DemoError as error:
        sys.stderr.write(f"demo: {error} (the node's log: {directory / 'node.log'})\n")
        return 1
    except KeyboardInterrupt:
        return 130
    finally:
        stop_node(process)
        try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
