"""Records to figures: for every name (a preset, a sweep value) and object, then for every name over its objects."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from graspd_core.bench.study import Record
from graspd_core.metrics.metric_registry import METRICS

# Shares of grasps that passed a trial; a grasp that was not found did not pass.
TRIAL_FIGURES = ("standard", "hard", "noisy")
# Displacements that trials measured [cm], by figure: which trial.
_DISPLACEMENTS = {"sd_cm": "sd", "gravity_cm": "gravity"}


@dataclass(frozen=True)
class Row:
    """Figures of one name on one object, all seeds together; None where there is none.

    Attributes:
        asked: grasps asked for.
        given: grasps found.
        held: grasps that passed the standard hold trial.
        spent: CPU seconds of the optimiser and of those trials.

    `values` has the medians of `_grasp_figures` over the grasps, the shares of `TRIAL_FIGURES` of the grasps asked for,
    and seconds: `cpu_per_grasp` of the optimiser, `cpu_with_scene`, `cpu_per_verified` (`spent` over `held`),
    `first_cpu` and `first_wall` until the first verified grasp.
    """

    name: str
    object: str
    method: str
    asked: int
    given: int
    held: int
    spent: float
    values: dict[str, float | None]


@dataclass(frozen=True)
class Spread:
    """Median, quartiles and mean over objects, and how many there were."""

    median: float
    low: float
    high: float
    mean: float
    objects: int


def rows(records: Iterable[Record], kind: str = "raw") -> list[Row]:
    """A row for every name and object, in the order of the records. Cells that raised are left out."""
    groups: dict[tuple[str, str], list[Record]] = {}
    # Where nothing was found there is no trace of the trials: those of the other records are meant, and the first.
    ran = {TRIAL_FIGURES[0]}
    for record in records:
        if record.get("kind") == kind and not record["error"]:
            groups.setdefault((record["name"], record["object"]), []).append(record)
            ran.update(trial for grasp in record["grasps"] for trial in TRIAL_FIGURES if trial in grasp)
    return [_row(group, ran) for group in groups.values()]


def _row(group: Sequence[Record], ran: Collection[str]) -> Row:
    asked, held = sum(r["count"] for r in group), sum(r["held"] for r in group)
    grasps = [grasp for r in group for grasp in r["grasps"]]
    figures = [_grasp_figures(grasp) for grasp in grasps]
    names = _grasp_figures({})
    values: dict[str, float | None] = {name: _median(figure[name] for figure in figures) for name in names}
    for trial in TRIAL_FIGURES:
        outcomes = [_inner(grasp, trial, "share" if trial == "noisy" else "passed") for grasp in grasps]
        tried = any(outcome is not None for outcome in outcomes) if grasps else trial in ran
        values[trial] = sum(outcome or 0.0 for outcome in outcomes) / asked if tried else None
    # Planned runs have one total; raw ones count what a plan would have spent, the best of trials only.
    spent = sum(r["cpu"].get("total", r["cpu"].get("optimise", 0.0) + r["cpu"].get("standard", 0.0)) for r in group)
    values["cpu_per_grasp"] = sum(r["cpu"].get("optimise", r["cpu"].get("total", 0.0)) for r in group) / asked
    prepared = sum(r["cpu"].get("scene", 0.0) for r in group)
    values["cpu_with_scene"] = values["cpu_per_grasp"] + prepared / asked
    values["cpu_per_verified"] = spent / held if held else None
    for clock in ("cpu", "wall"):
        values[f"first_{clock}"] = _median((r.get("first_verified") or {}).get(clock) for r in group)
    values["peak_mb"] = max((r["peak_mb"] for r in group), default=None)
    values["rounds"] = _median(float(r["rounds"]) if "rounds" in r else None for r in group)
    one, given = group[0], sum(r["given"] for r in group)
    return Row(one["name"], one["object"], one["method"], asked, given, held, spent, values)


def spread(rows: Iterable[Row], figure: str) -> Spread | None:
    """A figure's spread over objects; None where no object has it."""
    values = [value for row in rows if (value := row.values.get(figure)) is not None]
    if not values:
        return None
    low, middle, high = np.percentile(values, [25, 50, 75])
    return Spread(float(middle), float(low), float(high), float(np.mean(values)), len(values))


def per_verified(rows: Sequence[Row]) -> float | None:
    """CPU seconds of the optimiser and the trials for each grasp that held, all objects together; None where none did.

    Not a mean over objects: one on which nothing held has cost seconds, too.
    """
    held = sum(row.held for row in rows)
    return sum(row.spent for row in rows) / held if held else None


def by_name(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Rows of each name."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row.name, []).append(row)
    return groups


def _grasp_figures(grasp: dict[str, Any]) -> dict[str, float | None]:
    """Figures of one grasp's record by name, each in the unit of its name; None where there is none."""
    measured = grasp.get("metrics") or {}
    moved = {name: _inner(grasp, trial, "displacement_cm") for name, trial in _DISPLACEMENTS.items()}
    metrics = {row.key: (measured.get(name), row.scale) for name, row in METRICS.items()}
    return moved | {key: None if value is None else float(value) * scale for key, (value, scale) in metrics.items()}


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return median(known) if known else None


def _inner(grasp: dict[str, Any], trial: str, figure: str) -> float | None:
    value = (grasp.get(trial) or {}).get(figure)
    return None if value is None else float(value)


def pareto_front(points: Float[np.ndarray, "points axes"]) -> Bool[np.ndarray, "points"]:
    """Which points are on the front where less is better on every axis.

    A point is off it when another is no worse on every axis and better on one; equal points are on it together.
    """
    no_worse = (points[:, None] <= points[None]).all(-1)
    better = (points[:, None] < points[None]).any(-1)
    return np.asarray(~(no_worse & better).any(0))
