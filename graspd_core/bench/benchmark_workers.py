"""Cells on worker processes: each does one after the other, alone in its process, and a death costs one cell."""

from __future__ import annotations

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from multiprocessing import connection, get_context, parent_process
from multiprocessing.process import BaseProcess
from pathlib import Path

from graspd_core.bench.measurements.measurement import Cell
from graspd_core.bench.measurements.run_measurement import asked, failure, run_cell
from graspd_core.bench.result_store import Record, write_cell

# How often a stop is looked for [s].
_POLL = 0.2
# One thread each, so that CPU seconds are comparable; nothing remembered on disk, so that every cell builds its own.
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "GRASPD_CACHE": "off"}


def run_cells(
    cells: Sequence[Cell], folder: Path, code: str, processes: int, stop: Callable[[], bool] = lambda: False
) -> Iterator[tuple[Cell, Record]]:
    """Run cells on `processes` workers and yield each as it ends; its record is on disk by then.

    Ends early, its workers killed, once `stop` is true. A worker that dies (out of memory, say) is a record with that
    error, and another takes its place.
    """
    waiting = deque(cells)
    idle: list[_Worker] = []
    busy: dict[connection.Connection, tuple[_Worker, Cell]] = {}
    try:
        while (waiting or busy) and not stop():
            while waiting and len(busy) < processes:
                worker, cell = idle.pop() if idle else _Worker(folder, code), waiting.popleft()
                busy[worker.pipe] = (worker, cell)
                with suppress(BrokenPipeError):
                    worker.pipe.send(cell)
            for pipe in connection.wait(list(busy), timeout=_POLL):
                worker, cell = busy.pop(pipe)  # pyright: ignore[reportArgumentType]
                try:
                    record = worker.pipe.recv()
                    idle.append(worker)
                except (EOFError, ConnectionResetError):
                    worker.process.join()
                    died = RuntimeError(f"its process died with exit code {worker.process.exitcode}")
                    record = {**asked(cell, code), **failure(died)}
                    write_cell(folder, cell, record)
                yield cell, record
    finally:
        for worker in [*idle, *(worker for worker, _ in busy.values())]:
            worker.process.kill()
            worker.process.join()


class _Worker:
    """A spawned process and the pipe to it."""

    def __init__(self, folder: Path, code: str) -> None:
        context = get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(target=_work, args=(theirs, folder, code), daemon=False)
        before = {name: os.environ.get(name) for name in ENVIRONMENT}
        os.environ.update(ENVIRONMENT)
        try:
            self.process.start()
        finally:
            for name, value in before.items():
                os.environ.pop(name) if value is None else os.environ.update({name: value})
        theirs.close()


def _work(pipe: connection.Connection, folder: Path, code: str) -> None:
    """Do cells until there are no more."""
    # A Ctrl-C reaches the whole group of processes; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Libraries greet on stdout, which is the parent's for its tables.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _warm_up()
    with suppress(EOFError, BrokenPipeError):
        while True:
            cell = pipe.recv()
            record = run_cell(cell, code)
            write_cell(folder, cell, record)
            pipe.send(record)


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _warm_up() -> None:
    """First-use work of the libraries, which no cell is to pay for."""
    import torch

    from graspd_core.hands.library import load_hand
    from graspd_core.planning.plan_grasps import plan_grasps
    from graspd_core.scene.load_scene import load_scene

    torch.set_num_threads(1)
    plan_grasps(load_scene("shape:sphere"), load_hand("allegro_right"), count=1, preset="fast")
