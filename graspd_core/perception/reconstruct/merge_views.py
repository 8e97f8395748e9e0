"""Views become one set of oriented points: several views, or a cloud that shows an object from all round.

Depth noise runs along the line of sight, so each point is moved along its own to the plane of its neighbours. Its
normal is turned to the camera that saw it. Both keep thin walls apart, which orientation by neighbours does not.

Truncated signed distances (Curless and Levoy 1996) wear thin walls and edges away. On 15 rendered views, Open3D's on a
grid of 2 mm gave surfaces of Chamfer 0.82 mm instead of 0.49 and overlap 0.87 instead of 0.92.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from graspd_core.config import ReconstructionConfig
from graspd_core.errors import CloudError
from graspd_core.mesh.topology import packed_rows, voxel_keys
from graspd_core.perception.cloud.free_space import FreeSpace, view_frame
from graspd_core.perception.cloud.point_cloud import (
    MIN_POINTS,
    PointCloud,
    Points,
    Vector,
    clean_cloud,
    least_axes,
    measured,
)
from graspd_core.se3 import perpendicular

# Points of a surface seen flatter than this flew off an edge.
MIN_VIEW_COSINE = 0.1
# A surface seen from one side rises by less than this many cells over one cell on most lines of sight. With more than
# this share of exceptions, the cloud is taken to show the object from all round. Where it is known which way a camera
# looked it takes more: from above, a third of the lines may run along the sides of a cup.
MAX_RISE_CELLS = 4.0
LAYERED_SHARE, LAYERED_SHARE_OF_CAMERA = 0.15, 0.45

# So many points tell whether they enclose a body. Clouds of shapes from all round have 0 to 0.056 (thin walls, noise
# of 1 mm), single views of `CHOSEN_ON` (graspd_bench/studies/cameras.py) 0.075 to 0.32. Normals of whole scenes may
# cancel. But these are flat: thrice their volume over area and size is 0.003 to 0.028, of bodies 0.12 or more.
ENCLOSING_POINTS, MOST_OPEN, LEAST_VOLUME = 4000, 0.06, 0.06
# Of an all-round cloud: neighbours for a normal, the directions that it is looked at from, and how often that is done.
NORMAL_NEIGHBOURS, UNPOSED_DIRECTIONS, UNPOSED_PASSES = 24, 150, 3
# It is thinned to this share of the step. Points that face opposite ways count as twice so many steps apart. Points
# this many steps off each other's plane may lie on two sides of a wall.
UNPOSED_THINNING, UNPOSED_FACING, UNPOSED_DEPTH = 0.6, 4.0, 0.25


@dataclass(frozen=True)
class Surfels:
    """Points of a surface and its outward unit normals.

    Attributes:
        points: [m].
    """

    points: Points
    normals: Points


def join(*parts: Surfels) -> Surfels:
    """Return the surfels of all parts."""
    return Surfels(np.concatenate([p.points for p in parts]), np.concatenate([p.normals for p in parts]))


def take(surfels: Surfels, kept: np.ndarray) -> Surfels:
    """Return the surfels that a mask or an index chooses."""
    return Surfels(surfels.points[kept], surfels.normals[kept])


def nothing() -> Surfels:
    """Return no surfels."""
    return Surfels(np.zeros((0, 3)), np.zeros((0, 3)))


def point_step(views: Sequence[PointCloud]) -> float:
    """Return the spacing that views are thinned to [m]: an eightieth of the object's diagonal, 1 mm at least."""
    points = np.concatenate([view.points for view in views])
    low, high = np.percentile(points, [2, 98], axis=0)
    return max(float(np.linalg.norm(high - low)) / 80, 1e-3)


def merge_views(
    views: Sequence[PointCloud], step: float | None = None, settings: ReconstructionConfig | None = None
) -> Surfels:
    """Return the oriented points of all views: strays dropped, noise smoothed, one per cube of side `step` and side of
    it.

    Raises CloudError: fewer than 50 points are left.
    """
    step, settings = point_step(views) if step is None else step, settings or ReconstructionConfig()
    together = join(*(orient_view(view, step, settings) for view in views))
    if len(together.points) < MIN_POINTS:
        raise CloudError(
            f"cloud: only {len(together.points)} of its {sum(len(view.points) for view in views)} points lie on a "
            f"surface; at least {MIN_POINTS} are needed: it is too sparse, or shows no surface"
        )
    return thin(together, step) if len(views) > 1 else together


def orient_view(view: PointCloud, step: float, settings: ReconstructionConfig) -> Surfels:
    """Return one view's surface points, about `step` [m] apart, with normals towards its camera."""
    from scipy.spatial import KDTree

    points = _thin_by_sight(view, step)
    if len(points) <= settings.neighbours:
        return nothing()
    distance, near = KDTree(points).query(points, k=settings.neighbours)
    ray = points - view.viewpoint
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    centre, normals = points[near].mean(1), np.zeros_like(points)
    weights = np.ones(near.shape)
    # The second pass leaves out what lies across an edge from the first one's plane.
    for _ in range(3):
        total = weights.sum(1, keepdims=True)
        centre = np.einsum("nk,nkd->nd", weights, points[near]) / total
        spread = points[near] - centre[:, None]
        normals = least_axes(np.swapaxes(weights[..., None] * spread, 1, 2) @ spread)
        off = np.einsum("nkd,nd->nk", spread, normals)
        weights = np.exp(-np.square(off / (1.5 * step)) - np.square(distance / distance[:, -1:]))
    normals *= -np.sign(np.einsum("nd,nd->n", normals, ray))[:, None]
    slope = -np.einsum("nd,nd->n", normals, ray)
    shift = np.einsum("nd,nd->n", points - centre, normals) / np.maximum(slope, 1e-3)
    crowded = distance[:, -1] < 2.5 * np.median(distance[:, -1])
    kept = (slope > MIN_VIEW_COSINE) & (np.abs(shift) < settings.stray_distance) & crowded
    smooth = points + shift[:, None] * ray
    return Surfels(smooth[kept], normals[kept])


def thin(surfels: Surfels, step: float) -> Surfels:
    """Return the mean of the points in each cube of side `step` [m] that face the same of six directions."""
    if len(surfels.points) == 0:
        return surfels
    facing = np.abs(surfels.normals).argmax(1)
    side = 2 * facing + (np.take_along_axis(surfels.normals, facing[:, None], 1)[:, 0] > 0)
    cells = np.column_stack([np.floor(surfels.points / step).astype(int), side])
    _, which, count = np.unique(packed_rows(cells), return_inverse=True, return_counts=True)
    mean = lambda x: np.column_stack([np.bincount(which, x[:, k]) for k in range(3)]) / count[:, None]  # noqa: E731
    normals = mean(surfels.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    return Surfels(mean(surfels.points), normals)


def _thin_by_sight(view: PointCloud, step: float) -> Points:
    """Return one point for each small cone of sight: that of median distance, so that strays do not count."""
    ray = view.points - view.viewpoint
    distance = np.linalg.norm(ray, axis=1)
    width = step / float(np.median(distance))
    axis = ray.mean(0) / np.linalg.norm(ray.mean(0))
    right = perpendicular(axis)
    depth = np.maximum(ray @ axis, 1e-6)
    image = np.column_stack([ray @ right, ray @ np.cross(axis, right)]) / depth[:, None]
    _, which, count = np.unique(voxel_keys(image, width), return_inverse=True, return_counts=True)
    order = np.lexsort([distance, which])
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    return view.points[order[first + (count - 1) // 2]]


def is_unposed(view: PointCloud, axis_known: bool = False) -> bool:
    """Tell whether a cloud shows surface behind surface on many lines of sight, as no single camera sees it.

    Args:
        view: the object's points.
        axis_known: whether the camera's direction is known.
    """
    from scipy.spatial import KDTree

    points = clean_cloud(view.points, view.viewpoint).points
    if (view.viewpoint > points.min(0)).all() and (view.viewpoint < points.max(0)).all() and is_all_round(view):
        return True
    local = (points - view.viewpoint) @ view_frame(PointCloud(points, view.viewpoint))
    distance = float(local[:, 2].mean())
    # From very near the object, lines of sight are not spread enough to sort points by: any direction will do.
    if distance > np.ptp(points, axis=0).max() and local[:, 2].min() > 0:
        local[:, :2] *= distance / local[:, 2:]
    cell = 1.5 * float(np.median(KDTree(points).query(points, k=5)[0][:, -1]))
    _, line = np.unique(packed_rows(np.round(local[:, :2] / cell).astype(int)), return_inverse=True)
    near, far = np.full(line.max() + 1, np.inf), np.full(line.max() + 1, -np.inf)
    np.minimum.at(near, line, local[:, 2])
    np.maximum.at(far, line, local[:, 2])
    # No camera sees what is behind it, whatever axis the name of its frame says.
    most = LAYERED_SHARE_OF_CAMERA if axis_known and local[:, 2].min() > 0 else LAYERED_SHARE
    return bool((far - near > MAX_RISE_CELLS * cell).mean() > most)


def is_all_round(view: PointCloud) -> bool:
    """Tell whether points enclose a body: its normals n and places p have mean n = 0 and mean n pᵀ = volume / area.

    That is the divergence theorem. One side of a body meets the first only by chance, and then not the second.
    """
    points = view.points[measured(view.points, view.viewpoint)]
    if len(points) < MIN_POINTS:
        return False
    some = PointCloud(points[:: 1 + len(points) // ENCLOSING_POINTS], view.viewpoint)
    surfels = orient_unposed(some, point_step([some]))
    place = surfels.points - surfels.points.mean(0)
    moment = surfels.normals.T @ place / np.linalg.norm(place, axis=1).sum()
    volume = float(np.trace(moment))
    uneven = float(np.linalg.norm(moment - volume / 3 * np.eye(3)))
    return bool(volume > LEAST_VOLUME and max(np.linalg.norm(surfels.normals.mean(0)), uneven) < MOST_OPEN)


def orient_unposed(view: PointCloud, step: float) -> Surfels:
    """Return points of an all-round cloud, about `step` [m] apart, with normals to the outside.

    The outside is seen from many directions: the nearest point in each cell of an image faces that direction. This
    distinguishes both sides of a thin wall, which agreement with neighbours does not.
    """
    from scipy.spatial import KDTree

    points = view.thinned(step * UNPOSED_THINNING).points
    seen_from, place, many = _seen_from(points), KDTree(points), min(NORMAL_NEIGHBOURS, len(points))
    near = np.asarray(place.query(points, k=many)[1])
    normals = _least_axes_of(points[near])
    for _ in range(UNPOSED_PASSES):
        # What lies as deep in the surface as noise faces the way that its neighbours are seen from.
        deep = np.einsum("nkd,nd->nk", points[near] - points[:, None], normals)
        ways = np.einsum("nk,nkd->nd", np.exp(-np.square(deep / (UNPOSED_DEPTH * step))), seen_from[near])
        normals *= np.where((normals * ways).sum(1) < 0, -1.0, 1.0)[:, None]
        tree = KDTree(np.hstack([points, UNPOSED_FACING * step * normals]))
        alike = _least_axes_of(points[np.asarray(tree.query(tree.data, k=many)[1])])
        normals = alike * np.where((alike * normals).sum(1) < 0, -1.0, 1.0)[:, None]
    return thin(Surfels(points, normals), step)


def _least_axes_of(groups: Float[np.ndarray, "n k 3"]) -> Points:
    spread = groups - groups.mean(1, keepdims=True)
    return least_axes(np.swapaxes(spread, 1, 2) @ spread)


def _seen_from(points: Points) -> Points:
    """Return the sum of the evenly spread directions from which each point is nearest in a cell of an image."""
    from scipy.spatial import KDTree

    width = 2 * float(np.median(KDTree(points).query(points, k=5)[0][:, -1]))
    rng, total = np.random.default_rng(0), np.zeros_like(points)
    turn = np.arange(UNPOSED_DIRECTIONS) + 0.5
    height, angle = 1 - 2 * turn / UNPOSED_DIRECTIONS, np.pi * (1 + 5**0.5) * turn
    flat = np.sqrt(1 - height**2)
    for way in np.column_stack([flat * np.cos(angle), flat * np.sin(angle), height]):
        right = perpendicular(way)
        image = np.column_stack([points @ right, points @ np.cross(way, right)]) + rng.uniform(0, width, 2)
        order = np.argsort(-(points @ way))
        first = order[np.unique(voxel_keys(image, width)[order], return_index=True)[1]]
        total[first] += way
    return total


@dataclass(frozen=True, eq=False)
class Evidence:
    """The seen part of an object, from which other guesses of the hidden part are made.

    Attributes:
        seen, free_space, step: the surface, what speaks against guesses, and the spacing [m], in a frame of its own.
        rotation, origin: of that frame in the views' [m].
        chosen: the rule that the reconstruction took, empty for none.
        settings: of the reconstruction.
        hidden: whether a good part of the surface was.
        doubts: why the views may not show what was there, so that no grasp counts as verified.
    """

    seen: Surfels
    free_space: FreeSpace
    step: float
    rotation: Float[np.ndarray, "3 3"]
    origin: Vector
    chosen: str
    settings: ReconstructionConfig
    hidden: bool
    doubts: tuple[str, ...] = ()
