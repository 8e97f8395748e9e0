"""Measure the overhead of `graspd dataset`: make the same blocks in a plain loop, on one Ray worker, and on two.

    dataset_overhead.py [--blocks 8] [--count 64] [--object shape:mug]

A block is one call of `plan_grasps`. Wall time shows how the work scales on an idle machine. CPU time shows the cost on
any machine, and includes all child processes. The time to start Ray and its workers has its own column.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from tempfile import TemporaryDirectory

import psutil
import torch

from graspd_core import load_hand, load_scene, plan_grasps
from graspd_core.runtime.worker_process import resident_mb
from graspd_dataset.blocks import Block, DatasetRequest, blocks_of
from graspd_dataset.dataset_store import DatasetStore
from graspd_dataset.guarded_calls import Limits
from graspd_dataset.ray_engine import RayEngine, ray_running
from graspd_dataset.run_dataset import run_blocks
from graspd_dataset.run_records import markdown_table


def loop(blocks: Sequence[Block]) -> tuple[float, float, int]:
    """Run `plan_grasps` over the blocks. Return wall and CPU time [s], and the number of rows."""
    scene, hand = load_scene(blocks[0].object.source), load_hand(blocks[0].hand)
    plan_grasps(scene, hand, count=2, preset=blocks[0].config)
    wall, cpu, rows = time.perf_counter(), time.process_time(), 0
    for block in blocks:
        rows += len(plan_grasps(scene, hand, count=block.count, seed=block.seed, preset=block.config).tried)
    return time.perf_counter() - wall, time.process_time() - cpu, rows


def family_cpu() -> dict[int, float]:
    """Return the CPU time of this process and its descendants, by process id [s]."""
    taken = {}
    for process in [psutil.Process(), *psutil.Process().children(recursive=True)]:
        try:
            taken[process.pid] = sum(process.cpu_times()[:2])
        except psutil.Error:
            continue
    return taken


def on_ray(blocks: Sequence[Block], first: Sequence[Block], workers: int) -> tuple[float, float, int, float, float]:
    """Run blocks on warm workers. Return wall time, CPU time [s], rows, time to start [s], memory of children [MB]."""
    with TemporaryDirectory() as folder, ray_running(None, workers) as ray:
        begin = time.perf_counter()
        engine = RayEngine(ray, DatasetStore(folder), Limits(), ship=False)
        list(run_blocks(first[: 2 * workers], engine))
        begin = time.perf_counter() - begin
        before, wall = family_cpu(), time.perf_counter()
        rows = sum(report.rows for _, report in run_blocks(blocks, engine))
        wall, after = time.perf_counter() - wall, family_cpu()
        held = sum(resident_mb(process.pid) for process in psutil.Process().children(recursive=True))
    return wall, sum(after.values()) - sum(before.get(pid, 0.0) for pid in after), rows, begin, held


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blocks", type=int, default=8)
    parser.add_argument("--count", type=int, default=64)
    parser.add_argument("--object", default="shape:mug")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    request = DatasetRequest((options.object,), per_object=options.blocks * options.count, block=options.count)
    blocks = blocks_of(request)
    first = blocks_of(DatasetRequest((options.object,), per_object=8, block=2, seed=1000))
    body = []
    wall, cpu, rows = loop(blocks)
    body.append(("plan_grasps in a loop", f"{wall:.1f}", f"{cpu:.1f}", f"{rows}", "", ""))
    for workers in (1, 2):
        wall, cpu, rows, begin, held = on_ray(blocks, first, workers)
        name = f"{workers} worker{'s' * (workers > 1)}"
        body.append((name, f"{wall:.1f}", f"{cpu:.1f}", f"{rows}", f"{begin:.1f}", f"{held:.0f}"))
    print(markdown_table(("", "wall s", "CPU s", "rows", "to begin s", "MB"), body))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
