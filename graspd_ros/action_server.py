"""Action servers: goals go the way of all requests, and hear of progress and end as their listeners do.

A goal that is refused is accepted by the action server and aborted at once, so that its client is told why. Nothing
here waits: the worker's word starts and ends a goal, and the executor only carries it out.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from graspd_msgs.action import SynthesizeGrasps
from graspd_msgs.msg import Grasp, GraspArray, GraspProgress
from rclpy.action.server import ActionServer, CancelResponse, RCLError, ServerGoalHandle
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future

from graspd_ros.request import Listener

GOAL_DEPTH = 500  # a reader keeps only its newest messages: of a burst of goals most would vanish
RESULT_TIMEOUT = 60  # seconds that a client has to ask for a result; rclpy's 900 keep a lot in memory


class ActionMessages(Protocol):
    """What one goal of an action tells its client, in the action's own messages."""

    def progressed(self, message: GraspProgress) -> Any | None: ...
    def found(self, message: Grasp) -> Any | None: ...
    def result(self, message: GraspArray) -> Any: ...


class SynthesizeMessages:
    """Those of `~/synthesize`."""

    def progressed(self, message: GraspProgress) -> SynthesizeGrasps.Feedback:
        """Each report."""
        return SynthesizeGrasps.Feedback(progress=message)

    def found(self, message: Grasp) -> None:
        """Nothing: the answer holds them all."""

    def result(self, message: GraspArray) -> SynthesizeGrasps.Result:
        """The same as on ~/grasps."""
        return SynthesizeGrasps.Result(result=message)


class GoalServer:
    """An action server.

    Args:
        node: the node that it is part of.
        action: its type, and below its name.
        make_messages: what a new goal tells its client.
        submit: takes a goal's request for a listener; gives the id that the request goes by.
        cancel: cancels a request by its id; says whether there was one.
    """

    def __init__(
        self,
        node: Node,
        action: Any,
        name: str,
        make_messages: Callable[[], ActionMessages],
        submit: Callable[[Any, Listener], str],
        cancel: Callable[[str], bool],
    ) -> None:
        self._node = node
        self._make_messages = make_messages
        self._submit = submit
        self._cancel = cancel
        self._ids: dict[bytes, str] = {}
        deep = QoSProfile(depth=GOAL_DEPTH)
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
        """Whether every goal has got its end."""
        return not self._ids

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        request_id = self._ids.get(bytes(handle.goal_id.uuid))
        return CancelResponse.ACCEPT if request_id and self._cancel(request_id) else CancelResponse.REJECT


class Goal:
    """A request's listener that tells an action client."""

    def __init__(
        self, node: Node, handle: ServerGoalHandle, messages: ActionMessages, on_end: Callable[[], object]
    ) -> None:
        self._node = node
        self._messages = messages
        self._handle = handle
        self._on_end = on_end
        self._answer = Future()
        self._begun = False

    def progressed(self, message: GraspProgress) -> None:
        """Feedback; the first that is not of waiting tells that the goal is executed."""
        if message.stage != "queued":
            self._begin()
        self._feed(self._messages.progressed(message))

    def found(self, message: Grasp) -> None:
        """Feedback of those actions that give grasps while others are still tried."""
        self._begin()
        self._feed(self._messages.found(message))

    def _feed(self, feedback: Any | None) -> None:
        if feedback is not None:
            self._handle.publish_feedback(feedback)

    def ended(self, message: GraspArray) -> None:
        """The goal's end, and its result."""
        self._begin()
        self._answer.set_result(message)
        if self._node.executor is not None:
            self._node.executor.wake()  # it looks at the future only when something happens

    def _begin(self) -> None:
        if not self._begun:
            self._begun = True
            try:
                self._handle.execute(self._conclude)
            except RCLError:  # its client cancelled it after rclpy had looked for that: the second look finds it
                self._handle.execute(self._conclude)

    async def _conclude(self, handle: ServerGoalHandle) -> Any:
        message: GraspArray = await self._answer  # pyright: ignore[reportAssignmentType]
        try:
            if message.status in (GraspArray.SUCCEEDED, GraspArray.PARTIAL):
                handle.succeed()
            elif message.status == GraspArray.CANCELLED and handle.is_cancel_requested:
                handle.canceled()  # rcl allows it only after the client's own wish; ~/cancel and ~/reset abort
            else:
                handle.abort()
        finally:
            self._on_end()
        return self._messages.result(message)


def _no_execution(handle: ServerGoalHandle) -> Any:
    raise RuntimeError("a goal was executed without its own callback")
