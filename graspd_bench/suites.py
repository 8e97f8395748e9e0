"""Suites, lists of cells (runs): all presets on all objects, sweeps of settings, and a comparison of hands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from graspd_bench.figures import hand_row
from graspd_bench.measurement import USUAL, Cell, Kind, requested_trials
from graspd_bench.study import Request, all_shapes, find_objects
from graspd_core.errors import ConfigError
from graspd_core.hands.library import hand_names
from graspd_core.optimize.plan_config import PlanConfig, load_preset, method_row, override, preset_names
from graspd_dataset.run_records import object_name

# Number of grasps of a cell of kind "verified", and batch size of a cell of kind "pace".
VERIFIED, BATCH = 8, 32
# Grasps of a raw cell in the studies `hands` and `decades`.
HAND_COUNT = 8
# Built-in presets with cells of kind "verified". Presets of users have such cells too.
PLANNED = ("fast", "balanced", "accurate")
# Variant of `balanced` with the same effort in every round, for comparison.
STEADY = "balanced_steady"
# The study `main` skips this preset: it has the raw grasps of `balanced`, and only orders verified grasps differently.
_RANKED = "robust"
# If settings have more steps than `_LONG`, a raw cell has `_LONG_COUNT` grasps, because a grasp takes seconds.
_LONG, _LONG_COUNT = 2000, 4
# With more steps than `_LONGEST`, a grasp takes three times as long as with `_LONG` steps.
_LONGEST = 7000
# Trials of the settings sweeps.
_SWEEP_TRIALS = ("standard",)
_SWEEP_OBJECTS = ("shape:box", "shape:mug", "shape:bowl", "shape:hammer")
_SWEEP_PRESET = "balanced"
_QUICK_OBJECTS = ("shape:sphere", "shape:box", "shape:mug")
_QUICK_COUNT = 4
# Presets of a quick run. Other presets take minutes per cell.
_QUICK_PRESETS = ("fast", "balanced", "accurate", "random_closure", "graspd2022_short")

# CPU seconds per grasp by method, on an idle core. `cell_seconds` has the times of long settings and other methods.
_SECONDS = {"closed_form": 0.05, "graspd2022": 1.2, "annealing": 3.3, "random_closure": 0.3}

_STEPS = {"explore": 50, "refine": 80, "polish": 50}
# Settings sweeps by name. Each value of a sweep is a set of changes to `balanced`.
SWEEPS: Mapping[str, Sequence[Mapping[str, int]]] = {
    "candidates": [{"problem.candidates": n} for n in (32, 64, 128, 256, 512)],
    "directions": [{"problem.directions": n} for n in (6, 12, 24, 48, 96)],
    "resolution": [{"resolution": n} for n in (16, 24, 32, 48, 64)],
    "steps": [
        {f"closed_form.{stage}_steps": round(n * share) for stage, n in _STEPS.items()}
        for share in (0.2, 0.5, 1.0, 2.0, 4.0)
    ],
}
# Sweeps over three decades: title, preset, setting and values. The values include the preset's own value.
DECADES = (
    (
        "Grasp'D, stiffness [N/m]",
        "graspd2022_short",
        "graspd2022.contact.stiffness",
        (30, 100, 300, 1e3, 3e3, 1e4, 3e4),
    ),
    ("Grasp'D, friction", "graspd2022_short", "graspd2022.contact.friction", (0.02, 0.06, 0.2, 0.8, 2.0, 6.0, 20.0)),
    ("closed form, width [mm]", "balanced", "closed_form.delta_end", (1e-4, 4e-4, 1e-3, 4e-3, 1e-2, 4e-2, 1e-1)),
    ("closed form, friction", "balanced", "problem.friction", (0.02, 0.06, 0.2, 0.4, 2.0, 6.0, 20.0)),
)


def main_suite(request: Request) -> tuple[Cell, ...]:
    """Return the cells of study `main`: raw and verified grasps of presets on objects, and cells that measure speed."""
    names = (name for name in preset_names() if name != _RANKED)
    defaults = [name for name in names if not request.quick or name in _QUICK_PRESETS]
    presets = {name: load_preset(name) for name in request.presets or defaults}
    if len({object_name(name) for name in presets}) < len(presets):
        raise ConfigError(f"presets: {', '.join(presets)}; valid: presets of different names")
    planned = {name: config for name, config in presets.items() if name in PLANNED or name not in preset_names()}
    if "balanced" in planned and not request.presets:
        planned[STEADY] = override(planned["balanced"], {"rounds.first_budget": 1.0, "rounds.growth": 1.0})
    trials = requested_trials(request, USUAL)
    cells: list[Cell] = []
    for thing in find_objects(request.objects or (_QUICK_OBJECTS if request.quick else all_shapes())):
        for name, config in presets.items():
            cells += _cells(request, "raw", name, config, thing, _count(request, config), trials)
        # Users call `plan_grasps` with presets of closed_form. Other presets are compared by raw grasps only.
        for name, config in planned.items():
            cells += _cells(request, "verified", name, config, thing, _QUICK_COUNT if request.quick else VERIFIED)
    if not request.objects:
        for name in (name for name in PLANNED if name in presets):
            cells += _cells(request, "pace", name, presets[name], "shape:cylinder", BATCH)[:1]
        if "balanced" in presets:
            cells += _cells(request, "start", "balanced", presets["balanced"], "shape:mug", 1)[:1]
    return tuple(cells)


def sweep_suite(request: Request) -> tuple[Cell, ...]:
    """Return `raw` cells that sweep four settings, one at a time. Other settings are those of `balanced`."""
    base = load_preset(_SWEEP_PRESET)
    count, trials = _count(request, base), requested_trials(request, _SWEEP_TRIALS)
    return tuple(
        cell
        for thing in find_objects(request.objects or (_SWEEP_OBJECTS[:2] if request.quick else _SWEEP_OBJECTS))
        for sweep, values in SWEEPS.items()
        for changes in values
        # The value in a name such as `steps=90` is the sum of the changed settings.
        for name in (f"{sweep}={sum(changes.values()):g}",)
        for cell in _cells(request, "raw", name, override(base, changes), thing, count, trials)
    )


def decades_suite(request: Request) -> tuple[Cell, ...]:
    """Return `raw` cells that sweep contact settings over three decades, which shows how exact a setting must be."""
    count, trials = request.count or HAND_COUNT, requested_trials(request, _SWEEP_TRIALS)
    return tuple(
        cell
        for thing in find_objects(request.objects or _SWEEP_OBJECTS[:2])
        for _, preset, setting, values in DECADES
        for value in (values[:2] if request.quick else values)
        for config in (override(load_preset(preset), {setting: value}),)
        for cell in _cells(request, "raw", f"{setting}={value:g}", config, thing, count, trials)
    )


def hands_suite(request: Request) -> tuple[Cell, ...]:
    """Return `raw` cells of each built-in hand with preset `balanced`."""
    base, count = load_preset(_SWEEP_PRESET), request.count or (_QUICK_COUNT if request.quick else HAND_COUNT)
    trials = requested_trials(request, _SWEEP_TRIALS)
    return tuple(
        cell
        for thing in find_objects(request.objects or (_QUICK_OBJECTS if request.quick else all_shapes()))
        for hand in hand_names()
        for cell in _cells(request, "raw", hand_row(hand), base, thing, count, trials, hand=hand)
    )


def cell_seconds(cell: Cell) -> float:
    """Return the estimated CPU time of a cell on one thread of an idle core [s]."""
    if cell.kind != "raw":
        return {"verified": 1.5, "pace": 8.0, "start": 6.0}[cell.kind]
    each = _SECONDS.get(cell.settings.method, 1.0)
    if _steps(cell.settings) > _LONG:
        each = 25.0 if _steps(cell.settings) > _LONGEST else 8.0
    return 1.0 + cell.count * (each + 0.075 * len(cell.trials))


def _steps(config: PlanConfig) -> int:
    return getattr(config.settings, "steps", 0)


def _count(request: Request, config: PlanConfig) -> int:
    usual = _LONG_COUNT if _steps(config) > _LONG else method_row(config.method).benchmark_count
    return request.count or (_QUICK_COUNT if request.quick else usual)


def _cells(
    request: Request,
    kind: Kind,
    name: str,
    config: PlanConfig,
    thing: str,
    count: int,
    trials: tuple[str, ...] = (),
    *,
    hand: str = "",
) -> list[Cell]:
    hand = hand or request.hand or "allegro_right"
    return [Cell(kind, object_name(name), config, thing, hand, seed, count, trials) for seed in request.seeds or (0,)]
