"""Client of soak.py. It sends requests like a robot, and records all answers and waiting times."""

from __future__ import annotations

import random
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from typing import Any

import rclpy
from geometry_msgs.msg import Point, Pose
from graspd_msgs.action import SynthesizeGrasps
from graspd_msgs.msg import GraspArray, GraspProgress, GraspRequest
from rcl_interfaces.srv import GetParameters
from rclpy.action.client import ActionClient, ClientGoalHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Trigger

TIMEOUT = 90.0  # longest wait for an answer [s]
PING_PERIOD = 0.05
STATUSES = ("succeeded", "partial", "failed", "cancelled", "superseded", "refused")
LONG = {"num_grasps": 64, "preset": "accurate"}
MALFORMED: tuple[dict[str, Any], ...] = (
    {"source": 77},
    {"source": GraspRequest.MESH, "mesh_uri": "../../etc/passwd"},
    {"source": GraspRequest.MESH, "mesh_uri": "sphere.obj", "time_budget": float("nan")},
    {"source": GraspRequest.MESH, "mesh_uri": "sphere.obj", "object_pose": Pose(position=Point(x=float("inf")))},
    {"source": GraspRequest.MESH, "mesh_uri": "sphere.obj", "preset": "x" * 100_000},
    {"source": GraspRequest.MESH, "mesh_uri": "sphere.obj", "hand": "none"},
    {"source": GraspRequest.CLOUD},
)


class Client:
    """ROS node that sends requests to graspd. Answers arrive only during `spin`."""

    def __init__(self, sample: Callable[[], None], period: float) -> None:
        """Create the node. `spin` calls `sample` every `period` seconds."""
        rclpy.init()
        self._sample, self._period, self._sampled = sample, period, 0.0
        self.node = rclpy.create_node("soak_client")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self.ready = False
        self.sent: dict[str, float] = {}
        self.answers: dict[str, list[GraspArray]] = defaultdict(list)
        self.stages: dict[str, list[str]] = defaultdict(list)
        self.waits: dict[str, list[float]] = defaultdict(list)
        self.timeouts = 0
        deep = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(String, "/graspd/status", self._on_status, 1000)
        self.node.create_subscription(GraspArray, "/graspd/grasps", self._on_answer, deep)
        self.node.create_subscription(GraspProgress, "/graspd/progress", self._on_progress, 1000)
        self._requests = self.node.create_publisher(GraspRequest, "/graspd/request", 1000)
        self._cancels = self.node.create_publisher(String, "/graspd/cancel", 1000)
        self._goals = ActionClient(self.node, SynthesizeGrasps, "/graspd/synthesize")
        self._parameters = self.node.create_client(GetParameters, "/graspd/get_parameters")
        self._triggers = {n: self.node.create_client(Trigger, f"/graspd/{n}") for n in ("add_view", "reset_views")}
        self._ping: Any = None
        self._pinged = 0.0

    def _on_status(self, message: String) -> None:
        self.ready = self.ready or '"ready"' in message.data

    def _on_answer(self, message: GraspArray) -> None:
        self.answers[message.request_id].append(message)

    def _on_progress(self, message: GraspProgress) -> None:
        self.stages[message.request_id].append(message.stage)

    def spin(self) -> None:
        """Process messages for up to 5 ms. Call a trivial service again and again, and record its waiting times."""
        self._executor.spin_once(timeout_sec=0.005)
        now = time.monotonic()
        if self.ready and now - self._sampled >= self._period:
            self._sampled = now
            self._sample()
        if self._ping is not None and self._ping.done():
            self.waits["trivial service"].append(now - self._pinged)
            self._ping = None
        if self.ready and self._ping is None and now - self._pinged >= PING_PERIOD:
            self._pinged, self._ping = now, self._parameters.call_async(GetParameters.Request(names=["seed"]))

    def wait(self, condition: Callable[[], Any], what: str) -> float:
        """Spin until the condition holds or `TIMEOUT` passes. Return the time waited [s]. Count timeouts."""
        begun = time.monotonic()
        while not condition():
            if time.monotonic() > begun + TIMEOUT:
                print(f"soak: waited {TIMEOUT:.0f} s for {what}", file=sys.stderr)
                self.timeouts += 1
                break
            self.spin()
        return time.monotonic() - begun

    def request(self, **fields: Any) -> str:
        """Send a request. Return its id."""
        name = f"soak-{len(self.sent)}"
        self.sent[name] = time.monotonic()
        self._requests.publish(GraspRequest(id=name, **fields))
        return name

    def answered(self, name: str) -> float:
        return self.wait(lambda: self.answers[name], "an answer")

    def settle(self) -> None:
        """Wait for an answer to every request. Then wait 1 s longer for duplicate answers."""
        self.wait(lambda: all(self.answers[name] for name in self.sent), "all answers")
        end = time.monotonic() + 1.0
        self.wait(lambda: time.monotonic() > end, "the end")

    def figures(self) -> dict[str, Any]:
        answers = [answer for name in self.sent for answer in self.answers[name]]
        return {
            "requests": len(self.sent),
            "lost": sum(not self.answers[name] for name in self.sent),
            "twice": sum(len(self.answers[name]) > 1 for name in self.sent),
            "timeouts": self.timeouts,
            "statuses": dict(Counter(STATUSES[answer.status] for answer in answers)),
            "codes": dict(Counter(answer.error_code for answer in answers if answer.error_code)),
            "waits": dict(self.waits),
        }

    # Each method below acts like a robot in one situation.

    def grasp_mesh(self, script: random.Random) -> None:
        """Request grasps of a mesh from an idle node."""
        mesh = {"source": GraspRequest.MESH, "mesh_uri": f"{script.choice(['sphere', 'mug', 'box'])}.obj"}
        name = self.request(**mesh, preset=script.choice(["fast", "balanced"]), seed=script.randrange(1000))
        self.waits["request to first progress"].append(self.wait(lambda: self.stages[name], "progress"))
        self.answered(name)

    def grasp_cloud(self, script: random.Random) -> None:
        """Request grasps of the object in the camera's latest cloud."""
        name = self.request(source=GraspRequest.LATEST_CLOUD, preset="fast", num_grasps=4)
        self.waits["request to first progress"].append(self.wait(lambda: self.stages[name], "progress"))
        self.answered(name)

    def grasp_views(self, script: random.Random) -> None:
        """Request grasps of an object seen in three views."""
        for service in ("add_view", "add_view", "add_view"):
            self.call(service)
        self.answered(self.request(source=GraspRequest.VIEWS, preset="fast", num_grasps=4))
        self.call("reset_views")

    def grasp_by_action(self, script: random.Random) -> None:
        """Send an action goal, and wait for its result."""
        name = f"soak-{len(self.sent)}"
        self.sent[name] = time.monotonic()
        request = GraspRequest(id=name, source=GraspRequest.MESH, mesh_uri="box.obj", preset="fast", num_grasps=4)
        sent = self._goals.send_goal_async(SynthesizeGrasps.Goal(request=request))
        self.wait(sent.done, "a goal to be accepted")
        handle: ClientGoalHandle | None = sent.result()
        if handle is None:
            return
        result = handle.get_result_async()
        self.wait(result.done, "a goal's result")
        self.answered(name)

    def change_of_mind(self, script: random.Random) -> None:
        """Send a request, and cancel it in a random stage."""
        stage = script.choice(["queued", "load", "optimise", "verify"])
        size = {"num_grasps": 16, "preset": "fast"} if stage == "verify" else {}
        mesh = {"source": GraspRequest.MESH, "mesh_uri": "mug.obj"}
        ahead = self.request(**mesh, **LONG) if stage == "queued" else ""
        name = self.request(**mesh, **size)
        self.wait(lambda: stage in self.stages[name] or self.answers[name], stage)
        if not self.answers[name]:
            self._cancels.publish(String(data=name))
            self.waits[f"cancel to answer, {stage}"].append(self.answered(name))
        if ahead:
            self._cancels.publish(String(data=ahead))
            self.answered(ahead)

    def impatience(self, script: random.Random) -> None:
        """Send a burst of 40 requests, and cancel all of them after 35 answers."""
        names = [self.request(source=GraspRequest.MESH, mesh_uri="mug.obj", **LONG) for _ in range(40)]
        self.wait(lambda: sum(bool(self.answers[name]) for name in names) >= 35, "35 refusals")
        self._cancels.publish(String(data=""))
        for name in names:
            self.answered(name)

    def nonsense(self, script: random.Random) -> None:
        """Send malformed requests."""
        for name in [self.request(**fields) for fields in MALFORMED]:
            self.answered(name)

    def call(self, service: str) -> None:
        future = self._triggers[service].call_async(Trigger.Request())
        self.wait(future.done, service)


SCENES = (
    Client.grasp_mesh,
    Client.grasp_cloud,
    Client.grasp_views,
    Client.grasp_by_action,
    Client.change_of_mind,
    Client.change_of_mind,
    Client.impatience,
    Client.nonsense,
)
