"""The node: three-line callbacks that hand requests to the worker, and the worker's reports as messages.

Every request that is not refused ends in exactly one terminal event on `~/status`: result, error, cancelled or
superseded. Callbacks run in the executor's thread, everything heavy in the worker's; rclpy publishes from both.
"""

from __future__ import annotations

import itertools
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import JointState, PointCloud2
from std_msgs.msg import String

from graspd_core.config import load_preset
from graspd_core.errors import GraspdError
from graspd_core.io import save_result
from graspd_core.pipeline import Scene, load_hand, load_scene, plan_grasps, scene_from_cloud, warm_up
from graspd_core.types import GraspResult, Progress, Stage
from graspd_ros import convert
from graspd_ros.mesh_path import resolve_mesh
from graspd_ros.parameters import Settings, declare_settings, read_settings
from graspd_ros.pointcloud import points_from_message
from graspd_ros.worker import BusyPolicy, Ending, Report, StopHook, Worker

SUPERSEDED_PERIOD = 1.0  # seconds between two counts of superseded clouds on ~/status


@dataclass(frozen=True)
class GraspRequest:
    """One object to grasp.

    Attributes:
        id: names the request in every event.
        source: mesh or cloud.
        frame: the frame id of the results: the input's own.
        stamp: when the object was as it was given.
        settings: the parameters at the time of the request.
        load: reads the object, for a distance grid of that many nodes a side; slow, may raise a GraspdError.
        only_newest: whether a newer request of this kind takes its place while it waits.
    """

    id: str
    source: str
    frame: str
    stamp: Time
    settings: Settings
    load: Callable[[int], Scene]
    only_newest: bool = False


@dataclass(frozen=True)
class Planned:
    """A run's result, and where it was written, if it was."""

    result: GraspResult
    file: str = ""


class GraspNode(Node):
    """Subscribes to objects, publishes grasps. `on_failure` is called when the node cannot serve at all.

    Raises:
        GraspdError: the hand or a parameter is unusable.
    """

    def __init__(self, on_failure: Callable[[], None]) -> None:
        super().__init__("graspd")
        settings = declare_settings(self)
        # Before the first work: on a busy machine, more threads than asked for make loading the hand take seconds.
        torch.set_num_threads(settings.torch_threads)
        # As many contact candidates as the command line loads, so that both find the same grasps.
        self._hand = load_hand(settings.hand, candidates=load_preset(settings.preset).closed_form.fine_candidates)
        self._on_failure = on_failure
        self._numbers = itertools.count(1)
        self._announcing = threading.Lock()
        self._superseded = 0
        self._superseded_told = 0.0
        self._closed = False
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._joint_states = self.create_publisher(JointState, "~/joint_states", latched)
        self._grasp_pose = self.create_publisher(PoseStamped, "~/grasp_pose", latched)
        self._status = self.create_publisher(String, "~/status", 50)
        self.create_subscription(String, "~/mesh", self._on_mesh, 10)
        self.create_subscription(String, "~/cancel", self._on_cancel, 10)
        self.create_subscription(
            PointCloud2,
            "points",
            self._on_points,
            qos_profile_sensor_data,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self._worker: Worker[GraspRequest, Planned] = Worker(
            work=self._work, finish=self._finish, prepare=self._prepare, queue_size=settings.queue_size
        )
        self._worker.start()

    def close(self, timeout: float) -> bool:
        """Cancel everything and publish no more; True when the worker ended within `timeout` seconds."""
        ended = self._worker.stop(timeout)
        self._closed = True
        return ended

    # Callbacks: short, in the executor's thread.

    def _on_mesh(self, message: String) -> None:
        settings, request_id = read_settings(self), f"mesh-{next(self._numbers)}"
        try:
            path = resolve_mesh(message.data, settings.mesh_roots)
        except GraspdError as error:
            self._tell_error(request_id, "mesh", error)
            return

        def load(resolution: int) -> Scene:
            mass, friction, scale = settings.mass, settings.friction, settings.mesh_scale
            return load_scene(str(path), mass=mass, friction=friction, scale=scale, resolution=resolution)

        stamp = self.get_clock().now().to_msg()
        self._submit(GraspRequest(request_id, "mesh", settings.mesh_frame, stamp, settings, load))

    def _on_points(self, message: PointCloud2) -> None:
        settings = read_settings(self)
        if settings.cloud_policy == "off":
            return

        def load(resolution: int) -> Scene:
            points = points_from_message(message)
            return scene_from_cloud(points, mass=settings.mass, friction=settings.friction, resolution=resolution)

        header, newest = message.header, settings.cloud_policy == "newest"
        request_id = f"cloud-{next(self._numbers)}"
        self._submit(GraspRequest(request_id, "cloud", header.frame_id, header.stamp, settings, load, newest))

    def _on_cancel(self, message: String) -> None:
        if not self._worker.cancel(message.data) and message.data:
            culprit = GraspdError(f"cancel: no request {message.data!r} is waiting or running")
            self._tell_error(message.data, "cancel", culprit)

    def _submit(self, request: GraspRequest) -> None:
        with self._announcing:  # the worker starts only once the answer is out
            admission = self._worker.submit(request, BusyPolicy(request.settings.busy_policy))
            if not admission.accepted:
                self._tell("refused", request.id, request.source, message=admission.reason)
            elif not request.only_newest:
                self._tell("accepted", request.id, request.source, ahead=admission.ahead)

    # The worker's side.

    def _prepare(self) -> None:
        torch.set_num_threads(read_settings(self).torch_threads)
        try:
            warm_up(self._hand, stop=self._worker.stopping)
        except Exception as error:  # without this the node would stand there deaf
            self._tell_error("", "node", error)
            self._on_failure()
            return
        if self._worker.stopping():
            return
        self._tell("ready", "", "node", hand=self._hand.name, base_link=self._hand.base_link)
        self.get_logger().info(f"ready: {self._hand.name} waits for objects")

    def _work(self, request: GraspRequest, stop: StopHook) -> Planned:
        with self._announcing:
            pass
        if request.only_newest:
            self._tell_superseded(request.id)
            self._tell("accepted", request.id, request.source, ahead=0)
        begun = time.monotonic()
        settings, tell_progress = request.settings, self._progress_hook(request, begun)
        tell_progress(Progress(Stage.LOAD, 0, 1, 0.0, 0, 0.0))
        config = load_preset(settings.preset)
        scene = request.load(config.resolution)
        result = plan_grasps(
            scene,
            self._hand,
            count=settings.num_grasps,
            seed=settings.seed,
            preset=config,
            verify=settings.verify,
            deadline=max(settings.deadline - (time.monotonic() - begun), 1e-3),
            device=settings.device,
            progress=tell_progress,
            stop=stop,
        )
        if not settings.output_dir:
            return Planned(result)
        path = Path(settings.output_dir) / f"{request.id}.json"
        save_result(path, result, scene.object, self._hand, config)
        return Planned(result, str(path))

    def _progress_hook(self, request: GraspRequest, begun: float) -> Callable[[Progress], None]:
        period, last = 1.0 / request.settings.progress_rate, -float("inf")

        def tell(progress: Progress) -> None:
            nonlocal last
            now = time.monotonic()
            if now - last >= period:
                last = now
                event = {**convert.progress_event(progress), "elapsed": now - begun}
                self._tell("progress", request.id, request.source, **event)

        return tell

    def _finish(self, request: GraspRequest, report: Report[Planned]) -> None:
        if report.value is not None:
            self._publish_result(request, report.value)
        elif report.error is not None:
            self._tell_error(request.id, request.source, report.error)
        elif report.ending is Ending.SUPERSEDED and request.only_newest:
            self._superseded += 1
            if time.monotonic() - self._superseded_told >= SUPERSEDED_PERIOD:
                self._tell_superseded(request.id)
        else:
            self._tell(report.ending.value, request.id, request.source)

    def _publish_result(self, request: GraspRequest, planned: Planned) -> None:
        best = convert.presentable(planned.result)
        if best is not None and not self._closed:
            base_link, stamp = self._hand.base_link, request.stamp
            self._joint_states.publish(convert.joint_message(best, self._hand.joint_names, base_link, stamp))
            self._grasp_pose.publish(convert.pose_message(best, request.frame, stamp))
        event = convert.result_event(planned.result)
        self._tell("result", request.id, request.source, frame=request.frame, file=planned.file, **event)
        self.get_logger().info(f"{request.id}: {event['verified']} of {event['grasps']} verified: {event['message']}")

    # Events.

    def _tell(self, event: str, request_id: str, source: str, **details: Any) -> None:
        if self._closed:
            return
        stamp = self.get_clock().now().nanoseconds * 1e-9
        line = {"event": event, "request": request_id, "source": source, "stamp": stamp, **details}
        self._status.publish(String(data=convert.status_line(line)))

    def _tell_superseded(self, request_id: str) -> None:
        """How many clouds gave way to newer ones since this was last told; at most one a second and one a request."""
        count, self._superseded = self._superseded, 0
        if count:
            self._superseded_told = time.monotonic()
            self._tell("superseded", request_id, "cloud", count=count)

    def _tell_error(self, request_id: str, source: str, error: Exception) -> None:
        expected = isinstance(error, GraspdError | OSError)
        message = str(error) if expected else f"internal error: {type(error).__name__}: {error}"
        self._tell("error", request_id, source, kind=type(error).__name__, message=message)
        detail = "" if expected else "\n" + "".join(traceback.format_exception(error))
        self.get_logger().error(f"{request_id or source}: {message}{detail}")
