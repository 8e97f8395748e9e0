"""The ROS node. It passes requests to the worker and publishes the worker's reports as messages.

Every request ends in exactly one GraspArray on `~/grasps` and one terminal event on `~/status`. An action goal also
gets one result. Callbacks run in the executor's thread. Heavy work runs in the worker's thread. Both threads publish.
"""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from graspd_msgs.action import SynthesizeGrasps
from graspd_msgs.msg import Grasp, GraspArray, GraspProgress, GraspRequest
from graspd_msgs.srv import ListHands
from rclpy.action.server import ActionServer, CancelResponse, RCLError, ServerGoalHandle
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_msgs.msg import String
from std_srvs.srv import Trigger

from graspd_core import hand_names, load_hand, warm_up
from graspd_core.errors import ConfigError, GraspdError
from graspd_core.hands.model import all_joint_names
from graspd_core.runtime.worker_process import trim_heap
from graspd_core.transforms import TransformBuffer
from graspd_ros.convert import nanoseconds
from graspd_ros.error_codes import ErrorCode, code_of, sentence_of
from graspd_ros.inputs.request_builder import SOURCES, RequestBuilder
from graspd_ros.inputs.sensor_frames import DepthMessage, ImagePairs, SensorFrame, cloud_frame, depth_sensor_frame
from graspd_ros.inputs.sensor_topics import SensorTopic
from graspd_ros.inputs.solids import SceneObject, updated_objects
from graspd_ros.inputs.tf_listener import TransformListener, check_arm, heard_robot
from graspd_ros.outputs.responses import RECEIVED, Responses, health_message, resident_memory
from graspd_ros.parameters import LiveSettings, Settings
from graspd_ros.request import Listener, Request
from graspd_ros.request_planner import PATIENCE, Planned, Planner, overdue
from graspd_ros.worker import BusyPolicy, StopHook, Worker

GOAL_PATIENCE = 0.3  # longest wait at shutdown until the executor has ended all goals [s]
RESULT_PATIENCE = 0.05  # wait after GOAL_PATIENCE, in which the last result is sent [s]
IMAGES = "depth images"  # key in `missing` for images without a matching CameraInfo. Other keys are topic names
OVERDUE_PERIOD = 0.25  # seconds between two checks for waiting requests whose deadline passed
# A subscriber's queue keeps only the newest messages. A burst of requests must fit, or some requests get no answer.
REQUEST_DEPTH = 500
THINGS_DEPTH = 500  # queue of collision objects. A planning scene arrives in one burst
RESULT_TIMEOUT = 60  # seconds for which clients can fetch a result. rclpy's default of 900 s needs much memory


class GraspNode(Node):
    """ROS node that receives objects and answers with grasps.

    The node calls `on_failure` if it cannot get ready. Raises GraspdError if the hand or a parameter is unusable.
    """

    def __init__(self, on_failure: Callable[[], None]) -> None:
        super().__init__("graspd")
        transforms = TransformBuffer()
        self._settings = LiveSettings(self, transforms.frames)
        settings = self._settings.now
        # Set the threads before the hand is loaded. With more threads, loading takes seconds on a busy machine.
        torch.set_num_threads(settings.torch_threads)
        self._hand = load_hand(settings.hand, prefix=settings.hand_prefix)
        self._on_failure = on_failure
        self._ready = False
        self._announcing = threading.Lock()
        self._listener = TransformListener(self, transforms)
        self._pairs = ImagePairs()
        self._collision_objects: Mapping[str, SceneObject] = {}
        self._request_builder = RequestBuilder(
            self._hand.name,
            self._now,
            self._listener.lookup,
            lambda target, source, at: self._listener.lookup_in_time(target, source, at, self._worker.stopping),
        )
        self._responses = Responses(self, self._hand)
        robot = heard_robot(self, settings.arm)
        self.add_on_set_parameters_callback(lambda changed: check_arm(changed, robot))
        self._planner = Planner(self._hand, self._listener.lookup_in_time, robot)
        self._worker: Worker[Request, Planned] = Worker(
            work=self._work, finish=self._responses.finished, prepare=self._prepare, queue_size=settings.queue_size
        )
        self._create_inlets(settings.collision_objects)
        self._goals = self._create_actions()
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # diagnostics go on when simulated time stops
        self.create_timer(1.0, self._on_diagnostics_due, clock=steady)
        self.create_timer(1.0, self._watch_sensors, clock=steady)
        late = lambda request: request.time_left() <= 0  # noqa: E731
        self.create_timer(OVERDUE_PERIOD, lambda: self._worker.end_waiting(late, overdue()), clock=steady)
        self._worker.start()

    def _create_inlets(self, collision_objects: str) -> None:
        def listen(kind: type, topic: str, callback: Callable, qos: QoSProfile | int) -> None:
            options = QoSOverridingOptions.with_default_policies()
            self.create_subscription(kind, topic, callback, qos, qos_overriding_options=options)

        listen(GraspRequest, "~/request", lambda message: self._take_request(message, "request"), REQUEST_DEPTH)
        listen(String, "~/mesh", self._on_mesh, 10)
        listen(String, "~/cancel", self._on_cancel, REQUEST_DEPTH)
        image = SensorTopic(self, Image, "depth/image_rect", self._on_depth)
        name, ending = "depth/image_rect/compressedDepth", "/compressedDepth"
        self._sensors = (
            SensorTopic(self, PointCloud2, "points", self._on_points),
            image,
            SensorTopic(self, CameraInfo, "depth/camera_info", self._on_depth),
            SensorTopic(self, CompressedImage, name, self._on_depth, instead_of=image, ending=ending),
        )
        if collision_objects:
            listen(_collision_object(), collision_objects, self._on_collision_object, THINGS_DEPTH)
        self.create_service(ListHands, "~/list_hands", self._on_list_hands)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/add_view", self._on_add_view)
        self.create_service(Trigger, "~/reset_views", self._on_reset_views)

    def _create_actions(self) -> list[GoalServer]:
        take, cancel = self._on_goal, self._worker.cancel
        servers = [GoalServer(self, SynthesizeGrasps, "~/synthesize", SynthesizeMessages, take, cancel)]
        try:
            from grasping_msgs.action import GraspPlanning

            from graspd_ros.grasp_planning import PlanningMessages
        except ImportError:
            self.get_logger().info("grasping_msgs or moveit_msgs is not installed: there is no ~/grasp_planning")
            return servers
        make, submit = lambda: PlanningMessages(self._hand), self._on_planning_goal
        return [*servers, GoalServer(self, GraspPlanning, "~/grasp_planning", make, submit, cancel)]

    def close(self, timeout: float) -> bool:
        """Cancel all requests and stop publishing. Return True if worker and planner ended in time.

        The caller must still spin the executor, which sends the results of the action goals.
        """
        ended = self._worker.stop(timeout) and self._planner.rest(PATIENCE)
        end = time.monotonic() + GOAL_PATIENCE
        while not all(server.idle() for server in self._goals) and time.monotonic() < end:
            time.sleep(0.01)
        time.sleep(RESULT_PATIENCE)
        self._responses.publishers.close()
        return ended

    # Callbacks. They run in the executor's thread, so they must be short.

    def _on_mesh(self, message: String) -> None:
        name, builder = self._request_builder.new_id("mesh"), self._request_builder
        self._take("mesh", name, lambda settings: builder.from_mesh(name, settings, message.data))

    def _on_goal(self, goal: SynthesizeGrasps.Goal, listener: Goal) -> str:
        return self._take_request(goal.request, "goal", listener)

    def _on_planning_goal(self, goal: Any, listener: Goal) -> str:
        from graspd_ros.grasp_planning import request_from_goal

        name, builder = self._request_builder.new_id("planning"), self._request_builder

        def make(settings: Settings) -> Request:
            return listener.messages.watching(request_from_goal(builder, name, settings, goal), goal)

        self._take("grasp_planning", name, make, listener)
        return name

    def _on_points(self, message: PointCloud2) -> None:
        self._on_sensor(lambda now: cloud_frame(message, now))

    def _on_depth(self, message: DepthMessage | CameraInfo) -> None:
        def paired(now: int) -> SensorFrame | None:
            pair = self._pairs.add(message)
            return None if pair is None else depth_sensor_frame(*pair, now)

        self._on_sensor(paired)

    def _on_collision_object(self, message: Any) -> None:
        try:
            self._collision_objects = updated_objects(self._collision_objects, message)
        except Exception as error:  # no message may stop the executor
            self._responses.refused("", "collision_objects", code_of(error), sentence_of(error))

    def _on_cancel(self, message: String) -> None:
        if not self._worker.cancel(message.data) and message.data:
            self._responses.nothing_to_cancel(message.data)

    def _on_list_hands(self, _: ListHands.Request, response: ListHands.Response) -> ListHands.Response:
        response.names, response.current = list(hand_names()), self._hand.name
        response.joint_names, response.base_link = list(all_joint_names(self._hand)), self._hand.base_link
        return response

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        cancelled, views = self._worker.cancel(""), self._request_builder.drop_views()
        self._request_builder.newest = None
        self._pairs.forget()
        self._responses.forget()
        response.success, response.message = True, f"cancelled {cancelled} requests, dropped {views} views"
        return response

    def _on_add_view(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            self._request_builder.add_view(self._settings.now)
            views = self._request_builder.views
            response.success, response.message = True, f"{len(views.clouds)} views in {views.frame!r}"
        except Exception as error:  # no cloud may stop the executor
            response.success, response.message = False, sentence_of(error)
        return response

    def _on_reset_views(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = True, f"dropped {self._request_builder.drop_views()} views"
        return response

    def _watch_sensors(self) -> None:
        """Log once why a sensor topic is silent. Store the reasons for error messages of `RequestBuilder.latest`."""
        before = self._request_builder.missing
        missing = {sensor.name: reason for sensor in self._sensors if (reason := sensor.check())}
        for name in missing.keys() - before.keys():  # only a warning, because some cameras publish only on demand
            self.get_logger().warning(missing[name])
        if reason := self._pairs.unpaired():
            missing[IMAGES] = reason
            if IMAGES not in before:
                self._responses.refused("", "sensors", ErrorCode.NO_CLOUD, reason)
        self._request_builder.missing = missing

    def _on_diagnostics_due(self) -> None:
        running, waiting = self._worker.state()
        health = self._responses.counters.health(
            name=self.get_fully_qualified_name(),
            hand=self._hand.name,
            ready=self._ready,
            worker_alive=self._worker.alive(),
            running=running or "",
            waiting=waiting,
            queue_size=self._worker.queue_size,
            transforms=self._listener.available,
        )
        self._diagnostics.publish(health_message(health, self._now(), resident_memory()))

    # Make requests from messages and submit them to the worker.

    def _take_request(self, message: GraspRequest, kind: str, listener: Listener | None = None) -> str:
        name, builder = message.id or self._request_builder.new_id(kind), self._request_builder
        source = SOURCES[message.source].name if message.source in SOURCES else "request"
        self._take(source, name, lambda settings: builder.from_message(name, settings, message), listener)
        return name

    def _take(
        self, source: str, request_id: str, make: Callable[[Settings], Request], listener: Listener | None = None
    ) -> None:
        try:
            request = make(self._settings.now)
        except Exception as error:  # no request may stop the executor
            self._responses.not_made(request_id, source, error, listener)
        else:
            self._submit(replace(request, listener=listener))

    def _on_sensor(self, read: Callable[[int], SensorFrame | None]) -> None:
        try:
            sensor_frame = read(nanoseconds(self._now()))
            if sensor_frame is not None:
                self._see(sensor_frame)
        except GraspdError as error:
            self._responses.cloud_not_taken(self._request_builder.new_id("cloud"), error)

    def _see(self, sensor_frame: SensorFrame) -> None:
        self._responses.counters.count(RECEIVED)
        builder, settings = self._request_builder, self._settings.now
        builder.newest = sensor_frame
        if settings.cloud_policy != "off":
            self._submit(builder.from_sensor_frame(builder.new_id("cloud"), settings, sensor_frame))

    def _submit(self, request: Request) -> None:
        if self._collision_objects:
            request = replace(request, collision_objects=self._collision_objects)
        with self._announcing:  # the worker waits until the admission is published
            admission = self._worker.submit(request, BusyPolicy(request.settings.busy_policy))
            self._responses.admitted(request, admission)

    def _now(self) -> Time:
        return self.get_clock().now().to_msg()

    # Methods that run in the worker's thread.

    def _prepare(self) -> None:
        torch.set_num_threads(self._settings.now.torch_threads)
        try:
            warm_up(self._hand, stop=self._worker.stopping)
            settings = self._settings.now
            if settings.publish_markers:
                self._responses.drawn(settings)
            if settings.grasp_library:
                from graspd_ros.known_objects import warm_up_library

                warm_up_library(settings, self._hand)
        except BaseException as error:  # an uncaught error would leave a node without a worker
            self._responses.report_error("", "node", error)
            self._on_failure()
            return
        if self._worker.stopping():
            return
        # The existing objects stay alive. Without this, each garbage collection would take 0.2 s to scan them.
        gc.collect()
        gc.freeze()
        # The first log call takes 0.1 s, because rclpy searches all modules for the caller.
        self.get_logger().info(f"ready: {self._hand.name} waits for objects")
        self._ready = True
        self._responses.publishers.emit("ready", "", "node", hand=self._hand.name, base_link=self._hand.base_link)

    def _work(self, request: Request, stop: StopHook) -> Planned:
        with self._announcing:
            self._responses.started(request)
        try:
            return self._planner.plan(request, stop, self._responses.progress_hook(request))
        finally:
            trim_heap()


def _collision_object() -> type:
    try:
        from moveit_msgs.msg import CollisionObject
    except ImportError:
        text = "parameter collision_objects: moveit_msgs/CollisionObject is not installed; install it (docs/moveit.md)"
        raise ConfigError(f"{text} or leave the parameter empty") from None
    return CollisionObject


class SynthesizeMessages:
    """Converts the node's messages to the feedback and the result of a `~/synthesize` goal."""

    def progressed(self, message: GraspProgress) -> SynthesizeGrasps.Feedback:
        return SynthesizeGrasps.Feedback(progress=message)

    def found(self, message: Grasp) -> None:
        """Return no feedback, because the result holds all grasps."""

    def result(self, message: GraspArray) -> SynthesizeGrasps.Result:
        return SynthesizeGrasps.Result(result=message)

    def succeeded(self, result: SynthesizeGrasps.Result) -> bool:
        """Return True, so that the answer's status alone decides whether the goal succeeds."""
        return True


class GoalServer:
    """Action server that submits its goals as requests.

    An invalid goal is accepted and aborted at once, so that the client gets the reason. No method blocks. The worker
    decides when a goal starts and ends. The executor's thread informs the client.

    Args:
        make_messages: makes the message converter of a new goal, for example `SynthesizeMessages`.
        submit: submits a goal's request with its listener and returns the request's id.
        cancel: cancels the request with a given id. Returns the number of cancelled requests.
    """

    def __init__(
        self,
        node: Node,
        action: Any,
        name: str,
        make_messages: Callable[[], Any],
        submit: Callable[[Any, Goal], str],
        cancel: Callable[[str], int],
    ) -> None:
        self._node = node
        self._make_messages = make_messages
        self._submit = submit
        self._cancel = cancel
        self._ids: dict[bytes, str] = {}
        deep = QoSProfile(depth=REQUEST_DEPTH)
        self._server = ActionServer(
            node,
            action,
            name,
            execute_callback=_no_execution,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel,
            goal_service_qos_profile=deep,
            result_service_qos_profile=deep,
            cancel_service_qos_profile=deep,
            result_timeout=RESULT_TIMEOUT,
        )

    def _on_accepted(self, handle: ServerGoalHandle) -> None:
        key = bytes(handle.goal_id.uuid)
        goal = Goal(self._node, handle, self._make_messages(), on_end=lambda: self._ids.pop(key, None))
        self._ids[key] = ""
        self._ids[key] = self._submit(handle.request, goal)

    def idle(self) -> bool:
        return not self._ids

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        request_id = self._ids.get(bytes(handle.goal_id.uuid))
        return CancelResponse.ACCEPT if request_id and self._cancel(request_id) else CancelResponse.REJECT


class Goal:
    """Listener of one request that sends feedback and result to the action client."""

    def __init__(self, node: Node, handle: ServerGoalHandle, messages: Any, on_end: Callable[[], object]) -> None:
        self._node = node
        self.messages = messages
        self._handle = handle
        self._on_end = on_end
        self._answer = Future()
        self._begun = False

    def progressed(self, message: GraspProgress) -> None:
        """Send feedback. The first message whose stage is not `queued` sets the goal to executing."""
        if message.stage != "queued":
            self._begin()
        self._feed(self.messages.progressed(message))

    def found(self, message: Grasp) -> None:
        """Send a grasp as feedback if the action has feedback for grasps."""
        self._begin()
        self._feed(self.messages.found(message))

    def _feed(self, feedback: Any | None) -> None:
        if feedback is not None:
            self._handle.publish_feedback(feedback)

    def ended(self, message: GraspArray) -> None:
        """End the goal and send its result."""
        self._begin()
        self._answer.set_result(message)
        if self._node.executor is not None:
            self._node.executor.wake()  # the executor checks the future only after an event

    def _begin(self) -> None:
        if not self._begun:
            self._begun = True
            try:
                self._handle.execute(self._conclude)
            except RCLError:  # the client cancelled during this call. A second call notices the cancellation
                self._handle.execute(self._conclude)

    async def _conclude(self, handle: ServerGoalHandle) -> Any:
        message: GraspArray = await self._answer  # pyright: ignore[reportAssignmentType]
        try:
            result = self.messages.result(message)
            if message.status in (GraspArray.SUCCEEDED, GraspArray.PARTIAL) and self.messages.succeeded(result):
                handle.succeed()
            elif message.status == GraspArray.CANCELLED and handle.is_cancel_requested:
                handle.canceled()  # rcl allows this only if the client cancelled. ~/cancel and ~/reset abort the goal
            else:
                handle.abort()
            return result
        finally:
            self._on_end()


def _no_execution(handle: ServerGoalHandle) -> Any:
    raise RuntimeError("a goal was executed without its own callback")
