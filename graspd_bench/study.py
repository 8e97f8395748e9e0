"""Benchmarks: their cases, the function that runs one of them, and the use of the records."""

from __future__ import annotations

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
from graspd_dataset.run_records import thing_name

Record = dict[str, Any]

# What objects weigh where nobody says [kg]: the convention of DexGraspBench, which figures compare with.
PROTOCOL_MASS = 0.1


@dataclass(frozen=True)
class Picture:
    """A chart on disk, and what it shows."""

    title: str
    png: Path


# Parts of a page's sections by the name of their marker: Markdown and pictures.
Sections = Mapping[str, Sequence[str | Picture | None]]


@dataclass(frozen=True)
class Case:
    """One run. Its fields called `object`, `hand` and `preset`, where it has such, count by their content."""

    @property
    def label(self) -> str:
        """Return its name in progress and in the name of its file, from the fields that are not empty."""
        values = (getattr(self, field.name) for field in fields(self))
        return " ".join(thing_name(value) for value in values if isinstance(value, str | int | float) and value != "")

    def asked(self) -> Record:
        """Return all that the run depends on but the code, JSON-ready. Runs that ask for the same share a record."""
        said = asdict(self)
        if "object" in said:
            said["object"] = [thing_name(said["object"]), object_hash(said["object"])]
        if "hand" in said:
            said["hand"] = [said["hand"], hand_hash(said["hand"])]
        if "preset" in said:
            said["settings"] = to_mapping(load_preset(said["preset"]))
        return said

    def shown(self) -> Record:
        """Return what the record says of the case."""
        return asdict(self)


@dataclass(frozen=True)
class Request:
    """What a caller wants to run. Empty and None stand for the study's own choice.

    Attributes:
        presets: names or files.
        objects: shape:NAME, mesh files, or folders of them.
        cases: names or families of the study's own cases.
        seeds: of every case.
        count: grasps of a case.
        hand: name or path.
        trials: of raw grasps.
        quick: a small run that takes minutes.
        imported: file or folder of imported grasps.
        joint_order: of the joints in its npy files, by name.
        checkout: folder of DexGraspBench.
        python: program that runs it.
        armature: try its hand with our armature, too.
        grasps: file of our grasps to use instead of planned ones.
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

    def preset(self, usual: str = "balanced") -> str:
        """Return the only preset. Raises ConfigError: there are several, or it is unknown."""
        if len(self.presets) > 1:
            raise ConfigError(f"presets: {', '.join(self.presets)}; this study takes one at a time")
        name = (self.presets or (usual,))[0]
        load_preset(name)
        return name


def error_of(record: Record) -> tuple[str, ...]:
    """Return the error that a case ended in."""
    return (record["error"],) if record["error"] else ()


def held_of(record: Record) -> str:
    """Return the results of a case, in a few words."""
    return f"{record['held']}/{record['count']} held" if "held" in record else "measured"


@dataclass(frozen=True)
class Study:
    """One benchmark.

    Attributes:
        about: its question, one line.
        cases: makes the cases of a request. Raises GraspdError: the request has unknown names.
        run: runs a case and returns its figures, in a process that does one case after another. A function of a module.
        sections: makes of records, and the path that charts begin with (None: draw none), the sections of pages.
        failures: whether the sections need records of failed cases, too.
        sources: files of graspd_bench, by glob, that figures depend on beside graspd_core.
        takes: names of the fields of `Request` that it uses.
        seconds: CPU seconds of a case, roughly.
        faults: returns what is wrong with a record, a line each.
        came: returns the results of a record that has no fault, in a few words.
        alone: whether every case has a process of its own, cold.
        patience: seconds until a case counts as hung.
        usual: whether it is part of `graspd bench all`, because it needs only shipped files.
    """

    about: str
    cases: Callable[[Request], Sequence[Case]]
    run: Callable[[Any], Record]
    sections: Callable[[Sequence[Record], Path | None], Sections]
    sources: tuple[str, ...]
    takes: tuple[str, ...] = ()
    seconds: Callable[[Any], float] = lambda case: 10.0
    faults: Callable[[Record], tuple[str, ...]] = error_of
    came: Callable[[Record], str] = held_of
    alone: bool = False
    patience: Callable[[Any], float] = lambda case: 3600.0
    usual: bool = True
    failures: bool = False


def all_shapes() -> tuple[str, ...]:
    """Return the authored shapes as objects."""
    return tuple(f"shape:{name}" for name in SHAPES)


def find_objects(sources: Sequence[str]) -> tuple[str, ...]:
    """Return the same as `object_sources`. Raises MeshError also where two of them have the same name."""
    found = object_sources(sources)
    names = [thing_name(source) for source in found]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise MeshError(f"two objects are called {twice[0]!r}: results go by that name")
    return found


@dataclass(frozen=True)
class ObjectCase(Case):
    """`count` grasps of an object (a mesh file or shape:NAME) with a hand, a preset and a seed."""

    object: str
    preset: str
    hand: str
    seed: int
    count: int

    @property
    def config(self) -> PlanConfig:
        return load_preset(self.preset)

    def load(self, friction: float = 0.6) -> tuple[HandModel, Scene]:
        """Return the hand and the scene."""
        hand = load_hand(self.hand, candidates=self.config.problem.fine_candidates)
        return hand, load_scene(self.object, mass=PROTOCOL_MASS, resolution=self.config.resolution, friction=friction)


def object_cases(request: Request, objects: Sequence[str], count: int, quick_count: int = 2) -> tuple[ObjectCase, ...]:
    """Return a case for each object and seed. A small run has only the first object, with fewer grasps."""
    things = find_objects(request.objects or objects[: 1 if request.quick else None])
    count, hand = request.count or (quick_count if request.quick else count), request.hand or "allegro_right"
    seeds = request.seeds or (0,)
    return tuple(ObjectCase(thing, request.preset(), hand, seed, count) for seed in seeds for thing in things)


def raw_grasps(scene: Scene, hand: HandModel, config: PlanConfig, count: int, seed: int) -> tuple[Grasp, ...]:
    """Return the first grasps of a method's own ranking, none filtered by a trial."""
    return find_candidates(PlannerInput(scene, hand, count, seed, config, Hooks())).grasps[:count]
