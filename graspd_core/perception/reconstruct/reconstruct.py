"""Reconstruct a closed mesh from one or more views of an object, with the confidence of each part.

The hidden part is guessed first, by the symmetry, revolution or extrusion that fits the views best. Then screened
Poisson reconstruction fits a surface to seen and guessed points. The surface is computed on a grid, and again by Open3D
if the first surface does not fit. Space that the cameras saw to be empty is cut away.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from graspd_core.config import ReconstructionConfig
from graspd_core.errors import CloudError, MeshError
from graspd_core.mesh.mesh_files import check_mesh, simplify
from graspd_core.mesh.surface_queries import make_surface, surface_distance
from graspd_core.mesh.topology import is_closed, scaled_normals
from graspd_core.perception.cloud.free_space import FreeSpace, make_view_depths
from graspd_core.perception.cloud.point_cloud import PointCloud, Points, Vector, clean_cloud, measured
from graspd_core.perception.cloud.viewpoint_check import refuse_no_place
from graspd_core.perception.reconstruct import poisson
from graspd_core.perception.reconstruct.extrusion import MAX_FOOT_HEIGHT_M, with_foot
from graspd_core.perception.reconstruct.merge_views import (
    Evidence,
    Surfels,
    is_unposed,
    join,
    merge_views,
    nothing,
    orient_unposed,
    point_step,
)
from graspd_core.perception.reconstruct.shape_completion import Completion, complete_shape
from graspd_core.se3 import perpendicular
from graspd_core.types import Plane, TriangleMesh

# Least fraction of the seen points that must lie on the mesh.
MIN_FITTED_SHARE = 0.85
# An object smaller than this many cells of least width comes out too thick on the grid. Open3D's solver is used then.
_LEAST_CELLS = 8
# An all-round cloud gets a finer grid if the usual grid would thicken its walls at more than this fraction of points.
# The finer grid has _WALL_CELLS cells along the longest side. Its least cell width is _WALL_CELL times the usual one.
# Walls of 4 mm then come out as 4 mm, not 5 mm, in 1.8 s of one core instead of 1.2 s.
_THIN_SHARE, _WALL_CELLS, _WALL_CELL = 0.1, 100, 0.7
# A face belongs to the object's foot only if the cosine of its normal to straight down is above this.
_DOWN = 0.7


@dataclass(frozen=True)
class Reconstruction:
    """A closed mesh, and how it was reconstructed.

    Attributes:
        mesh: the closed mesh, in the frame of the views [m].
        confidence: confidence of each vertex, from 1 at seen surface down to 0 far from seen surface.
        warnings: what was guessed, one sentence each.
        evidence: what the cameras saw, for other guesses of the hidden side.
    """

    mesh: TriangleMesh
    confidence: Float[np.ndarray, "vertices"]
    warnings: tuple[str, ...]
    evidence: Evidence


def reconstruct(
    views: Sequence[PointCloud],
    support: Plane | None = None,
    settings: ReconstructionConfig | None = None,
    whole: Sequence[PointCloud] = (),
) -> Reconstruction:
    """Reconstruct a closed mesh of the object that the views show.

    Args:
        views: the object's points as each camera saw them, all in one frame. NaN and stray points are dropped. A single
            cloud that shows the object from all round may replace several views.
        support: plane that the object stands on, in the same frame.
        settings: precision of the cameras, and sizes.
        whole: all points that the same cameras saw. They show what hides parts of the object.

    Raises:
        CloudError: too few points, no closed surface fits them, or the surface is too small or too large for a hand.
    """
    settings = settings or ReconstructionConfig()
    axis_known = views[0].forward is not None if views else False
    views = _clean(views, settings)
    rotation, origin = _frame(views, support)
    local = [_in_frame(view, rotation, origin) for view in views]
    by_eye = _by_eye(whole)
    around = [_in_frame(by_eye[tuple(view.viewpoint)], rotation, origin) for view in views] if whole else ()
    step = point_step(local)
    standing, cells = support is not None, poisson.GRID_CELLS
    unposed = len(local) == 1 and is_unposed(local[0], axis_known)
    if unposed:
        seen, free_space = orient_unposed(local[0], step), FreeSpace((), standing, 0.0, settings.outline_slack)
        guess = Completion("", nothing(), 0.0)
        if _has_thin_walls(seen, settings.min_cell):
            settings, cells = replace(settings, min_cell=_WALL_CELL * settings.min_cell), _WALL_CELLS
    else:
        seen = merge_views(local, step, settings)
        lowest = float(np.clip(np.percentile(seen.points[:, 2], 0.5), 0.0, MAX_FOOT_HEIGHT_M)) if standing else 0.0
        free_space = FreeSpace(
            make_view_depths(local, around), standing, lowest, settings.outline_slack, settings.surface_tolerance
        )
        guess = complete_shape(seen, free_space, step, settings)
    evidence = Evidence(seen, free_space, step, rotation, origin, guess.method, settings, hidden=False)
    try:
        mesh = _closed(evidence, guess.surfels, cells)
    except CloudError:
        if not guess.method:
            raise
        # No surface fits both the guess and the seen points, so the guess is wrong. Robustness checks may use the rule
        # again, if its shape fits on their coarser grid.
        guess, evidence = replace(guess, method="", surfels=nothing()), replace(evidence, chosen="")
        mesh = _closed(evidence, guess.surfels, cells)
    confidence = _confidence(mesh, np.concatenate([view.points for view in local]), settings)
    hidden = not unposed and _is_guessed(mesh, evidence, guess, confidence, len(local))
    by = guess.method or "closing the surface smoothly within the cameras' outlines"
    sides = "one side only" if len(views) == 1 else f"{len(views)} sides, not all round"
    warnings = (f"cloud: seen from {sides}; the rest is guessed by {by}",) if hidden else ()
    mesh = TriangleMesh(mesh.vertices @ rotation.T + origin, mesh.faces)
    return Reconstruction(mesh, confidence, warnings, replace(evidence, hidden=hidden))


def _by_eye(whole: Sequence[PointCloud]) -> dict[tuple[float, ...], PointCloud]:
    """Return what was seen from each camera position. Several clouds of a camera that only turned become one cloud."""
    places = [tuple(view.viewpoint.astype(float)) for view in whole]
    found = {place: [view for view, at in zip(whole, places, strict=True) if at == place] for place in places}
    return {place: replace(of[0], points=np.concatenate([v.points for v in of])) for place, of in found.items()}


def _in_frame(view: PointCloud, rotation: Float[np.ndarray, "3 3"], origin: Vector) -> PointCloud:
    # Some drivers send infinity for missing depth. Infinity becomes NaN here.
    with np.errstate(invalid="ignore"):
        return PointCloud((view.points - origin) @ rotation, (view.viewpoint - origin) @ rotation)


def _has_thin_walls(seen: Surfels, least: float) -> bool:
    moved = poisson.part_walls(seen, poisson.grid_cell(seen, least)).points != seen.points
    return float(moved.any(1).mean()) > _THIN_SHARE


def _closed(evidence: Evidence, guess: Surfels, cells: int) -> TriangleMesh:
    """Close the surface by the grid solver. Use Open3D's solver if the settings ask for it or no surface fits."""
    settings = evidence.settings
    adaptive = partial(poisson.poisson_field, finest=settings.poisson_cell)
    small = float(np.ptp(evidence.seen.points, axis=0).max()) < _LEAST_CELLS * settings.min_cell
    if settings.poisson == "grid" and not small:
        with suppress(CloudError):
            return closed_mesh(evidence, guess, poisson.grid_poisson_field, cells)
    return closed_mesh(evidence, guess, adaptive, cells)


def closed_mesh(evidence: Evidence, guess: Surfels, field: poisson.Field, cells: int) -> TriangleMesh:
    """Return a closed mesh through the seen and the guessed surfels, down to the support if there is one.

    Args:
        field: function that fits a surface to points.
        cells: number of grid cells along the object's longest side.

    Raises:
        CloudError: no closed surface fits the seen points.
    """
    free_space, least = evidence.free_space, evidence.settings.min_cell
    known = with_foot(join(evidence.seen, guess), free_space, evidence.step)
    known = poisson.part_walls(known, poisson.grid_cell(known, least, cells))
    cell = poisson.grid_cell(known, least, cells)
    return _finished(poisson.close_surface(known, field, free_space, cell), evidence.seen, evidence.settings)


def _clean(views: Sequence[PointCloud], settings: ReconstructionConfig) -> list[PointCloud]:
    """Drop points that are not finite or far from the others, and views with too few points for a surface."""
    if len(views) == 0:
        raise CloudError("cloud: no view at all; at least one is needed")
    for view in views:
        refuse_no_place(view.viewpoint)
    most = settings.max_points // len(views)
    kept = [_some(view, most) for view in views]
    clean = clean_cloud(np.concatenate(kept))
    tree = KDTree(clean)
    near = 3 * float(np.median(tree.query(clean, k=2)[0][:, 1]))
    result = []
    for points, view in zip(kept, views, strict=True):
        points = points[tree.query(points, distance_upper_bound=near)[0] < near] if len(points) else points
        # About a thousand points are checked. One point sent many times is no surface, but would mark space as empty.
        if len(np.unique(points[:: 1 + len(points) // 1000], axis=0)) > settings.neighbours:
            result.append(PointCloud(points, view.viewpoint.astype(float)))
    if not result:
        raise CloudError(
            f"cloud: none of its {len(views)} views shows more than {settings.neighbours} points of the object"
        )
    return result


def _some(view: PointCloud, most: int) -> Points:
    points = view.points[:: 1 + len(view.points) // most].astype(float)
    good = measured(points, view.viewpoint)
    return points[good] if good.any() else points


def _frame(views: Sequence[PointCloud], support: Plane | None) -> tuple[Float[np.ndarray, "3 3"], Vector]:
    """Return axes (columns) and origin [m] of the local frame: z is normal to the support, or towards a camera."""
    points = np.concatenate([view.points for view in views])
    centre = points.mean(0)
    view = views[0].viewpoint - centre
    if support is None:
        up = view if np.linalg.norm(view) > 1e-6 else np.eye(3)[2]
        view = np.linalg.svd(points[:: 1 + len(points) // 2000] - centre, full_matrices=False)[2][0]
    else:
        up = np.asarray(support.normal, dtype=float)
        centre = centre - (centre @ up - support.offset) * up
    up = up / np.linalg.norm(up)
    level = view - (view @ up) * up
    if np.linalg.norm(level) < 1e-3 * np.linalg.norm(view):
        level = perpendicular(up)
    level = level / np.linalg.norm(level)
    return np.column_stack([level, np.cross(up, level), up]), centre


def _finished(mesh: TriangleMesh, seen: Surfels, settings: ReconstructionConfig) -> TriangleMesh:
    """Simplify and check the mesh. Raises CloudError if the mesh is not closed or too far from the seen points."""
    try:
        mesh = _fewer(check_mesh(mesh, "reconstruction")[0], settings.max_faces)
    except MeshError as error:
        raise CloudError(f"cloud: no usable surface fits its {len(seen.points)} points ({error})") from None
    fitted = float((surface_distance(make_surface(mesh), seen.points) < settings.fit_distance).mean())
    advice = "add more views, or more points on thin walls"
    if not is_closed(mesh):
        raise CloudError(f"cloud: the surface of its {len(seen.points)} points is not closed; {advice}")
    if fitted < MIN_FITTED_SHARE:
        share = f"{fitted:.0%} of its {len(seen.points)} points"
        raise CloudError(f"cloud: the surface fits {share}, at least {MIN_FITTED_SHARE:.0%} are needed; {advice}")
    return mesh


def _fewer(mesh: TriangleMesh, most: int) -> TriangleMesh:
    """Reduce a mesh to about `most` faces. Use a slower simplifier if the quick one tears the surface."""
    import open3d as o3d

    for aggressiveness in (7, 5, 3):
        quick, _ = check_mesh(simplify(mesh, most, aggressiveness=aggressiveness), "reconstruction")
        if is_closed(quick):
            return quick
    whole = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.faces.astype(np.int32))
    ).simplify_quadric_decimation(most)
    slow = TriangleMesh(np.asarray(whole.vertices), np.asarray(whole.triangles, dtype=np.int64))
    slow, _ = check_mesh(slow, "reconstruction")
    return slow if is_closed(slow) else mesh


def _confidence(mesh: TriangleMesh, seen: Points, settings: ReconstructionConfig) -> Float[np.ndarray, "vertices"]:
    far = settings.guessed_distance
    distance, _ = KDTree(seen).query(mesh.vertices, distance_upper_bound=far)
    return np.clip((far - distance) / (far - settings.seen_distance), 0.0, 1.0)


def _is_guessed(
    mesh: TriangleMesh, evidence: Evidence, guess: Completion, confidence: Float[np.ndarray, "vertices"], views: int
) -> bool:
    """Return True if much surface was unseen, or a rule completed a single view. Surface on the support is known."""
    seen, settings = evidence.seen, evidence.settings
    area, normals = _open_area(mesh, evidence.free_space.standing)
    if views > 1:
        # The rule does not matter here. Openness is no measure for several views: normals of opposite sides cancel.
        # Surface is seen if position and normal are near. Normals 60° apart count like a distance of `reach`.
        reach = settings.seen_distance
        place = np.hstack([mesh.vertices[mesh.faces].mean(1), reach * normals])
        unseen = KDTree(np.hstack([seen.points, reach * seen.normals])).query(place)[0] > reach
        return float((area * unseen).sum() / max(area.sum(), 1e-12)) > settings.open_share
    # In a view from above, the normals of top and foot cancel although no side was seen. So guessed area counts too.
    guessed = float((area * (1.0 - confidence[mesh.faces].mean(1))).sum() / max(area.sum(), 1e-12))
    return bool(guess.method) or max(guess.openness, guessed) > settings.open_share


def _open_area(mesh: TriangleMesh, standing: bool) -> tuple[Float[np.ndarray, "faces"], Float[np.ndarray, "faces 3"]]:
    """Return area [m²] and unit normal of each face. If `standing`, faces on the support have no area."""
    across = scaled_normals(mesh.vertices, mesh.faces)
    length = np.linalg.norm(across, axis=1)
    foot = (across[:, 2] < -_DOWN * length) & (mesh.vertices[mesh.faces, 2].max(1) < MAX_FOOT_HEIGHT_M)
    normals = across / np.maximum(length, 1e-30)[:, None]
    return 0.5 * np.where(foot & standing, 0.0, length), normals
