"""One thread that works off requests, one at a time. It knows neither ROS nor grasps.

Every request that `submit` accepted ends in exactly one call of `finish`, whatever happens to it: done, failed,
cancelled, or superseded by a newer one.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Generic, Protocol, TypeVar


class BusyPolicy(StrEnum):
    """What becomes of a request that arrives while another is being worked on."""

    REJECT = "reject"
    QUEUE = "queue"
    REPLACE = "replace"


class Ending(StrEnum):
    """How a request ended."""

    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"
    SUPERSEDED = "superseded"


class Request(Protocol):
    """What the worker needs to know of a request.

    `only_newest` requests wait in a place of their own, where a newer one takes the place of an older.
    """

    @property
    def id(self) -> str: ...
    @property
    def only_newest(self) -> bool: ...


R = TypeVar("R", bound=Request)
V = TypeVar("V")
StopHook = Callable[[], bool]


@dataclass(frozen=True)
class Admission:
    """The answer to `submit`: taken or not, and why not; `ahead` requests come before it."""

    accepted: bool
    reason: str = ""
    ahead: int = 0


@dataclass(frozen=True)
class Report(Generic[V]):
    """The end of a request: `value` when done, `error` when failed."""

    ending: Ending
    value: V | None = None
    error: Exception | None = None


class Worker(Generic[R, V]):
    """A worker thread with a bounded queue.

    Args:
        work: does one request; asks its stop hook often and returns early when that says so. May raise anything.
        finish: told of each accepted request's end; called in the worker thread, or in the caller's when `submit` or
            `cancel` ends a waiting request. Must not raise.
        prepare: runs in the worker thread before the first request.
        queue_size: most requests that wait behind the running one under the policy `queue`.
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
        self._queue_size = queue_size
        self._condition = threading.Condition()
        self._waiting: deque[R] = deque()
        self._newest: R | None = None
        self._running: R | None = None
        self._ending: Ending | None = None  # what the running request was told to end as
        self._stopping = False
        self._thread = threading.Thread(target=self._loop, name="graspd_worker", daemon=True)

    def start(self) -> None:
        """Start the thread; requests may be submitted before."""
        self._thread.start()

    def submit(self, request: R, policy: BusyPolicy) -> Admission:
        """Take a request or say why not. An `only_newest` request is always taken, whatever the policy."""
        superseded: list[R] = []
        with self._condition:
            ahead = len(self._waiting) + (self._running is not None)
            if self._stopping:
                return Admission(False, "the node is shutting down")
            if request.only_newest:
                superseded = [self._newest] if self._newest else []
                self._newest = request
            elif policy is BusyPolicy.REJECT and ahead:
                return Admission(False, "busy with another request, and busy_policy is reject")
            elif policy is BusyPolicy.QUEUE and ahead > self._queue_size:
                return Admission(
                    False, f"the queue is full: one runs, {ahead - 1} of queue_size={self._queue_size} wait"
                )
            else:
                if policy is BusyPolicy.REPLACE:
                    superseded = list(self._waiting)
                    self._waiting.clear()
                    self._ending = self._ending or (Ending.SUPERSEDED if self._running else None)
                    ahead = int(self._running is not None)
                self._waiting.append(request)
            self._condition.notify()
        for old in superseded:
            self._finish(old, Report(Ending.SUPERSEDED))
        return Admission(True, ahead=ahead)

    def cancel(self, request_id: str) -> int:
        """Cancel a waiting or running request, or all of them when the id is empty; returns how many."""
        with self._condition:
            dropped = [r for r in [*self._waiting, self._newest] if r and request_id in ("", r.id)]
            self._waiting = deque(r for r in self._waiting if r not in dropped)
            if self._newest in dropped:
                self._newest = None
            running = self._running is not None and request_id in ("", self._running.id)
            if running:
                self._ending = Ending.CANCELLED
        for request in dropped:
            self._finish(request, Report(Ending.CANCELLED))
        return len(dropped) + running

    def stopping(self) -> bool:
        """Whether `stop` was called; long work outside requests polls this."""
        return self._stopping

    def stop(self, timeout: float) -> bool:
        """End everything as cancelled; True when the thread ended within `timeout` seconds."""
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
                told, self._running, self._ending = self._ending, None, None
            self._finish(request, Report(told) if told else report)

    def _done(self, request: R) -> Report[V]:
        try:
            return Report(Ending.DONE, value=self._work(request, self._should_stop))
        except Exception as error:  # whatever one request does, the next one is still served
            return Report(Ending.FAILED, error=error)

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
