"""Summarise benchmark records by name (preset, sweep value or hand) and by object, and compare two benchmark runs."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from graspd_bench.study import Record
from graspd_core.optimize.plan_config import preset_names
from graspd_core.verify.metrics import METRICS

# Presets of the short table and chart: three for planning, the published method, its repaired form, and a baseline.
FEW = ("fast", "balanced", "accurate", "graspd2022", "graspd2022_repaired", "random_closure")
# Prefixes of the names of ablations, and the preset that the ablation varies (its parent). The first that fits counts.
_ABLATIONS = (("closed_form_", "balanced"), ("graspd2022_no_", "graspd2022_repaired"))


def parent_of(name: str) -> str | None:
    """Return the preset of which `name` is an ablation (a variant without one part), or None."""
    return next((parent for prefix, parent in _ABLATIONS if name.startswith(prefix)), None)


def hand_row(hand: str) -> str:
    """Return the name under which study `hands` records the results of a hand, such as `hand:leap_right`."""
    return f"hand:{Path(hand).stem}"


def is_hand(name: str) -> bool:
    """Return True if a name stands for a hand, such as `hand:leap_right`."""
    return name.startswith("hand:")


def is_preset(name: str) -> bool:
    """Return True if a name stands for a preset, not for a sweep value or a hand."""
    return not is_sweep_value(name) and not is_hand(name)


def is_few(name: str) -> bool:
    """Return True if a preset is one of `FEW` or a user's own. The short table and chart show only such presets."""
    return is_preset(name) and (name in FEW or name not in preset_names())


def is_sweep_value(name: str) -> bool:
    """Return True if a name stands for the value of a swept setting, such as `steps=90`."""
    return "=" in name


def short_name(name: str) -> str:
    """Return the label of a preset in charts. If the preset is an ablation, the label omits the method."""
    parent = parent_of(name)
    if parent is None:
        return name
    method = "closed_form_" if name.startswith("closed_form_") else "graspd2022_"
    return name.removeprefix(method).replace("_", " ")


# Trials that give the share of requested grasps that passed. A grasp that was not found has not passed.
TRIAL_FIGURES = ("standard", "hard", "noisy")
# Displacements [cm], and the trial that measured each.
_DISPLACEMENTS = {"sd_cm": "sd", "gravity_cm": "gravity"}


@dataclass(frozen=True)
class Row:
    """Results of one name (preset, sweep value or hand) on one object, over all seeds.

    Attributes:
        count: number of requested grasps.
        held: number of grasps that passed the standard hold trial. 0 without this trial.
        spent: CPU time [s] of optimiser and standard hold trials, or of the whole run if verified grasps are planned.
        values: numbers by name, None if not measured. Medians over grasps (`_grasp_figures`), shares of requested
            grasps (`TRIAL_FIGURES`), times [s], memory [MB], rounds. `cpu_per_grasp` is the optimiser's time per
            requested grasp. `cpu_per_verified` is `spent` / `held`. `first_*`: time to the first verified grasp.
        quartiles: lower and upper quartile over the grasps, for each value that is a median over grasps.
    """

    name: str
    object: str
    method: str
    count: int
    held: int
    spent: float
    values: dict[str, float | None]
    quartiles: dict[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Spread:
    """Median, quartiles (`low`, `high`) and mean of a value over objects, and the number of objects."""

    median: float
    low: float
    high: float
    mean: float
    objects: int


def rows(records: Iterable[Record], kind: str = "raw") -> list[Row]:
    """Return a row for every name and object of the records of `kind`, in record order. Leave out failed runs."""
    groups: dict[tuple[str, str], list[Record]] = {}
    # A record without grasps does not name its trials. They are taken to be the trials of the other records.
    ran = {TRIAL_FIGURES[0]}
    for record in records:
        if record.get("kind") == kind and not record["error"]:
            groups.setdefault((record["name"], record["object"]), []).append(record)
            ran.update(trial for grasp in record["grasps"] for trial in TRIAL_FIGURES if trial in grasp)
    return [_row(group, ran) for group in groups.values()]


def _row(group: Sequence[Record], ran: Collection[str]) -> Row:
    # A record of a run without the standard trial has no key "held".
    count, held = sum(r["count"] for r in group), sum(r.get("held", 0) for r in group)
    grasps = [grasp for r in group for grasp in r["grasps"]]
    figures = [_grasp_figures(grasp) for grasp in grasps]
    names = _grasp_figures({})
    values: dict[str, float | None] = {name: _median(figure[name] for figure in figures) for name in names}
    known = {name: [value for figure in figures if (value := figure[name]) is not None] for name in names}
    quartiles = {name: tuple(np.percentile(some, [25, 75]).tolist()) for name, some in known.items() if some}
    for trial in TRIAL_FIGURES:
        outcomes = [_inner(grasp, trial, "share" if trial == "noisy" else "passed") for grasp in grasps]
        tried = any(outcome is not None for outcome in outcomes) if grasps else trial in ran
        values[trial] = sum(outcome or 0.0 for outcome in outcomes) / count if tried else None
    # Planned runs record one total. For raw runs, sum the parts that a plan has too: optimiser and standard trial.
    spent = sum(r["cpu"].get("total", r["cpu"].get("optimise", 0.0) + r["cpu"].get("standard", 0.0)) for r in group)
    values["cpu_per_grasp"] = sum(r["cpu"].get("optimise", r["cpu"].get("total", 0.0)) for r in group) / count
    prepared = sum(r["cpu"].get("scene", 0.0) for r in group)
    values["cpu_with_scene"] = values["cpu_per_grasp"] + prepared / count
    values["cpu_per_verified"] = spent / held if held else None
    for clock in ("cpu", "wall"):
        values[f"first_{clock}"] = _median((r.get("first_verified") or {}).get(clock) for r in group)
    values["peak_mb"] = max((r["peak_mb"] for r in group), default=None)
    # A method that sends no progress has 0 rounds in its record, which means unknown.
    values["rounds"] = _median(float(r["rounds"]) if r.get("rounds") else None for r in group)
    one = group[0]
    return Row(one["name"], one["object"], one["method"], count, held, spent, values, quartiles)


def spread(rows: Iterable[Row], figure: str) -> Spread | None:
    """Return the spread of a value over the rows, None without values. For one row, use its quartiles over grasps."""
    known = [row for row in rows if row.values.get(figure) is not None]
    values = [row.values[figure] or 0.0 for row in known]
    if not values:
        return None
    low, middle, high = np.percentile(values, [25, 50, 75])
    if len(values) == 1:
        low, high = known[0].quartiles.get(figure, (low, high))
    return Spread(float(middle), float(low), float(high), float(np.mean(values)), len(values))


def share_interval(held: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of the share `held` / `count` (Wilson 1927)."""
    z, share = 1.96, held / count
    middle = share + z * z / (2 * count)
    half = z * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    low, high = ((middle + side * half) / (1 + z * z / count) for side in (-1.0, 1.0))
    return max(low, 0.0), min(high, 1.0)


def per_verified(rows: Sequence[Row]) -> float | None:
    """Return the CPU time of optimiser and trials per held grasp, summed over all objects [s]. None if no grasp held.

    The result is not a mean over objects, because an object on which no grasp held has also cost time.
    """
    held = sum(row.held for row in rows)
    return sum(row.spent for row in rows) / held if held else None


def by_name(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Group rows by name."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row.name, []).append(row)
    return groups


def _grasp_figures(grasp: dict[str, Any]) -> dict[str, float | None]:
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
    """Return which points are on the Pareto front, if less is better on every axis.

    A point is not on the front if another is no worse on every axis and better on one. Equal points do not exclude each
    other.
    """
    no_worse = (points[:, None] <= points[None]).all(-1)
    better = (points[:, None] < points[None]).any(-1)
    return np.asarray(~(no_worse & better).any(0))


# Values to compare between runs: heading, digits, relative limit and absolute limit. A change beyond both is reported.
FIGURES = {
    "standard": ("held", 3, 0.0, 0.001),
    "hard": ("held hard", 3, 0.0, 0.001),
    "sd_cm": ("SD cm", 2, 0.05, 0.02),
    "penetration_mm": ("penetration mm", 2, 0.05, 0.1),
    "contact_area_cm2": ("contact area cm²", 1, 0.05, 0.5),
    "cpu_per_grasp": ("CPU s per grasp", 3, 0.15, 0.02),
    "cpu_per_verified": ("CPU s per verified", 2, 0.15, 0.1),
    "first_cpu": ("first verified, CPU s", 2, 0.15, 0.3),
}


@dataclass(frozen=True)
class Move:
    """Change of one value between two runs. `old` or `new` is None if that run lacks the value."""

    kind: str
    name: str
    object: str
    figure: str
    old: float | None
    new: float | None


def moves(old: Sequence[Record], new: Sequence[Record]) -> list[Move]:
    """Return the changes between two runs. For each name: means over common objects ("all"), then every object."""
    found: list[Move] = []
    for kind in ("raw", "verified"):
        before, after = ({(row.name, row.object): row for row in rows(run, kind)} for run in (old, new))
        shared = [key for key in after if key in before]
        befores, afters = (by_name(side[key] for key in shared) for side in (before, after))
        for name in afters:
            means = ({f: mean_of(side[name], f) for f in FIGURES} for side in (befores, afters))
            pairs = [("all", *means)]
            pairs += [(row.object, before[name, row.object].values, row.values) for row in afters[name]]
            every = ((thing, f, a.get(f), b.get(f)) for thing, a, b in pairs for f in FIGURES)
            found += [Move(kind, name, thing, f, a, b) for thing, f, a, b in every if _moved(f, a, b)]
    return found


def _moved(figure: str, old: float | None, new: float | None) -> bool:
    _, _, share, least = FIGURES[figure]
    if old is None or new is None:
        return (old is None) != (new is None)
    return abs(new - old) > max(share * abs(old), least)


def mean_of(group: Sequence[Row], figure: str) -> float | None:
    """Return the mean of a value over the objects, None without values. For `cpu_per_verified`, see `per_verified`."""
    if figure == "cpu_per_verified":
        return per_verified(group)
    over = spread(group, figure)
    return over.mean if over else None


def comparison(old: Sequence[Record], new: Sequence[Record]) -> str:
    """List as text the values that differ between two runs. Below them, list the cases that only one run has."""
    old, new = ([record for record in records if "kind" in record] for records in (old, new))
    lines = [f"{'cells':9} {'preset':32} {'object':22} {'figure':22} {'old':>9} {'new':>9}  change"]
    for move in moves(old, new):
        heading, digits = FIGURES[move.figure][:2]
        a, b = (f"{v:.{digits}f}" if v is not None else "–" for v in (move.old, move.new))
        change = f"{(move.new - move.old) / move.old:+.0%}" if move.old and move.new is not None else ""
        lines.append(f"{move.kind:9} {move.name:32} {move.object:22} {heading:22} {a:>9} {b:>9}  {change}".rstrip())
    if len(lines) == 1:
        lines = ["nothing moved"]
    for text, some, others in (("only in the old run", old, new), ("only in this run", new, old)):
        have = {(r["kind"], r["name"], r["object"]) for r in others}
        missing = dict.fromkeys((r["kind"], r["name"], r["object"]) for r in some)
        if names := [" ".join(key) for key in missing if key not in have]:
            lines.append(f"{text}: {len(names)} ({', '.join(names[:6])}{', …' if len(names) > 6 else ''})")
    return "\n".join(lines)
