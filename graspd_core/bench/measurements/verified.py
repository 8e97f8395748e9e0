"""Verified grasps, planned by `plan_grasps` as a user's are: rounds, trials and all."""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import Any

from graspd_core.bench.measurements.measurement import Cell
from graspd_core.hands.library import load_hand
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.scene.load_scene import load_scene
from graspd_core.types import Progress, Stage, Verdict


class _First:
    """Notes when the first grasp was verified, and how often the optimiser was started."""

    def __init__(self, began: dict[str, float]) -> None:
        self.began, self.first, self.rounds, self._stage = began, None, 0, Stage.LOAD

    def __call__(self, progress: Progress) -> None:
        if progress.stage is Stage.OPTIMISE and self._stage is not Stage.OPTIMISE:
            self.rounds += 1
        self._stage = progress.stage
        if progress.verified and self.first is None:
            self.first = {name: value - self.began[name] for name, value in _now().items()}


def run_verified(cell: Cell) -> dict[str, Any]:
    """Figures of one planned run: how many of `count` were verified, and what all of it cost."""
    hand = load_hand(cell.hand)
    began = _now()
    told = _First(began)
    scene = load_scene(cell.object)
    result = plan_grasps(scene, hand, count=cell.count, seed=cell.seed, preset=cell.settings, progress=told)
    taken = {name: value - began[name] for name, value in _now().items()}
    return {
        "given": len(result.grasps),
        "held": sum(grasp.verdict is Verdict.VERIFIED for grasp in result.grasps),
        "first_verified": told.first,
        "rounds": told.rounds,
        "outcome": result.outcome.name,
        "audits": asdict(result.audits),
        "cpu": {"total": taken["cpu"]},
        "wall": {"total": taken["wall"], "optimise": result.timing.optimise, "verify": result.timing.verify},
        "grasps": [{"verdict": str(grasp.verdict), "reason": grasp.reason} for grasp in result.grasps],
    }


def _now() -> dict[str, float]:
    return {"cpu": time.process_time(), "wall": time.perf_counter()}
