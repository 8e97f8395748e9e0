"""Cases on worker processes: each does one after the other, alone in its process, and a death costs one case."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import connection, get_context, parent_process
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from graspd_core.bench.result_store import failure, finite, head, write_record
from graspd_core.bench.stopwatch import forget_peak, peak_mb
from graspd_core.bench.study import Case, Record

# How often a stop is looked for [s].
_POLL = 0.2
# One thread each, so that CPU seconds are comparable; nothing remembered on disk, so that every case builds its own.
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "GRASPD_CACHE": "off"}


@dataclass(frozen=True)
class Job:
    """A case, what is run for it, and under which study and code its record is kept.

    Attributes:
        alone: in a process of its own, cold.
        patience: seconds until it is called hung.
    """

    study: str
    case: Case
    run: Callable[[Any], Record]
    code: str
    alone: bool = False
    patience: float = 3600.0


def run_cases(
    jobs: Sequence[Job], folder: Path, processes: int, stop: Callable[[], bool] = lambda: False
) -> Iterator[tuple[Job, Record]]:
    """Run jobs on `processes` workers and yield each as it ends; its record is on disk by then.

    Ends early, its workers killed, once `stop` is true. A worker that dies (out of memory, say) or hangs is a record
    with that error, and another takes its place.
    """
    waiting = deque(jobs)
    idle: list[_Worker] = []
    busy: dict[Any, _Worker] = {}
    try:
        while (waiting or busy) and not stop():
            while waiting and len(busy) < processes:
                job = waiting.popleft()
                worker = idle.pop() if idle and not job.alone else _Worker(folder, warm=not job.alone)
                worker.send(job)
                busy[worker.pipe] = worker
            ready = connection.wait(list(busy), timeout=_POLL)
            late = [pipe for pipe, worker in busy.items() if pipe not in ready and time.monotonic() > worker.until]
            for pipe in [*ready, *late]:
                worker = busy.pop(pipe)
                job, record = worker.job, worker.lost(folder) if pipe in late else worker.receive(folder)
                if worker.process.is_alive() and not job.alone and len(busy) + len(idle) < processes:
                    idle.append(worker)
                else:
                    worker.end()
                yield job, record
    finally:
        for worker in [*idle, *busy.values()]:
            worker.end()


class _Worker:
    """A spawned process, the pipe to it, and what it does."""

    def __init__(self, folder: Path, *, warm: bool) -> None:
        context = get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(target=_work, args=(theirs, folder, warm), daemon=False)
        before = {name: os.environ.get(name) for name in ENVIRONMENT}
        os.environ.update(ENVIRONMENT)
        try:
            self.process.start()
        finally:
            for name, value in before.items():
                os.environ.pop(name) if value is None else os.environ.update({name: value})
        theirs.close()

    def send(self, job: Job) -> None:
        self.job, self.until = job, time.monotonic() + job.patience
        with suppress(BrokenPipeError):
            self.pipe.send(job)

    def receive(self, folder: Path) -> Record:
        """The record that it answers with; where it died, one that says so."""
        try:
            return self.pipe.recv()
        except (EOFError, ConnectionResetError):
            self.process.join()
            died = RuntimeError(f"its process died with exit code {self.process.exitcode}")
            return self._write(folder, failure(died, "died"))

    def lost(self, folder: Path) -> Record:
        """Kill it; the record says that it hung."""
        self.end()
        return self._write(folder, failure(TimeoutError(f"no end after {self.job.patience:.0f} s"), "hung"))

    def end(self) -> None:
        self.process.kill()
        self.process.join()

    def _write(self, folder: Path, failed: Record) -> Record:
        record = {**head(self.job.study, self.job.case, self.job.code), **failed}
        write_record(folder, self.job.study, self.job.case, record)
        return record


def _work(pipe: connection.Connection, folder: Path, warm: bool) -> None:
    """Do jobs until there are no more."""
    # A Ctrl-C reaches the whole group of processes; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Libraries greet on stdout, which is the parent's for its tables.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _prepare(warm)
    with suppress(EOFError, BrokenPipeError):
        while True:
            job = pipe.recv()
            record = run_job(job)
            write_record(folder, job.study, job.case, record)
            pipe.send(record)


def run_job(job: Job) -> Record:
    """The record of one job, in this process. What it raises is written down in it: one bad case ends no benchmark.

    Everything is built anew, so that no case lives on what another left in memory.
    """
    from graspd_core.runtime import disk_cache

    disk_cache.forget()
    forget_peak()
    cpu, wall = time.process_time(), time.perf_counter()
    try:
        figures = job.run(job.case)
    except Exception as error:
        figures = failure(error)
    taken = {"case_cpu": time.process_time() - cpu, "case_wall": time.perf_counter() - wall}
    return finite({**head(job.study, job.case, job.code), "peak_mb": peak_mb(), **taken, **figures})


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _prepare(warm: bool) -> None:
    """One thread; and first-use work of the libraries, which no case is to pay for that runs among others."""
    import torch

    torch.set_num_threads(1)
    if warm:
        from graspd_core.hands.library import load_hand
        from graspd_core.planning.plan_grasps import plan_grasps
        from graspd_core.scene.load_scene import load_scene

        plan_grasps(load_scene("shape:sphere"), load_hand("allegro_right"), count=1, preset="fast")
