"""Study `throughput`: verified grasps per second of wall time for a known object, on one and on two threads.

Cases that run at the same time share the cores. So the results are valid only with `--processes 1` on an idle machine.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from graspd_bench.study import ObjectCase, Record, Request, Sections, object_cases
from graspd_core.mesh.shapes import SHAPES
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.types import Verdict
from graspd_dataset.run_records import markdown_table, object_name

THREADS = (1, 2)
# Grasps of a first plan with another seed. This plan caches the object's SDF grid, convex parts and worlds.
_WARM_UP = 2


@dataclass(frozen=True)
class Throughput(ObjectCase):
    """Verified grasps of an object, planned on `threads` threads."""

    threads: int = 1


def throughput_cases(request: Request) -> tuple[Throughput, ...]:
    """Return cases of every shape with three seeds (by default), each on one and on two threads."""
    request = request if request.seeds or request.quick else replace(request, seeds=(0, 1, 2))
    cases = object_cases(request, [f"shape:{name}" for name in SHAPES], 64)
    return tuple(Throughput(**vars(case), threads=threads) for case in cases for threads in THREADS)


def run_throughput(case: Throughput) -> Record:
    """Time a plan without metrics, with caches filled. Return counts of grasps, and the wall and CPU time [s]."""
    hand, scene = case.load()
    before = torch.get_num_threads()
    torch.set_num_threads(case.threads)
    try:
        plan_grasps(scene, hand, count=_WARM_UP, seed=case.seed + 1, preset=case.config, measure=False)
        wall, cpu = time.perf_counter(), time.process_time()
        result = plan_grasps(scene, hand, count=case.count, seed=case.seed, preset=case.config, measure=False)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    finally:
        torch.set_num_threads(before)
    verified = sum(grasp.verdict is Verdict.VERIFIED for grasp in result.tried)
    return {"verified": verified, "tried": len(result.tried), "wall_s": wall, "cpu_s": cpu}


def throughput_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return a table of verified grasps per second, and CPU time for each, by object and number of threads."""
    if not any(record["verified"] for record in records):
        return {}
    headings = ["object", "tried for one verified"]
    for threads in THREADS:
        headings += [f"verified a second, {threads} thread{'s' if threads > 1 else ''}", "CPU ms each"]
    things = list(dict.fromkeys(object_name(row["object"]) for row in records))
    figures = {thing: _figures([row for row in records if object_name(row["object"]) == thing]) for thing in things}
    figures["**mean**"] = np.ma.masked_invalid(list(figures.values())).mean(axis=0).filled(np.nan).tolist()
    body = [[name, f"{tried:.2f}", *(f"{value:.1f}" for value in others)] for name, (tried, *others) in figures.items()]
    body = [[cell.replace("nan", "–") if place else cell for place, cell in enumerate(row)] for row in body]
    return {"throughput": [markdown_table(headings, body)]}


def _figures(rows: Sequence[Record]) -> list[float]:
    """Return tries per verified grasp, then for one and two threads: verified grasps per second, CPU ms per grasp."""
    found = [sum(row["tried"] for row in rows) / (sum(row["verified"] for row in rows) or np.nan)]
    for threads in THREADS:
        here = [row for row in rows if row["threads"] == threads]
        verified, wall, cpu = (sum(row[key] for row in here) for key in ("verified", "wall_s", "cpu_s"))
        found += [verified / wall, 1e3 * cpu / (verified or np.nan)] if here else [np.nan, np.nan]
    return found
