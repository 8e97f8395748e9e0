"""What becomes of a request, in messages: exactly one GraspArray for each, and events for those without graspd_msgs.

Clouds that come unasked are the exception: those that gave way to a newer one before their turn are only counted.
"""

from __future__ import annotations

import dataclasses
import math
import time
import traceback
from collections.abc import Sequence

from builtin_interfaces.msg import Time
from graspd_msgs.msg import GraspArray, GraspProgress
from rclpy.node import Node
from std_msgs.msg import Header

from graspd_core import HandModel
from graspd_core.errors import GraspdError
from graspd_core.hands.model import Primitive
from graspd_core.types import Progress, ProgressHook, Stage
from graspd_ros.counters import Counters
from graspd_ros.inputs.requests import MOST_ID, Listener, Request
from graspd_ros.outputs import messages
from graspd_ros.outputs import status_json as convert
from graspd_ros.outputs.error_codes import ErrorCode, code_of, sentence_of
from graspd_ros.outputs.markers import result_markers
from graspd_ros.outputs.publishers import Publishers
from graspd_ros.outputs.trajectory import Pace
from graspd_ros.parameters import Settings
from graspd_ros.request_planner import Planned, limited
from graspd_ros.worker import Admission, Refusal, Report, WorkerEnding

COUNT_PERIOD = 1.0  # seconds between two counts of superseded clouds, and between two complaints about clouds
_REFUSALS = {
    Refusal.BUSY: ErrorCode.BUSY,
    Refusal.DUPLICATE: ErrorCode.DUPLICATE_ID,
    Refusal.STOPPING: ErrorCode.SHUTTING_DOWN,
}
_ENDINGS = {
    WorkerEnding.CANCELLED: messages.AnswerEnding(GraspArray.CANCELLED, ErrorCode.CANCELLED, "cancelled"),
    WorkerEnding.SUPERSEDED: messages.AnswerEnding(
        GraspArray.SUPERSEDED, ErrorCode.SUPERSEDED, "a newer request took its place"
    ),
}


class Responses:
    """Publish what becomes of requests through `publishers`, and count it in `counters`."""

    def __init__(self, node: Node, hand: HandModel) -> None:
        self.publishers = Publishers(node)
        self.counters = Counters()
        self._node = node
        self._hand = hand
        self._visuals: Sequence[Primitive] | None = None
        self._superseded = 0
        self._superseded_told = self._complained = -float("inf")

    def forget(self) -> None:
        """As after a start: no counts, and late joiners get nothing from before now but the last answer."""
        self.publishers.publish(result_markers((), self._hand, "", self._now()))
        self.publishers.forget()
        self.counters.clear()

    # Taken or not.

    def admitted(self, request: Request, admission: Admission) -> None:
        """A request was taken, or not."""
        if admission.refusal is not None:
            code, message = _REFUSALS[admission.refusal], admission.reason
            self.publishers.tell("refused", request.id, request.source, code=code, message=message)
            self._log().warning(f"{request.id}: refused: {message}")
            self._publish(
                self._answer(request, messages.AnswerEnding(GraspArray.REFUSED, code, message)), request.listener
            )
        elif not request.only_newest:
            self._accepted(request, admission.ahead)

    def not_made(self, request_id: str, source: str, error: Exception, listener: Listener | None = None) -> None:
        """A message that is no valid request."""
        code, message = code_of(error), sentence_of(error)
        if code is ErrorCode.INTERNAL:
            self.tell_error(request_id[:MOST_ID], source, error)
        else:
            self.publishers.tell("refused", request_id[:MOST_ID], source, code=code, message=message)
            self._log().warning(f"{request_id[:MOST_ID] or source}: refused: {message}")
        ending = messages.AnswerEnding(GraspArray.REFUSED, code, message)
        header = Header(stamp=self._now())
        self._publish(messages.array_message(ending, request_id[:MOST_ID], header, 0.0, self._hand, Pace()), listener)

    def cloud_not_taken(self, request_id: str, error: Exception) -> None:
        """A cloud that came unasked and is no use; cameras repeat themselves, complaints do only once a second."""
        if time.monotonic() - self._complained >= COUNT_PERIOD:
            self._complained = time.monotonic()
            self.not_made(request_id, "cloud", error)

    def thing_not_taken(self, error: Exception) -> None:
        """A message about a thing of the planning scene that is no use; things stay as they were."""
        code, message = code_of(error), sentence_of(error)
        self.publishers.tell("refused", "", "collision_objects", code=code, message=message)
        self._log().warning(f"refused: {message}")

    def _accepted(self, request: Request, ahead: int) -> None:
        self.counters.count("accepted")
        self.publishers.tell("accepted", request.id, request.source, ahead=ahead)
        if ahead:
            self._report(request, messages.queued_message(request.id, request.frame_out, self._now(), ahead))

    # On the way.

    def started(self, request: Request) -> None:
        """The worker begins; a cloud that waited for that is told of only now."""
        if request.only_newest:
            self._tell_superseded(request.id)
            self._accepted(request, 0)

    def progress_hook(self, request: Request) -> ProgressHook:
        """Tells of the request's progress, not too often."""
        lowest = math.inf

        def tell(progress: Progress) -> None:
            nonlocal lowest
            elapsed = request.elapsed()
            if progress.stage is Stage.OPTIMISE and progress.step:
                lowest = min(lowest, progress.best)
            progress = dataclasses.replace(progress, best=lowest if math.isfinite(lowest) else 0.0)
            event = {**convert.progress_event(progress), "elapsed": elapsed}
            self.publishers.tell("progress", request.id, request.source, **event)
            message = messages.progress_message(progress, request.id, request.frame_out, self._now(), elapsed)
            self._report(request, message)

        limited_tell = limited(tell, request.settings.progress_rate)

        def hook(progress: Progress) -> None:
            if progress.found is not None and request.listener is not None:
                rank, header = progress.verified - 1, Header(frame_id=request.frame_out, stamp=request.stamp)
                found = messages.grasp_message(progress.found, rank, request.id, header, self._hand, _pace(request))
                request.listener.found(found)
            limited_tell(progress)

        return hook

    def _report(self, request: Request, message: GraspProgress) -> None:
        self.publishers.publish(message)
        if request.listener is not None:
            request.listener.progressed(message)

    # Over.

    def finished(self, request: Request, report: Report[Planned]) -> None:
        """A request that was taken has ended; never raises."""
        try:
            self._finished(request, report)
        except Exception as error:  # whatever is wrong with a result, its client is not left waiting
            try:
                self._finished(request, Report(WorkerEnding.FAILED, error=error))
            except Exception as again:  # and the worker's thread goes on
                self._log().error(f"{request.id}: not answered:\n{''.join(traceback.format_exception(again))}")

    def _finished(self, request: Request, report: Report[Planned]) -> None:
        if report.error is not None:
            self.tell_error(request.id, request.source, report.error)
            code, message = code_of(report.error), sentence_of(report.error)
            self._publish(
                self._answer(request, messages.AnswerEnding(GraspArray.FAILED, code, message)), request.listener
            )
        elif report.ending is WorkerEnding.DONE and report.value is not None:
            self._result(request, report.value)
        elif report.ending is WorkerEnding.SUPERSEDED and request.only_newest and report.value is None:
            self._superseded += 1
            self.counters.count("clouds_superseded")
            if time.monotonic() - self._superseded_told >= COUNT_PERIOD:
                self._tell_superseded(request.id)
        else:
            found = report.value.result if report.value else None
            answer = self._answer(request, dataclasses.replace(_ENDINGS[report.ending], result=found))
            self.publishers.tell(report.ending.value, request.id, request.source)
            self._publish(answer, request.listener)

    def _result(self, request: Request, planned: Planned) -> None:
        result, hand = planned.result, self._hand
        # Everything is made before anything is published: a result that cannot be told is an error as a whole.
        answer = self._answer(request, messages.ending_of(result))
        event = convert.result_event(result)
        shown = []
        best = convert.presentable(result)
        if best is not None:
            shown.append(convert.joint_message(best.grasp, hand, request.stamp))
            shown.append(convert.pose_message(best, request.frame_out, request.stamp))
            shown.append(next(iter(answer.grasps)).trajectory)
        if request.settings.publish_markers and planned.worked_on:
            settings = request.settings
            look = {"shown": settings.marker_grasps, "parts": settings.marker_parts, "solids": self.drawn(settings)}
            shown.append(result_markers(result.grasps, hand, request.frame_out, request.stamp, **look))
        for message in shown:
            self.publishers.publish(message)
        self.publishers.tell("result", request.id, request.source, frame=request.frame_out, file=planned.file, **event)
        self._log().info(f"{request.id}: {event['verified']} of {event['grasps']} verified: {event['message']}")
        self.counters.planned(result, request.elapsed())
        self._publish(answer, request.listener)

    def drawn(self, settings: Settings) -> Sequence[Primitive]:
        """The solids that markers draw the hand with; read on first use, for seconds where its meshes are large."""
        if settings.marker_geometry != "visual":
            return self._hand.primitives
        if self._visuals is None:
            from graspd_core.hands.readers.visual_solids import visual_solids

            try:
                self._visuals = visual_solids(self._hand, settings.hand_prefix)
            except GraspdError as error:
                self._visuals = self._hand.primitives
                self._log().warning(f"~/markers draws the hand's collision solids: {error}")
        return self._visuals

    def _answer(self, request: Request, ending: messages.AnswerEnding) -> GraspArray:
        header = Header(frame_id=request.frame_out, stamp=request.stamp)
        return messages.array_message(ending, request.id, header, request.elapsed(), self._hand, _pace(request))

    def _publish(self, message: GraspArray, listener: Listener | None) -> None:
        self.counters.answered(message)
        self.publishers.publish(message)
        if listener is not None:
            try:
                listener.ended(message)
            except Exception as error:  # the answer is out: it must not be followed by another
                self._log().error(f"{message.request_id}: {''.join(traceback.format_exception(error))}")

    # Events.

    def nothing_to_cancel(self, request_id: str) -> None:
        """A cancel that came after the end, or for a request that never was: common, and no fault."""
        message = f"cancel: no request {request_id!r} is waiting or running"
        self.publishers.tell("error", request_id, "cancel", kind="NotFound", code=ErrorCode.NOT_FOUND, message=message)
        self._log().debug(message)

    def tell_error(self, request_id: str, source: str, error: BaseException) -> None:
        """An error on ~/status and in the log."""
        message, kind, code = sentence_of(error), type(error).__name__, code_of(error)
        self.publishers.tell("error", request_id, source, kind=kind, code=code, message=message)
        expected = isinstance(error, GraspdError | OSError)
        detail = "" if expected else "\n" + "".join(traceback.format_exception(error))
        self._log().error(f"{request_id or source}: {message}{detail}")

    def _tell_superseded(self, request_id: str) -> None:
        """How many clouds gave way to newer ones since this was last told; at most one a second and one a request."""
        count, self._superseded = self._superseded, 0
        if count:
            self._superseded_told = time.monotonic()
            self.publishers.tell("superseded", request_id, "cloud", count=count)

    def _now(self) -> Time:
        return self._node.get_clock().now().to_msg()

    def _log(self):
        return self._node.get_logger()


def _pace(request: Request) -> Pace:
    settings = request.settings
    return Pace(settings.joint_speed, settings.base_speed, settings.base_turn, settings.shortest_stage)
