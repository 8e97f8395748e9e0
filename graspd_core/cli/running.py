"""Handle exit status, deadline and Ctrl-C of a running command."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Any

from graspd_core.errors import ConfigError
from graspd_core.types import GraspResult, ProgressHook, WatchHook

EXIT_OK, EXIT_BAD_INPUT, EXIT_TOO_FEW, EXIT_INTERRUPTED = 0, 2, 3, 130
# Exit status if the reader of the output has ended, such as `head`. Shells report the same for the signal SIGPIPE.
EXIT_PIPE = 141


# Signals that end a run. Terminals send SIGINT, services and batch systems send SIGTERM.
_ENDS = (signal.SIGINT, signal.SIGTERM)


class Interrupt:
    """Context for Ctrl-C and SIGTERM. The first signal ends the run, not the process. The second ends the process."""

    def __init__(self) -> None:
        self._event = threading.Event()

    def __enter__(self) -> Interrupt:
        # Only the main thread can handle signals. In other threads this context does nothing.
        self._mine = threading.current_thread() is threading.main_thread()
        if self._mine:
            self._before = {number: signal.signal(number, self._handle) for number in _ENDS}
        return self

    def __exit__(self, *_: object) -> None:
        if self._mine:
            for number, handler in self._before.items():
                signal.signal(number, handler)

    def is_interrupted(self) -> bool:
        return self._event.is_set()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._event.is_set():
            raise KeyboardInterrupt
        self._event.set()


# Interval after which `_alarm` raises again if a library caught DeadlinePassed [s].
_AGAIN = 0.5


class DeadlinePassed(BaseException):
    """A deadline has passed. The class is not an Exception, because file readers catch every Exception."""


class Deadline:
    """Deadline `seconds` after `began`, a `time.perf_counter()` value. If `seconds` is None, it never passes."""

    def __init__(self, seconds: float | None, began: float) -> None:
        self._end = None if seconds is None else began + seconds

    def left(self) -> float | None:
        """Return the remaining time [s], always above 0, or None without a deadline."""
        return None if self._end is None else max(self._end - time.perf_counter(), 1e-9)

    @contextmanager
    def cuts_short(self) -> Iterator[None]:
        """Raise DeadlinePassed inside the context as soon as the deadline has passed.

        A running call of a compiled library is not interrupted. Outside the main thread, DeadlinePassed is raised only
        after the work, because only the main thread can handle signals.
        """
        if self._end is None:
            yield
            return
        with _alarm(self._end) if threading.current_thread() is threading.main_thread() else nullcontext():
            try:
                yield
            except Exception:
                # An interrupted library may raise its own error. Ignore errors after the deadline.
                if time.perf_counter() < self._end:
                    raise
        if time.perf_counter() >= self._end:
            raise DeadlinePassed


@contextmanager
def _alarm(end: float) -> Iterator[None]:
    """Raise DeadlinePassed in the main thread at `end`, and again if a library catches it."""
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
    """Return the start time of this process, a `time.perf_counter()` value. If unknown, return the time now."""
    now = time.perf_counter()
    try:
        # The start time is field 22. Field 2, the program's name in brackets, may contain blanks.
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        age = time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError, ValueError, IndexError):
        return now
    return now - max(age, 0.0)


@dataclass(frozen=True)
class Watched:
    """Hooks that show a run in a browser, and `show`, which shows the result until Ctrl-C. The defaults do nothing."""

    watch: WatchHook | None = None
    progress: ProgressHook = lambda progress: None
    show: Callable[[GraspResult], None] = lambda result: None


def sibling(module: str) -> Any:
    """Import a module of another graspd package. Raises ConfigError: the package is not installed."""
    package = module.partition(".")[0]
    if find_spec(package) is None:
        raise ConfigError(f"{package} is not installed; run: pip install graspd")
    return import_module(module)
