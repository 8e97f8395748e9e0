"""docs/ros.md against a live node: names, types and QoS, the command lines, and the client as the page shows it."""

import importlib
import importlib.util
import re
import shlex
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml
from graspd_msgs.msg import GraspRequest
from rclpy.action.graph import get_action_server_names_and_types_by_node
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from graspd_core.cli import build_parser
from graspd_ros.grasp_node import GraspNode
from graspd_ros.inputs.request_builder import check_request, source_of
from graspd_ros.parameters import Settings, check_parameters

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "ros.md").read_text()
LINES = [line.strip() for line in PAGE.splitlines() if line.startswith("    ")]
PYTHON = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
TF = {"/tf", "/tf_static"}


def section(title: str) -> str:
    return re.split(r"^## ", PAGE.split(f"\n## {title}\n")[1], flags=re.MULTILINE)[0]


def tables(title: str) -> list[list[list[str]]]:
    """The tables of a section, as rows of cells; headers left out."""
    found: list[list[list[str]]] = []
    for block in re.findall(r"(?:^\|.*\|\n)+", section(title), re.MULTILINE):
        rows = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in block.splitlines()]
        found.append(rows[2:])
    return found


def commands(*words: str) -> list[list[str]]:
    found = [shlex.split(line, comments=True) for line in LINES]
    return [parts for parts in found if parts[: len(words)] == list(words)]


def quoted(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def full(name: str) -> str:
    return name.replace("~", "/graspd") if name.startswith("~") else f"/{name.lstrip('/')}"


def type_of(name: str) -> Any:
    module, _, name = name.rpartition("/")
    return getattr(importlib.import_module(module.replace("/", ".")), name)


def fill(message: Any, values: dict[str, Any]) -> None:
    """Set fields as `ros2 topic pub` does, without its leniency: unknown fields and other types are errors."""
    for name, value in values.items():
        assert name in message.get_fields_and_field_types(), f"{type(message).__name__} has no field {name}"
        present = getattr(message, name)
        if isinstance(value, dict):
            fill(present, value)
        else:
            value = float(value) if isinstance(present, float) and isinstance(value, int) else value
            assert type(value) is type(present), f"{name}: {value!r}"
            setattr(message, name, value)


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("docs")


@pytest.fixture(scope="module")
def node(directory: Path, claim_domain: Callable[[], int]) -> Iterator[GraspNode]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        # A deadline beyond all that a busy machine may need.
        given = f"mesh_roots:=['{directory}']", "deadline:=1000.0", "collision_objects:=/collision_object"
        domain = claim_domain()
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        rclpy.init(args=["--ros-args", *(word for value in given for word in ("-p", value))], domain_id=domain)
        node = GraspNode(on_failure=lambda: None)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        spinner = threading.Thread(target=executor.spin)
        spinner.start()
        yield node
        node.close(10.0)
        executor.shutdown()
        spinner.join()
        node.destroy_node()
        rclpy.shutdown()


def endpoints(node: GraspNode) -> dict[str, tuple[str, str, QoSProfile]]:
    """Type, direction and QoS of every topic of the node's own."""
    found = {}
    sides: tuple[tuple[str, Any], ...] = (("in", node.subscriptions), ("out", node.publishers))
    for direction, ends in sides:
        for end in ends:
            kind: Any = end.msg_type
            package = kind.__module__.split(".")[0]
            if package not in ("rcl_interfaces", "rosgraph_msgs"):
                found[end.topic_name] = f"{package}/{kind.__name__}", direction, end.qos_profile
    # One of the sensors' is heard only where somebody publishes it.
    for topic in node._sensors:
        package = topic._kind.__module__.split(".")[0]
        found[topic.name] = f"{package}/{topic._kind.__name__}", "in", topic._qos
    return found


def qos_words(qos: QoSProfile) -> str:
    words = ["reliable" if qos.reliability == ReliabilityPolicy.RELIABLE else "best effort"]
    words += ["transient local"] if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL else []
    return ", ".join([*words, str(qos.depth)])


def test_topics_are_those_of_the_node_in_type_direction_and_qos(node: GraspNode):
    documented = {full(quoted(row[0])[0]): row[1:] for row in tables("Names")[0]}
    live = endpoints(node)
    assert set(documented) - TF == set(live) - TF
    assert (set(live) >= TF) == bool(importlib.util.find_spec("tf2_msgs"))
    for topic, (kind, direction, qos) in live.items():
        cells = documented[topic]
        assert re.match(re.escape(kind) + r"\b", cells[0]), f"{topic}: {kind}"
        offered = topic in {sensor.name for sensor in node._sensors}
        assert cells[1:] == [direction, f"as offered, {qos.depth}" if offered else qos_words(qos)], topic


def test_services_and_actions_are_those_of_the_node(node: GraspNode):
    documented = {full(quoted(row[0])[0]): row[1] for row in tables("Names")[1]}
    services: Any = node.services
    types = {node.resolve_service_name(service.srv_name): service.srv_type for service in services}
    live = {name: f"{kind.__module__.split('.')[0]}/{kind.__name__}" for name, kind in types.items()}
    of_rcl = ("rcl_interfaces/", "type_description_interfaces/")
    live = {name: kind for name, kind in live.items() if not kind.startswith(of_rcl)}
    for name, (kind,) in get_action_server_names_and_types_by_node(node, "graspd", "/"):
        live[name] = kind.replace("/action/", "/")
    assert live == documented
    calls = commands("ros2", "service", "call")
    assert calls
    assert all(types[name] is type_of(kind) for name, kind in (parts[3:] for parts in calls))


def test_documented_messages_fit_their_types_and_topics(node: GraspNode):
    live = endpoints(node)
    published = commands("ros2", "topic", "pub")
    assert len(published) >= 6
    for parts in published:
        options, (topic, kind, text) = parts[3:-3], parts[-3:]
        assert options == ["--once"]
        assert live[topic][:2] == (kind.replace("/msg/", "/"), "in")
        message = type_of(kind)()
        fill(message, yaml.safe_load(text))
        if isinstance(message, GraspRequest):
            check_request(message, "allegro_right")
            source_of(message)


def test_documented_goals_fit_the_action():
    goals = commands("ros2", "action", "send_goal")
    assert goals
    for parts in goals:
        name, kind, text = parts[-3:]
        assert name == "/graspd/synthesize"
        goal = type_of(kind).Goal()
        fill(goal, yaml.safe_load(text))
        check_request(goal.request, "allegro_right")
        source_of(goal.request)


def test_the_table_of_parameters_has_those_of_the_node(node: GraspNode):
    page = (ROOT / "docs" / "reference" / "parameters.md").read_text()
    assert re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE) == [field.name for field in fields(Settings)]


def check_type(node: GraspNode, parameter: Parameter) -> None:
    declared = node.get_parameter(parameter.name).type_
    assert parameter.type_ == declared or node.describe_parameter(parameter.name).dynamic_typing, parameter.name


def test_documented_parameters_can_be_set(node: GraspNode):
    settings = commands("ros2", "param", "set")
    assert settings
    for name, text in (parts[4:] for parts in settings):
        parameter = Parameter(name, value=yaml.safe_load(text))  # as the command reads it
        check_type(node, parameter)
        assert not node.describe_parameter(name).read_only
        assert check_parameters([parameter]).successful


def test_documented_starts_of_the_node_name_parameters_and_topics(node: GraspNode):
    """A node of no topics reads the arguments, as ROS does, and tells what it read."""
    starts = commands("graspd_node")
    assert starts
    names = set(endpoints(node))
    for parts in starts:
        probe = rclpy.create_node(
            "probe",
            cli_args=parts[1:],
            use_global_arguments=False,
            automatically_declare_parameters_from_overrides=True,
        )
        given = {part.split(":=")[0] for flag, part in zip(parts[2::2], parts[3::2], strict=True) if flag == "-p"}
        for name in given:
            assert node.has_parameter(name), name
            check_type(node, probe.get_parameter(name))
        assert check_parameters([probe.get_parameter(name) for name in given]).successful
        probe.destroy_node()
        renamed = {part.split(":=")[0] for flag, part in zip(parts[2::2], parts[3::2], strict=True) if flag == "-r"}
        assert {full(name) for name in renamed} <= names


def test_documented_commands_parse(directory: Path):
    plays = commands("graspd_play")
    assert plays
    for parts in plays:
        played = subprocess.run(
            [sys.executable, "-m", "graspd_ros.player", *parts[1:]], cwd=directory, capture_output=True, text=True
        )
        assert "recording: no such bag" in played.stderr
    replays = [shlex.split(text) for text in re.findall(r"`graspd (replay [^`]+)`", PAGE)]
    assert replays
    for parts in replays:
        build_parser().parse_args(parts)


def test_the_client_gets_a_verified_grasp_of_the_can(node: GraspNode, directory: Path):
    """The can is made, and the action's client run, as the page shows them."""
    (can,) = commands("python", "-c")
    subprocess.run([sys.executable, *can[1:]], cwd=directory, check=True)
    (client,) = (block for block in PYTHON if "ActionClient" in block)
    ran = subprocess.run([sys.executable, "-c", client], cwd=directory, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    assert re.search(r"^\S+/0 object base_link geometry_msgs.msg.Point", ran.stdout, re.MULTILINE), ran.stdout
