"""Worker thread that processes requests one at a time. It is independent of ROS and of grasps.

Every request that `submit` accepts ends in exactly one call of `finish`: done, failed, cancelled, or superseded.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Generic, Protocol, TypeVar

from graspd_ros.error_codes import ErrorCode


class BusyPolicy(StrEnum):
    """What happens to a request that arrives while another request is running."""

    REJECT = "reject"
    QUEUE = "queue"
    REPLACE = "replace"


class WorkerEnding(StrEnum):
    """Outcome of a request."""

    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"
    SUPERSEDED = "superseded"


class WorkerRequest(Protocol):
    """Interface of a request.

    `only_newest` requests wait outside the queue, in one slot. A newer `only_newest` request replaces the old one.
    """

    @property
    def id(self) -> str: ...
    @property
    def only_newest(self) -> bool: ...


R = TypeVar("R", bound=WorkerRequest)
V = TypeVar("V")
StopHook = Callable[[], bool]


@dataclass(frozen=True)
class Admission:
    """Answer of `submit`. Without `refusal` the request is accepted, and `ahead` requests are processed before it."""

    refusal: ErrorCode | None = None
    reason: str = ""
    ahead: int = 0


@dataclass(frozen=True)
class Report(Generic[V]):
    """Outcome of a request. `error` is set if the request failed. If stopped, `value` may be partial or None."""

    ending: WorkerEnding
    value: V | None = None
    error: BaseException | None = None


class Worker(Generic[R, V]):
    """Worker thread with a bounded queue.

    Args:
        work: processes one request. It must call its stop hook often, and return early if the hook returns True. It
            may raise any exception.
        finish: called once at the end of each accepted request. It runs in the worker thread, or in the thread that
            ends a waiting request. It must not raise.
        prepare: runs in the worker thread before the first request.
        queue_size: greatest number of requests that wait behind the running request under the policy `queue`.
    """

    def __init__(
        self,
        *,
        work: Callable[[R, StopHook], V],
        finish: Callable[[R, Report[V]], None],
        prepare: Callable[[], None],
        queue_size: int,
    ) -> None:
        self._work = work
        self._finish = finish
        self._prepare = prepare
        self.queue_size = queue_size
        self._condition = threading.Condition()
        self._waiting: deque[R] = deque()
        self._newest: R | None = None
        self._running: R | None = None
        self._live: set[str] = set()  # ids of accepted requests that have not been finished
        self._ending: WorkerEnding | None = None  # ending that the running request will get
        self._stopping = False
        self._thread = threading.Thread(target=self._loop, name="graspd_worker", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def submit(self, request: R, policy: BusyPolicy) -> Admission:
        """Accept a request or return the reason of the refusal. The policy does not apply to `only_newest` requests."""
        superseded: list[R] = []
        with self._condition:
            ahead = len(self._waiting) + (self._running is not None)
            refused = self._refusal(request, policy, ahead)
            if refused:
                return refused
            if request.only_newest:
                superseded = [self._newest] if self._newest else []
                self._newest = request
            else:
                if policy is BusyPolicy.REPLACE:
                    superseded = list(self._waiting)
                    self._waiting.clear()
                    self._ending = self._ending or (WorkerEnding.SUPERSEDED if self._running else None)
                    ahead = int(self._running is not None)
                self._waiting.append(request)
            self._live.add(request.id)
            self._condition.notify()
        self._end_all(superseded, Report(WorkerEnding.SUPERSEDED))
        return Admission(ahead=ahead)

    def _refusal(self, request: R, policy: BusyPolicy, ahead: int) -> Admission | None:
        if self._stopping:
            return Admission(ErrorCode.SHUTTING_DOWN, "the node is shutting down")
        if request.id in self._live:
            return Admission(ErrorCode.DUPLICATE_ID, f"a request {request.id!r} is already waiting or running")
        if request.only_newest or policy is BusyPolicy.REPLACE:
            return None
        if policy is BusyPolicy.REJECT and ahead:
            return Admission(ErrorCode.BUSY, "the node is busy, and busy_policy is reject")
        if policy is BusyPolicy.QUEUE and ahead > self.queue_size:
            full = f"the queue is full: one runs, {ahead - 1} of queue_size={self.queue_size} wait"
            return Admission(ErrorCode.BUSY, full)
        return None

    def cancel(self, request_id: str) -> int:
        """Cancel a waiting or running request by id, or all if the id is empty. Return how many were cancelled."""
        with self._condition:
            dropped = self._take_out(lambda request: request_id in ("", request.id))
            running = self._running is not None and request_id in ("", self._running.id)
            if running:
                self._ending = WorkerEnding.CANCELLED
        self._end_all(dropped, Report(WorkerEnding.CANCELLED))
        return len(dropped) + running

    def end_waiting(self, which: Callable[[R], bool], report: Report[V]) -> int:
        """End the waiting requests for which `which` returns True. Return their number."""
        with self._condition:
            dropped = self._take_out(which)
        self._end_all(dropped, report)
        return len(dropped)

    def _take_out(self, which: Callable[[R], bool]) -> list[R]:
        dropped = [r for r in [*self._waiting, self._newest] if r is not None and which(r)]
        self._waiting = deque(r for r in self._waiting if r not in dropped)
        if self._newest in dropped:
            self._newest = None
        return dropped

    def state(self) -> tuple[str | None, int]:
        """Return the running request's id (or None), and the number of waiting requests that are not `only_newest`."""
        with self._condition:
            running = self._running.id if self._running else None
            return running, len(self._waiting)

    def alive(self) -> bool:
        return self._thread.is_alive()

    def stopping(self) -> bool:
        """Return True after `stop` was called. Long work outside requests must poll this."""
        return self._stopping

    def stop(self, timeout: float) -> bool:
        """Cancel all requests and end the thread. Return True if the thread ended within `timeout` seconds."""
        with self._condition:
            self._stopping = True
            self._condition.notify()
        self.cancel("")
        if self._thread.is_alive():
            self._thread.join(timeout)
        return not self._thread.is_alive()

    def _loop(self) -> None:
        self._prepare()
        while (request := self._next()) is not None:
            report = self._done(request)
            with self._condition:
                ending, self._running, self._ending = self._ending, None, None
            self._end_all([request], Report(ending, value=report.value) if ending else report)

    def _end_all(self, requests: list[R], report: Report[V]) -> None:
        for request in requests:
            try:
                self._finish(request, report)
            finally:
                with self._condition:
                    self._live.discard(request.id)

    def _done(self, request: R) -> Report[V]:
        try:
            return Report(WorkerEnding.DONE, value=self._work(request, self._should_stop))
        except BaseException as error:  # even SystemExit, so that one request cannot end the worker
            return Report(WorkerEnding.FAILED, error=error)

    def _next(self) -> R | None:
        with self._condition:
            self._condition.wait_for(lambda: self._stopping or self._waiting or self._newest is not None)
            if self._stopping:
                return None
            if self._waiting:
                self._running = self._waiting.popleft()
            else:
                self._running, self._newest = self._newest, None
            return self._running

    def _should_stop(self) -> bool:
        return self._ending is not None
