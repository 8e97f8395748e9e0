"""A running command: its exit status and deadline, and its response to Ctrl-C."""

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


# Signals that end a run: what a terminal sends, and what a service or a batch system does.
_ENDS = (signal.SIGINT, signal.SIGTERM)


class Interrupt:
    """A context in which the first Ctrl-C or SIGTERM ends a run with its result so far, the second the process."""

    def __init__(self) -> None:
        self._event = threading.Event()

    def __enter__(self) -> Interrupt:
        # Signals belong to the main thread. In another thread, the caller keeps them.
        self._mine = threading.current_thread() is threading.main_thread()
        if self._mine:
            self._before = {number: signal.signal(number, self._handle) for number in _ENDS}
        return self

    def __exit__(self, *_: object) -> None:
        if self._mine:
            for number, handler in self._before.items():
                signal.signal(number, handler)

    def came(self) -> bool:
        return self._event.is_set()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._event.is_set():
            raise KeyboardInterrupt
        self._event.set()


# Seconds from one interruption of the same work to the next.
_AGAIN = 0.5


class DeadlinePassed(BaseException):
    """The end of work by a deadline. It is no Exception, because readers of files catch all of those as their own."""


class Deadline:
    """A time `seconds` after `began`, a `time.perf_counter()` value. None: never."""

    def __init__(self, seconds: float | None, began: float) -> None:
        self._end = None if seconds is None else began + seconds

    def left(self) -> float | None:
        """Return the seconds left, more than zero, None without a deadline."""
        return None if self._end is None else max(self._end - time.perf_counter(), 1e-9)

    @contextmanager
    def cuts_short(self) -> Iterator[None]:
        """Raise DeadlinePassed in the work inside once the deadline has passed.

        A library's long call ends first. Signals belong to the main thread. In another one, DeadlinePassed waits for
        the work's end.
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
    """Raise DeadlinePassed in the main thread at `end`, and again while a library catches that as its own error."""
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
    """Return the start of this process, a `time.perf_counter()` value. If the system does not say it, now."""
    now = time.perf_counter()
    try:
        # The 22nd field. The second, the program's name in brackets, may hold blanks.
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        age = time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError, ValueError, IndexError):
        return now
    return now - max(age, 0.0)


@dataclass(frozen=True)
class Watched:
    """How a run is followed in a browser, by default not at all.

    Attributes:
        watch: hook of `plan_grasps`.
        told: as its progress hook.
        show: shows what was found until Ctrl-C.
    """

    watch: WatchHook | None = None
    told: ProgressHook | None = None
    show: Callable[[GraspResult], None] = lambda result: None

    def progress(self, reporter: ProgressHook) -> ProgressHook:
        """Return the progress hook of a run that `reporter` follows too."""
        told = self.told
        if told is None:
            return reporter
        return lambda progress: (reporter(progress), told(progress))[0]


# Packages beside graspd_core by the command, or the option, that needs them.
SIBLINGS = {"view": "graspd_viewer", "bench": "graspd_bench", "dataset": "graspd_dataset", "import": "graspd_dataset"}
SIBLINGS |= {"cell": "graspd_cell"}


def sibling(module: str) -> Any:
    """Import a module of a package beside graspd_core. Raises ConfigError: the package is not installed."""
    package = module.partition(".")[0]
    if find_spec(package) is None:
        raise ConfigError(f"{package} is not installed; run: pip install graspd")
    return import_module(module)
