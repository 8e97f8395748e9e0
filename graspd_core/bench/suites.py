"""What is run: suites of cells, and the objects, presets and counts that they are made of.

`SUITES` is the registry: a new suite is a function from `Request` to cells, and a row in it.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from graspd_core.bench.measurements.benchmark_trials import TRIALS, USUAL
from graspd_core.bench.measurements.measurement import Cell, Kind
from graspd_core.bench.names import hand_row
from graspd_core.errors import ConfigError, MeshError
from graspd_core.hands.library import hand_names, load_hand
from graspd_core.mesh.mesh_files import MESH_ENDINGS, content_hash
from graspd_core.mesh.shapes import SHAPES, make_shape
from graspd_core.methods.method_registry import METHODS
from graspd_core.methods.plan_config import PlanConfig, load_preset, override, preset_names
from graspd_core.paths import config_dir

# Grasps of a raw cell by method: the slow ones are asked for fewer.
# Verified grasps that a planned cell asks for, and the batch that pace is taken at.
VERIFIED, BATCH = 8, 32
# Grasps of a raw cell by which hands are compared.
HAND_COUNT = 8
# Presets that people plan with.
PLANNED = ("fast", "balanced", "accurate")
# What `balanced` is compared with: the same effort in every round.
STEADY = "balanced_steady"
# Trials of the settings sweep (suite `ladder`).
_SWEEP_TRIALS = ("standard",)
_SWEEP_OBJECTS = ("shape:box", "shape:mug", "shape:bowl", "shape:hammer")
_SWEEP_PRESET = "balanced"
_QUICK_OBJECTS = ("shape:sphere", "shape:box", "shape:mug")
_QUICK_COUNT = 4
# The others take minutes a cell.
_QUICK_PRESETS = ("fast", "balanced", "accurate", "random_closure", "graspd2022_short")

_STEPS = {"explore": 50, "refine": 80, "polish": 50}
# Sweep values: what is changed, and to what; all else stays at `balanced`.
SWEEPS: Mapping[str, Sequence[Mapping[str, int]]] = {
    "candidates": [{"problem.candidates": n} for n in (32, 64, 128, 256, 512)],
    "directions": [{"problem.directions": n} for n in (6, 12, 24, 48, 96)],
    "resolution": [{"resolution": n} for n in (16, 24, 32, 48, 64)],
    "steps": [
        {f"closed_form.{stage}_steps": round(n * share) for stage, n in _STEPS.items()}
        for share in (0.2, 0.5, 1.0, 2.0, 4.0)
    ],
}


@dataclass(frozen=True)
class SuiteRequest:
    """What a caller wants run; empty and None mean the suite's own choice.

    Attributes:
        presets: names or files.
        objects: shape:NAME, mesh files, or folders of them.
        seeds: of every cell.
        count: grasps of a raw cell.
        hand: name or path.
        trials: of raw grasps.
        quick: a small run that takes minutes.
    """

    presets: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()
    seeds: tuple[int, ...] = (0,)
    count: int | None = None
    hand: str = "allegro_right"
    trials: tuple[str, ...] = ()
    quick: bool = False


@dataclass(frozen=True)
class Object:
    """One object and the hash of its content."""

    source: str
    sha256: str = field(repr=False)


def cells_of(suites: Sequence[str], request: SuiteRequest) -> tuple[Cell, ...]:
    """All cells of some suites, those of one object next to each other.

    Raises:
        GraspdError: a name of a suite, preset, object, hand or trial is unknown, or a number out of range; the message
            lists the valid ones.
    """
    for name in suites:
        if name not in SUITES:
            raise ConfigError(f"unknown suite {name!r}; valid suites: {', '.join(SUITES)}, stress")
    for name in request.trials:
        if name not in TRIALS:
            raise ConfigError(f"unknown trial {name!r}; valid trials: {', '.join(TRIALS)}")
    if request.count is not None and not 1 <= request.count <= 1024:
        raise ConfigError(f"count: {request.count} grasps; valid: 1 to 1024")
    for seed in request.seeds:
        if not 0 <= seed < 2**31:
            raise ConfigError(f"seed: {seed}; valid: 0 to 2^31 - 1")
    return tuple(dict.fromkeys(cell for name in suites for cell in SUITES[name](request)))


def main_suite(request: SuiteRequest) -> tuple[Cell, ...]:
    """Every preset on every object: raw grasps, verified ones, the pace of the optimiser, and a fresh start."""
    make = _Maker(request)
    defaults = [name for name in preset_names() if not request.quick or name in _QUICK_PRESETS]
    presets = {name: load_preset(name) for name in request.presets or defaults}
    planned = {name: config for name, config in presets.items() if name in PLANNED}
    if "balanced" in planned:
        planned[STEADY] = override(planned["balanced"], {"rounds.first_budget": 1.0, "rounds.growth": 1.0})
    objects = find_objects(request.objects or (_QUICK_OBJECTS if request.quick else all_shapes()))
    cells: list[Cell] = []
    for thing in objects:
        for name, config in presets.items():
            cells += make("raw", name, config, thing, _count(request, config), request.trials or USUAL)
        # The closed form's own presets are what `plan_grasps` is used with; the others are only compared raw.
        for name, config in planned.items():
            cells += make("verified", name, config, thing, _QUICK_COUNT if request.quick else VERIFIED)
    if not request.objects:
        (cylinder,), (mug,) = find_objects(("shape:cylinder",)), find_objects(("shape:mug",))
        for name in (name for name in PLANNED if name in presets):
            cells += make("pace", name, presets[name], cylinder, BATCH)[:1]
        if "balanced" in presets:
            cells += make("start", "balanced", presets["balanced"], mug, 1)[:1]
    return tuple(cells)


def sweep_suite(request: SuiteRequest) -> tuple[Cell, ...]:
    """Each of four settings from poor to rich, one at a time."""
    make = _Maker(request)
    base = load_preset(_SWEEP_PRESET)
    objects = find_objects(request.objects or (_SWEEP_OBJECTS[:2] if request.quick else _SWEEP_OBJECTS))
    count = request.count or (_QUICK_COUNT if request.quick else METHODS[base.method].benchmark_count)
    cells: list[Cell] = []
    for thing in objects:
        for sweep, sweep_values in SWEEPS.items():
            for changes in sweep_values:
                name = sweep_name(sweep, changes)
                cells += make("raw", name, override(base, changes), thing, count, request.trials or _SWEEP_TRIALS)
    return tuple(cells)


def hands_suite(request: SuiteRequest) -> tuple[Cell, ...]:
    """Every built-in hand with one preset."""
    objects = find_objects(request.objects or (_QUICK_OBJECTS if request.quick else all_shapes()))
    base, count = load_preset(_SWEEP_PRESET), request.count or (_QUICK_COUNT if request.quick else HAND_COUNT)
    makers = {name: _Maker(dataclasses.replace(request, hand=name)) for name in hand_names()}
    cells: list[Cell] = []
    for thing in objects:
        for name, make in makers.items():
            cells += make("raw", hand_row(name), base, thing, count, request.trials or _SWEEP_TRIALS)
    return tuple(cells)


SUITES: dict[str, Callable[[SuiteRequest], tuple[Cell, ...]]] = {
    "main": main_suite,
    "ladder": sweep_suite,
    "hands": hands_suite,
}


def sweep_name(sweep: str, changes: Mapping[str, int]) -> str:
    """Name of a sweep value's cells: the sweep and its value (steps: all of them together)."""
    return f"{sweep}={sum(changes.values()):g}"


def all_shapes() -> tuple[str, ...]:
    """The authored shapes as objects."""
    return tuple(f"shape:{name}" for name in SHAPES)


def find_objects(sources: Sequence[str]) -> tuple[Object, ...]:
    """Shapes, mesh files and the meshes of folders. Raises MeshError: there is no such thing."""
    found: list[Object] = []
    for source in sources:
        path = Path(source)
        if source.startswith("shape:"):
            found.append(Object(source, content_hash(make_shape(source.removeprefix("shape:")))))
        elif path.is_dir():
            files = sorted(p for p in path.iterdir() if p.suffix.lower().lstrip(".") in MESH_ENDINGS)
            if not files:
                raise MeshError(f"{source}: no mesh in this folder; valid endings: {', '.join(MESH_ENDINGS)}")
            found += [_file(file) for file in files]
        else:
            found.append(_file(path))
    names = [Path(thing.source).stem for thing in found]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise MeshError(f"two objects are called {twice[0]!r}: results go by that name")
    return tuple(found)


def _file(path: Path) -> Object:
    if not path.is_file():
        raise MeshError(f"{path}: no such mesh file; shape:NAME is an authored shape: {', '.join(sorted(SHAPES))}")
    if path.suffix.lower().lstrip(".") not in MESH_ENDINGS:
        raise MeshError(f"{path}: unknown mesh ending {path.suffix!r}; valid endings: {', '.join(MESH_ENDINGS)}")
    return Object(str(path), hashlib.sha256(path.read_bytes()).hexdigest())


def _count(request: SuiteRequest, config: PlanConfig) -> int:
    return request.count or (_QUICK_COUNT if request.quick else METHODS[config.method].benchmark_count)


class _Maker:
    """Makes cells of one request's hand and seeds."""

    def __init__(self, request: SuiteRequest) -> None:
        self.request = request
        self.hand_hash = hand_hash(request.hand)

    def __call__(
        self, kind: Kind, name: str, config: PlanConfig, thing: Object, count: int, trials: tuple[str, ...] = ()
    ) -> list[Cell]:
        hand = self.request.hand
        label = Path(name).stem if Path(name).suffix in (".yaml", ".yml") else name
        return [
            Cell(kind, label, config, thing.source, thing.sha256, hand, self.hand_hash, seed, count, trials)
            for seed in self.request.seeds
        ]


def hand_hash(name: str) -> str:
    """Hash of a hand's URDF and description. Raises HandError: there is no such hand, or it cannot be used."""
    hand = load_hand(name, candidates=1)
    boxed = config_dir() / "hands" / f"{name}.yaml"
    files = [Path(hand.urdf), boxed if boxed.is_file() else Path(name)]
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.read_bytes())
    return digest.hexdigest()
