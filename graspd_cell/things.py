"""Objects with realistic masses: random irregular objects, built-in shapes, or a mesh folder with a csv of masses."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from graspd_bench.rendering.families import FAMILIES, PREFIX, draw_object
from graspd_bench.study import masses_of
from graspd_core.errors import ConfigError, MeshError
from graspd_core.mesh.mesh_files import MESH_ENDINGS, simplify
from graspd_core.mesh.shapes import SHAPES
from graspd_core.perception.load_scene import SHAPE_PREFIX, load_scene
from graspd_core.perception.scene import ObjectModel, object_parts
from graspd_core.types import TriangleMesh

# Density of built-in shapes, between wood and water [kg/m³].
SHAPE_DENSITY = 700.0
# A family's number, or none.
_SEED = re.compile("[0-9]{0,18}")
# Faces of an object's simplified surface for the camera.
_SEEN_FACES = 2000


@dataclass(frozen=True, eq=False)
class Thing:
    """Object to take out of a bin.

    Attributes:
        name: name of the object.
        model: mesh, mass and inertia.
        parts: convex parts for collisions [m].
        seen: simplified surface for the camera [m].
    """

    name: str
    model: ObjectModel
    parts: tuple[TriangleMesh, ...]
    seen: TriangleMesh


@dataclass(frozen=True)
class ThingSource:
    """Source of an object: `family:NAME:SEED` (random irregular shape), `shape:NAME`, or a mesh file with mass [kg]."""

    source: str
    mass: float | None = None

    @property
    def name(self) -> str:
        """Short name for reports."""
        return Path(self.source).stem if self.mass is not None else self.source.split(":", 1)[1].replace(":", " ")


def family_sources(seeds: Sequence[int], families: Sequence[str] = tuple(FAMILIES)) -> tuple[ThingSource, ...]:
    """Return one object source per seed and family, which is a kind of random irregular object."""
    return tuple(ThingSource(f"{PREFIX}{family}:{seed}") for seed in seeds for family in families)


def find_sources(names: Sequence[str]) -> tuple[ThingSource, ...]:
    """Return the object sources that `names` give: `family:NAME[:SEED]`, `shape:NAME`, or a folder.

    Raises ConfigError: a name is unknown, or a folder lacks meshes or masses.
    """
    found: list[ThingSource] = []
    for name in names:
        kind, _, rest = name.partition(":")
        if f"{kind}:" == SHAPE_PREFIX and rest in SHAPES:
            found.append(ThingSource(name))
        elif f"{kind}:" == PREFIX and rest.partition(":")[0] in FAMILIES and _SEED.fullmatch(rest.partition(":")[2]):
            found.append(ThingSource(name if ":" in rest else f"{name}:0"))
        elif Path(name).is_dir():
            found += folder_sources(Path(name))
        else:
            families = ", ".join(FAMILIES)
            raise ConfigError(
                f"unknown thing {name!r}; valid: a folder of meshes, shape:NAME, or family:NAME[:SEED] of {families}"
            )
    return tuple(found)


def folder_sources(folder: Path) -> tuple[ThingSource, ...]:
    """Return the meshes of a folder with their masses (`masses_of`). Raises ConfigError: no meshes, or no mass."""
    meshes = sorted(path for path in folder.iterdir() if path.suffix.lower().lstrip(".") in MESH_ENDINGS)
    if not meshes:
        raise ConfigError(f"{folder}: no meshes; endings: {', '.join(sorted(MESH_ENDINGS))}")
    return tuple(ThingSource(str(path), mass) for path, mass in zip(meshes, masses_of(meshes), strict=True))


def load_thing(source: ThingSource) -> Thing:
    """Load an object with its mass. Raises GraspdError: its mesh cannot be used."""
    kind, _, rest = source.source.partition(":")
    if f"{kind}:" == PREFIX:
        family, _, seed = rest.partition(":")
        drawn = draw_object(family, int(seed or 0))
        model = load_scene(drawn.mesh, mass=drawn.mass).object
    else:
        model = load_scene(source.source, mass=source.mass).object
        if source.mass is None:
            model = model.at_mass(SHAPE_DENSITY * model.volume)
    if not model.volume > 0:
        told = f"{source.source}: volume {model.volume:.3g} m³"
        raise MeshError(f"{told}; valid: a closed mesh whose faces point outwards")
    return Thing(source.name, model, object_parts(model), simplify(model.mesh, _SEEN_FACES))
