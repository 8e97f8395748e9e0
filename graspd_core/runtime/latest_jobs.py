"""One thread that draws: of each kind of work it does the newest, so that no flood of sliders piles up."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

Work = Callable[[], object]


class LatestJobs:
    """Does what it is given in a thread of its own; work that newer work of its kind replaces is never done.

    Args:
        failed: told of what work raised.
    """

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self._waiting: dict[str, tuple[float, Work]] = {}
        self._change = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="graspd-viewer", daemon=True)
        self._thread.start()

    def submit(self, kind: str, work: Work, after: float = 0.0) -> None:
        """Have work done, `after` seconds from now, unless other work of its kind comes first."""
        with self._change:
            self._waiting[kind] = time.monotonic() + after, work
            self._change.notify()

    def drop(self, kind: str) -> None:
        """Work of that kind that waits is not done."""
        with self._change:
            self._waiting.pop(kind, None)

    def close(self) -> None:
        """End the thread behind the work it is at."""
        with self._change:
            self._closed = True
            self._change.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join(10.0)

    def _next(self) -> Work | None:
        with self._change:
            while not self._closed:
                kind = min(self._waiting, key=lambda kind: self._waiting[kind][0], default=None)
                left = None if kind is None else self._waiting[kind][0] - time.monotonic()
                if kind is not None and left is not None and left <= 0:
                    return self._waiting.pop(kind)[1]
                self._change.wait(left)
        return None

    def _run(self) -> None:
        while (work := self._next()) is not None:
            try:
                work()
            except Exception as error:
                self._failed(error)
