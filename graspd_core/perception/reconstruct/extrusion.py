"""Guess surfaces between an object and its support: walls beneath the outline seen from above, and the bottom."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_closing, binary_erosion, distance_transform_edt, gaussian_filter, maximum_filter
from scipy.spatial import KDTree

from graspd_core.mesh.convex_parts import convex_hull
from graspd_core.perception.cloud.free_space import FreeSpace, empty_depth, facing
from graspd_core.perception.cloud.point_cloud import Points
from graspd_core.perception.reconstruct.merge_views import Surfels, join, nothing, take, thin

# The object ends at an outline point if the space at this distance outwards [m] is seen to be empty.
OUTLINE_STEP_M = 0.008
# Least cosines at an outline point: of the surface normal to the vertical, and to the direction of a camera.
MIN_LEVEL_COSINE, MIN_FACING_COSINE = 0.85, 0.3
# Least fraction of the lowest points that belong to walls, and greatest vertical part of a wall's unit normal.
MIN_WALL_SHARE, MAX_WALL_COSINE = 0.6, 0.25
# The foot counts as seen if the lowest points are at most this high [m]. Segmentation removes the points below them.
MAX_FOOT_HEIGHT_M = 0.015
# Greatest fraction of a guessed wall's vertical line that the cameras may contradict.
MAX_CONTRADICTED_WALL = 0.15
# Least fraction of the base's outline that has walls above it.
MIN_ENCLOSED_SHARE = 0.6


def extrude(seen: Surfels, free_space: FreeSpace, step: float) -> Surfels:
    """Return vertical walls from the object's outline, seen from above, down to the support.

    A wall is built only where cameras saw a level top and empty space just outside it, and do not contradict the wall.
    """
    margin = 6
    low = seen.points[:, :2].min(0) - margin * step
    index = tuple(np.floor((seen.points[:, :2] - low) / step).astype(int).T)
    shape = tuple(int(i.max()) + margin + 1 for i in index)
    top = np.full(shape, -np.inf)
    np.maximum.at(top, index, seen.points[:, 2])
    mask = np.asarray(binary_closing(np.isfinite(top), np.ones((3, 3)), iterations=3), dtype=bool)
    _, at = distance_transform_edt(~np.isfinite(top), return_indices=True)  # pyright: ignore[reportGeneralTypeIssues]
    top = np.where(mask, top[tuple(at)], -np.inf)
    rim = mask & ~np.asarray(binary_erosion(mask), dtype=bool)
    slope = np.stack([*np.gradient(gaussian_filter(mask.astype(float), 2.0))], -1)[rim]
    outward = np.pad(-slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9), ((0, 0), (0, 1)))
    height = maximum_filter(top, 3)[rim]
    place = np.column_stack([low + (np.argwhere(rim) + 0.5) * step, height])
    _, nearest = KDTree(seen.points).query(place)
    # If the surface turns away from the camera, it continues behind the outline. A horizontal surface ends there.
    level = (seen.normals[nearest, 2] > MIN_LEVEL_COSINE) & (
        facing(free_space, seen.points, seen.normals)[nearest] > MIN_FACING_COSINE
    )
    proven = (empty_depth(free_space, place + OUTLINE_STEP_M * outward) > free_space.slack) & level
    return _lowered(place[proven], outward[proven], 0.0, free_space, step)[0]


def _lowered(
    top: Points, outward: Points, bottom: float, free_space: FreeSpace, step: float
) -> tuple[Surfels, Bool[np.ndarray, "n"]]:
    """Return vertical walls from points down to height `bottom` [m], and a mask of the points that have such a wall.

    A point has no wall where the cameras contradict the wall.
    """
    levels = np.arange(bottom + 0.5 * step, top[:, 2].max(initial=bottom + step), step)
    row, level = np.nonzero(levels < top[:, 2:] - 0.5 * step)
    points = np.column_stack([top[row, :2], levels[level]])
    wrong = np.bincount(row, empty_depth(free_space, points) > free_space.slack, len(top))
    good = wrong <= MAX_CONTRADICTED_WALL * np.bincount(row, minlength=len(top))
    return take(Surfels(points, outward[row]), good[row]), good


def with_foot(surfels: Surfels, free_space: FreeSpace, step: float) -> Surfels:
    """Return the surfels. If the object stands on a support, add guessed surface from the surfels to the support."""
    return join(surfels, stand(surfels, free_space, step)) if free_space.standing else surfels


def stand(surfels: Surfels, free_space: FreeSpace, step: float) -> Surfels:
    """Guess the bottom, and walls from the lowest surfels down to it. Return nothing if walls are doubtful."""
    lowest = float(np.percentile(surfels.points[:, 2], 1))
    band = take(surfels, surfels.points[:, 2] < lowest + 3 * step)
    wall = np.abs(band.normals[:, 2]) < MAX_WALL_COSINE
    if lowest > MAX_FOOT_HEIGHT_M:
        return _column(surfels, free_space, step)
    if wall.mean() < MIN_WALL_SHARE or wall.sum() < 10:
        return nothing()
    feet = take(band, wall)
    # Displacement along the wall for each metre downwards.
    down = feet.normals[:, 2:] * feet.normals - np.array([0.0, 0.0, 1.0])
    down /= -down[:, 2:]
    fall = np.arange(0.5 * step, lowest + 3 * step, step)
    points = (feet.points[:, None] + down[:, None] * fall[:, None]).reshape(-1, 3)
    skirt = Surfels(points, np.repeat(feet.normals, len(fall), 0))
    skirt = thin(take(skirt, (points[:, 2] > 0) & (points[:, 2] < lowest)), step)
    return join(skirt, _base((feet.points + down * feet.points[:, 2:])[:, :2], free_space, step))


def _column(surfels: Surfels, free_space: FreeSpace, step: float) -> Surfels:
    """Return walls and bottom beneath surfels that end high above the support. Add walls across vertical gaps."""
    order = np.argsort(surfels.points[:, 2])
    height = surfels.points[order, 2]
    level = np.cumsum(np.diff(height, prepend=height[:1]) > MAX_FOOT_HEIGHT_M)
    walls, rim = _walls(surfels, 0.0, free_space, step)
    for k in range(1, int(level[-1]) + 1):
        bottom = float(height[level == k - 1].max())
        walls = join(walls, _walls(take(surfels, order[level == k]), bottom, free_space, step)[0])
    return join(walls, _base(rim, free_space, step)) if len(rim) > 3 else nothing()


def _walls(
    surfels: Surfels, bottom: float, free_space: FreeSpace, step: float
) -> tuple[Surfels, Float[np.ndarray, "n 2"]]:
    """Return walls beneath the outline seen from above, down to the height `bottom` [m], and their lower ends [m]."""
    hull = convex_hull(surfels.points[:, :2])
    if hull is None:
        return nothing(), np.zeros((0, 2))
    corners = surfels.points[hull.vertices, :2]
    edges = np.roll(corners, -1, 0) - corners
    length = np.linalg.norm(edges, axis=1)
    edge = np.repeat(np.arange(len(corners)), np.maximum((length / step).astype(int), 1))
    along = np.concatenate([np.arange(n) / n for n in np.bincount(edge)])
    rim = corners[edge] + along[:, None] * edges[edge]
    # The corners run counter-clockwise, so outwards is to the right of an edge.
    outward = np.column_stack([edges[:, 1], -edges[:, 0], np.zeros(len(edges))])[edge] / length[edge, None]
    top = np.column_stack([rim, surfels.points[KDTree(surfels.points[:, :2]).query(rim)[1], 2]])
    walls, good = _lowered(top, outward, bottom, free_space, step)
    return walls, rim[good]


def _base(feet: Float[np.ndarray, "n 2"], free_space: FreeSpace, step: float) -> Surfels:
    """Return the hidden bottom in the hull of `feet`, the lower ends of walls. Return nothing if walls are missing."""
    hull = convex_hull(feet)
    if hull is None:
        return nothing()
    corners = feet[hull.vertices]
    along = np.linspace(0, 1, 40, endpoint=False)[:, None, None]
    rim = (corners + along * (np.roll(corners, -1, 0) - corners)).reshape(-1, 2)
    length = np.tile(np.linalg.norm(np.roll(corners, -1, 0) - corners, axis=1), 40)
    if length[KDTree(feet).query(rim)[0] < 3 * step].sum() < MIN_ENCLOSED_SHARE * length.sum():
        return nothing()
    axes = [np.arange(corners[:, k].min(), corners[:, k].max(), step) for k in (0, 1)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    within = grid[(grid @ hull.equations[:, :2].T + hull.equations[:, 2] < -0.5 * step).all(1)]
    base = np.column_stack([within, np.zeros(len(within))])
    base = base[empty_depth(free_space, base) < free_space.slack]
    return Surfels(base, np.tile(np.array([0.0, 0.0, -1.0]), (len(base), 1)))
