"""A node in a process of its own and a client that talks to it over DDS, both in a domain that nobody else uses."""

from __future__ import annotations

import array
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState, PointCloud2, PointField
from std_msgs.msg import String

from graspd_core.geometry.mesh import save_mesh
from graspd_core.geometry.shapes import make_shape

DOMAIN = 1 + os.getpid() % 100
START_TIMEOUT = 60.0  # imports, hand and warm-up; 10 s on a quiet machine
MATCH_SETTLE = 0.3  # seconds after the match in which the first messages could still be lost

TERMINAL = {"result", "error", "cancelled", "superseded"}

Event = dict[str, Any]


class Client:
    """Publishes what the node takes, keeps what it answers."""

    def __init__(self) -> None:
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        self.context = Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.node = rclpy.create_node("graspd_test_client", context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.events: list[Event] = []
        self.joints: list[JointState] = []
        self.poses: list[PoseStamped] = []
        self.node.create_subscription(String, "/graspd/status", self._on_status, 100)
        self.node.create_subscription(JointState, "/graspd/joint_states", self.joints.append, latched)
        self.node.create_subscription(PoseStamped, "/graspd/grasp_pose", self.poses.append, latched)
        self._mesh = self.node.create_publisher(String, "/graspd/mesh", 10)
        self._cancel = self.node.create_publisher(String, "/graspd/cancel", 10)
        self._points = self.node.create_publisher(PointCloud2, "/points", 10)
        self._set_parameters = self.node.create_client(SetParameters, "/graspd/set_parameters")

    def _on_status(self, message: String) -> None:
        self.events.append(json.loads(message.data))

    def spin_until(self, condition: Callable[[], Any], timeout: float, what: str) -> Any:
        """Spin until the condition gives something true, and return that; fail the test after `timeout` seconds."""
        end = time.monotonic() + timeout
        while not (found := condition()):
            if time.monotonic() > end:
                pytest.fail(f"no {what} within {timeout:.0f} s; events: {self.events[-5:]}")
            self._executor.spin_once(timeout_sec=0.02)
        return found

    def event(self, timeout: float, **wanted: Any) -> Event:
        """Wait for the first event, seen or yet to come, whose entries are those wanted; an error fails the test."""

        def find() -> Event | None:
            error = next((e for e in self.events if e["event"] == "error"), None)
            if error and wanted["event"] != "error":
                pytest.fail(f"while waiting for {wanted}: {error}")
            return next((e for e in self.events if all(e.get(k) == v for k, v in wanted.items())), None)

        return self.spin_until(find, timeout, f"event {wanted}")

    def wait_for_match(self) -> None:
        publishers = (self._mesh, self._cancel, self._points)
        matched = lambda: all(p.get_subscription_count() for p in publishers)  # noqa: E731
        self.spin_until(matched, START_TIMEOUT, "match")
        self.spin_for(MATCH_SETTLE)

    def spin_for(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.02)

    def forget(self) -> None:
        """Drop what was received so far."""
        for received in (self.events, self.joints, self.poses):
            received.clear()

    def send_mesh(self, uri: str | Path) -> None:
        self._mesh.publish(String(data=str(uri)))

    def send_cancel(self, request_id: str) -> None:
        self._cancel.publish(String(data=request_id))

    def send_cloud(self, cloud: PointCloud2) -> None:
        self._points.publish(cloud)

    def set_parameters(self, **values: Any) -> None:
        """Change the node's parameters while it runs."""
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        self.spin_until(self._set_parameters.service_is_ready, 10.0, "parameter service")
        future = self._set_parameters.call_async(SetParameters.Request(parameters=parameters))
        answer = self.spin_until(lambda: future.done() and future.result(), 10.0, "answer to set_parameters")
        refused = [result.reason for result in answer.results if not result.successful]
        assert not refused, refused

    def end_all(self) -> None:
        """Cancel what is still going on and wait until it has ended."""
        self.send_cancel("")

        def ended() -> bool:
            ends = {event["request"] for event in self.events if event["event"] in TERMINAL}
            return all(event["request"] in ends for event in self.events if event["event"] == "accepted")

        self.spin_until(ended, 20.0, "end of everything")

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


class NodeProcess:
    """`graspd_node` as a user starts it, with parameters."""

    def __init__(self, directory: Path, parameters: dict[str, Any]) -> None:
        arguments = [part for name, value in parameters.items() for part in ("-p", f"{name}:={value}")]
        environment = {**os.environ, "ROS_DOMAIN_ID": str(DOMAIN), "ROS_LOG_DIR": str(directory / "log")}
        self.directory = directory
        self.log = directory / "node.log"
        self._file = self.log.open("w")
        self.process = subprocess.Popen(
            [sys.executable, "-m", "graspd_ros.node", "--ros-args", *arguments],
            cwd=directory,
            env=environment,
            stdout=self._file,
            stderr=subprocess.STDOUT,
        )

    def alive(self) -> bool:
        return self.process.poll() is None

    def stop(self, number: signal.Signals = signal.SIGINT, timeout: float = 10.0) -> tuple[int, float, str]:
        """Send a signal; exit status, seconds until the end, and the log."""
        begun = time.monotonic()
        if self.alive():
            self.process.send_signal(number)
        try:
            status = self.process.wait(timeout)
        except subprocess.TimeoutExpired:
            self.process.kill()
            status = self.process.wait()
        self._file.close()
        return status, time.monotonic() - begun, self.log.read_text()


def cloud_message(points: np.ndarray, frame: str = "camera") -> PointCloud2:
    """An unorganised float32 cloud."""
    data = np.ascontiguousarray(points, dtype="<f4")
    fields = [PointField(name=n, offset=4 * i, datatype=PointField.FLOAT32, count=1) for i, n in enumerate("xyz")]
    message = PointCloud2(height=1, width=len(data), fields=fields, point_step=12, row_step=12 * len(data))
    message.header.frame_id = frame
    message.data = array.array("B", data.tobytes())
    return message


@pytest.fixture(scope="session")
def make_cloud() -> Callable[..., PointCloud2]:
    return cloud_message


@pytest.fixture(scope="session")
def client() -> Iterator[Client]:
    client = Client()
    yield client
    client.close()


def start_ready(client: Client, directory: Path, **parameters: Any) -> NodeProcess:
    """A node that has said it is ready and that hears the client."""
    client.forget()
    process = NodeProcess(directory, parameters)
    try:
        client.event(START_TIMEOUT, event="ready")
        client.wait_for_match()
    except BaseException:
        process.stop()
        raise
    client.forget()
    return process


@pytest.fixture(scope="module")
def shared_node(client: Client, tmp_path_factory: pytest.TempPathFactory) -> Iterator[NodeProcess]:
    """One node for the tests of a module: starting one takes seconds. `sphere.obj` and `mug.obj` are in reach."""
    directory = tmp_path_factory.mktemp("node")
    for shape in ("sphere", "mug"):
        save_mesh(make_shape(shape), directory / f"{shape}.obj")
    process = start_ready(client, directory, queue_size=1, output_dir="out")
    yield process
    process.stop()


@pytest.fixture
def node(client: Client, shared_node: NodeProcess) -> Iterator[NodeProcess]:
    """The shared node, idle before and after."""
    client.forget()
    yield shared_node
    client.end_all()


@pytest.fixture
def start_node(client: Client, tmp_path: Path) -> Iterator[Callable[..., NodeProcess]]:
    """Starts a node of the test's own; `ready=False` does not wait for it. `sphere.obj` and `mug.obj` are in reach."""
    for shape in ("sphere", "mug"):
        save_mesh(make_shape(shape), tmp_path / f"{shape}.obj")
    started: list[NodeProcess] = []

    def start(ready: bool = True, **parameters: Any) -> NodeProcess:
        started.append(start_ready(client, tmp_path, **parameters) if ready else NodeProcess(tmp_path, parameters))
        return started[-1]

    yield start
    for process in started:
        process.stop()
