"""Base classes of the studies: a study, its cases, a user's request, and cases with grasps of one object."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from graspd_core.errors import ConfigError, MeshError
from graspd_core.hands.library import hand_hash, load_hand
from graspd_core.hands.model import HandModel
from graspd_core.mesh.shapes import SHAPES, object_hash, object_sources
from graspd_core.optimize.candidates import PlannerInput, find_candidates
from graspd_core.optimize.loop import Hooks
from graspd_core.optimize.plan_config import PlanConfig, load_preset, to_mapping
from graspd_core.perception.load_scene import load_scene
from graspd_core.perception.scene import Scene
from graspd_core.types import Grasp
from graspd_dataset.run_records import object_name

Record = dict[str, Any]

# Default mass of objects [kg]. DexGraspBench uses the same mass, so that results can be compared.
PROTOCOL_MASS = 0.1


@dataclass(frozen=True)
class Picture:
    """A chart on disk, and its title."""

    title: str
    png: Path


# Sections of a page by the name of their marker. The parts of a section are Markdown texts and pictures.
Sections = Mapping[str, Sequence[str | Picture | None]]


@dataclass(frozen=True)
class Case:
    """Base class of one run of a study. Files in `object`, `hand` and `preset` count by content, not by path."""

    @property
    def label(self) -> str:
        """Return the name of the case for progress lines and file names. It joins the case's texts and numbers."""
        values = (getattr(self, field.name) for field in fields(self))
        return " ".join(object_name(value) for value in values if isinstance(value, str | int | float) and value != "")

    def inputs(self) -> Record:
        """Return all inputs of the run except the code, ready for JSON. Cases with equal inputs share one record."""
        said = asdict(self)
        if "object" in said:
            said["object"] = [object_name(said["object"]), object_hash(said["object"])]
        if "hand" in said:
            said["hand"] = [said["hand"], hand_hash(said["hand"])]
        if "preset" in said:
            said["settings"] = to_mapping(load_preset(said["preset"]))
        return said

    def recorded(self) -> Record:
        """Return the fields of the case that go into its record."""
        return asdict(self)


@dataclass(frozen=True)
class Request:
    """What a user asks to run. A field that is empty or None takes the study's default.

    Attributes:
        presets: names or files of presets.
        objects: shape:NAME, mesh files, or folders of mesh files.
        cases: which cases to run, by name or family, in studies that name their cases.
        seeds: random seeds. Every case is run with each seed.
        count: number of grasps of a case.
        hand: name or path of the hand.
        trials: names of the trials to run on raw grasps.
        quick: whether to run a small selection that takes minutes.
        imported: file or folder of imported grasps.
        joint_order: joint names in the order of the imported npy files.
        checkout: folder of DexGraspBench.
        python: Python program that runs DexGraspBench.
        armature: whether to try grasps a second time, with our joint armature in DexGraspBench's hand.
        grasps: file of our grasps, which DexGraspBench tries instead of newly planned ones.
    """

    presets: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()
    cases: tuple[str, ...] = ()
    seeds: tuple[int, ...] = ()
    count: int | None = None
    hand: str = ""
    trials: tuple[str, ...] = ()
    quick: bool = False
    imported: str = ""
    joint_order: tuple[str, ...] = ()
    checkout: str = ""
    python: str = ""
    armature: bool = False
    grasps: str = ""

    def __post_init__(self) -> None:
        if self.count is not None and not 1 <= self.count <= 1024:
            raise ConfigError(f"count: {self.count} grasps; valid: 1 to 1024")
        for seed in self.seeds:
            if not 0 <= seed < 2**31:
                raise ConfigError(f"seed: {seed}; valid: 0 to 2^31 - 1")

    def preset(self) -> str:
        """Return the requested preset, or balanced. Raises ConfigError: several presets, or an unknown preset."""
        if len(self.presets) > 1:
            raise ConfigError(f"presets: {', '.join(self.presets)}; this study takes one at a time")
        name = (self.presets or ("balanced",))[0]
        load_preset(name)
        return name


def error_of(record: Record) -> tuple[str, ...]:
    """Return a tuple with the error of a case that failed, or an empty tuple."""
    return (record["error"],) if record["error"] else ()


def held_of(record: Record) -> str:
    """Return the result of a case in a few words, such as "7/8 held"."""
    return f"{record['held']}/{record['count']} held" if "held" in record else "measured"


@dataclass(frozen=True)
class Study:
    """One study of the benchmark.

    Attributes:
        about: what the study compares or measures, in one line.
        cases: returns the cases of a request. Raises GraspdError if the request has unknown names.
        run: module-level function (workers unpickle it) that runs a case and returns the results.
        sections: returns page sections from records and a path prefix for charts. None: no charts.
        sources: glob patterns of the files in graspd_bench that the study's results depend on.
        takes: names of the `Request` fields that the study uses.
        seconds: returns the estimated CPU time of a case [s].
        faults: returns the faults of a record, one line per fault.
        summary: returns the result in a record without faults, in a few words.
        alone: whether every case gets a new process, without libraries and random states of earlier cases.
        patience: returns the seconds until a case counts as hung.
        usual: whether `graspd bench all` includes the study. False, for example, if it needs files of the user.
        failures: whether `sections` also needs the records of failed cases.
    """

    about: str
    cases: Callable[[Request], Sequence[Case]]
    run: Callable[[Any], Record]
    sections: Callable[[Sequence[Record], Path | None], Sections]
    sources: tuple[str, ...]
    takes: tuple[str, ...] = ()
    seconds: Callable[[Any], float] = lambda case: 10.0
    faults: Callable[[Record], tuple[str, ...]] = error_of
    summary: Callable[[Record], str] = held_of
    alone: bool = False
    patience: Callable[[Any], float] = lambda case: 3600.0
    usual: bool = True
    failures: bool = False


def all_shapes() -> tuple[str, ...]:
    """Return all built-in shapes, as `shape:NAME`."""
    return tuple(f"shape:{name}" for name in SHAPES)


def find_objects(sources: Sequence[str]) -> tuple[str, ...]:
    """List `sources` with folders replaced by their meshes. Raises MeshError: unknown object, or a name twice."""
    found = object_sources(sources)
    names = [object_name(source) for source in found]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        same = ", ".join(source for source in found if object_name(source) == twice[0])
        raise MeshError(f"objects {same} share the name {twice[0]!r}; rename one of them")
    return found


# Accepted column names of a csv of masses. The first one present is used.
_NAME_COLUMNS, _MASS_COLUMNS = ("name", "mesh", "file"), ("mass_kg", "mass")


def masses_of(meshes: Sequence[Path]) -> list[float]:
    """Return the masses of meshes in one folder, as the csv files in the folder give them [kg].

    Raises ConfigError: a csv file is unreadable, or its masses are not positive numbers, or a mesh has no mass.
    """
    folder = meshes[0].parent
    masses = _masses_in(folder)
    if missing := [path.name for path in meshes if path.stem not in masses]:
        told = f"its csv files name {', '.join(masses) or 'none'}"
        raise ConfigError(f"{folder}: no mass of {missing[0]}; {told}; columns: name, mass_kg")
    return [masses[path.stem] for path in meshes]


def _masses_in(folder: Path) -> dict[str, float]:
    found: dict[str, float] = {}
    for path in sorted(folder.glob("*.csv")):
        try:
            # Spreadsheets write a byte order mark.
            with path.open(newline="", encoding="utf-8-sig") as file:
                rows = list(csv.DictReader(file))
        except (OSError, ValueError, csv.Error) as error:
            raise ConfigError(f"{path}: cannot be read: {error}; valid: text with columns name, mass_kg") from None
        columns = list(rows[0]) if rows else []
        name = next((column for column in _NAME_COLUMNS if column in columns), None)
        mass = next((column for column in _MASS_COLUMNS if column in columns), None)
        for row in rows if name and mass else ():
            try:
                value = float(row[mass])
            except (TypeError, ValueError):
                raise ConfigError(f"{path}: the mass of {row[name]!r} is {row[mass]!r}; valid: a number [kg]") from None
            if not 0 < value < float("inf"):
                raise ConfigError(f"{path}: the mass of {row[name]!r} is {row[mass]}; valid: more than zero kilograms")
            found[Path(str(row[name])).stem] = value
    return found


@dataclass(frozen=True)
class ObjectCase(Case):
    """A case of `count` grasps of an object (a mesh file or shape:NAME) with a hand, a preset and a seed."""

    object: str
    preset: str
    hand: str
    seed: int
    count: int

    @property
    def config(self) -> PlanConfig:
        return load_preset(self.preset)

    def load(self, friction: float = 0.6) -> tuple[HandModel, Scene]:
        """Return the hand, and a scene with only the object, with 0.1 kg and the given Coulomb friction."""
        hand = load_hand(self.hand, candidates=self.config.problem.fine_candidates)
        return hand, load_scene(self.object, mass=PROTOCOL_MASS, resolution=self.config.resolution, friction=friction)


def object_cases(request: Request, objects: Sequence[str], count: int, quick_count: int = 2) -> tuple[ObjectCase, ...]:
    """Return a case for each object and seed. A quick request takes one default object and `quick_count` grasps."""
    objects_found = find_objects(request.objects or objects[: 1 if request.quick else None])
    count, hand = request.count or (quick_count if request.quick else count), request.hand or "allegro_right"
    seeds = request.seeds or (0,)
    return tuple(ObjectCase(source, request.preset(), hand, seed, count) for seed in seeds for source in objects_found)


def raw_grasps(scene: Scene, hand: HandModel, config: PlanConfig, count: int, seed: int) -> tuple[Grasp, ...]:
    """Return the first `count` grasps in the method's own ranking. No trial has filtered them."""
    return find_candidates(PlannerInput(scene, hand, count, seed, config, Hooks()))[:count]
