"""One cell: a kind of run, settings, an object, a hand and a seed; and what is run for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from graspd_core.bench.study import Case, Record, hand_hash, object_hash, thing_name
from graspd_core.methods.plan_config import PlanConfig, to_mapping

Kind = Literal["raw", "verified", "pace", "start"]


@dataclass(frozen=True)
class Cell(Case):
    """One run of the suites.

    Attributes:
        kind: what is run: "raw" grasps each tried, "verified" ones planned, "pace" of the optimiser alone, "start":
            the first verified grasp of a fresh process.
        name: of the settings: a preset, or a sweep value.
        settings: the settings themselves.
        object: a mesh file or shape:NAME.
        hand: name or path.
        seed: of the method.
        count: grasps asked for.
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
        return f"{self.kind} {self.name} {thing_name(self.object)} seed {self.seed}"

    def asked(self) -> Record:
        return {
            **{name: getattr(self, name) for name in ("kind", "name", "seed", "count")},
            "object": object_hash(self.object),
            "hand": hand_hash(self.hand),
            "settings": to_mapping(self.settings),
            "trials": sorted(self.trials),
        }

    def shown(self) -> Record:
        return {
            **{name: getattr(self, name) for name in ("kind", "name", "hand", "seed", "count")},
            "object": thing_name(self.object),
            "method": self.settings.method,
            "settings": to_mapping(self.settings),
        }


def run_cell(cell: Cell) -> Record:
    """Figures of one cell."""
    from graspd_core.bench.measurements.throughput import run_pace, run_start
    from graspd_core.bench.measurements.unfiltered import run_raw
    from graspd_core.bench.measurements.verified import run_verified

    kinds = {"raw": run_raw, "verified": run_verified, "pace": run_pace, "start": run_start}
    return kinds[cell.kind](cell)
