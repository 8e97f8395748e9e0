"""The deadline of a command: it counts from the start of its process, and ends what knows nothing of it."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FrameType

# Seconds from one interruption of the same work to the next.
_AGAIN = 0.5


class DeadlinePassed(BaseException):
    """What a deadline ends the work with. No Exception: readers of files take every one of those for their own."""


class Deadline:
    """`seconds` after `began`, a `time.perf_counter()` value; None: never."""

    def __init__(self, seconds: float | None, began: float) -> None:
        self._end = None if seconds is None else began + seconds

    def left(self) -> float | None:
        """Seconds left, more than none; None without a deadline."""
        return None if self._end is None else max(self._end - time.perf_counter(), 1e-9)

    @contextmanager
    def cuts_short(self) -> Iterator[None]:
        """Raise DeadlinePassed in the work inside once the deadline has passed; a library's long call ends first.

        Signals belong to the main thread: in another one, DeadlinePassed waits for the work's end.
        """
        if self._end is None:
            yield
            return
        with _alarm(self._end) if threading.current_thread() is threading.main_thread() else nullcontext():
            try:
                yield
            except Exception:
                # What a library that was interrupted makes of that.
                if time.perf_counter() < self._end:
                    raise
        if time.perf_counter() >= self._end:
            raise DeadlinePassed


@contextmanager
def _alarm(end: float) -> Iterator[None]:
    """Raise DeadlinePassed in the main thread at `end`, and again as long as a library takes that for its own error."""
    armed = True

    def passed(number: int, frame: FrameType | None) -> None:
        if armed:
            signal.setitimer(signal.ITIMER_REAL, _AGAIN)
            raise DeadlinePassed

    timer = signal.setitimer(signal.ITIMER_REAL, 0)
    handler = signal.signal(signal.SIGALRM, passed)
    try:
        try:
            signal.setitimer(signal.ITIMER_REAL, max(end - time.perf_counter(), 1e-6))
            yield
        finally:
            armed = False
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)
        signal.setitimer(signal.ITIMER_REAL, *timer)


def process_began() -> float:
    """When this process was started, a `time.perf_counter()` value; where the system does not say, now."""
    now = time.perf_counter()
    try:
        # The 22nd field; the second, the program's name in brackets, may hold blanks.
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        age = time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError, ValueError, IndexError):
        return now
    return now - max(age, 0.0)
