"""Space that the cameras saw to be empty: before a seen surface, and beside the object's outline.

Each view's own object points give a small depth image of it. A guessed point before that surface, or beside the
outline, contradicts the camera. A point behind it is hidden, and may be there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from graspd_core.config import ReconstructionConfig
from graspd_core.perception.cloud.point_cloud import PointCloud, Points, Vector
from graspd_core.se3 import perpendicular

# Positions or normals, and a depth [m] or share of each.
Places = Float[np.ndarray, "*batch 3"]
Depths = Float[np.ndarray, "*batch"]

# Depth images of more cells than this across the object tell no more.
MAX_IMAGE_CELLS = 160
# Points, itself among them, that a point's spacing is taken from.
SPACING_NEIGHBOURS = 5

# What is this much nearer than the object's surface beside it stands before it [m].
OCCLUDER_GAP_M = 0.01
# Beside what was seen, hidden parts are looked for so far [m].
HIDDEN_REACH_M = 0.1

# A point so much deeper in empty space than the slack is impossible.
CONTRADICTION_DEPTH_M = 0.01


@dataclass(frozen=True)
class ViewDepth:
    """One camera's depth image of the object, in directions from the camera (a pinhole of focal length 1).

    Attributes:
        eye: where the camera stood [m].
        frame: columns right, down and forward.
        low: the first cell's direction. `cell`: the width of one.
        depth: along forward [m], of the surface or, beside the outline, of the nearest cell of it, infinite where
            something stands before it.
        nearest: the same, the smallest over the cell's neighbours, or the depth of what stands before it.
        beside: cells between this one and the outline, 0 within it and where something hides what is behind.
    """

    eye: Vector
    frame: Float[np.ndarray, "3 3"]
    low: Float[np.ndarray, "2"]
    cell: float
    depth: Float[np.ndarray, "x y"]
    nearest: Float[np.ndarray, "x y"]
    beside: Float[np.ndarray, "x y"]


@dataclass(frozen=True)
class FreeSpace:
    """The space that the object does not fill.

    Attributes:
        view_depths: one a camera, none for unknown cameras.
        standing: the object stands on a support that fills z < 0.
        lowest: height of the lowest points seen [m]: segmentation cuts the rest off with the support, so that outlines
            end too high by up to this.
        slack: outlines and surfaces are seen to within this [m].
        tolerance: a guessed point this near to a seen surface confirms the guess [m].
    """

    view_depths: tuple[ViewDepth, ...]
    standing: bool
    lowest: float = 0.0
    slack: float = ReconstructionConfig.outline_slack
    tolerance: float = ReconstructionConfig.surface_tolerance


def make_view_depths(views: Sequence[PointCloud], whole: Sequence[PointCloud] = ()) -> tuple[ViewDepth, ...]:
    """Return the depth images of the views' points of the object. Views with too few points make none.

    Args:
        views: the object's points alone.
        whole: all that each camera saw, in the same order. Without it, nothing stood between cameras and object.
    """
    around = whole or [None] * len(views)
    made = (_make_view_depth(view, all_seen) for view, all_seen in zip(views, around, strict=True))
    return tuple(view_depth for view_depth in made if view_depth is not None)


def _make_view_depth(view: PointCloud, whole: PointCloud | None) -> ViewDepth | None:
    """Return the depth image of a view's points.

    Holes of a few cells are filled, since they are missing pixels. None for fewer than five points before the camera,
    or for points all in one line of sight.
    """
    from scipy.ndimage import binary_closing, distance_transform_edt, minimum_filter
    from scipy.spatial import KDTree

    frame = view_frame(view)
    local = (view.points - view.viewpoint) @ frame
    local = local[local[:, 2] > 1e-3]
    if len(local) < SPACING_NEIGHBOURS:
        return None
    plane = local[:, :2] / local[:, 2:]
    spacing = float(np.median(KDTree(plane).query(plane, k=SPACING_NEIGHBOURS)[0][:, -1]))
    cell = max(1.5 * spacing, float(np.ptp(plane, axis=0).max()) / MAX_IMAGE_CELLS)
    if cell < 1e-9:
        return None
    # What is hidden may go on as far beside what is seen.
    margin = 6 if whole is None else max(6, int(HIDDEN_REACH_M / (cell * float(np.median(local[:, 2])))))
    low = plane.min(0) - margin * cell
    index = tuple(np.floor((plane - low) / cell).astype(int).T)
    shape = tuple(int(i.max()) + margin + 1 for i in index)
    total, count = np.zeros(shape), np.zeros(shape)
    np.add.at(total, index, local[:, 2])
    np.add.at(count, index, 1.0)
    seen = count > 0
    mask = np.asarray(binary_closing(seen, np.ones((3, 3)), iterations=2), dtype=bool)
    _, at = distance_transform_edt(~seen, return_indices=True)  # pyright: ignore[reportGeneralTypeIssues]
    depth = (total / np.maximum(count, 1))[tuple(at)]
    nearest = minimum_filter(depth, 3)
    if whole is not None:
        before = _occluders(whole, frame, low, cell, depth)
        hidden = np.isfinite(before) & ~mask
        depth, nearest, mask = np.where(hidden, np.inf, depth), np.where(hidden, before, nearest), mask | hidden
    beside = np.asarray(distance_transform_edt(~mask))
    return ViewDepth(view.viewpoint, frame, low, cell, depth, nearest, beside)


def _occluders(
    whole: PointCloud,
    frame: Float[np.ndarray, "3 3"],
    low: Float[np.ndarray, "2"],
    cell: float,
    depth: Float[np.ndarray, "x y"],
) -> Float[np.ndarray, "x y"]:
    """Return the depth of what stands before the object in each cell [m], infinite for nothing."""
    from scipy.ndimage import binary_closing, distance_transform_edt

    # Of all that a camera saw little is in the object's image. Points that are not finite compare as false.
    x, y, forward = ((whole.points - whole.viewpoint) @ frame).T
    high = low + cell * np.array(depth.shape)
    ahead = (forward > 1e-3) & (x >= low[0] * forward) & (x < high[0] * forward)
    ahead &= (y >= low[1] * forward) & (y < high[1] * forward)
    plane = np.stack([x[ahead], y[ahead]], -1) / forward[ahead, None]
    forward = forward[ahead]
    index = tuple(np.minimum(((plane - low) / cell).astype(int), np.array(depth.shape) - 1).T)
    near = forward < depth[index] - OCCLUDER_GAP_M
    before = np.full(depth.shape, np.inf)
    np.minimum.at(before, tuple(axis[near] for axis in index), forward[near])
    known = np.isfinite(before)
    if not known.any():
        return before
    # Holes of a few cells are missing pixels of it.
    _, at = distance_transform_edt(~known, return_indices=True)  # pyright: ignore[reportGeneralTypeIssues]
    return np.where(binary_closing(known, np.ones((3, 3)), iterations=2), before[tuple(at)], np.inf)


def empty_depth(free_space: FreeSpace, points: Places) -> Depths:
    """Return how deep points lie in the support, or in space that a camera saw to be empty [m]."""
    return _classify(free_space, points, None)[1]


def weigh(free_space: FreeSpace, points: Places, normals: Places) -> tuple[Bool[np.ndarray, "*batch"], Depths]:
    """Return whether guessed points lie on a seen surface that faces its camera, and their contradiction, 0 to 1."""
    confirmed, deep = _classify(free_space, points, normals)
    return confirmed, np.clip((deep - free_space.slack) / CONTRADICTION_DEPTH_M, 0.0, 1.0)


def on_seen(free_space: FreeSpace, points: Places) -> Bool[np.ndarray, "*batch"]:
    """Return whether points lie on a seen surface, within one and a half of the tolerance."""
    found = np.zeros(points.shape[:-1], dtype=bool)
    for view_depth in free_space.view_depths:
        empty, behind = _look(view_depth, points)
        depth = np.where(np.isfinite(behind), np.abs(behind), 0.0)
        found |= (empty < 1.5 * free_space.tolerance) & (depth < 1.5 * free_space.tolerance)
    return found


def facing(free_space: FreeSpace, points: Points, normals: Points) -> Float[np.ndarray, "n"]:
    """Return the cosine between normals and the direction to the camera that they face most."""
    most = np.full(len(points), -1.0)
    for view_depth in free_space.view_depths:
        way = view_depth.eye - points
        most = np.maximum(most, (way * normals).sum(1) / np.linalg.norm(way, axis=1))
    return most


def _classify(
    free_space: FreeSpace, points: Places, normals: Places | None
) -> tuple[Bool[np.ndarray, "*batch"], Depths]:
    confirmed = np.zeros(points.shape[:-1], dtype=bool)
    deepest = np.zeros(points.shape[:-1])
    for view_depth in free_space.view_depths:
        empty, behind = _look(view_depth, points)
        deepest = np.maximum(deepest, empty)
        if normals is not None:
            confirmed |= (np.abs(behind) < free_space.tolerance) & (((view_depth.eye - points) * normals).sum(-1) > 0)
    if free_space.standing:
        height = points[..., 2]
        deepest = np.maximum(deepest - np.clip(free_space.lowest - height, 0.0, free_space.lowest), -height)
    return confirmed, np.maximum(deepest, 0.0)


def _look(view_depth: ViewDepth, points: Places) -> tuple[Depths, Depths]:
    """Return how deep points lie in empty space, and how far behind the seen surface [m], infinite beside it."""
    local = (points - view_depth.eye) @ view_depth.frame
    forward = np.maximum(local[..., 2], 1e-6)
    place = (local[..., :2] / forward[..., None] - view_depth.low) / view_depth.cell
    inner = np.clip(place, 0, np.array(view_depth.depth.shape) - 1)
    index = tuple(np.moveaxis(inner.astype(int), -1, 0))
    # Beyond the image's edge, the way to the edge adds up.
    beside = (view_depth.beside[index] + np.abs(place - inner).sum(-1)) * view_depth.cell * forward
    before = np.maximum(view_depth.nearest[index] - local[..., 2], 0.0)
    within = view_depth.beside[index] == 0
    depth = view_depth.depth[index]
    return np.where(within, before, beside), np.where(within & np.isfinite(depth), local[..., 2] - depth, np.inf)


def view_frame(view: PointCloud) -> Float[np.ndarray, "3 3"]:
    """Return a camera frame that looks at the middle of the points. Columns: right, down and forward."""
    forward = view.points.mean(0) - view.viewpoint
    length = float(np.linalg.norm(forward))
    forward = forward / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
    right = perpendicular(forward)
    return np.column_stack([right, np.cross(forward, right), forward])
