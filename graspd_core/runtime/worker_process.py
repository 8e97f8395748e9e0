"""Run functions in a child process, because many libraries hold Python's GIL during long calls and some crash.

A server process calls `start_worker_process` once. After that `run_isolated` runs functions in the child. In other
processes `run_isolated` calls the functions directly. The child is a bare interpreter, because a child of
multiprocessing would import the user's main module again. This module imports fast, so that the child can start before
slow imports. `trim_heap` returns freed memory to the system, for processes that run for days.
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

# Parameter of glibc's mallopt for the greatest number of arenas, and the number of arenas.
_M_ARENA_MAX, _ARENAS = -8, 2


def trim_heap() -> None:
    """Return freed memory to the system. Only glibc needs this call."""
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError, TypeError):  # no glibc
        return
    trim(ctypes.c_size_t(0))


def limit_malloc_arenas() -> None:
    """Let all threads share two memory arenas (glibc only). One arena per thread would keep much freed memory."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return
    mallopt(_M_ARENA_MAX, _ARENAS)


T = TypeVar("T")

# Program of the child. The child searches modules in the paths of this process.
_CHILD = "import sys; sys.path[:] = {path!r}; from {module} import serve; serve({pipe}, {modules!r}, {parent})"

# Interval at which `bounded` checks the child's time and memory [s].
_POLL = 0.1
# prctl(2): the signal that a process gets when the thread that started it ends.
_PR_SET_PDEATHSIG = 1


class WorkerProcess:
    """A child process that calls functions. It starts immediately and ends with this process.

    The child first imports `modules`. Calls run one at a time. A dead child is replaced. Functions must be
    importable by name. Arguments, results and errors are pickled. If this process ends, the child finishes its call and
    ends. With `killed_with_thread` (Linux only), the end of the starting thread kills the child, even during a call.
    """

    def __init__(self, *modules: str, killed_with_thread: bool = False) -> None:
        self._modules = modules
        self._parent = os.getpid() if killed_with_thread else 0
        self._lock = threading.Lock()
        self._start()

    def __call__(self, work: Callable[..., T], *arguments: Any, **named: Any) -> T:
        """Run `work` in the child. Return its result or raise its error. Raises MemoryError: the child died twice."""
        # pickle copies tensors. multiprocessing would share the memory of tensors, which is lost if a process dies.
        call = pickle.dumps((work, arguments, named), pickle.HIGHEST_PROTOCOL)
        with self._lock:
            for _ in range(2):
                if self._process.poll() is not None:
                    self._start()
                try:
                    self._pipe.send_bytes(call)
                    reply = self._pipe.recv_bytes()
                    break
                except (EOFError, OSError):
                    self._process.wait()
                except BaseException:
                    # After Ctrl-C, the answer to this call would stay in the pipe, and the next call would read it.
                    self._process.kill()
                    self._process.wait()
                    raise
            else:
                # Do not run the function in this process, because it could kill this process too.
                raise MemoryError(f"{work.__name__}: the worker process died twice, perhaps for lack of memory")
        failed, answer = pickle.loads(reply)
        if failed:
            raise answer
        return answer

    def bounded(self, seconds: float, most_mb: float, work: Callable[..., T], *arguments: Any) -> T:
        """Run `work` in the child, but kill the child if the call takes too long or too much memory.

        Raises:
            TimeoutError: the call did not end within `seconds`.
            MemoryError: the child's resident memory exceeded `most_mb` [MB] (checked on systems with /proc).
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
                        raise TimeoutError(f"the call did not end within {seconds:g} s")
                    if (held := resident_mb(self._process.pid)) > most_mb:
                        raise MemoryError(f"its process used {held:.0f} MB, more than {most_mb:g} MB")
                reply = self._pipe.recv_bytes()
            except (EOFError, ConnectionError):
                raise ChildProcessError(f"its process died with exit code {self._process.wait()}") from None
            except BaseException:
                self._process.kill()
                self._process.wait()
                raise
        failed, answer = pickle.loads(reply)
        if failed:
            raise answer
        return answer

    def close(self) -> None:
        """End the child."""
        self._pipe.close()
        self._process.kill()
        self._process.wait()

    def _start(self) -> None:
        # The child gets only its own end of the pipe, so that it reads an end of file when this process dies.
        self._pipe, theirs = Pipe()
        path = [entry for entry in sys.path if isinstance(entry, str)]
        names = {"module": __name__, "modules": self._modules, "parent": self._parent}
        program = _CHILD.format(path=path, pipe=theirs.fileno(), **names)
        # Ctrl-C reaches every process of the terminal, but the child must end with its parent only. Block the signal at
        # the child's start, because the child's imports take a second before the child could ignore the signal.
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
    """Start the child of `run_isolated`, so that calls of `run_isolated` do not block other threads.

    The child first imports `modules`. If the child runs already, do nothing.
    """
    global _child
    if _child is None:
        _child = WorkerProcess(*modules)
        atexit.register(_child.close)


def run_isolated(work: Callable[..., T], *arguments: Any, **named: Any) -> T:
    """Run `work` in the child, or in this process if there is no child. Return its result or raise its error."""
    return work(*arguments, **named) if _child is None else _child(work, *arguments, **named)


def resident_mb(process: int) -> float:
    """Return the resident memory of a process [MB]. Return 0 if the process has ended or the system has no /proc."""
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def serve(number: int, modules: Iterable[str] = (), parent: int = 0) -> None:
    """Import `modules`, then answer calls from the pipe with file descriptor `number` until the pipe is closed.

    If `parent` is a process id, the end of that process kills this process.
    """
    if parent:
        _end_with(parent)
    pipe = Connection(number)
    # Libraries read this variable at import. One thread is enough, because the parent uses the other cores.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    limit_malloc_arenas()
    for name in modules:
        # Ignore a failing import. A call that needs the module will raise the error again.
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
    """Run a pickled call. Return the pickle of (True, error) if the call failed, otherwise of (False, result)."""
    try:
        work, arguments, named = pickle.loads(call)
        return pickle.dumps((False, work(*arguments, **named)), pickle.HIGHEST_PROTOCOL)
    except Exception as error:
        # A traceback cannot be pickled, so add its text as a note.
        error.add_note("".join(traceback.format_exception(error)))
        try:
            answer = pickle.dumps((True, error))
            pickle.loads(answer)
        except Exception:  # The error cannot be pickled.
            answer = pickle.dumps((True, RuntimeError(f"{type(error).__name__}: {error}")))
        return answer


# Modules for the calls of the child: scenes from clouds, robustness checks, and Open3D.
_MODULES = ("graspd_core.perception.scene_from_views", "graspd_core.verify.robustness", "open3d")


def start_planning_worker() -> None:
    """Start the child process if it does not run yet. The child imports the libraries of planning."""
    start_worker_process(*_MODULES)
