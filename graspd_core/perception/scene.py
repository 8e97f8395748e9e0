"""The frozen scene: the object's mesh, its mass and its signed distance, and what stands around it.

A scene keeps the coordinates of its file. Float32 would round an object far from the origin, as in the coordinates of a
map: `near_scene` moves a whole scene about its object, and `moved_grasp` brings grasps back.

Confidence says how far the object's surface is known, as a grid beside its signed distance: 1 where it was seen, 0
where it was guessed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import grid_sample

from graspd_core.errors import MeshError
from graspd_core.mesh.components import bodies_apart
from graspd_core.mesh.convex_parts import convex_parts
from graspd_core.mesh.mesh_files import check_mesh, content_hash, mass_properties
from graspd_core.mesh.sdf import GridSDF, build_sdf, grid_layout, is_solid
from graspd_core.mesh.sharp_features import sharp_points
from graspd_core.mesh.topology import far_centre, moved_mesh
from graspd_core.perception.reconstruct.merge_views import Evidence
from graspd_core.runtime import disk_cache as cache
from graspd_core.runtime.worker_process import run_isolated
from graspd_core.types import Contact, Grasp, Plane, Posture, TriangleMesh


def moved_sdf(sdf: GridSDF, offset: Float[np.ndarray, "3"]) -> GridSDF:
    """Return the SDF shifted by `offset` [m]."""
    origin = sdf.origin.double() + torch.as_tensor(offset, device=sdf.origin.device)
    return GridSDF(sdf.field, origin.to(sdf.origin), sdf.spacing, sdf.half)


def moved_plane(plane: Plane, offset: Float[np.ndarray, "3"]) -> Plane:
    """Return the plane shifted by `offset` [m]."""
    return Plane(plane.normal, plane.offset + float(plane.normal @ offset))


def moved_grasp(grasp: Grasp, offset: Float[np.ndarray, "3"]) -> Grasp:
    """Return the grasp shifted by `offset` [m], or the grasp itself if the offset is zero."""
    if not offset.any():
        return grasp

    def posture(given: Posture) -> Posture:
        return replace(given, position=given.position + offset)

    def contact(given: Contact) -> Contact:
        x, y, z = (np.array(given.position) + offset).tolist()
        return replace(given, position=(x, y, z))

    postures = {name: posture(getattr(grasp, name)) for name in ("pregrasp", "grasp", "squeeze")}
    return replace(grasp, **postures, contacts=tuple(map(contact, grasp.contacts)))


# Cells from the surface within which a node looks for its vertex; every surface has nodes this near.
_NEAR_SURFACE_CELLS = 2.0


def confidence_grid(
    vertices: Float[np.ndarray, "vertices 3"], confidence: Float[np.ndarray, "vertices"], sdf: GridSDF
) -> Float[Tensor, "x y z"]:
    """Return the confidence in the vertex nearest to each node by the surface, elsewhere of the nearest such node."""
    spacing = float(sdf.spacing)
    near = sdf.field[0].abs().cpu().numpy() < _NEAR_SURFACE_CELLS * spacing
    nodes = sdf.origin.cpu().numpy() + spacing * np.argwhere(near)
    grid = np.zeros(near.shape)
    grid[near] = confidence[KDTree(vertices).query(nodes)[1]]
    # Far from the vertices a search among them costs a second; a step on the grid costs nothing.
    source: Any = distance_transform_edt(~near, return_distances=False, return_indices=True)
    return torch.as_tensor(grid[tuple(source)]).to(sdf.field)


def sample_confidence(
    grid: Float[Tensor, "x y z"], sdf: GridSDF, points: Float[Tensor, "batch points 3"]
) -> Float[Tensor, "batch points"]:
    """Interpolate linearly, beyond the grid from its border. Differentiable in the points."""
    unit = points / sdf.half - (sdf.origin / sdf.half + 1)
    # grid_sample takes x for the last axis of its input.
    field = grid.permute(2, 1, 0)[None, None]
    sampled = grid_sample(field, unit.reshape(1, 1, 1, -1, 3), align_corners=True, padding_mode="border")
    return sampled.reshape(points.shape[:-1])


# Faces beyond this are smaller than the cells of a 48³ grid: nothing that it or a hand could feel, and slow to build.
MAX_FACES = 25_000

# What a household thing of one litre may weigh [kg], and how that grows with its volume. The line is water's density at
# 1.8 l, and that of solid steel at 0.03 l: large things are hollow or light inside, and small ones may be metal. Of the
# ten YCB scans that it was fitted on, none is heavier. The heaviest, drill and hammer, reach 0.87 and 0.97 of it.
HEAVY_LITRE, HEAVY_GROWTH = 1.35, 0.5

# How a surface is cut into convex parts that is known to millimetres only, from cameras or by guess.
COARSE_CUTS: dict[str, Any] = {"tolerance": 0.003, "max_parts": 32, "surface_points": 2000}
# How many places of it are looked at for sharp ones.
_COARSE_POOL = 2000


@dataclass(frozen=True)
class ObjectModel:
    """The thing to grasp, in its own frame (that of its mesh as loaded, after scaling).

    Attributes:
        source: where it came from, for messages.
        sha256: hash of the cleaned mesh's content.
        mesh: the cleaned surface [m].
        volume: enclosed volume [m³].
        mass: [kg].
        mass_assumed: whether nobody gave the mass, so that it is the heavy end of what the volume allows.
        center_of_mass: [m].
        inertia: about the centre of mass, mesh axes [kg·m²].
        friction: Coulomb coefficient against the hand.
        scale: factor that the file's coordinates were multiplied by.
        radius: distance from the centre of mass to the farthest vertex [m].
        warnings: what was found wrong with the input, one sentence each.
        reconstructed: whether the mesh was made of what cameras saw.
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
    reconstructed: bool = False
    mass_assumed: bool = False

    def at_mass(self, mass: float) -> ObjectModel:
        """Return the same object of another mass [kg], spread as before."""
        return replace(self, mass=float(mass), inertia=self.inertia * (mass / self.mass))


@dataclass(frozen=True)
class Obstacle:
    """A thing that the hand must not touch.

    Attributes:
        mesh: its closed surface, in the object's frame [m].
        sdf: its signed distance.
    """

    mesh: TriangleMesh
    sdf: GridSDF


@dataclass(frozen=True, eq=False)
class Scene:
    """What a grasp is planned against, all in the object's frame.

    Attributes:
        object: the thing to grasp.
        sdf: its signed distance.
        timing: seconds taken by loading and by the distance field.
        support: what the object stands on, if anything. Gravity points against its normal.
        obstacles: other things, only those that the hand could reach.
        confidence: how far the surface nearest to each node of `sdf` was seen, 1, or guessed, 0. None: all of it known.
        evidence: of what else may be true of an object that cameras saw. None for a mesh.
    """

    object: ObjectModel
    sdf: GridSDF
    timing: tuple[float, float]
    support: Plane | None = None
    obstacles: tuple[Obstacle, ...] = ()
    confidence: Float[torch.Tensor, "x y z"] | None = None
    evidence: Evidence | None = None


def build_scene(
    mesh: TriangleMesh,
    *,
    source: str = "mesh",
    mass: float | None = None,
    friction: float = 0.6,
    scale: float = 1.0,
    resolution: int = 48,
    device: torch.device | str = "cpu",
    warnings: tuple[str, ...] = (),
    started: float | None = None,
    support: Plane | None = None,
    obstacles: tuple[Obstacle, ...] = (),
    confidence: Float[np.ndarray, "vertices"] | None = None,
    ahead: Callable[[ObjectModel], None] | None = None,
) -> Scene:
    """Build the scene of a mesh already in metres.

    Its callers check the numbers (`refuse_numbers`). `scale` is what its file was multiplied by, for record and advice.

    Args:
        mass: [kg]. None assumes the most that a thing of its volume may weigh (`heavy_mass`), and warns of it.
        support: what the object stands on.
        obstacles: other things near it.
        confidence: how far each of the mesh's vertices was seen, 1, or guessed, 0. None where all of it is known.
        ahead: called with the object before its distance grid is built, to begin what does without.

    Raises:
        MeshError: see `load_scene`, or there is not one confidence for every vertex.
    """
    if confidence is not None and len(confidence) != len(mesh.vertices):
        raise MeshError(
            f"{source}: {len(confidence)} values of confidence for {len(mesh.vertices)} vertices; valid: one each"
        )
    started = time.perf_counter() if started is None else started
    clean, found = check_mesh(mesh, source, MAX_FACES, scale=scale, dusty=confidence is None)
    bodies, gap = bodies_apart(clean) if confidence is None else (1, 0.0)
    if bodies > 1:
        found += (f"{source}: {bodies} bodies, {1000 * gap:.0f} mm apart; they are grasped as one rigid thing",)
    model = _object_model(clean, source, mass, friction, scale, warnings + found, confidence is not None)
    if ahead is not None:
        ahead(model)
    loaded = time.perf_counter()
    far = far_centre(clean.vertices)
    sdf = object_sdf(moved_object(model, -far), resolution)
    sdf = moved_sdf(sdf, far) if far.any() else sdf
    if not is_solid(sdf):
        cell = float(sdf.spacing) * 1000
        note = f"{source}: encloses nothing that a grid of {cell:.1f} mm cells can see; it counts as a sheet"
        model = ObjectModel(**{**vars(model), "warnings": (*model.warnings, note)})
    sdf = sdf.to(device, sdf.field.dtype)
    known = None if confidence is None else confidence_grid(mesh.vertices, confidence, sdf)
    timing = (loaded - started, time.perf_counter() - loaded)
    return Scene(model, sdf, timing, support, obstacles, known)


def object_sdf(model: ObjectModel, resolution: int = 48) -> GridSDF:
    """Return the signed distance of an object near the origin (float32, CPU) on at most `resolution`³ nodes.

    Remembered by content.
    """

    def build() -> cache.Arrays:
        sdf = build_sdf(model.mesh, resolution=resolution)
        return {name: tensor.numpy() for name, tensor in vars(sdf).items()}

    def valid(arrays: cache.Arrays) -> bool:
        shapes = {
            "field": (4, *grid_layout(model.mesh, resolution).counts),
            "origin": (3,),
            "spacing": (),
            "half": (3,),
        }
        return {name: array.shape for name, array in arrays.items()} == shapes

    arrays = cache.remember(f"sdf-{model.sha256}-{resolution}", build, valid)
    return GridSDF(**{name: torch.as_tensor(array) for name, array in arrays.items()})


def object_sharp_points(model: ObjectModel, count: int) -> tuple[Float[np.ndarray, "points 3"], float]:
    """Return the object's sharp points [m] and its share of thin surface (`sharp_points`), remembered by content."""
    coarse = {"pool": _COARSE_POOL} if model.reconstructed else {}

    def build() -> cache.Arrays:
        points, thin_share = sharp_points(model.mesh, count, **coarse)
        return {"points": points, "thin_share": np.array(thin_share)}

    def valid(arrays: cache.Arrays) -> bool:
        return set(arrays) == {"points", "thin_share"} and arrays["points"].shape[1:] == (3,)

    arrays = cache.remember(f"sharp-{model.sha256}-{count}{'-coarse' if coarse else ''}", build, valid)
    return arrays["points"], float(arrays["thin_share"])


def object_parts(model: ObjectModel) -> tuple[TriangleMesh, ...]:
    """Convex parts that together fill the object and leave its hollows hollow, remembered by content.

    Those of a reconstructed object are coarser: cameras do not see it finer than that.
    """
    cuts = COARSE_CUTS if model.reconstructed else {}

    def build() -> cache.Arrays:
        # Some tenths of a second of Python's own work, beside the optimiser.
        parts = run_isolated(convex_parts, model.mesh, object_sdf(model), **cuts)
        return {f"{kind}{i}": getattr(part, kind) for i, part in enumerate(parts) for kind in ("vertices", "faces")}

    def valid(arrays: cache.Arrays) -> bool:
        names = {f"{kind}{i}" for i in range(len(arrays) // 2) for kind in ("vertices", "faces")}
        return bool(names) and set(arrays) == names and all(a.shape[1:] == (3,) for a in arrays.values())

    arrays = cache.remember(f"parts-{model.sha256}{'-coarse' if cuts else ''}", build, valid)
    return tuple(TriangleMesh(arrays[f"vertices{i}"], arrays[f"faces{i}"]) for i in range(len(arrays) // 2))


def near_scene(scene: Scene) -> tuple[Scene, Float[np.ndarray, "3"]]:
    """Return a scene about its object, and where its origin lies in the scene given [m].

    The origin moves for an object farther from it than a hundred times its size: float32 could not tell a contact there
    from a gap, and MuJoCo finds none. Otherwise this is the scene itself, and zero.
    """
    far = far_centre(scene.object.mesh.vertices)
    if not far.any():
        return scene, far
    near = replace(
        scene,
        object=moved_object(scene.object, -far),
        sdf=moved_sdf(scene.sdf, -far),
        support=scene.support and moved_plane(scene.support, -far),
        obstacles=tuple(moved_obstacle(obstacle, -far) for obstacle in scene.obstacles),
        evidence=scene.evidence and replace(scene.evidence, origin=scene.evidence.origin - far),
    )
    return near, far


def moved_object(model: ObjectModel, offset: Float[np.ndarray, "3"]) -> ObjectModel:
    """Return the object shifted by `offset` [m], or the object itself if the offset is zero."""
    if not offset.any():
        return model
    mesh = moved_mesh(model.mesh, offset)
    return replace(model, mesh=mesh, sha256=content_hash(mesh), center_of_mass=model.center_of_mass + offset)


def moved_obstacle(neighbour: Obstacle, offset: Float[np.ndarray, "3"]) -> Obstacle:
    """Return the obstacle shifted by `offset` [m]."""
    return Obstacle(moved_mesh(neighbour.mesh, offset), moved_sdf(neighbour.sdf, offset))


def _object_model(mesh, source, mass, friction, scale, warnings, reconstructed) -> ObjectModel:
    volume, center, unit_inertia = mass_properties(mesh)
    assumed = mass is None
    if mass is None:
        mass = heavy_mass(volume)
        told = f"no mass was given: {mass:.2g} kg is assumed, the heavy end for its volume of {volume * 1e6:.0f} cm³"
        warnings += (f"{source}: {told}",)
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
        reconstructed=reconstructed,
        mass_assumed=assumed,
    )


def heavy_mass(volume: float) -> float:
    """Return the most that a household thing of a volume [m³] may weigh [kg], full or hollow, metal or not."""
    return HEAVY_LITRE * (1e3 * volume) ** HEAVY_GROWTH


def refuse_numbers(source: str, *, mass: float | None, friction: float, resolution: int, scale: float = 1.0) -> None:
    if not (np.isfinite(scale) and scale > 0):
        raise MeshError(f"{source}: scale {scale!r} must be a positive number")
    if mass is not None and not (np.isfinite(mass) and mass > 0):
        raise MeshError(f"{source}: mass {mass!r} kg must be a positive number")
    if not (np.isfinite(friction) and friction > 0):
        raise MeshError(f"{source}: friction {friction!r} must be a positive number")
    if not 8 <= resolution <= 256:
        raise MeshError(f"{source}: resolution {resolution!r} must be between 8 and 256 nodes")
