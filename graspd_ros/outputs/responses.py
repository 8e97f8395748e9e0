"""Outcomes of requests as messages: one GraspArray per request, and events for clients without graspd_msgs.

A newer cloud may replace a waiting cloud that came without a request. The old cloud is counted, but gets no answer.
The node reports its health on /diagnostics, with counts since its start or the last ~/reset.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import threading
import time
import traceback
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from graspd_msgs.msg import Grasp as GraspMessage
from graspd_msgs.msg import GraspArray, GraspProgress
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Header, String
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from graspd_core import HandModel
from graspd_core.errors import GraspdError
from graspd_core.hands.model import Primitive
from graspd_core.io.grasps_json import grasp_figures
from graspd_core.types import Grasp, GraspResult, Progress, ProgressHook, Stage, Verdict
from graspd_ros.convert import pose_of_posture
from graspd_ros.error_codes import ErrorCode, code_of, sentence_of
from graspd_ros.outputs import messages
from graspd_ros.outputs.messages import result_markers
from graspd_ros.outputs.moveit import attached_kind, attached_object
from graspd_ros.parameters import Settings
from graspd_ros.request import MOST_ID, Listener, Request
from graspd_ros.request_planner import Planned
from graspd_ros.worker import Admission, Report, WorkerEnding

_ENDS = {
    GraspArray.SUCCEEDED: "requests succeeded",
    GraspArray.PARTIAL: "requests partial",
    GraspArray.FAILED: "requests failed",
    GraspArray.CANCELLED: "requests cancelled",
    GraspArray.SUPERSEDED: "requests superseded",
    GraspArray.REFUSED: "requests refused",
}
# Keys of the counts in /diagnostics.
ACCEPTED, RECEIVED, SUPERSEDED = "requests accepted", "clouds received", "clouds superseded"
VERIFIED, FAILED = "grasps verified", "grasps failed"
COUNT_PERIOD = 1.0  # seconds between two reports of superseded clouds, or of unusable clouds
_NEWER = "a newer request took its place"
_ENDINGS = {
    WorkerEnding.CANCELLED: messages.AnswerEnding(GraspArray.CANCELLED, ErrorCode.CANCELLED, "cancelled"),
    WorkerEnding.SUPERSEDED: messages.AnswerEnding(GraspArray.SUPERSEDED, ErrorCode.SUPERSEDED, _NEWER),
}

# Latched topics that ~/reset clears.
SHOWN = {
    JointState: "~/joint_states",
    PoseStamped: "~/grasp_pose",
    JointTrajectory: "~/trajectory",
    MarkerArray: "~/markers",
}


@dataclass(frozen=True)
class Health:
    """State of the node.

    Attributes:
        running: id of the running request. Empty when idle.
        waiting: number of waiting requests, at most `queue_size`.
        counts: counts since the start or the last ~/reset, by their keys in /diagnostics.
        last_latency: time from the arrival of the last planned request to its answer [s]. None before the first answer.
        last_first_verified: planning time of the same request until its first verified grasp [s]. None without one.
    """

    name: str
    hand: str
    ready: bool
    worker_alive: bool
    running: str = ""
    waiting: int = 0
    queue_size: int = 0
    transforms: bool = False
    counts: Mapping[str, int] = field(default_factory=dict)
    failed_in_a_row: int = 0
    last_latency: float | None = None
    last_first_verified: float | None = None
    last_error: str = ""


class Counters:
    """Thread-safe store of counts by name, the times of the last planned request, and the last error."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._last: dict[str, Any] = {}

    def count(self, key: str) -> None:
        with self._lock:
            self._counts[key] += 1

    def answered(self, message: GraspArray) -> None:
        """Count an answered request and its grasps."""
        with self._lock:
            self._counts[_ENDS[message.status]] += 1
            self._counts[VERIFIED] += sum(grasp.verdict == GraspMessage.VERIFIED for grasp in message.grasps)
            self._counts[FAILED] += sum(grasp.verdict == GraspMessage.FAILED for grasp in message.grasps)
            if message.status == GraspArray.FAILED:
                self._last["failed_in_a_row"] = self._last.get("failed_in_a_row", 0) + 1
                self._last["last_error"] = message.message
            elif message.status in (GraspArray.SUCCEEDED, GraspArray.PARTIAL):
                self._last["failed_in_a_row"] = 0

    def planned(self, result: GraspResult, latency: float) -> None:
        """Store the times of a run that ended `latency` seconds after its request arrived."""
        with self._lock:
            self._last |= {"last_latency": latency, "last_first_verified": result.timing.first_verified}

    def clear(self) -> None:
        with self._lock:
            self._counts.clear()
            self._last.clear()

    def health(self, **state: Any) -> Health:
        with self._lock:
            return Health(**state, counts=dict(self._counts), **self._last)


def health_message(health: Health, stamp: Time, memory: int) -> DiagnosticArray:
    """Return the node's diagnostic status: a level for alarms, a message for people, and values for plots.

    `memory` is the resident memory of the process and its children [bytes].
    """
    level, message = _verdict(health)
    status = DiagnosticStatus(
        level=level,
        name=f"{health.name.lstrip('/')}: grasp synthesis",
        message=message,
        hardware_id=health.hand,
        values=[KeyValue(key=key, value=value) for key, value in _values(health, memory).items()],
    )
    return DiagnosticArray(header=Header(stamp=stamp), status=[status])


def resident_memory(pid: int | None = None) -> int:
    """Return the resident memory of a process (None for this one) and its children [bytes]. 0 if unknown.

    Memory that several processes share is counted for each process.
    """
    process = Path("/proc", str(pid or os.getpid()))
    try:
        pages = int((process / "statm").read_text().split()[1])
        tasks = list((process / "task").iterdir())
    except OSError:
        return 0
    children = [int(child) for task in tasks for child in _words(task / "children")]
    return pages * os.sysconf("SC_PAGE_SIZE") + sum(map(resident_memory, children))


def _words(file: Path) -> list[str]:
    try:
        return file.read_text().split()
    except OSError:  # the thread has ended meanwhile
        return []


def _verdict(health: Health) -> tuple[bytes, str]:
    """Return the diagnostic level and message of the worst problem, or OK and what the node does."""
    if not health.worker_alive:
        return DiagnosticStatus.ERROR, "the worker has ended; restart the node"
    if not health.ready:
        return DiagnosticStatus.WARN, "warming up"
    if health.failed_in_a_row:
        times = "the last request" if health.failed_in_a_row == 1 else f"the last {health.failed_in_a_row} requests"
        return DiagnosticStatus.WARN, f"{times} failed: {health.last_error or 'no reason given'}"
    if health.queue_size and health.waiting >= health.queue_size:
        return DiagnosticStatus.WARN, f"the queue is full: {health.waiting} wait"
    return DiagnosticStatus.OK, f"works on {health.running}" if health.running else "waits for requests"


def _values(health: Health, memory: int) -> dict[str, str]:
    state = "ended" if not health.worker_alive else "warming up" if not health.ready else "idle"

    def counted(*keys: str) -> dict[str, str]:
        return {key: str(health.counts.get(key, 0)) for key in keys}

    return {
        "worker": "busy" if state == "idle" and health.running else state,
        "current request": health.running,
        "queue length": str(health.waiting),
        "queue size": str(health.queue_size),
        "last latency [s]": _seconds(health.last_latency),
        "last first verified [s]": _seconds(health.last_first_verified),
        **counted(ACCEPTED, *_ENDS.values(), VERIFIED, FAILED),
        "last error": health.last_error,
        **counted(RECEIVED, SUPERSEDED),
        "transforms heard": "yes" if health.transforms else "no: tf2_msgs is not installed",
        "memory [MB]": f"{memory / 1e6:.0f}" if memory else "",
    }


def _seconds(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


class Publishers:
    """Set of publishers, one per message type."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._lock = threading.Lock()
        self._closed = False
        # Latched, so that late subscribers still receive `ready`.
        status = QoSProfile(depth=50, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publishers: dict[type, Any] = {
            String: node.create_publisher(String, "~/status", status),
            GraspProgress: node.create_publisher(GraspProgress, "~/progress", 50),
        }
        self.attached = attached_kind()
        self._shown = {**SHOWN, **({self.attached: "~/attached_object"} if self.attached else {})}
        latched = {GraspArray: "~/grasps", **self._shown}
        self._publishers |= {kind: self._latched(kind, topic) for kind, topic in latched.items()}

    def _latched(self, kind: type, topic: str) -> Any:
        return self._node.create_publisher(
            kind,
            topic,
            QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def publish(self, message: Any) -> None:
        """Publish on the topic of the message's type. Do nothing after `close`."""
        with self._lock:
            if not self._closed:
                self._publishers[type(message)].publish(message)

    def emit(self, event: str, request_id: str, source: str, **details: Any) -> None:
        """Publish one event on ~/status, with `details` as further fields."""
        stamp = self._node.get_clock().now().nanoseconds * 1e-9
        line = {"event": event, "request": request_id, "source": source, "stamp": stamp, **details}
        self.publish(String(data=status_line(line)))

    def forget(self) -> None:
        """Recreate all latched publishers except ~/grasps and ~/status. Late subscribers then get no old messages.

        ~/grasps keeps its publisher, because subscribers need a moment to find a new one and would miss answers.
        """
        with self._lock:
            for kind, topic in self._shown.items():
                self._node.destroy_publisher(self._publishers[kind])
                self._publishers[kind] = self._latched(kind, topic)

    def close(self) -> None:
        with self._lock:
            self._closed = True


class Responses:
    """Reporter of request outcomes. It publishes through `publishers` and counts in `counters`."""

    def __init__(self, node: Node, hand: HandModel) -> None:
        self.publishers = Publishers(node)
        self.counters = Counters()
        self._node = node
        self._hand = hand
        self._visuals: Sequence[Primitive] | None = None
        self._superseded = 0
        self._superseded_reported = self._complained = -float("inf")

    def forget(self) -> None:
        """Reset counters and latched topics. Late subscribers still get the last answer and the events on ~/status."""
        self.publishers.publish(result_markers((), self._hand, "", self._now()))
        self.publishers.forget()
        self.counters.clear()

    def admitted(self, request: Request, admission: Admission) -> None:
        if admission.refusal is not None:
            code, message = admission.refusal, admission.reason
            self.refused(request.id, request.source, code, message)
            ending = messages.AnswerEnding(GraspArray.REFUSED, code, message)
            self._publish(self._answer(request, ending), request.listener)
        elif not request.only_newest:
            self._accepted(request, admission.ahead)

    def not_made(self, request_id: str, source: str, error: Exception, listener: Listener | None = None) -> None:
        """Answer an invalid request message with status REFUSED."""
        code, message = code_of(error), sentence_of(error)
        if code is ErrorCode.INTERNAL:
            self.report_error(request_id[:MOST_ID], source, error)
        else:
            self.refused(request_id[:MOST_ID], source, code, message)
        ending = messages.AnswerEnding(GraspArray.REFUSED, code, message)
        header = Header(stamp=self._now())
        answer = messages.array_message(ending, request_id[:MOST_ID], header, 0.0, self._hand, Settings())
        self._publish(answer, listener)

    def cloud_not_taken(self, request_id: str, error: Exception) -> None:
        """Report an unusable cloud that came without a request, at most once a second."""
        if time.monotonic() - self._complained >= COUNT_PERIOD:
            self._complained = time.monotonic()
            self.not_made(request_id, "cloud", error)

    def refused(self, request_id: str, source: str, code: ErrorCode, message: str) -> None:
        """Report on `~/status` and in the log why a message is not used. Without a request, `request_id` is ""."""
        self.publishers.emit("refused", request_id, source, code=code, message=message)
        self._log().warning(f"{request_id or source}: refused: {message}")

    def _accepted(self, request: Request, ahead: int) -> None:
        self.counters.count(ACCEPTED)
        self.publishers.emit("accepted", request.id, request.source, ahead=ahead)
        if ahead:
            header, message = Header(frame_id=request.frame_out, stamp=self._now()), f"queued: {ahead} ahead"
            self._report(request, GraspProgress(header=header, request_id=request.id, stage="queued", message=message))

    def started(self, request: Request) -> None:
        """Report an `only_newest` request as accepted when it starts. Other requests are reported on submission."""
        if request.only_newest:
            self._report_superseded(request.id)
            self._accepted(request, 0)

    def progress_hook(self, request: Request) -> ProgressHook:
        """Return a hook that publishes progress at up to `progress_rate` [Hz], and gives each grasp to the listener."""
        lowest, last, period = math.inf, -math.inf, 1 / request.settings.progress_rate

        def hook(progress: Progress) -> None:
            nonlocal lowest, last
            if progress.found is not None and request.listener is not None:
                rank, header = progress.verified - 1, Header(frame_id=request.frame_out, stamp=request.stamp)
                found = messages.grasp_message(progress.found, rank, request.id, header, self._hand, request.settings)
                request.listener.found(found)
            if (now := time.monotonic()) - last < period:
                return
            last, elapsed = now, request.elapsed()
            if progress.stage is Stage.OPTIMISE and progress.step:
                lowest = min(lowest, progress.best)
            progress = dataclasses.replace(progress, best=lowest if math.isfinite(lowest) else 0.0)
            event = {**progress_event(progress), "elapsed": elapsed}
            self.publishers.emit("progress", request.id, request.source, **event)
            message = messages.progress_message(progress, request.id, request.frame_out, self._now(), elapsed)
            self._report(request, message)

        return hook

    def _report(self, request: Request, message: GraspProgress) -> None:
        self.publishers.publish(message)
        if request.listener is not None:
            request.listener.progressed(message)

    def finished(self, request: Request, report: Report[Planned]) -> None:
        """Answer an accepted request that has ended. Never raise."""
        try:
            self._finished(request, report)
        except Exception as error:  # the client must get an answer even if the result is invalid
            try:
                self._finished(request, Report(WorkerEnding.FAILED, error=error))
            except Exception as again:  # the worker's thread must go on
                self._log().error(f"{request.id}: not answered:\n{''.join(traceback.format_exception(again))}")

    def _finished(self, request: Request, report: Report[Planned]) -> None:
        if report.error is not None:
            self.report_error(request.id, request.source, report.error)
            code, message = code_of(report.error), sentence_of(report.error)
            answer = self._answer(request, messages.AnswerEnding(GraspArray.FAILED, code, message))
            self._publish(answer, request.listener)
        elif report.ending is WorkerEnding.DONE and report.value is not None:
            self._result(request, report.value)
        elif report.ending is WorkerEnding.SUPERSEDED and request.only_newest and report.value is None:
            self._superseded += 1
            self.counters.count(SUPERSEDED)
            if time.monotonic() - self._superseded_reported >= COUNT_PERIOD:
                self._report_superseded(request.id)
        else:
            answer = self._answer(request, dataclasses.replace(_ENDINGS[report.ending], planned=report.value))
            self.publishers.emit(report.ending.value, request.id, request.source)
            self._publish(answer, request.listener)

    def _result(self, request: Request, planned: Planned) -> None:
        result, hand = planned.result, self._hand
        # Make all messages before publishing any, so that an invalid result is reported as an error only.
        answer = self._answer(request, messages.ending_of(planned))
        event = {**result_event(result), "mass": planned.mass, "mass_assumed": planned.mass_assumed}
        latched = []
        best = presentable(result)
        if best is not None:
            latched.append(messages.joint_message(best.grasp, hand, request.stamp))
            header = Header(frame_id=request.frame_out, stamp=request.stamp)
            latched.append(PoseStamped(header=header, pose=pose_of_posture(best.grasp)))
            first = next(iter(answer.grasps))
            latched.append(first.trajectory)
            if planned.held is not None and self.publishers.attached is not None:
                latched.append(attached_object(first, planned.held, hand, planned.mass))
        if request.settings.publish_markers and planned.worked_on:
            settings = request.settings
            look = {"most": settings.marker_grasps, "parts": settings.marker_parts, "solids": self.drawn(settings)}
            latched.append(result_markers(result.tried, hand, request.frame_out, request.stamp, **look))
        for message in latched:
            self.publishers.publish(message)
        self.publishers.emit("result", request.id, request.source, frame=request.frame_out, file=planned.file, **event)
        self._log().info(f"{request.id}: {event['verified']} of {event['grasps']} verified: {event['message']}")
        self.counters.planned(result, request.elapsed())
        self._publish(answer, request.listener)

    def drawn(self, settings: Settings) -> Sequence[Primitive]:
        """Return the shapes that markers draw as the hand. The first call may take seconds to read large meshes."""
        if settings.marker_geometry != "visual":
            return self._hand.primitives
        if self._visuals is None:
            from graspd_core.hands.readers.urdf import visual_solids

            try:
                self._visuals = visual_solids(self._hand, settings.hand_prefix)
            except GraspdError as error:
                self._visuals = self._hand.primitives
                self._log().warning(f"~/markers draws the hand's collision shapes: {error}")
        return self._visuals

    def _answer(self, request: Request, ending: messages.AnswerEnding) -> GraspArray:
        header = Header(frame_id=request.frame_out, stamp=request.stamp)
        return messages.array_message(ending, request.id, header, request.elapsed(), self._hand, request.settings)

    def _publish(self, message: GraspArray, listener: Listener | None) -> None:
        self.counters.answered(message)
        self.publishers.publish(message)
        if listener is not None:
            try:
                listener.ended(message)
            except Exception as error:  # the answer is already published. There must be no second one
                self._log().error(f"{message.request_id}: {''.join(traceback.format_exception(error))}")

    def nothing_to_cancel(self, request_id: str) -> None:
        """Report a cancel without a matching request. This is common and harmless."""
        message = f"cancel: no request {request_id!r} is waiting or running"
        self.publishers.emit("error", request_id, "cancel", kind="NotFound", code=ErrorCode.NOT_FOUND, message=message)
        self._log().debug(message)

    def report_error(self, request_id: str, source: str, error: BaseException) -> None:
        """Report an error on ~/status and in the log."""
        message, kind, code = sentence_of(error), type(error).__name__, code_of(error)
        self.publishers.emit("error", request_id, source, kind=kind, code=code, message=message)
        expected = isinstance(error, GraspdError | OSError)
        detail = "" if expected else "\n" + "".join(traceback.format_exception(error))
        self._log().error(f"{request_id or source}: {message}{detail}")

    def _report_superseded(self, request_id: str) -> None:
        """Publish how many waiting clouds were replaced since the last report, in an event with `request_id`."""
        count, self._superseded = self._superseded, 0
        if count:
            self._superseded_reported = time.monotonic()
            self.publishers.emit("superseded", request_id, "cloud", count=count)

    def _now(self) -> Time:
        return self._node.get_clock().now().to_msg()

    def _log(self):
        return self._node.get_logger()


def presentable(result: GraspResult) -> Grasp | None:
    """Return the best grasp if it is usable, otherwise None, so that topics for robots get no doubtful grasp."""
    return next((best for best in result.tried[:1] if best.usable), None)


def progress_event(progress: Progress) -> dict[str, Any]:
    """Return a progress report as a JSON-ready event. `fraction` refers to the current stage."""
    values = {name: value for name, value in vars(progress).items() if name != "found"}
    return {**values, "fraction": messages.fraction_of(progress)}


def result_event(result: GraspResult) -> dict[str, Any]:
    """Return the event with outcome, counts, timing and the best grasp. `best` is None if no grasp is usable."""
    best = presentable(result)
    return {
        "outcome": result.outcome.name.lower(),
        "message": result.message or result.outcome.value,
        "warnings": list(result.warnings),
        "grasps": len(result.tried),
        "verified": sum(grasp.verdict is Verdict.VERIFIED for grasp in result.tried),
        "timing": dataclasses.asdict(result.timing),
        "audits": dataclasses.asdict(result.audits),
        "best": None if best is None else _summary(best),
    }


def _summary(grasp: Grasp) -> dict[str, Any]:
    pose = grasp.grasp
    return {
        "verdict": grasp.verdict,
        "score": grasp.score,
        "probability": grasp.probability,
        "position": [float(value) for value in pose.position],
        "quaternion_wxyz": [float(value) for value in pose.quaternion_wxyz],
        "links": [contact.link for contact in grasp.contacts],
        **grasp_figures(grasp),
    }


def status_line(event: dict[str, Any]) -> str:
    """Return an event as one line of JSON. Non-finite numbers become null."""
    return json.dumps(_finite(event), allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
