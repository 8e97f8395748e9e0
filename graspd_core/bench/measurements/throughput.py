"""The optimiser alone, and the first verified grasp of a process that has just begun."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from typing import Any

from graspd_core.bench.measurements.measurement import Cell
from graspd_core.bench.stopwatch import Stopwatch
from graspd_core.hands.library import load_hand
from graspd_core.methods.candidates import find_candidates
from graspd_core.methods.closed_form.closed_form_config import ClosedFormConfig
from graspd_core.methods.loop import Hooks
from graspd_core.scene.load_scene import load_scene

_RUNS = 3

# What `graspd synthesize` does, without a cache, from the first import on.
_FRESH = """
import sys, time
import torch; torch.set_num_threads(1)
from graspd_core.methods.plan_config import load_preset
from graspd_core.hands.library import load_hand
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.scene.load_scene import load_scene
source, hand, seed = sys.argv[1:]
result = plan_grasps(load_scene(source), load_hand(hand), count=1, seed=int(seed))
print(str(result.grasps[0].verdict) == "verified" if result.grasps else False, time.process_time())
"""


def run_pace(cell: Cell) -> dict[str, Any]:
    """CPU seconds of one batch, the least of three after one that is not counted, and what a grasp-step of it costs.

    A grasp-step is one step of one start: what the optimiser does most of.
    """
    hand = load_hand(cell.hand, candidates=cell.settings.problem.fine_candidates)
    scene = load_scene(cell.object, resolution=cell.settings.resolution)
    runs: list[Stopwatch] = []
    for run in range(_RUNS + 1):
        stopwatch = Stopwatch()
        with stopwatch("optimise"):
            find_candidates(scene, hand, count=cell.count, seed=cell.seed + run, config=cell.settings, hooks=Hooks())
        runs.append(stopwatch)
    best = min(runs[1:], key=lambda stopwatch: stopwatch.cpu["optimise"])
    return {"cpu": best.cpu, "wall": best.wall, "grasp_steps": grasp_steps(cell)}


def grasp_steps(cell: Cell) -> int | None:
    """Steps times starts of one batch of the closed form; None for other methods."""
    s = cell.settings.settings
    if not isinstance(s, ClosedFormConfig):
        return None
    kept = s.keep_per_grasp * cell.count
    return round(s.starts_per_grasp * cell.count * s.explore_steps + kept * (s.refine_steps + s.polish_steps))


def run_start(cell: Cell) -> dict[str, Any]:
    """Seconds from the start of a process to its first verified grasp, with nothing remembered on disk."""
    environment = {**os.environ, "GRASPD_CACHE": "off", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", _FRESH, cell.object, cell.hand, str(cell.seed)]
    began = time.perf_counter()
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    wall = time.perf_counter() - began
    verified, cpu = done.stdout.split()
    return {"given": 1, "held": int(verified == "True"), "cpu": {"total": float(cpu)}, "wall": {"total": wall}}
