"""The immutable scene: the object with its mesh, mass and signed distance grid, its support and its obstacles.

A scene keeps the coordinates of its file. Float32 would round an object far from the origin, for example in map
coordinates. `near_scene` moves such a scene near the origin, and `moved_grasp` moves grasps back.

The confidence grid has the nodes of the signed distance grid. Confidence falls from 1 at seen to 0 at guessed surfaces.
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

from graspd_core.errors import ConfigError, MeshError
from graspd_core.mesh.components import bodies_apart
from graspd_core.mesh.convex_parts import convex_parts
from graspd_core.mesh.mesh_files import check_mesh, content_hash, mass_properties, surface_samples
from graspd_core.mesh.sdf import GridSDF, build_sdf, grid_layout, interpolate, is_solid
from graspd_core.mesh.sharp_features import sharp_points
from graspd_core.mesh.topology import far_centre, moved_mesh
from graspd_core.perception.reconstruct.merge_views import Evidence
from graspd_core.runtime import disk_cache as cache
from graspd_core.runtime.worker_process import run_isolated
from graspd_core.types import Grasp, Plane, TriangleMesh


def moved_sdf(sdf: GridSDF, offset: Float[np.ndarray, "3"]) -> GridSDF:
    """Return the SDF shifted by `offset` [m]. Its origin is in float64, because float32 rounds map coordinates."""
    origin = sdf.origin.double() + torch.as_tensor(offset, device=sdf.origin.device)
    return GridSDF(sdf.field, origin, sdf.spacing, sdf.half)


def moved_grasp(grasp: Grasp, offset: Float[np.ndarray, "3"]) -> Grasp:
    """Return the grasp shifted by `offset` [m], or the grasp itself if the offset is zero."""
    if not offset.any():
        return grasp
    postures = {name: getattr(grasp, name) for name in ("pregrasp", "grasp", "squeeze", "arrival")}
    moved = {name: replace(one, position=one.position + offset) for name, one in postures.items() if one is not None}
    contacts = (replace(one, position=tuple(np.add(one.position, offset).tolist())) for one in grasp.contacts)
    return replace(grasp, **moved, contacts=tuple(contacts))


# Nodes within this many cells of the surface take the confidence of their nearest vertex. Every surface has such nodes.
_NEAR_SURFACE_CELLS = 2.0


def confidence_grid(
    vertices: Float[np.ndarray, "vertices 3"], confidence: Float[np.ndarray, "vertices"], sdf: GridSDF
) -> Float[Tensor, "x y z"]:
    """Give nodes near the surface the confidence of the nearest vertex. All other nodes copy the nearest such node."""
    spacing = float(sdf.spacing)
    near = sdf.field[0].abs().cpu().numpy() < _NEAR_SURFACE_CELLS * spacing
    nodes = sdf.origin.cpu().numpy() + spacing * np.argwhere(near)
    grid = np.zeros(near.shape)
    grid[near] = confidence[KDTree(vertices).query(nodes)[1]]
    # For nodes far from the surface, a search among the vertices would take a second. The distance transform is fast.
    source: Any = distance_transform_edt(~near, return_distances=False, return_indices=True)
    return torch.as_tensor(grid[tuple(source)]).to(sdf.field)


def sample_confidence(
    grid: Float[Tensor, "x y z"], sdf: GridSDF, points: Float[Tensor, "batch points 3"]
) -> Float[Tensor, "batch points"]:
    """Interpolate the confidence at points [m], linearly and differentiably. Outside the grid, use its border value."""
    unit = points / sdf.half - (sdf.origin / sdf.half + 1).to(points)
    return interpolate(grid[None], unit.reshape(-1, 3)).reshape(points.shape[:-1])


# Meshes are simplified to this number of faces. More faces would be slow, and smaller than the cells of a 48³ grid.
MAX_FACES = 25_000

# Assumed mass of a household object of one litre [kg], and exponent of the volume. Large objects are hollow or light,
# and small objects may be metal. So the curve has water's density at 1.8 l, and solid steel's at 0.03 l. None of the
# ten YCB scans of the fit is above the curve. The heaviest scans, drill and hammer, reach 0.87 and 0.97 of it.
HEAVY_LITRE, HEAVY_GROWTH = 1.35, 0.5
# Valid masses of an object [kg]. Below a gram, the trials measure payloads that are too low.
MASSES = (1e-3, 100.0)

# Settings for cutting reconstructed or guessed surfaces into convex parts. They are accurate to millimetres only.
COARSE_CUTS: dict[str, Any] = {"tolerance": 0.003, "max_parts": 32, "surface_points": 2000}
# Obstacle grids: most nodes per side of a cube, least width of a cell [m], and free space around the obstacle [m].
_OBSTACLE_RESOLUTION, _OBSTACLE_CELL, _OBSTACLE_PADDING = 32, 0.005, 0.02
# Number of surface points of a reconstructed object that are searched for sharp points.
_COARSE_POOL = 2000


@dataclass(frozen=True)
class ObjectModel:
    """The object to grasp, in the object frame, which is the frame of the loaded and scaled mesh.

    Attributes:
        source: name of the object's source, such as its file, for messages.
        sha256: hash of the cleaned mesh's content.
        mesh: the cleaned mesh [m].
        volume: enclosed volume [m³].
        mass: mass [kg].
        mass_assumed: True if no mass was given. The mass is then `heavy_mass` of the volume.
        center_of_mass: centre of mass [m].
        inertia: inertia about the centre of mass, along the mesh axes [kg·m²].
        friction: Coulomb friction coefficient between object and hand.
        scale: factor by which the file's coordinates were multiplied.
        radius: distance from the centre of mass to the farthest vertex [m].
        warnings: problems found in the input, one sentence each.
        reconstructed: whether the mesh was reconstructed from camera data.
        file_state: `file_state` of the source when loading began. Empty if the source is not a file.
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
    file_state: tuple[int, ...] = ()

    def at_mass(self, mass: float) -> ObjectModel:
        """Return the object with another mass [kg] and proportional inertia."""
        return replace(self, mass=float(mass), inertia=self.inertia * (mass / self.mass))


@dataclass(frozen=True)
class Obstacle:
    """A body that the hand must not touch.

    Attributes:
        mesh: closed surface, object frame [m].
        sdf: signed distance grid of the body.
    """

    mesh: TriangleMesh
    sdf: GridSDF


@dataclass(frozen=True, eq=False)
class Scene:
    """The scene to plan grasps in, in the object frame.

    Attributes:
        object: the object to grasp.
        sdf: signed distance grid of the object.
        timing: time for loading and time for building the distance grid [s].
        support: plane that the object stands on, or None. Gravity points against the normal of the plane.
        obstacles: other bodies that the hand could reach.
        confidence: value at each node of `sdf`, from 1 near seen to 0 near guessed surface. None if all is known.
        evidence: camera evidence for other possible shapes of the object. None if the object was given as a mesh.
    """

    object: ObjectModel
    sdf: GridSDF
    timing: tuple[float, float]
    support: Plane | None = None
    obstacles: tuple[Obstacle, ...] = ()
    confidence: Float[torch.Tensor, "x y z"] | None = None
    evidence: Evidence | None = None

    def known_points(self) -> Float[np.ndarray, "points 3"]:
        """Return points on that part of the object's surface which was not guessed [m]."""
        if self.evidence is None:
            return np.vstack([self.object.mesh.vertices, surface_samples(self.object.mesh, _KNOWN_SAMPLES, 0)[0]])
        return self.evidence.seen.points @ self.evidence.rotation.T + self.evidence.origin


# Poses of objects, planes and obstacles are inexact. So an object may be this deep in another body, and this far above
# its support [m]. Cameras measure a few points far off: this fraction of an object's seen points does not count.
DEEPEST, _HIGHEST, SPARE = 0.01, 0.03, 0.05
_KNOWN_SAMPLES = 2000


def on_support(scene: Scene, support: Plane) -> Scene:
    """Return the scene with a support plane. Warn if an object of known shape is above the plane, instead of on it.

    Raises ConfigError: the plane cuts the object.
    """
    heights, source = scene.known_points() @ support.normal - support.offset, scene.object.source
    lowest = float(np.quantile(heights, 0.0 if scene.evidence is None else SPARE))
    if lowest < -DEEPEST:
        told = f"{source}: the object reaches {-1e3 * lowest:.0f} mm below its support plane"
        raise ConfigError(f"{told}; valid: at most {1e3 * DEEPEST:.0f} mm; correct the plane or the object's pose")
    if lowest > _HIGHEST and scene.evidence is None:
        told = f"{source}: the object is {1e2 * lowest:.0f} cm above its support plane"
        scene = replace(scene, object=replace(scene.object, warnings=(*scene.object.warnings, told)))
    return replace(scene, support=support)


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
    """Build the scene of a mesh in metres. Callers must check the numbers (`refuse_numbers`).

    Args:
        mesh: surface of the object [m].
        mass: mass of the object [kg]. None assumes `heavy_mass` of its volume and adds a warning.
        scale: factor by which the file's coordinates were already multiplied. It is only stored and named in messages.
        started: time when loading began (`time.perf_counter`), for the scene's timing. None means now.
        support: plane that the object stands on, or None.
        obstacles: other bodies near the object.
        confidence: confidence at each vertex, 1 if seen, 0 if guessed. None if all of the surface is known.
        ahead: called with the object before its distance grid is built, to start work that does not need the grid.

    Raises:
        MeshError: the mesh is not usable (`check_mesh`), or `confidence` has another length than the vertices.
        ConfigError: the support cuts an object whose surface is known.
    """
    if confidence is not None and len(confidence) != len(mesh.vertices):
        raise MeshError(
            f"{source}: {len(confidence)} values of confidence for {len(mesh.vertices)} vertices; valid: one per vertex"
        )
    started = time.perf_counter() if started is None else started
    clean, found = check_mesh(mesh, source, MAX_FACES, scale=scale, dusty=confidence is None)
    bodies, gap = bodies_apart(clean) if confidence is None else (1, 0.0)
    if bodies > 1:
        found += (f"{source}: {bodies} bodies, {1000 * gap:.0f} mm apart; they are grasped as one rigid object",)
    model = _object_model(clean, source, mass, friction, scale, warnings + found, confidence is not None)
    if ahead is not None:
        ahead(model)
    loaded = time.perf_counter()
    far = far_centre(clean.vertices)
    sdf = object_sdf(moved_object(model, -far), resolution)
    sdf = moved_sdf(sdf, far) if far.any() else sdf
    if not is_solid(sdf):
        cell = float(sdf.spacing) * 1000
        note = f"{source}: no node of the {cell:.1f} mm grid lies inside; the object counts as a sheet"
        model = ObjectModel(**{**vars(model), "warnings": (*model.warnings, note)})
    sdf = sdf.to(device, sdf.field.dtype)
    known = None if confidence is None else confidence_grid(mesh.vertices, confidence, sdf)
    timing = (loaded - started, time.perf_counter() - loaded)
    scene = Scene(model, sdf, timing, support, obstacles, known)
    return scene if support is None or known is not None else on_support(scene, support)


def object_sdf(model: ObjectModel, resolution: int = 48) -> GridSDF:
    """Return the signed distance grid (float32, CPU) of an object near the origin, with at most `resolution`³ nodes.

    The grid is cached by the mesh's content.
    """

    def build() -> cache.Arrays:
        sdf = build_sdf(model.mesh, resolution=resolution)
        return {name: tensor.numpy() for name, tensor in vars(sdf).items()}

    def valid(arrays: cache.Arrays) -> bool:
        counts, _, _ = grid_layout(model.mesh, resolution)
        shapes = {"field": (4, *counts), "origin": (3,), "spacing": (), "half": (3,)}
        return {name: array.shape for name, array in arrays.items()} == shapes

    arrays = cache.remember(f"sdf-{model.sha256}-{resolution}", build, valid)
    return GridSDF(**{name: torch.as_tensor(array) for name, array in arrays.items()})


def object_sharp_points(model: ObjectModel, count: int) -> tuple[Float[np.ndarray, "points 3"], float]:
    """Return the sharp points [m] and the thin fraction of the object's surface (`sharp_points`), cached by content."""
    coarse = {"pool": _COARSE_POOL} if model.reconstructed else {}

    def build() -> cache.Arrays:
        points, thin_share = sharp_points(model.mesh, count, **coarse)
        return {"points": points, "thin_share": np.array(thin_share)}

    def valid(arrays: cache.Arrays) -> bool:
        return set(arrays) == {"points", "thin_share"} and arrays["points"].shape[1:] == (3,)

    arrays = cache.remember(f"sharp-{model.sha256}-{count}{'-coarse' if coarse else ''}", build, valid)
    return arrays["points"], float(arrays["thin_share"])


def object_parts(model: ObjectModel) -> tuple[TriangleMesh, ...]:
    """Return a convex decomposition of the object, cached by content. Hollows of the object stay hollow.

    The parts of a reconstructed object are coarser, because camera data are coarse.
    """
    cuts = COARSE_CUTS if model.reconstructed else {}

    def build() -> cache.Arrays:
        # The cuts take some tenths of a second. They run in a child process, in parallel with the optimiser.
        parts = run_isolated(convex_parts, model.mesh, object_sdf(model), **cuts)
        return {f"{kind}{i}": getattr(part, kind) for i, part in enumerate(parts) for kind in ("vertices", "faces")}

    def valid(arrays: cache.Arrays) -> bool:
        names = {f"{kind}{i}" for i in range(len(arrays) // 2) for kind in ("vertices", "faces")}
        return bool(names) and set(arrays) == names and all(a.shape[1:] == (3,) for a in arrays.values())

    arrays = cache.remember(f"parts-{model.sha256}{'-coarse' if cuts else ''}", build, valid)
    return tuple(TriangleMesh(arrays[f"vertices{i}"], arrays[f"faces{i}"]) for i in range(len(arrays) // 2))


def near_scene(scene: Scene) -> tuple[Scene, Float[np.ndarray, "3"]]:
    """Return the scene moved near the origin, and the new origin in the given scene's frame [m].

    Move only objects that are farther from the origin than a hundred times their size. That far away, float32 cannot
    resolve contacts, and MuJoCo finds no contact. For nearer objects, return the scene itself and zero.
    """
    far = far_centre(scene.object.mesh.vertices)
    if not far.any():
        return scene, far
    plane = scene.support
    near = replace(
        scene,
        object=moved_object(scene.object, -far),
        sdf=moved_sdf(scene.sdf, -far),
        support=plane and replace(plane, offset=plane.offset - float(plane.normal @ far)),
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


def make_obstacle(mesh: TriangleMesh) -> Obstacle:
    """Return an obstacle with the surface `mesh`. The origin of its grid is in float64 (`moved_sdf`)."""
    far = far_centre(mesh.vertices)
    sides = np.ptp(mesh.vertices, axis=0) + 2 * _OBSTACLE_PADDING
    resolution = min(int(np.ceil(np.cbrt(sides.prod()) / _OBSTACLE_CELL)), _OBSTACLE_RESOLUTION)
    sdf = build_sdf(moved_mesh(mesh, -far), resolution=resolution, padding=_OBSTACLE_PADDING)
    return Obstacle(mesh, moved_sdf(sdf, far))


def moved_obstacle(neighbour: Obstacle, offset: Float[np.ndarray, "3"]) -> Obstacle:
    """Return the obstacle shifted by `offset` [m]."""
    return Obstacle(moved_mesh(neighbour.mesh, offset), moved_sdf(neighbour.sdf, offset))


def _object_model(mesh, source, mass, friction, scale, warnings, reconstructed) -> ObjectModel:
    volume, center, unit_inertia = mass_properties(mesh)
    assumed = mass is None
    if mass is None:
        mass = heavy_mass(volume)
        told = f"no mass was given: {mass:.2g} kg is assumed, the greatest plausible mass for {volume * 1e6:.0f} cm³"
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
    """Return the greatest mass [kg] that a household object of this volume [m³] may have, of any material."""
    return HEAVY_LITRE * (1e3 * volume) ** HEAVY_GROWTH


def refuse_numbers(source: str, *, mass: float | None, friction: float, resolution: int, scale: float = 1.0) -> None:
    if not (np.isfinite(scale) and scale > 0):
        raise MeshError(f"{source}: scale {scale!r} must be a positive number")
    if mass is not None and not MASSES[0] <= mass <= MASSES[1]:
        raise MeshError(f"{source}: mass {mass!r} kg; valid: {MASSES[0]:g} to {MASSES[1]:g} kg")
    # More is a percentage or an angle in degrees. Rubber has about 1.
    if not 0 < friction <= 5:
        raise MeshError(f"{source}: friction {friction!r}; valid: above 0, up to 5")
    if not 8 <= resolution <= 256:
        raise MeshError(f"{source}: resolution {resolution!r} must be between 8 and 256 nodes")
