"""From a file, a named shape or a mesh to a frozen scene: the object's mesh, its mass and its signed distance."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.errors import MeshError
from graspd_core.geometry import cache
from graspd_core.geometry.cloud import CLOUD_ENDINGS, is_cloud_file, load_cloud
from graspd_core.geometry.convex import convex_parts
from graspd_core.geometry.mesh import MESH_ENDINGS, check_mesh, content_hash, load_mesh, mass_properties, simplify
from graspd_core.geometry.reconstruct import reconstruct
from graspd_core.geometry.sdf import GridSDF, build_sdf, is_solid
from graspd_core.geometry.shapes import make_shape
from graspd_core.types import Plane, TriangleMesh

SHAPE_PREFIX = "shape:"

# Faces beyond this add nothing that a 48³ grid or a hand could feel, and cost build time.
MOST_FACES = 50_000

# Mean density of household things [kg/m³], for callers that know no mass: between wood-like solids and hollow ware.
DENSITY = 300.0


@dataclass(frozen=True)
class ObjectModel:
    """The thing to grasp, in its own frame (that of its mesh as loaded, after scaling).

    Attributes:
        source: where it came from, for messages.
        sha256: hash of the cleaned mesh's content.
        mesh: the cleaned surface [m].
        volume: enclosed volume [m³].
        mass: [kg].
        center_of_mass: [m].
        inertia: about the centre of mass, mesh axes [kg·m²].
        friction: Coulomb coefficient against the hand.
        scale: factor that the file's coordinates were multiplied by.
        radius: distance from the centre of mass to the farthest vertex [m].
        warnings: what was found wrong with the input, one sentence each.
    """

    source: str
    sha256: str
    mesh: TriangleMesh
    volume: float
    mass: float
    center_of_mass: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]
    friction: float
    scale: float
    radius: float
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Neighbour:
    """A thing that the hand must not touch.

    Attributes:
        mesh: its closed surface, in the object's frame [m].
        sdf: its signed distance.
    """

    mesh: TriangleMesh
    sdf: GridSDF


@dataclass(frozen=True)
class Scene:
    """What a grasp is planned against; all in the object's frame.

    Attributes:
        object: the thing to grasp.
        sdf: its signed distance.
        timing: seconds taken by loading and by the distance field.
        support: what the object stands on, if anything; gravity points against its normal.
        neighbours: other things, only those that the hand could reach.
        trust: how far the surface nearest to each node of `sdf` was seen, 1, or guessed, 0; None: all of it is known.
    """

    object: ObjectModel
    sdf: GridSDF
    timing: tuple[float, float]
    support: Plane | None = None
    neighbours: tuple[Neighbour, ...] = ()
    trust: Float[torch.Tensor, "x y z"] | None = None


def load_scene(
    source: str | Path | TriangleMesh,
    *,
    mass: float | None = 0.1,
    friction: float = 0.6,
    scale: float = 1.0,
    resolution: int = 48,
    device: torch.device | str = "cpu",
) -> Scene:
    """Build the scene of one object.

    Args:
        source: a mesh file, a point cloud file (a solid is reconstructed), `shape:NAME`, or a mesh.
        mass: [kg]; None takes 300 kg/m³ times the volume.
        friction: Coulomb coefficient between hand and object.
        scale: factor on the file's coordinates to make them metres.
        resolution: nodes along each axis of the distance grid.

    Raises:
        MeshError: the mesh cannot be read or used, or a number is out of range.
        CloudError: the cloud cannot be read or shows no object.
    """
    start = time.perf_counter()
    given = "mesh" if isinstance(source, TriangleMesh) else str(source)
    _refuse_numbers(given, mass=mass, friction=friction, resolution=resolution, scale=scale)
    mesh, name, warnings = _read_source(source, scale)
    return build_scene(
        mesh,
        source=name,
        mass=mass,
        friction=friction,
        scale=scale,
        resolution=resolution,
        device=device,
        warnings=warnings,
        started=start,
    )


def scene_from_cloud(
    points: Float[np.ndarray, "n 3"],
    *,
    viewpoint: tuple[float, float, float] = (0.0, 0.0, 0.0),
    mass: float | None = 0.1,
    friction: float = 0.6,
    source: str = "cloud",
    resolution: int = 48,
) -> Scene:
    """The scene of an object that a camera saw, in the cloud's frame; what was guessed is in the object's warnings.

    Args:
        points: the object's points alone [m]; NaN and stray points are dropped.
        viewpoint: where the camera stood [m].
        mass: [kg]; None takes 300 kg/m³ times the volume.
        friction: Coulomb coefficient between hand and object.
        source: name of the cloud, for messages.
        resolution: nodes along each axis of the distance grid.

    Raises:
        CloudError: the points show no usable object.
        MeshError: the object they show is too small or too large, or a number is out of range.
    """
    started = time.perf_counter()
    _refuse_numbers(source, mass=mass, friction=friction, resolution=resolution)
    mesh, warnings = reconstruct(points, viewpoint=viewpoint)
    return build_scene(
        mesh,
        source=source,
        mass=mass,
        friction=friction,
        resolution=resolution,
        warnings=warnings,
        started=started,
    )


def build_scene(
    mesh: TriangleMesh,
    *,
    source: str = "mesh",
    mass: float | None = 0.1,
    friction: float = 0.6,
    scale: float = 1.0,
    resolution: int = 48,
    device: torch.device | str = "cpu",
    warnings: tuple[str, ...] = (),
    started: float | None = None,
) -> Scene:
    """The scene of a mesh already in metres; `scale` is only recorded. Raises MeshError, see `load_scene`."""
    started = time.perf_counter() if started is None else started
    _refuse_numbers(source, mass=mass, friction=friction, resolution=resolution, scale=scale)
    clean, found = check_mesh(mesh, source)
    if len(clean.faces) > MOST_FACES:
        found += (f"{source}: simplified from {len(clean.faces)} to {MOST_FACES} faces",)
        clean, _ = check_mesh(simplify(clean, MOST_FACES), source)
    model = _object_model(clean, source, mass, friction, scale, warnings + found)
    loaded = time.perf_counter()
    sdf = object_sdf(model, resolution)
    if not is_solid(sdf):
        cell = float(sdf.spacing) * 1000
        note = f"{source}: encloses nothing that a grid of {cell:.1f} mm cells can see; distances are unsigned"
        model = ObjectModel(**{**vars(model), "warnings": (*model.warnings, note)})
    sdf = sdf.to(device, sdf.field.dtype)
    return Scene(model, sdf, (loaded - started, time.perf_counter() - loaded))


def object_sdf(model: ObjectModel, resolution: int = 48) -> GridSDF:
    """The object's signed distance (float32, CPU), remembered by content."""

    def build() -> cache.Arrays:
        sdf = build_sdf(model.mesh, resolution=resolution)
        return {"field": sdf.field.numpy(), "origin": sdf.origin.numpy(), "spacing": sdf.spacing.numpy()}

    def valid(arrays: cache.Arrays) -> bool:
        return {name: array.shape for name, array in arrays.items()} == {
            "field": (4, resolution, resolution, resolution),
            "origin": (3,),
            "spacing": (),
        }

    arrays = cache.remember(f"sdf-{model.sha256}-{resolution}", build, valid)
    return GridSDF(*(torch.as_tensor(arrays[name]) for name in ("field", "origin", "spacing")))


def object_parts(model: ObjectModel) -> tuple[TriangleMesh, ...]:
    """Convex parts that together fill the object and leave its hollows hollow, remembered by content."""

    def build() -> cache.Arrays:
        parts = convex_parts(model.mesh)
        return {f"{kind}{i}": getattr(part, kind) for i, part in enumerate(parts) for kind in ("vertices", "faces")}

    def valid(arrays: cache.Arrays) -> bool:
        names = {f"{kind}{i}" for i in range(len(arrays) // 2) for kind in ("vertices", "faces")}
        return bool(names) and set(arrays) == names and all(a.shape[1:] == (3,) for a in arrays.values())

    arrays = cache.remember(f"parts-{model.sha256}", build, valid)
    return tuple(TriangleMesh(arrays[f"vertices{i}"], arrays[f"faces{i}"]) for i in range(len(arrays) // 2))


def _read_source(source: str | Path | TriangleMesh, scale: float) -> tuple[TriangleMesh, str, tuple[str, ...]]:
    if isinstance(source, TriangleMesh):
        return TriangleMesh(source.vertices * scale, source.faces), "mesh", ()
    name = str(source)
    if name.startswith(SHAPE_PREFIX):
        shape = make_shape(name.removeprefix(SHAPE_PREFIX))
        return TriangleMesh(shape.vertices * scale, shape.faces), name, ()
    if is_cloud_file(source):
        cloud = load_cloud(source)
        mesh, warnings = reconstruct(cloud.points * scale, viewpoint=tuple(cloud.viewpoint * scale))
        return mesh, name, warnings
    endings = sorted({*MESH_ENDINGS, *CLOUD_ENDINGS})
    if Path(source).is_file() and Path(source).suffix.lower().lstrip(".") not in endings:
        raise MeshError(f"{name}: unknown ending {Path(source).suffix!r}; valid endings: {', '.join(endings)}")
    return load_mesh(source, scale=scale), name, ()


def _object_model(mesh, source, mass, friction, scale, warnings) -> ObjectModel:
    volume, center, unit_inertia = mass_properties(mesh)
    mass = DENSITY * volume if mass is None else mass
    return ObjectModel(
        source=source,
        sha256=content_hash(mesh),
        mesh=mesh,
        volume=volume,
        mass=float(mass),
        center_of_mass=center,
        inertia=unit_inertia * (mass / volume),
        friction=float(friction),
        scale=float(scale),
        radius=float(np.linalg.norm(mesh.vertices - center, axis=1).max()),
        warnings=warnings,
    )


def _refuse_numbers(source: str, *, mass: float | None, friction: float, resolution: int, scale: float = 1.0) -> None:
    if not (np.isfinite(scale) and scale > 0):
        raise MeshError(f"{source}: scale {scale!r} must be a positive number")
    if mass is not None and not (np.isfinite(mass) and mass > 0):
        raise MeshError(f"{source}: mass {mass!r} kg must be a positive number")
    if not (np.isfinite(friction) and friction > 0):
        raise MeshError(f"{source}: friction {friction!r} must be a positive number")
    if not 8 <= resolution <= 256:
        raise MeshError(f"{source}: resolution {resolution!r} must be between 8 and 256 nodes")
