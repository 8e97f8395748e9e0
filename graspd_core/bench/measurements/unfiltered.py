"""Raw grasps: the first `count` of a method's own ranking, every one measured and tried, none filtered by a trial."""

from __future__ import annotations

from typing import Any

from graspd_core.bench.measurements.benchmark_trials import TRIALS, Tried
from graspd_core.bench.measurements.measurement import Cell
from graspd_core.bench.object_case import raw_grasps
from graspd_core.bench.stopwatch import Stopwatch
from graspd_core.hands.library import load_hand
from graspd_core.metrics.measure import measure
from graspd_core.metrics.metrics_context import make_metrics_context
from graspd_core.scene.load_scene import load_scene
from graspd_core.scene.scene import object_parts


def run_raw(cell: Cell) -> dict[str, Any]:
    """Figures of one raw cell. Grasps that a method does not find are missing from the list, and count as failed."""
    stopwatch = Stopwatch()
    hand = load_hand(cell.hand, candidates=cell.settings.problem.fine_candidates)
    with stopwatch("scene"):
        scene = load_scene(cell.object, resolution=cell.settings.resolution)
    with stopwatch("optimise"):
        grasps = raw_grasps(scene, hand, cell.settings, cell.count, cell.seed)
    with stopwatch("parts"):
        tried = Tried(hand, scene.object, object_parts(scene.object))
    results: list[dict[str, Any]] = [{"score": grasp.score, "links": len(grasp.contacts)} for grasp in grasps]
    # A method that finds nothing has paid for its scene and its search only.
    first: dict[str, float] | None = None
    for name in cell.trials if grasps else ():
        with stopwatch(f"world {name}"):
            trial = TRIALS[name](tried)
        for grasp, result in zip(grasps, results, strict=True):
            with stopwatch(name):
                result[name] = trial(grasp)
            if name == "standard" and first is None and result[name]["passed"]:
                # The parts are built beside the optimiser in `plan_grasps`: in CPU seconds they count all the same.
                first = {"cpu": sum(stopwatch.cpu.values()), "wall": sum(stopwatch.wall.values())}
    context = make_metrics_context(scene.object, hand)
    for grasp, result in zip(grasps, results, strict=True):
        with stopwatch("metrics"):
            result["metrics"] = dict(measure(context, grasp.grasp))
    return {
        "given": len(grasps),
        "held": sum(bool(r.get("standard", {}).get("passed")) for r in results),
        "first_verified": first,
        "cpu": stopwatch.cpu,
        "wall": stopwatch.wall,
        "parts": len(tried.parts),
        "grasps": results,
    }
