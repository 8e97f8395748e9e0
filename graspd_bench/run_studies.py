"""Runs of studies: makes the cases, skips finished ones, runs the rest, and writes the results to pages.

Each worker process does one case after the other, so that a death costs one case.
"""

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

from graspd_bench.result_store import bench_version, head, read_record, write_record
from graspd_bench.study import Case, Picture, Record, Request, Study
from graspd_bench.study_registry import STUDIES
from graspd_bench.tables import sourced
from graspd_core.errors import ConfigError, choices
from graspd_dataset.run_records import failure, finite, forget_peak, peak_mb

# How often a stop is looked for [s].
_POLL = 0.2
# One thread each, so that CPU seconds are comparable. Nothing remembered on disk, so that every case builds its own.
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "GRASPD_CACHE": "off"}


@dataclass(frozen=True)
class Job:
    """A case, the function that runs it, and the study and code of its record.

    Attributes:
        alone: in a process of its own, cold.
        patience: seconds until it counts as hung.
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
    """Run jobs on `processes` workers and yield each as it ends. Its record is on disk by then.

    Ends early, its workers killed, once `stop` is true. A worker that dies (as out of memory) or hangs gives a record
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
    """A spawned process, the pipe to it, and its job."""

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
        """Return the record that it answers with. If it died, the record says so."""
        try:
            return self.pipe.recv()
        except (EOFError, ConnectionResetError):
            self.process.join()
            died = RuntimeError(f"its process died with exit code {self.process.exitcode}")
            return self._write(folder, failure(died, "died"))

    def lost(self, folder: Path) -> Record:
        """Kill it and return a record that says that it hung."""
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
    # A Ctrl-C reaches the whole group of processes. The parent decides what it means.
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
    """Return the record of one job, run in this process. An exception is recorded, so one bad case ends no benchmark.

    Everything is built anew, so that no case uses what another left in memory.
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
    """Set one thread, and do first-use work of the libraries, which no case among others is to pay for."""
    import torch

    torch.set_num_threads(1)
    if warm:
        from graspd_core.hands.library import load_hand
        from graspd_core.perception.load_scene import load_scene
        from graspd_core.planning.plan_grasps import plan_grasps

        plan_grasps(load_scene("shape:sphere"), load_hand("allegro_right"), count=1, preset="fast")


# Every study that needs nothing that is not shipped.
ALL = "all"


@dataclass(frozen=True)
class Plan:
    """All jobs of a command, and the records of those that have finished before."""

    folder: Path
    jobs: tuple[Job, ...]
    done: dict[Job, Record]

    @property
    def missing(self) -> tuple[Job, ...]:
        return tuple(job for job in self.jobs if job not in self.done)

    def seconds(self, processes: int) -> float:
        """Return the seconds that the missing cases take on quiet cores, roughly."""
        return sum(STUDIES[job.study].seconds(job.case) for job in self.missing) / processes


def studies_of(names: Sequence[str]) -> dict[str, Study]:
    """Return studies by their names, each once. `all` are those that need nothing from the user.

    Raises ConfigError, which lists the valid names, if there is no such study.
    """
    if unknown := [name for name in names if name not in (*STUDIES, ALL)]:
        raise ConfigError(f"unknown suite {unknown[0]!r}; {choices(unknown[0], (*STUDIES, ALL))}")
    usual = [name for name, study in STUDIES.items() if study.usual]
    return {name: STUDIES[name] for given in names for name in (usual if given == ALL else [given])}


def make_plan(
    studies: dict[str, Study], request: Request, folder: Path, *, any_code: bool = False, failed: bool = False
) -> Plan:
    """Plan the jobs of some studies.

    Args:
        any_code: records of other versions of the code count as finished, too.
        failed: so do those of cases that failed.

    Raises:
        GraspdError: the request names something unknown, or something that no study uses.
    """
    taken = {field for study in studies.values() for field in study.takes}
    for field, usual in vars(Request()).items():
        if getattr(request, field) != usual and field not in taken:
            raise ConfigError(f"{field}: {', '.join(studies)} does not look at it; valid: {', '.join(sorted(taken))}")
    jobs, done = [], {}
    for name, study in studies.items():
        code = bench_version(study.sources)
        for case in study.cases(request):
            jobs.append(Job(name, case, study.run, code, study.alone, study.patience(case)))
            record = read_record(folder, name, case, None if any_code else code, failed=failed)
            if record is not None:
                done[jobs[-1]] = record
    return Plan(folder, tuple(jobs), done)


def run_plan(plan: Plan, processes: int, stop: Callable[[], bool] = lambda: False) -> Iterator[tuple[Job, Record]]:
    """Run what is missing. Yield each job as it ends, and add it to those that are done."""
    for job, record in run_cases(plan.missing, plan.folder, processes, stop):
        plan.done[job] = record
        yield job, record


def records_of(plan: Plan) -> dict[str, list[Record]]:
    """Return the records by study, in the order of the cases."""
    found: dict[str, list[Record]] = {job.study: [] for job in plan.jobs}
    for job in plan.jobs:
        if job in plan.done:
            found[job.study].append(plan.done[job])
    return found


def report_of(plan: Plan, chart: Path | None) -> dict[str, Sequence[str | Picture]]:
    """Return sections of all studies that have records, by marker. Charts are drawn where a path is given."""
    sections: dict[str, Sequence[str | Picture]] = {}
    for name, records in records_of(plan).items():
        study = STUDIES[name]
        shown = [record for record in records if study.failures or not record["error"]]
        if shown:
            sections |= sourced(f"graspd bench {name}", records, study.sections(shown, chart))
    return sections


def faults_of(plan: Plan) -> list[str]:
    """Return what is wrong, a line for each fault."""
    return [
        f"{job.study} {job.case.label}: {fault}"
        for job in plan.jobs
        if job in plan.done
        for fault in STUDIES[job.study].faults(plan.done[job])
    ]
