"""A running command: its exit status, its progress, and what Ctrl-C does to it."""

from __future__ import annotations

import signal
import sys
import threading
from types import FrameType
from typing import Any

from graspd_core.types import Progress, Stage

EXIT_OK, EXIT_BAD_INPUT, EXIT_TOO_FEW, EXIT_INTERRUPTED = 0, 2, 3, 130


class Interrupt:
    """The first Ctrl-C ends a run, which keeps what it has found so far; the second ends the process."""

    def __init__(self) -> None:
        self._event = threading.Event()

    def __enter__(self) -> Interrupt:
        # Signals belong to the main thread; in another one, who runs us keeps them.
        self._mine = threading.current_thread() is threading.main_thread()
        if self._mine:
            self._before = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        if self._mine:
            signal.signal(signal.SIGINT, self._before)

    def came(self) -> bool:
        return self._event.is_set()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._event.is_set():
            raise KeyboardInterrupt
        self._event.set()


class Reporter:
    """Progress on a terminal as a bar, elsewhere as plain lines, one a stage."""

    def __enter__(self) -> Reporter:
        self._bar: Any = None
        self._stage: Stage | None = None
        return self

    def __call__(self, progress: Progress) -> None:
        if progress.stage is not self._stage:
            self._close()
            self._stage = progress.stage
            if sys.stderr.isatty() and progress.stage is not Stage.DONE:
                from tqdm import tqdm

                self._bar = tqdm(total=progress.of, desc=str(progress.stage), file=sys.stderr, leave=False)
            elif progress.stage is not Stage.DONE:
                print(f"graspd: {progress.stage} ({progress.elapsed:.1f} s)", file=sys.stderr)
        if self._bar is not None:
            self._bar.set_postfix_str(f"{progress.verified} verified" if progress.verified else f"{progress.best:.2f}")
            self._bar.update(progress.step - self._bar.n)

    def __exit__(self, *_: object) -> None:
        self._close()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None
