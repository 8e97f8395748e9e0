"""Cells of the suites, and the functions that run them. A cell is one run with settings, object, hand and seed.

Trials have the names that `--trials` accepts (docs/metrics.md). A result's name ends with its unit, such as `_cm`.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from graspd_bench.bullet.bullet_hold import bullet_hold_trial
from graspd_bench.bullet.bullet_world import BulletWorld, build_bullet_world, bullet_available, bullet_displacement
from graspd_bench.study import PROTOCOL_MASS, Case, Record, Request, raw_grasps
from graspd_bench.trials import gravity_trial
from graspd_core.errors import ConfigError, choices
from graspd_core.hands.library import hand_hash, load_hand
from graspd_core.hands.model import HandModel
from graspd_core.mesh.shapes import object_hash
from graspd_core.optimize.closed_form.closed_form_config import ClosedFormConfig
from graspd_core.optimize.plan_config import PlanConfig, to_mapping
from graspd_core.perception.load_scene import load_scene
from graspd_core.perception.scene import ObjectModel, object_parts
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.types import Grasp, Progress, Stage, TrialResult, TriangleMesh, Verdict
from graspd_core.verify.hold_trial import TRIALS as NOISY_TRIALS
from graspd_core.verify.hold_trial import hold_trial, noisy_share, pose_errors
from graspd_core.verify.metrics import measure
from graspd_core.verify.prepared_grasp import make_metrics_context
from graspd_core.verify.world import PROTOCOLS, Protocol, World, build_world
from graspd_dataset.run_records import Stopwatch, object_name

Figures = dict[str, Any]
# Makes a trial of one hand and object, given with its convex parts. The trial returns the results of a grasp by name.
MakeTrial = Callable[[HandModel, ObjectModel, Sequence[TriangleMesh]], Callable[[Grasp], Figures]]


def _in_mujoco(figures: Callable[[World, Grasp, Protocol], Figures], name: str = "standard") -> MakeTrial:
    protocol = PROTOCOLS[name]

    def make(hand: HandModel, target: ObjectModel, parts: Sequence[TriangleMesh]) -> Callable[[Grasp], Figures]:
        world = build_world(hand, target, parts, protocol)
        return lambda grasp: figures(world, grasp, protocol)

    return make


def _in_bullet(figures: Callable[[BulletWorld, Grasp], Figures]) -> MakeTrial:
    def make(hand: HandModel, target: ObjectModel, parts: Sequence[TriangleMesh]) -> Callable[[Grasp], Figures]:
        if not bullet_available():
            return lambda grasp: {}
        world = build_bullet_world(hand, target, parts)
        return lambda grasp: figures(world, grasp)

    return make


def _hold(world: World, grasp: Grasp, protocol: Protocol) -> Figures:
    return _figures(hold_trial(world, grasp, protocol))


def _figures(result: TrialResult) -> Figures:
    return {
        "passed": result.passed,
        "displacement_cm": result.displacement * 100,
        "rotation_deg": float(np.rad2deg(result.rotation)),
        "reason": result.reason,
    }


TRIALS: Mapping[str, MakeTrial] = {
    "standard": _in_mujoco(_hold),
    "hard": _in_mujoco(_hold, "hard"),
    "sd": _in_bullet(lambda world, grasp: {"displacement_cm": bullet_displacement(world, grasp.grasp) * 100}),
    "gravity": _in_mujoco(lambda *trial: {"displacement_cm": gravity_trial(*trial) * 100}),
    "noisy": _in_mujoco(lambda *trial: {"share": noisy_share(*trial, errors=pose_errors(0, NOISY_TRIALS))}),
    "bullet": _in_bullet(lambda world, grasp: _figures(bullet_hold_trial(world, grasp, PROTOCOLS["standard"]))),
}
# Default trials of a raw cell. The noisy trial takes eight times as long as another trial, so it is not among them.
USUAL = ("standard", "hard", "sd", "gravity")


def requested_trials(request: Request, usual: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the requested trials, each once, in the order of `TRIALS`. Default: `usual`."""
    for name in request.trials:
        if name not in TRIALS:
            raise ConfigError(f"unknown trial {name!r}; {choices(name, TRIALS)}")
    return tuple(name for name in TRIALS if name in request.trials) or usual


Kind = Literal["raw", "verified", "pace", "start"]
_RUNS = 3

# Program of a new process, which imports the libraries and plans one grasp, like the command `graspd synthesize`.
_FRESH = """
import sys, time
import torch; torch.set_num_threads(1)
from graspd_core.optimize.plan_config import load_preset
from graspd_core.hands.library import load_hand
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.perception.load_scene import load_scene
source, hand, seed = sys.argv[1:]
result = plan_grasps(load_scene(source, mass=0.1), load_hand(hand), count=1, seed=int(seed))
print(str(result.grasps[0].verdict) == "verified" if result.grasps else False, time.process_time())
"""


@dataclass(frozen=True)
class Cell(Case):
    """One run of the suites.

    Attributes:
        kind: "raw" tries every raw grasp, and "verified" plans verified grasps. "pace" times the optimiser alone, and
            "start" times the first verified grasp of a new process.
        name: name of the settings: a preset, a sweep value, or a hand.
        settings: the settings.
        object: a mesh file or shape:NAME.
        hand: name or path of the hand.
        seed: random seed of the method.
        count: number of requested grasps.
        trials: names of the trials of every raw grasp.
    """

    kind: Kind
    name: str
    settings: PlanConfig
    object: str
    hand: str
    seed: int
    count: int
    trials: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        return f"{self.kind} {self.name} {object_name(self.object)} seed {self.seed}"

    def inputs(self) -> Record:
        return {
            **{name: getattr(self, name) for name in ("kind", "name", "seed", "count")},
            "object": object_hash(self.object),
            "hand": hand_hash(self.hand),
            "settings": to_mapping(self.settings),
            "trials": sorted(self.trials),
        }

    def recorded(self) -> Record:
        return {
            **{name: getattr(self, name) for name in ("kind", "name", "hand", "seed", "count")},
            "object": object_name(self.object),
            "method": self.settings.method,
            "settings": to_mapping(self.settings),
        }


def run_cell(cell: Cell) -> Record:
    """Run a cell of any kind. Return its results."""
    return {"raw": run_raw, "verified": run_verified, "pace": run_pace, "start": run_start}[cell.kind](cell)


def run_raw(cell: Cell) -> dict[str, Any]:
    """Plan raw grasps (not filtered by trials), try and measure them. Return counts, times, and a result per grasp."""
    stopwatch = Stopwatch()
    hand = load_hand(cell.hand, candidates=cell.settings.problem.fine_candidates)
    with stopwatch("scene"):
        scene = load_scene(cell.object, mass=PROTOCOL_MASS, resolution=cell.settings.resolution)
    with stopwatch("optimise"):
        grasps = raw_grasps(scene, hand, cell.settings, cell.count, cell.seed)
    with stopwatch("parts"):
        parts = object_parts(scene.object)
    results: list[dict[str, Any]] = [{"score": grasp.score, "links": len(grasp.contacts)} for grasp in grasps]
    # If there are no grasps, no trial is run.
    first: dict[str, float] | None = None
    for name in cell.trials if grasps else ():
        with stopwatch(f"world {name}"):
            trial = TRIALS[name](hand, scene.object, parts)
        for grasp, result in zip(grasps, results, strict=True):
            with stopwatch(name):
                result[name] = trial(grasp)
            if name == "standard" and first is None and result[name]["passed"]:
                # `plan_grasps` builds the convex parts in parallel to the optimiser. Here their CPU seconds count too.
                first = {"cpu": sum(stopwatch.cpu.values()), "wall": sum(stopwatch.wall.values())}
    context = make_metrics_context(scene.object, hand)
    for grasp, result in zip(grasps, results, strict=True):
        with stopwatch("metrics"):
            result["metrics"] = dict(measure(context, grasp.grasp))
    # Without the standard trial, nothing is known about how many hold.
    held = {"held": sum(bool(r.get("standard", {}).get("passed")) for r in results)}
    return {
        "given": len(grasps),
        **(held if "standard" in cell.trials else {}),
        "first_verified": first,
        "cpu": stopwatch.cpu,
        "wall": stopwatch.wall,
        "parts": len(parts),
        "grasps": results,
    }


class _First:
    """Progress hook that records the time of the first verified grasp, and the number of optimiser rounds."""

    def __init__(self, began: dict[str, float]) -> None:
        self.began, self.first, self.rounds, self._stage = began, None, 0, Stage.LOAD

    def __call__(self, progress: Progress) -> None:
        if progress.stage is Stage.OPTIMISE and self._stage is not Stage.OPTIMISE:
            self.rounds += 1
        self._stage = progress.stage
        if progress.verified and self.first is None:
            self.first = {name: value - self.began[name] for name, value in _now().items()}


def run_verified(cell: Cell) -> dict[str, Any]:
    """Plan verified grasps. Return their number, the CPU and wall time of the whole run [s], and all verdicts."""
    hand = load_hand(cell.hand)
    began = _now()
    first = _First(began)
    scene = load_scene(cell.object, mass=PROTOCOL_MASS)
    result = plan_grasps(scene, hand, count=cell.count, seed=cell.seed, preset=cell.settings, progress=first)
    taken = {name: value - began[name] for name, value in _now().items()}
    return {
        "given": len(result.tried),
        "held": sum(grasp.verdict is Verdict.VERIFIED for grasp in result.tried),
        "first_verified": first.first,
        "rounds": first.rounds,
        "outcome": result.outcome.name,
        "cpu": {"total": taken["cpu"]},
        "wall": {"total": taken["wall"], "optimise": result.timing.optimise, "verify": result.timing.verify},
        "grasps": [{"verdict": str(grasp.verdict), "reason": grasp.reason} for grasp in result.tried],
    }


def _now() -> dict[str, float]:
    return {"cpu": time.process_time(), "wall": time.perf_counter()}


def run_pace(cell: Cell) -> dict[str, Any]:
    """Time a batch of raw grasps. Return CPU and wall time [s], and the number of optimiser steps, `grasp_steps`.

    Three batches are timed, after an untimed batch. The times are those of the fastest batch.
    """
    hand = load_hand(cell.hand, candidates=cell.settings.problem.fine_candidates)
    scene = load_scene(cell.object, mass=PROTOCOL_MASS, resolution=cell.settings.resolution)
    runs: list[Stopwatch] = []
    for run in range(_RUNS + 1):
        stopwatch = Stopwatch()
        with stopwatch("optimise"):
            raw_grasps(scene, hand, cell.settings, cell.count, cell.seed + run)
        runs.append(stopwatch)
    best = min(runs[1:], key=lambda stopwatch: stopwatch.cpu["optimise"])
    return {"cpu": best.cpu, "wall": best.wall, "grasp_steps": grasp_steps(cell)}


def grasp_steps(cell: Cell) -> int | None:
    """Return the number of optimiser steps of a batch, summed over starts. None if the method is not `closed_form`."""
    s = cell.settings.settings
    if not isinstance(s, ClosedFormConfig):
        return None
    kept = s.keep_per_grasp * cell.count
    return round(s.starts_per_grasp * cell.count * s.explore_steps + kept * (s.refine_steps + s.polish_steps))


def run_start(cell: Cell) -> dict[str, Any]:
    """Start a new process that plans a verified grasp. Return the CPU and wall time [s]. The disk cache is off."""
    environment = {**os.environ, "GRASPD_CACHE": "off", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", _FRESH, cell.object, cell.hand, str(cell.seed)]
    began = time.perf_counter()
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    wall = time.perf_counter() - began
    verified, cpu = done.stdout.split()
    return {"given": 1, "held": int(verified == "True"), "cpu": {"total": float(cpu)}, "wall": {"total": wall}}
