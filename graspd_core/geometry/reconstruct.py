"""From one or more views of an object to a closed mesh, saying how it was made and how far each part was seen.

What was seen is surfaced by screened Poisson with normals towards each view's camera; what was not is completed first,
by the symmetry, revolution or extrusion that the evidence favours; what the cameras saw to be empty is cut away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from graspd_core.errors import CloudError
from graspd_core.geometry.cloud import PointCloud, clean_cloud
from graspd_core.geometry.complete import OPEN, complete
from graspd_core.geometry.evidence import Evidence, make_sight
from graspd_core.geometry.extrude import LOW, stand
from graspd_core.geometry.fuse import Surfels, join, merge_views, point_step
from graspd_core.geometry.mesh import check_mesh, simplify
from graspd_core.geometry.poisson import close_surface, fit_poisson, part_walls
from graspd_core.geometry.topology import is_closed
from graspd_core.types import Plane, TriangleMesh

# Seen surface is trusted fully to the first distance from a seen point [m], guessed surface not at all past the second.
TRUSTED, GUESSED = 0.004, 0.02
# Faces of the result at most.
MOST_FACES = 16_000
# Share of the seen points that must lie within this [m] of the result.
FITTED, FIT = 0.85, 0.004
# Points of one view that are looked at.
MOST_POINTS = 120_000


@dataclass(frozen=True)
class Reconstruction:
    """A closed surface and how it came about.

    Attributes:
        mesh: closed, in the frame of the views [m].
        trust: of each vertex, 1 where the surface was seen, falling to 0 at 2 cm from it.
        method: "poisson", and what completed it, e.g. "poisson, revolution".
        warnings: what was guessed, one sentence each.
    """

    mesh: TriangleMesh
    trust: Float[np.ndarray, "vertices"]
    method: str
    warnings: tuple[str, ...]


def reconstruct(views: Sequence[PointCloud], *, support: Plane | None = None) -> Reconstruction:
    """The closed surface of the object that the views show.

    Args:
        views: the object's points alone, of each camera, all in one frame; NaN and stray points are dropped. A single
            cloud that shows it from all round may stand for many views.
        support: what the object stands on, in the same frame.

    Raises:
        CloudError: too few points, or no closed surface fits them.
    """
    from scipy.spatial import KDTree

    views = _clean(views)
    rotation, origin = _frame(views, support)
    local = [PointCloud((v.points - origin) @ rotation, (v.viewpoint - origin) @ rotation) for v in views]
    step = point_step(local)
    standing = support is not None
    warnings: tuple[str, ...] = ()
    method = "poisson"
    if all_round(local):
        seen, evidence = _all_round(local, step), Evidence((), standing)
        known = seen
    else:
        seen = merge_views(local, step)
        lowest = float(np.clip(np.percentile(seen.points[:, 2], 0.5), 0.0, LOW)) if standing else 0.0
        evidence = Evidence(tuple(make_sight(v) for v in local), standing, lowest)
        guess = complete(seen, evidence, step)
        known = join(seen, guess.surfels)
        known = join(known, stand(known, evidence, step)) if standing else known
        method += f", {guess.method}" if guess.method else ""
        if guess.method or guess.openness > OPEN:
            warnings = (_sentence(len(views), guess.method),)
    known = part_walls(known)
    mesh = close_surface(fit_poisson(known), known, evidence)
    mesh = _finished(mesh, seen)
    distance, _ = KDTree(seen.points).query(mesh.vertices)
    trust = np.clip((GUESSED - distance) / (GUESSED - TRUSTED), 0.0, 1.0)
    return Reconstruction(TriangleMesh(mesh.vertices @ rotation.T + origin, mesh.faces), trust, method, warnings)


def all_round(views: Sequence[PointCloud]) -> bool:
    """Whether a single cloud shows surface behind surface, as no camera sees it."""
    return len(views) == 1 and _layered_share(views[0]) > LAYERED_SHARE


# A surface seen from one side rises by less than this many cells over one cell on most lines of sight; with more than
# this share of exceptions, the cloud is taken to show the object from all round.
STEEPEST = 4.0
LAYERED_SHARE = 0.15


def _layered_share(view: PointCloud) -> float:
    """Share of lines of sight that meet points at depths too far apart for one surface, however steep."""
    from scipy.spatial import KDTree

    points = clean_cloud(view.points, view.viewpoint).points
    sight = points.mean(0) - view.viewpoint
    axis = sight / max(float(np.linalg.norm(sight)), 1e-9) if np.linalg.norm(sight) > 1e-6 else np.eye(3)[2]
    right = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    right /= np.linalg.norm(right)
    local = (points - view.viewpoint) @ np.column_stack([right, np.cross(axis, right), axis])
    distance = float(local[:, 2].mean())
    # From very near the object, lines of sight are not spread enough to sort points by: any direction will do.
    if distance > np.ptp(points, axis=0).max() and local[:, 2].min() > 0:
        local[:, :2] *= distance / local[:, 2:]
    cell = 1.5 * float(np.median(KDTree(points).query(points, k=5)[0][:, -1]))
    _, line = np.unique(np.round(local[:, :2] / cell).astype(int), axis=0, return_inverse=True)
    line = line.reshape(-1)
    near, far = np.full(line.max() + 1, np.inf), np.full(line.max() + 1, -np.inf)
    np.minimum.at(near, line, local[:, 2])
    np.maximum.at(far, line, local[:, 2])
    return float((far - near > STEEPEST * cell).mean())


def _clean(views: Sequence[PointCloud]) -> list[PointCloud]:
    """Finite points, near where most are, of the views that have any."""
    from scipy.spatial import KDTree

    if len(views) == 0:
        raise CloudError("cloud: no view at all; at least one is needed")
    kept = [view.points[:: 1 + len(view.points) // MOST_POINTS].astype(float) for view in views]
    clean = clean_cloud(np.concatenate(kept), views[0].viewpoint)
    tree = KDTree(clean.points)
    near = 3 * float(np.median(tree.query(clean.points, k=2)[0][:, 1]))
    result = []
    for points, view in zip(kept, views, strict=True):
        points = points[np.isfinite(points).all(1)]
        points = points[tree.query(points, distance_upper_bound=near)[0] < near] if len(points) else points
        if len(points):
            result.append(PointCloud(points, view.viewpoint.astype(float)))
    return result


def _frame(
    views: Sequence[PointCloud], support: Plane | None
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Axes (columns) and origin that move with the views: z up from the support, or towards the first camera."""
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
        level = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    level = level / np.linalg.norm(level)
    return np.column_stack([level, np.cross(up, level), up]), centre


def _all_round(views: Sequence[PointCloud], step: float) -> Surfels:
    """Points of an all-round cloud with normals that agree with their neighbours', outwards as a whole."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.concatenate([v.points for v in views])))
    cloud = cloud.voxel_down_sample(step)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(24))
    cloud.orient_normals_consistent_tangent_plane(16)
    return Surfels(np.asarray(cloud.points), np.asarray(cloud.normals))


def _finished(mesh: TriangleMesh, seen: Surfels) -> TriangleMesh:
    """Few faces, closed, and through the points that were seen."""
    from graspd_core.geometry.embree import make_surface, surface_distance

    mesh, _ = check_mesh(mesh, "reconstruction")
    fewer, _ = check_mesh(simplify(mesh, MOST_FACES), "reconstruction")
    mesh = fewer if is_closed(fewer) else mesh
    fitted = float((surface_distance(make_surface(mesh), seen.points) < FIT).mean())
    if not is_closed(mesh) or fitted < FITTED:
        raise CloudError(
            f"cloud: no closed surface fits its {len(seen.points)} points ({fitted:.0%} do); more views are needed"
        )
    return mesh


def _sentence(views: int, method: str) -> str:
    seen = "one side only" if views == 1 else f"{views} sides, not all round"
    by = method or "closing the surface smoothly within the cameras' outlines"
    return f"cloud: seen from {seen}; the rest is guessed by {by}"
