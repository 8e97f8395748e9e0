"""Work in a process of its own: many libraries hold Python's lock through long calls, and some crash.

A process that serves calls `start_worker_process` once. `run_isolated` then works in a child, in all other processes it
works in place. The child is a bare interpreter, not one of multiprocessing's, which would import the user's main module
again. This module is cheap to import, so that the child can be started before all else. For processes that serve for
days, it also gives freed memory back to the system.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import importlib
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any, TypeVar

# glibc's mallopt: how many arenas there may be.
_M_ARENA_MAX, _ARENAS = -8, 2


def trim_heap() -> None:
    """Return freed memory to the system. Only glibc keeps it and needs this."""
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError, TypeError):  # no glibc
        return
    trim(ctypes.c_size_t(0))


def limit_malloc_arenas() -> None:
    """Let all threads allocate from two arenas (glibc only), since each of its own would keep freed memory."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return
    mallopt(_M_ARENA_MAX, _ARENAS)


T = TypeVar("T")

# The child finds modules where this process does.
_CHILD = "import sys; sys.path[:] = {path!r}; from {module} import serve; serve({pipe}, {modules!r}, {parent})"

# How often a bounded call looks at the child's memory [s].
_POLL = 0.1
# prctl(2): the signal that a process gets when the thread that started it ends.
_PR_SET_PDEATHSIG = 1


class WorkerProcess:
    """A child process that calls functions. It starts at once and ends with this process, however that ends.

    Calls come one at a time. Before the first the child imports `modules`. A child that has died is replaced. Functions
    must be importable by their names. Arguments, results and errors are pickled. With `killed_with_thread` the child
    ends with the thread that started it, even in the middle of a call (Linux), otherwise after its call.
    """

    def __init__(self, *modules: str, killed_with_thread: bool = False) -> None:
        self._modules = modules
        self._parent = os.getpid() if killed_with_thread else 0
        self._lock = threading.Lock()
        self._start()

    def __call__(self, work: Callable[..., T], *arguments: Any, **named: Any) -> T:
        """Return or raise what the work does. Raises MemoryError: two children died over it."""
        # pickle's own way with tensors, by value: that of multiprocessing shares memory that outlives nobody's death.
        call = pickle.dumps((work, arguments, named), pickle.HIGHEST_PROTOCOL)
        with self._lock:
            for _ in range(2):
                if self._process.poll() is not None:
                    self._start()
                try:
                    self._pipe.send_bytes(call)
                    told = self._pipe.recv_bytes()
                    break
                except (EOFError, OSError):
                    self._process.wait()
                except BaseException:
                    # Ctrl-C while waiting: the answer, left in the pipe, would be taken for the next call's.
                    self._process.kill()
                    self._process.wait()
                    raise
            else:
                # Not called here instead: what killed them would kill this process.
                raise MemoryError(f"{work.__name__}: the process that it is done in died twice")
        failed, answer = pickle.loads(told)
        if failed:
            raise answer
        return answer

    def bounded(self, seconds: float, most_mb: float, work: Callable[..., T], *arguments: Any) -> T:
        """Call once, and end the call with its child if it takes too long or too much memory.

        Raises:
            TimeoutError: no end after `seconds`.
            MemoryError: the child's resident memory passed `most_mb` (checked on systems with /proc).
            ChildProcessError: the child died.
        """
        call = pickle.dumps((work, arguments, {}), pickle.HIGHEST_PROTOCOL)
        with self._lock:
            if self._process.poll() is not None:
                self._start()
            end = time.monotonic() + seconds
            try:
                self._pipe.send_bytes(call)
                while not self._pipe.poll(_POLL):
                    if time.monotonic() > end:
                        raise TimeoutError(f"no end after {seconds:g} s")
                    if (held := resident_mb(self._process.pid)) > most_mb:
                        raise MemoryError(f"its process held {held:.0f} MB, more than {most_mb:g}")
                told = self._pipe.recv_bytes()
            except (EOFError, ConnectionError):
                raise ChildProcessError(f"its process died with exit code {self._process.wait()}") from None
            except BaseException:
                self._process.kill()
                self._process.wait()
                raise
        failed, answer = pickle.loads(told)
        if failed:
            raise answer
        return answer

    def close(self) -> None:
        """End the child."""
        self._pipe.close()
        self._process.kill()
        self._process.wait()

    def _start(self) -> None:
        # Only the child's end of the pipe goes to the child, so that it reads an end of file when this process dies.
        self._pipe, theirs = Pipe()
        path = [entry for entry in sys.path if isinstance(entry, str)]
        names = {"module": __name__, "modules": self._modules, "parent": self._parent}
        program = _CHILD.format(path=path, pipe=theirs.fileno(), **names)
        # Ctrl-C reaches every process of the terminal. This one ends when its parent does. It is born with the signal
        # blocked, since it needs a second for its imports before it could ignore it.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-c", program], stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()]
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()


_child: WorkerProcess | None = None


def start_worker_process(*modules: str) -> None:
    """Do what goes through `run_isolated` in a child process from now on, so that other threads go on.

    The child begins by importing `modules`. If there is a child already, nothing is done.
    """
    global _child
    if _child is None:
        _child = WorkerProcess(*modules)
        atexit.register(_child.close)


def run_isolated(work: Callable[..., T], *arguments: Any, **named: Any) -> T:
    """Return or raise what the work does, in the child if there is one, else here."""
    return work(*arguments, **named) if _child is None else _child(work, *arguments, **named)


def resident_mb(process: int) -> float:
    """Return the resident memory of a process [MB], 0 if it has ended or there is no /proc."""
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def serve(number: int, modules: Iterable[str] = (), parent: int = 0) -> None:
    """Import modules, then answer calls from the pipe of this file descriptor until its other end is closed.

    The end of a named `parent` ends this process at once.
    """
    if parent:
        _end_with(parent)
    pipe = Connection(number)
    # Read by the libraries when they are imported, with the first work: the parent keeps the other cores busy.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    limit_malloc_arenas()
    for name in modules:
        # One that cannot be imported fails the work that needs it.
        with contextlib.suppress(Exception):
            importlib.import_module(name)
    while True:
        try:
            call = pipe.recv_bytes()
        except (EOFError, OSError):
            return
        answer = _answer(call)
        del call
        try:
            pipe.send_bytes(answer)
        except OSError:
            return
        del answer
        trim_heap()


def _end_with(parent: int) -> None:
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def _answer(call: bytes) -> bytes:
    """Return whether the work failed, and its result or error, pickled."""
    try:
        work, arguments, named = pickle.loads(call)
        return pickle.dumps((False, work(*arguments, **named)), pickle.HIGHEST_PROTOCOL)
    except Exception as error:
        # A traceback stays behind, a note goes along.
        error.add_note("".join(traceback.format_exception(error)))
        try:
            answer = pickle.dumps((True, error))
            pickle.loads(answer)
        except Exception:  # an error that cannot travel
            answer = pickle.dumps((True, RuntimeError(f"{type(error).__name__}: {error}")))
        return answer


# What the child's work imports: all of a scene from clouds and of other shapes, and the library behind them.
_MODULES = ("graspd_core.perception.scene_from_views", "graspd_core.verify.robustness", "open3d")


def start_planning_worker() -> None:
    """Start the child process, if there is none yet. It imports the libraries of planning meanwhile."""
    start_worker_process(*_MODULES)
