"""A node in a process of its own and a client that talks to it over DDS, both in a domain that nobody else uses."""

import array
import dataclasses
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
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from graspd_msgs.msg import GraspArray, GraspProgress, GraspRequest
from rcl_interfaces.srv import SetParameters
from rclpy.action.client import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from sensor_msgs.msg import JointState, PointCloud2, PointField
from std_msgs.msg import Header, String
from std_srvs.srv import Trigger

from graspd_core import make_shape, save_mesh
from graspd_core.paths import config_dir
from graspd_ros.parameters import Settings

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
PATIENCE = 200.0  # seconds until what is waited for is held to never come; a test's own limit is 300

CHANGEABLE = [field.name for field in dataclasses.fields(Settings) if not field.metadata["read_only"]]
DEFAULTS = {name: getattr(Settings(), name) for name in CHANGEABLE} | {"output_dir": "out"}
TERMINAL = {"result", "error", "cancelled", "superseded"}

Event = dict[str, Any]


class Client:
    """Publishes what the node takes, keeps what it answers."""

    def __init__(self, domain: int) -> None:
        self.domain = domain
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(config_dir() / "fastdds.xml")  # for large clouds
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node("graspd_test_client", context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self.events: list[Event] = []
        self.joints: list[JointState] = []
        self.poses: list[PoseStamped] = []
        deep = QoSProfile(depth=500, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        keep = lambda message: self.events.append(json.loads(message.data))  # noqa: E731
        self.node.create_subscription(String, "/graspd/status", keep, deep)
        self.node.create_subscription(JointState, "/graspd/joint_states", self.joints.append, LATCHED)
        self.node.create_subscription(PoseStamped, "/graspd/grasp_pose", self.poses.append, LATCHED)
        self.progress: list[GraspProgress] = []
        self.answers: list[GraspArray] = []
        self.node.create_subscription(GraspProgress, "/graspd/progress", self.progress.append, 500)
        self.node.create_subscription(GraspArray, "/graspd/grasps", self.answers.append, deep)
        self._request = self.node.create_publisher(GraspRequest, "/graspd/request", 500)
        self._mesh = self.node.create_publisher(String, "/graspd/mesh", 10)
        self._cancel = self.node.create_publisher(String, "/graspd/cancel", 10)
        self._points = self.node.create_publisher(PointCloud2, "/points", 10)
        self._services: dict[str, Any] = {}
        self._health: list[Any] = []
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._health.append, 10)

    def spin_until(self, condition: Callable[[], Any], what: str) -> Any:
        """Spin until the condition gives something true, and return that; fail the test where it never comes."""
        end = time.monotonic() + PATIENCE
        while not (found := condition()):
            if time.monotonic() > end:
                pytest.fail(f"no {what} within {PATIENCE:.0f} s; events: {self.events[-5:]}")
            self._executor.spin_once(timeout_sec=0.02)
        return found

    def event(self, **wanted: Any) -> Event:
        """Wait for the first event, seen or yet to come, whose entries are those wanted; an error fails the test."""

        def find() -> Event | None:
            error = next((e for e in self.events if e["event"] == "error"), None)
            if error and wanted["event"] != "error":
                pytest.fail(f"while waiting for {wanted}: {error}")
            return next((e for e in self.events if all(e.get(k) == v for k, v in wanted.items())), None)

        return self.spin_until(find, f"event {wanted}")

    def wait_for_match(self) -> None:
        """Wait until the node hears this client, and this client the node's answer."""
        publishers = (self._mesh, self._cancel, self._points, self._request)
        matched = lambda: all(p.get_subscription_count() for p in publishers)  # noqa: E731
        self.spin_until(matched, "match")
        self.send_cancel("nobody")
        self.event(event="error", request="nobody")
        self.call(Trigger, "reset")

    def health(self, condition: Callable[[dict[str, str]], bool] = bool) -> dict[str, str]:
        """Wait until the node says of itself what is wanted; it speaks once a second."""
        self._health.clear()

        def find() -> dict[str, str] | None:
            told = ({pair.key: pair.value for pair in array.status[0].values} for array in self._health)
            return next(filter(condition, told), None)

        return self.spin_until(find, "health")

    def late(self, kind: type, topic: str) -> list[Any]:
        """What somebody hears who comes late to a topic whose last message is kept."""
        heard: list[Any] = []
        self.node.create_subscription(kind, topic, heard.append, LATCHED)
        return heard

    def kept(self, kind: type, topic: str) -> Any:
        """A publisher whose last message is kept for whoever comes late."""
        return self.node.create_publisher(kind, topic, LATCHED)

    def now(self) -> Time:
        return self.node.get_clock().now().to_msg()

    def spin_for(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.02)

    def forget(self) -> None:
        """Drop what was received so far."""
        for received in (self.events, self.joints, self.poses, self.progress, self.answers):
            received.clear()

    def send_mesh(self, uri: str | Path) -> None:
        self._mesh.publish(String(data=str(uri)))

    def send_request(self, request: GraspRequest | None = None, **fields: Any) -> None:
        self._request.publish(request or GraspRequest(**fields))

    def show(self, send: Callable[[], Any], header: Header) -> None:
        """Send what a camera sees until it is the node's newest: it comes once, and the node may miss it."""

        def is_newest() -> bool:
            send()
            probe = f"probe-{len(self.answers)}"
            self.send_request(id=probe, source=GraspRequest.LATEST_CLOUD)
            self.send_cancel(probe)
            return self.answer(probe).header == header

        self.spin_until(is_newest, "sight of it")
        self.events = [event for event in self.events if not event["request"].startswith("probe-")]

    def answer(self, request_id: str) -> GraspArray:
        """Wait for the answer to a request."""
        find = lambda: next((a for a in self.answers if a.request_id == request_id), None)  # noqa: E731
        return self.spin_until(find, f"answer to {request_id}")

    def call(self, kind: Any, name: str, request: Any = None) -> Any:
        """Call a service of the node and wait for its answer."""
        service = self._services.get(name) or self.node.create_client(kind, f"/graspd/{name}")
        self._services[name] = service
        self.spin_until(service.service_is_ready, f"service {name}")
        return self.done(service.call_async(request or kind.Request()), f"answer of {name}")

    def actions(self, kind: Any, name: str, **qos: Any) -> ActionClient:
        """A client of an action that the node serves."""
        found = ActionClient(self.node, kind, f"/graspd/{name}", **qos)
        self.spin_until(found.server_is_ready, "action server")
        return found

    def done(self, future: Any, what: str) -> Any:
        """Wait for what a future gives."""
        return self.spin_until(lambda: future.done() and future.result(), what)

    def send_goal(self, actions: ActionClient, goal: Any, tell: Callable[[Any], Any] | None = None) -> Any:
        """Send a goal and wait until it is taken or not; gives its handle."""
        return self.done(actions.send_goal_async(goal, feedback_callback=tell), "answer to a goal")

    def send_cancel(self, request_id: str) -> None:
        self._cancel.publish(String(data=request_id))

    def send_cloud(self, cloud: PointCloud2) -> None:
        self._points.publish(cloud)

    def set_parameters(self, **values: Any) -> None:
        """Change the node's parameters while it runs."""
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        answer = self.call(SetParameters, "set_parameters", SetParameters.Request(parameters=parameters))
        refused = [result.reason for result in answer.results if not result.successful]
        assert not refused, refused

    def end_all(self) -> None:
        """Cancel what is still going on and wait until it has ended."""
        self.call(Trigger, "reset")
        self.spin_for(0.2)  # a cloud that waited is told of only as it begins, which it may just have done

        def ended() -> bool:
            ends = {event["request"] for event in self.events if event["event"] in TERMINAL}
            return all(event["request"] in ends for event in self.events if event["event"] == "accepted")

        self.spin_until(ended, "end of everything")

    def run(self, *command: str | Path) -> subprocess.CompletedProcess[str]:
        """Run a Python program in this domain to its end."""
        environment = {**os.environ, "ROS_DOMAIN_ID": str(self.domain)}
        return subprocess.run([sys.executable, *command], env=environment, capture_output=True, text=True)

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


class NodeProcess:
    """`graspd_node` as a user starts it, with parameters; or a module that does as it does."""

    def __init__(
        self, domain: int, directory: Path, parameters: dict[str, Any], module: Path | None = None, namespace: str = ""
    ) -> None:
        arguments = [part for name, value in parameters.items() for part in ("-p", f"{name}:={value}")]
        arguments += ["-r", f"__ns:={namespace}"] if namespace else []
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(directory / "log")}
        self.directory = directory
        self.log = directory / "node.log"
        self._file = self.log.open("w")
        self.process = subprocess.Popen(
            [sys.executable, *([module] if module else ["-m", "graspd_ros.node"]), "--ros-args", *arguments],
            cwd=directory,
            env=environment,
            stdout=self._file,
            stderr=subprocess.STDOUT,
        )

    def alive(self) -> bool:
        return self.process.poll() is None

    def stop(self, number: signal.Signals = signal.SIGINT) -> tuple[int, str]:
        """Send a signal; exit status and the log. One that does not end is killed, whose status is below zero."""
        if self.alive():
            self.process.send_signal(number)
        try:
            status = self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            status = self.process.wait()
        self._file.close()
        return status, self.log.read_text()


def cloud_message(points: np.ndarray, frame: str = "camera") -> PointCloud2:
    """An unorganised float32 cloud."""
    data = np.ascontiguousarray(points, dtype="<f4")
    fields = [PointField(name=n, offset=4 * i, datatype=PointField.FLOAT32, count=1) for i, n in enumerate("xyz")]
    message = PointCloud2(height=1, width=len(data), fields=fields, point_step=12, row_step=12 * len(data))
    message.header.frame_id = frame
    message.data = array.array("B", data.tobytes())
    return message


@pytest.fixture(scope="session")
def seen_ball() -> np.ndarray:
    """The half of a ball of 35 mm that a camera at the origin sees, 0.5 m ahead [m]."""
    directions = np.random.default_rng(0).normal(size=(8000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.array([0.0, 0.0, 0.5]) + 0.035 * directions[directions[:, 2] < 0]


@pytest.fixture(scope="session")
def typestore() -> Any:
    """rosbags' own reading of the definitions, which shares no code with rosidl."""
    store, types = get_typestore(Stores.ROS2_JAZZY), {}
    for file in (Path(__file__).parents[2] / "msg_defs" / "msg").glob("*.msg"):
        types |= get_types_from_msg(file.read_text(), f"graspd_msgs/msg/{file.stem}")
    store.register(types)
    return store


def _agree(theirs: Any, ours: Any) -> bool:
    if hasattr(ours, "get_fields_and_field_types"):
        return all(_agree(getattr(theirs, name), getattr(ours, name)) for name in ours.get_fields_and_field_types())
    if isinstance(ours, list | array.array | np.ndarray):
        return len(theirs) == len(ours) and all(map(_agree, theirs, ours))
    return theirs == ours


@pytest.fixture(scope="session")
def agree() -> Callable[[Any, Any], bool]:
    """Whether a message of rosbags' carries what one of rclpy's does."""
    return _agree


@pytest.fixture(scope="session")
def make_cloud() -> Callable[..., PointCloud2]:
    return cloud_message


@pytest.fixture
def make_node() -> Iterator[Callable[..., Node]]:
    """Makes nodes in this process, each with ROS arguments of its own."""
    made: list[Node] = []

    def make_node(*arguments: str, domain: int | None = None) -> Node:
        context = Context()
        rclpy.init(args=["--ros-args", *arguments], context=context, domain_id=domain)
        made.append(rclpy.create_node("made_by_a_test", context=context))
        return made[-1]

    yield make_node
    for node in made:
        node.destroy_node()
        rclpy.shutdown(context=node.context)


@pytest.fixture
def start_python(domain: int, tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts Python with arguments in the tests' DDS domain, its streams piped."""
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: Any) -> subprocess.Popen[str]:
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(tmp_path / "log")}
        command, pipe = [sys.executable, *map(str, arguments)], subprocess.PIPE
        started.append(subprocess.Popen(command, env=environment, stdin=pipe, stdout=pipe, stderr=pipe, text=True))
        return started[-1]

    yield start
    for process in started:
        process.terminate()  # killed, it would leave its shared memory behind
        process.communicate()


@pytest.fixture(scope="session")
def client(domain: int) -> Iterator[Client]:
    client = Client(domain)
    yield client
    client.close()


def start_ready(client: Client, directory: Path, module: Path | None = None, **parameters: Any) -> NodeProcess:
    """A node that has said it is ready and that hears the client."""
    client.spin_for(0.2)  # what the node before said last may still be unread
    client.forget()
    process = NodeProcess(client.domain, directory, parameters, module)
    try:
        client.event(event="ready")
        client.wait_for_match()
    except BaseException:
        process.stop()
        raise
    client.forget()
    return process


class SharedNode:
    """One node for all tests that need no own: starting one takes seconds. It gives way to nodes of a test's own."""

    def __init__(self, client: Client, directory: Path) -> None:
        self._client = client
        self._directory = directory
        self._process: NodeProcess | None = None
        save_shapes(directory)

    def process(self) -> NodeProcess:
        """The running node; started anew where it is not."""
        if self._process is None or not self._process.alive():
            self._process = start_ready(self._client, self._directory, queue_size=1, output_dir="out")
        return self._process

    def stop(self) -> None:
        if self._process is not None:
            self._process.stop()
            self._process = None


def save_shapes(directory: Path) -> None:
    """`sphere.obj` and `mug.obj`, in reach of a node that runs there."""
    for shape in ("sphere", "mug"):
        save_mesh(directory / f"{shape}.obj", make_shape(shape))


@pytest.fixture(scope="session")
def shared_node(client: Client, tmp_path_factory: pytest.TempPathFactory) -> Iterator[SharedNode]:
    shared = SharedNode(client, tmp_path_factory.mktemp("node"))
    yield shared
    shared.stop()


@pytest.fixture
def node(client: Client, shared_node: SharedNode) -> Iterator[NodeProcess]:
    """The shared node, idle before and after, dynamic parameters at their defaults, nothing latched or kept."""
    process = shared_node.process()
    client.set_parameters(**DEFAULTS)
    client.call(Trigger, "reset")
    client.forget()
    yield process
    client.end_all()


@pytest.fixture
def start_node(client: Client, shared_node: SharedNode, tmp_path: Path) -> Iterator[Callable[..., NodeProcess]]:
    """Starts nodes of the test's own; `ready=False` does not wait. `sphere.obj` and `mug.obj` are in reach.

    Nodes under namespaces stand side by side, each in a directory of its own.
    """
    shared_node.stop()
    save_shapes(tmp_path)
    started: list[NodeProcess] = []

    def start(ready: bool = True, module: Path | None = None, namespace: str = "", **parameters: Any) -> NodeProcess:
        if ready:
            started.append(start_ready(client, tmp_path, module, **parameters))
        else:
            directory = tmp_path / namespace.strip("/")
            directory.mkdir(exist_ok=True)
            started.append(NodeProcess(client.domain, directory, parameters, module, namespace))
        return started[-1]

    yield start
    for process in started:
        process.stop()
