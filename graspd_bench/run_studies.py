"""Runs of studies: make the cases, skip finished cases, run the other cases, and collect sections for Markdown pages.

Each worker process runs one case after another. If a worker dies, only its current case is lost.
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

# Interval at which a run checks whether to stop [s].
_POLL = 0.2
# One thread per process makes CPU seconds comparable. The disk cache is off, so every case computes everything anew.
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "GRASPD_CACHE": "off"}


@dataclass(frozen=True)
class Job:
    """A case of a study that is to be run.

    Attributes:
        study: name of the study.
        case: the case.
        run: function that runs the case.
        code: code version that the record will name.
        alone: whether the case gets a new process, without libraries and random states of earlier cases.
        patience: seconds until the case counts as hung.
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
    """Run jobs on `processes` workers. Yield each job and its record when the job ends. The record is then on disk.

    If `stop` returns true, kill the workers and end early. If a worker dies (for example, out of memory) or hangs,
    write a record with that error and start another worker.
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
    """A worker process, the pipe to it, and its current job."""

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
        """Return the record that the worker sends. If the worker died, write and return a record of the failure."""
        try:
            return self.pipe.recv()
        except (EOFError, ConnectionResetError):
            self.process.join()
            died = RuntimeError(f"its process died with exit code {self.process.exitcode}")
            return self._write(folder, failure(died, "died"))

    def lost(self, folder: Path) -> Record:
        """Kill the worker because it hung. Write and return a record of the timeout."""
        self.end()
        return self._write(folder, failure(TimeoutError(f"did not end within {self.job.patience:.0f} s"), "hung"))

    def end(self) -> None:
        self.process.kill()
        self.process.join()

    def _write(self, folder: Path, failed: Record) -> Record:
        record = {**head(self.job.study, self.job.case, self.job.code), **failed}
        write_record(folder, self.job.study, self.job.case, record)
        return record


def _work(pipe: connection.Connection, folder: Path, warm: bool) -> None:
    """Run jobs from a pipe until the pipe closes. Write each record and send it back."""
    # Ctrl-C reaches the whole process group. Only the parent handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Libraries print greetings to stdout, where the parent prints its tables.
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
    """Run a job in this process and return its record. An exception becomes an error record and is not raised.

    Caches in memory are cleared first, so no case uses results of another case.
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
    """Set one torch thread. If `warm`, plan once, so that the first case does not pay for loading libraries."""
    import torch

    torch.set_num_threads(1)
    if warm:
        from graspd_core.hands.library import load_hand
        from graspd_core.perception.load_scene import load_scene
        from graspd_core.planning.plan_grasps import plan_grasps

        plan_grasps(load_scene("shape:sphere"), load_hand("allegro_right"), count=1, preset="fast")


# Name for all studies whose field `usual` is true.
ALL = "all"


@dataclass(frozen=True)
class Plan:
    """All jobs of a command, the folder of the records, and the records of finished jobs."""

    folder: Path
    jobs: tuple[Job, ...]
    done: dict[Job, Record]

    @property
    def missing(self) -> tuple[Job, ...]:
        return tuple(job for job in self.jobs if job not in self.done)

    def seconds(self, processes: int) -> float:
        """Return the estimated wall time of the missing cases [s], if each process has an idle core."""
        return sum(STUDIES[job.study].seconds(job.case) for job in self.missing) / processes


def studies_of(names: Sequence[str]) -> dict[str, Study]:
    """Return the named studies, each once. `all` stands for all studies whose field `usual` is true.

    Raises ConfigError: there is no such study. The message lists the valid names.
    """
    if unknown := [name for name in names if name not in (*STUDIES, ALL)]:
        raise ConfigError(f"unknown study {unknown[0]!r}; {choices(unknown[0], (*STUDIES, ALL))}")
    usual = [name for name, study in STUDIES.items() if study.usual]
    return {name: STUDIES[name] for given in names for name in (usual if given == ALL else [given])}


def make_plan(
    studies: dict[str, Study], request: Request, folder: Path, *, any_code: bool = False, failed: bool = False
) -> Plan:
    """List the jobs of some studies, and read the records of the finished jobs.

    Args:
        any_code: whether records of other code versions count as finished.
        failed: whether records of failed cases count as finished.

    Raises:
        GraspdError: the request has an unknown name, or a field that none of the studies uses.
    """
    taken = {field for study in studies.values() for field in study.takes}
    for field, usual in vars(Request()).items():
        if getattr(request, field) != usual and field not in taken:
            raise ConfigError(f"{field}: not used by {', '.join(studies)}; valid: {', '.join(sorted(taken))}")
    jobs, done = [], {}
    for name, study in studies.items():
        code = bench_version(study.sources)
        # A seed or an object that is given twice counts once.
        for case in dict.fromkeys(study.cases(request)):
            jobs.append(Job(name, case, study.run, code, study.alone, study.patience(case)))
            record = read_record(folder, name, case, None if any_code else code, failed=failed)
            if record is not None:
                done[jobs[-1]] = record
    return Plan(folder, tuple(jobs), done)


def run_plan(plan: Plan, processes: int, stop: Callable[[], bool] = lambda: False) -> Iterator[tuple[Job, Record]]:
    """Run the missing jobs. Yield each job and its record when the job ends. Add the record to `plan.done`."""
    for job, record in run_cases(plan.missing, plan.folder, processes, stop):
        plan.done[job] = record
        yield job, record


def records_of(plan: Plan) -> dict[str, list[Record]]:
    """Return the finished records of each study, in the order of the study's cases."""
    found: dict[str, list[Record]] = {job.study: [] for job in plan.jobs}
    for job in plan.jobs:
        if job in plan.done:
            found[job.study].append(plan.done[job])
    return found


def report_of(plan: Plan, chart: Path | None) -> dict[str, Sequence[str | Picture]]:
    """Return the page sections of all studies with records, by the marker's name. If `chart` is given, draw charts."""
    sections: dict[str, Sequence[str | Picture]] = {}
    for name, records in records_of(plan).items():
        study = STUDIES[name]
        shown = [record for record in records if study.failures or not record["error"]]
        if shown:
            sections |= sourced(f"graspd bench {name}", records, study.sections(shown, chart))
    return sections


def faults_of(plan: Plan) -> list[str]:
    """Return what is wrong with the results of all finished jobs, one line per fault."""
    return [
        f"{job.study} {job.case.label}: {fault}"
        for job in plan.jobs
        if job in plan.done
        for fault in STUDIES[job.study].faults(plan.done[job])
    ]
