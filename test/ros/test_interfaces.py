"""graspd_msgs as built: every type imports, keeps what it carries, matches its definition, and crosses processes.

The oracle for bytes and type hashes is rosbags, which shares no code with rosidl. Run as a script, this file is the
other process.
"""

from __future__ import annotations

import array
import itertools
import os
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from action_msgs.msg import GoalStatus
from ament_index_python.packages import get_package_share_directory
from graspd_msgs.action import SynthesizeGrasps
from graspd_msgs.msg import Grasp, GraspArray, GraspProgress, GraspRequest
from graspd_msgs.srv import ListHands
from rclpy.action.client import ActionClient
from rclpy.action.server import ActionServer, CancelResponse
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.task import Future
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosidl_parser.definition import AbstractNestedType, AbstractString, Array, BasicType, NamespacedType

SOURCES = Path(__file__).parents[2] / "msg_defs"
MESSAGES = sorted(path.stem for path in SOURCES.glob("msg/*.msg"))
TIMEOUT = 100.0

# Values that each type keeps exactly: never zero, so that a field left behind is seen.
INTEGERS = {"uint8": 2**8, "int8": 2**7, "uint16": 2**16, "int32": 2**31, "uint32": 2**32, "int64": 2**63}


def message_class(name: str) -> Any:
    return getattr(import_module("graspd_msgs.msg"), name)


def filled(cls: Any, count: Iterator[int]) -> Any:
    """A message in which every field differs from every other, three elements in each sequence."""

    def value(kind: Any) -> Any:
        if isinstance(kind, AbstractNestedType):
            return [value(kind.value_type) for _ in range(kind.size if isinstance(kind, Array) else 3)]
        if isinstance(kind, NamespacedType):
            return filled(getattr(import_module(".".join(kind.namespaces)), kind.name), count)
        if isinstance(kind, AbstractString):
            return f"τεχτ {next(count)}"
        assert isinstance(kind, BasicType)
        if kind.typename == "boolean":
            return True
        number = next(count)
        if kind.typename == "float":
            return 1 / 2 ** (number % 100)
        # The largest of its kind, less a running number: a narrower type on the way would cut it.
        return 1 / number if kind.typename == "double" else (INTEGERS[kind.typename] - 1 - number % 100)

    names = cls.get_fields_and_field_types()
    return cls(**{name: value(kind) for name, kind in zip(names, cls.SLOT_TYPES, strict=True)})


def agree(theirs: Any, ours: Any) -> bool:
    """Whether a message of rosbags' carries what one of rclpy's does."""
    if hasattr(ours, "get_fields_and_field_types"):
        return all(agree(getattr(theirs, name), getattr(ours, name)) for name in ours.get_fields_and_field_types())
    if isinstance(ours, list | array.array | np.ndarray):
        return len(theirs) == len(ours) and all(map(agree, theirs, ours))
    return theirs == ours


@pytest.fixture(scope="module")
def typestore() -> Any:
    """rosbags' own reading of the definitions."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for name in MESSAGES:
        types |= get_types_from_msg((SOURCES / "msg" / f"{name}.msg").read_text(), f"graspd_msgs/msg/{name}")
    store.register(types)
    return store


@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_keeps_every_field(name: str):
    message = filled(message_class(name), itertools.count(2))
    assert deserialize_message(serialize_message(message), message_class(name)) == message
    assert message != message_class(name)()


@pytest.mark.parametrize("name", MESSAGES)
def test_another_implementation_reads_the_same_bytes(name: str, typestore: Any):
    message = filled(message_class(name), itertools.count(2))
    theirs = typestore.deserialize_cdr(serialize_message(message), f"graspd_msgs/msg/{name}")
    assert agree(theirs, message)


def test_the_defaults_ask_for_the_nodes_own_settings():
    request, grasp = GraspRequest(), Grasp()
    assert (request.source, request.seed, request.num_grasps, request.time_budget) == (GraspRequest.CLOUD, -1, 0, 0.0)
    assert (request.mesh_scale, request.hand, request.preset, request.use_target_point) == (1.0, "", "", False)
    assert grasp.verdict == Grasp.UNVERIFIED
    assert (grasp.metrics, grasp.trials) == ([], [])


def test_what_is_installed_is_what_the_definitions_say(monkeypatch: pytest.MonkeyPatch):
    # the wheels do not set it; a sourced workspace does
    monkeypatch.setenv("AMENT_PREFIX_PATH", os.environ.get("AMENT_PREFIX_PATH", sys.prefix))
    share = Path(get_package_share_directory("graspd_msgs"))
    paths = [path.relative_to(SOURCES) for kind in ("msg", "srv", "action") for path in SOURCES.glob(f"{kind}/*.*")]
    assert {path.stem for path in share.glob("*/*.idl")} == {path.stem for path in paths}
    for path in paths:
        assert (share / path).read_text() == (SOURCES / path).read_text(), f"{path} changed: run `make setup`"


class Client:
    """This process's end: a node that spins while it waits."""

    def __init__(self, domain: int) -> None:
        self.domain = domain
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node("graspd_interfaces_client", context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)

    def wait(self, condition: Callable[[], Any], what: str) -> Any:
        end = time.monotonic() + TIMEOUT
        while not (found := condition()):
            assert time.monotonic() < end, f"no {what} within {TIMEOUT:.0f} s"
            self._executor.spin_once(timeout_sec=0.02)
        return found

    def answer(self, future: Any, what: str) -> Any:
        self.wait(future.done, what)
        return future.result()

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture(scope="module")
def client(claim_domain: Callable[[], int]) -> Iterator[Client]:
    patch = pytest.MonkeyPatch()
    patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    client = Client(claim_domain())  # not that of the other DDS tests
    yield client
    client.close()
    patch.undo()


@pytest.fixture(scope="module")
def peer(client: Client) -> Iterator[subprocess.Popen[bytes]]:
    """The other process; it ends with its standard input, so that it cannot outlive this one."""
    process = subprocess.Popen([sys.executable, __file__, str(client.domain)], stdin=subprocess.PIPE)
    yield process
    process.communicate()
    assert process.returncode == 0


@pytest.mark.parametrize("name", MESSAGES)
def test_the_compiled_type_hash_is_that_of_the_definition(name: str, client: Client, typestore: Any):
    publisher = client.node.create_publisher(message_class(name), f"hash/{name.lower()}", 1)
    find = lambda: client.node.get_publishers_info_by_topic(publisher.topic_name)  # noqa: E731
    (endpoint,) = client.wait(find, "publisher")
    compiled = endpoint.topic_type_hash
    expected = typestore.hash_rihs01(f"graspd_msgs/msg/{name}")
    assert f"RIHS0{compiled.version}_{bytes(compiled.value).hex()}" == expected
    client.node.destroy_publisher(publisher)


def test_a_message_goes_to_another_process_and_back(client: Client, peer: subprocess.Popen[bytes]):
    received: list[GraspArray] = []
    subscription = client.node.create_subscription(GraspArray, "there_and_back", received.append, 10)
    publisher = client.node.create_publisher(GraspArray, "there", 10)
    client.wait(lambda: publisher.get_subscription_count() and subscription.get_publisher_count(), "match")
    message = filled(GraspArray, itertools.count(2))

    def answered() -> bool:
        publisher.publish(message)  # again and again: the other side may not know of this one yet
        return bool(received)

    client.wait(answered, "answer")
    assert received[0] == message


def test_a_service_answers_from_another_process(client: Client, peer: subprocess.Popen[bytes]):
    service = client.node.create_client(ListHands, "list_hands")
    client.wait(service.service_is_ready, "service")
    answer = client.answer(service.call_async(ListHands.Request()), "answer")
    assert (list(answer.names), answer.current, answer.base_link) == (["left", "right"], "right", "palm")


@pytest.fixture(scope="module")
def action(client: Client, peer: subprocess.Popen[bytes]) -> ActionClient:
    action = ActionClient(client.node, SynthesizeGrasps, "synthesize")
    client.wait(action.server_is_ready, "action server")
    return action


def test_an_action_is_carried_out_in_another_process(client: Client, action: ActionClient):
    goal = SynthesizeGrasps.Goal(request=filled(GraspRequest, itertools.count(2)))
    handle = client.answer(action.send_goal_async(goal), "goal response")
    assert handle.accepted
    answer = client.answer(handle.get_result_async(), "result")
    assert answer.status == GoalStatus.STATUS_SUCCEEDED
    assert answer.result.result == result_for(goal.request)


def test_an_action_in_another_process_reports_and_is_cancelled(client: Client, action: ActionClient):
    goal = SynthesizeGrasps.Goal(request=GraspRequest(id="endless"))
    feedback: list[GraspProgress] = []
    keep = lambda message: feedback.append(message.feedback.progress)  # noqa: E731
    handle = client.answer(action.send_goal_async(goal, feedback_callback=keep), "goal response")
    client.wait(lambda: len(feedback) >= 3, "feedback")
    steps = [progress.step for progress in feedback]
    assert {progress.request_id for progress in feedback} == {"endless"}
    assert steps == list(range(steps[0], steps[0] + len(steps)))
    cancelled = client.answer(handle.cancel_goal_async(), "cancel response")
    assert len(cancelled.goals_canceling) == 1
    answer = client.answer(handle.get_result_async(), "result")
    assert (answer.status, answer.result.result.status) == (GoalStatus.STATUS_CANCELED, GraspArray.CANCELLED)


def result_for(request: GraspRequest) -> GraspArray:
    """What the peer answers: everything of the request that fits."""
    grasp = Grasp(id=f"{request.id}/0", hand=request.hand, grasp_pose=request.object_pose, score=request.time_budget)
    return GraspArray(header=request.header, request_id=request.id, grasps=[grasp])


def run_peer(domain: int) -> None:
    """The other process: sends arrays back, lists hands, carries out goals."""
    rclpy.init(domain_id=domain)
    node = rclpy.create_node("graspd_interfaces_peer")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    publisher = node.create_publisher(GraspArray, "there_and_back", 10)
    node.create_subscription(GraspArray, "there", publisher.publish, 10)

    def list_hands(_: ListHands.Request, response: ListHands.Response) -> ListHands.Response:
        response.names, response.current, response.base_link = ["left", "right"], "right", "palm"
        return response

    waiting: list[Future] = []
    ended = Future(executor=executor)

    def tick() -> None:
        while waiting:
            waiting.pop().set_result(None)
        if select.select([sys.stdin], [], [], 0)[0]:
            ended.set_result(None)

    async def execute(handle: Any) -> SynthesizeGrasps.Result:
        request = handle.request.request
        if request.id != "endless":
            handle.succeed()
            return SynthesizeGrasps.Result(result=result_for(request))
        for step in itertools.count():
            if handle.is_cancel_requested:
                break
            handle.publish_feedback(SynthesizeGrasps.Feedback(progress=GraspProgress(request_id="endless", step=step)))
            waiting.append(Future(executor=executor))
            await waiting[-1]
        handle.canceled()
        return SynthesizeGrasps.Result(result=GraspArray(status=GraspArray.CANCELLED))

    node.create_timer(0.02, tick)
    node.create_service(ListHands, "list_hands", list_hands)
    accept = lambda _: CancelResponse.ACCEPT  # noqa: E731
    server = ActionServer(node, SynthesizeGrasps, "synthesize", execute, cancel_callback=accept)
    executor.spin_until_future_complete(ended)
    server.destroy()
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    run_peer(int(sys.argv[1]))
