"""A function in a process of its own, for libraries that hold Python's lock through a long call."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any


class OwnProcess:
    """Calls a function in a child process, which starts at once and ends with this one, however that ends.

    Calls come one at a time. Where the child has died the function is called here; the next call starts another.

    Args:
        work: a function that can be pickled, as its arguments, its result and its errors can.
    """

    def __init__(self, work: Callable[..., Any]) -> None:
        self._work = work
        self._lock = threading.Lock()
        self._start()

    def __call__(self, *arguments: Any) -> Any:
        with self._lock:
            if not self._process.is_alive():
                self._start()
            try:
                self._pipe.send(arguments)
                failed, answer = self._pipe.recv()
            except (EOFError, OSError):
                self._process.join()
                return self._work(*arguments)
        if failed:
            raise answer
        return answer

    def close(self) -> None:
        """End the child."""
        self._pipe.close()
        self._process.join()

    def _start(self) -> None:
        # spawn: a fork would copy locks that other threads hold. Only the child's end of the pipe goes to the child, so
        # that it reads an end of file when this process dies.
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(self._work, theirs), daemon=True, name="graspd_own_process"
        )
        self._process.start()
        theirs.close()


def _serve(work: Callable[..., Any], pipe: Connection) -> None:
    # Ctrl-C reaches every process of the terminal; this one ends when its parent does.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        try:
            arguments = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            answer = False, work(*arguments)
        except Exception as error:
            answer = True, error
        pipe.send(answer)
