"""A function in a process of its own, for libraries that hold Python's lock through a long call."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from typing import Any


class OwnProcess:
    """Calls a function in a child process, which starts at once and ends with this one, however that ends.

    Calls come one at a time. A child that has died is replaced.

    Args:
        work: a function that can be pickled, as its arguments, its result and its errors can.
    """

    def __init__(self, work: Callable[..., Any]) -> None:
        self._work = work
        self._lock = threading.Lock()
        self._start()

    def __call__(self, *arguments: Any) -> Any:
        """What the work gives or raises; MemoryError where two children died over it, as when memory is short."""
        with self._lock:
            for _ in range(2):
                if not self._process.is_alive():
                    self._start()
                try:
                    self._pipe.send(arguments)
                    failed, answer = self._pipe.recv()
                    break
                except (EOFError, OSError):
                    self._process.join()
                except BaseException:
                    # Ctrl-C while waiting: the answer, left in the pipe, would be taken for the next call's.
                    self._process.kill()
                    self._process.join()
                    raise
            else:
                # Not called here instead: what killed them would kill this process.
                raise MemoryError(f"{self._work.__name__}: the process that it is done in died twice")
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
        work = (self._work, theirs)
        self._process = context.Process(target=_serve, args=work, daemon=True, name="graspd_own_process")
        # Ctrl-C reaches every process of the terminal; this one ends when its parent does. It is born with the signal
        # blocked, since it needs a second for its imports before it could ignore it.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()


def _serve(work: Callable[..., Any], pipe: Connection) -> None:
    while True:
        try:
            arguments = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            answer = False, work(*arguments)
        except Exception as error:
            answer = True, error
        try:
            pipe.send(answer)
        except OSError:
            return
