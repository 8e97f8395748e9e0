"""Find free space: the space that cameras saw to be empty, in front of surfaces and outside the object's outline.

Each view's points of the object become a small depth image. A guessed point in front of the surface in this image, or
outside the outline, contradicts the camera. A point behind the surface is hidden, so it is possible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_closing, distance_transform_edt, minimum_filter
from scipy.spatial import KDTree

from graspd_core.config import ReconstructionConfig
from graspd_core.perception.cloud.point_cloud import PointCloud, Points, Vector
from graspd_core.se3 import perpendicular

# Positions or normals, and a depth [m] or fraction for each.
Places = Float[np.ndarray, "*batch 3"]
Depths = Float[np.ndarray, "*batch"]

# Maximum number of cells of a depth image across the object. More cells would show no further detail.
MAX_IMAGE_CELLS = 160
# Number of nearest points, including the point itself, that define the spacing at a point.
SPACING_NEIGHBOURS = 5

# A point belongs to an occluder if it is nearer to the camera than the object's surface, by more than this [m].
OCCLUDER_GAP_M = 0.01
# Hidden parts may lie up to this far beside the seen part [m].
HIDDEN_REACH_M = 0.1

# A guessed point contradicts the camera fully if it lies in empty space, deeper than the slack plus this [m].
CONTRADICTION_DEPTH_M = 0.01


@dataclass(frozen=True)
class ViewDepth:
    """One camera's depth image of the object, as a pinhole of focal length 1.

    Attributes:
        eye: position of the camera [m].
        frame: axes of the camera, as columns right, down and forward.
        low, cell: corner of the first cell, and width of a cell, in image coordinates (x/z and y/z).
        depth: depth of the object's surface in each cell [m]. Cells outside the outline copy the nearest seen cell, or
            are infinite if an occluder covers the cell.
        nearest: depth up to which the camera saw empty space [m]: least depth of 3×3 cells, or depth of the occluder.
        beside: distance from the outline in cells, 0 inside the outline and where an occluder hides the object.
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
    """The space that the object cannot fill, in the local frame of the reconstruction.

    Attributes:
        view_depths: one depth image per camera, none if the cameras are unknown.
        standing: whether the object stands on a support that fills z < 0.
        lowest: height of the lowest seen points [m]. Segmentation removes lower points together with the
            support, so seen outlines may be too high by up to `lowest`.
        slack: a point at most this deep in empty space does not contradict the cameras [m].
        tolerance: the cameras confirm a guessed point that is at most this far from seen surface [m].
    """

    view_depths: tuple[ViewDepth, ...]
    standing: bool
    lowest: float = 0.0
    slack: float = ReconstructionConfig.outline_slack
    tolerance: float = ReconstructionConfig.surface_tolerance


def make_view_depths(views: Sequence[PointCloud], whole: Sequence[PointCloud] = ()) -> tuple[ViewDepth, ...]:
    """Return a depth image of the object for each view. Views with too few points are left out.

    Args:
        views: the points of each view that show the object.
        whole: all points that each camera saw, in the same order. If empty, occluders are not considered.
    """
    around = whole or [None] * len(views)
    made = (_make_view_depth(view, all_seen) for view, all_seen in zip(views, around, strict=True))
    return tuple(view_depth for view_depth in made if view_depth is not None)


def _make_view_depth(view: PointCloud, whole: PointCloud | None) -> ViewDepth | None:
    """Return the depth image of a view's points. Holes of a few cells count as missing pixels and are filled.

    Return None if fewer than five points are in front of the camera, or if all points are in one line of sight.
    """
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
    # The margin around the seen part must hold the hidden parts.
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
    """Return the depth of the occluder in front of the object in each cell [m], infinite if there is none."""
    # Most points are outside the object's image and are dropped first. For NaN, the comparisons are false.
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
    # Holes of a few cells are missing pixels of the occluder.
    _, at = distance_transform_edt(~known, return_indices=True)  # pyright: ignore[reportGeneralTypeIssues]
    return np.where(binary_closing(known, np.ones((3, 3)), iterations=2), before[tuple(at)], np.inf)


def empty_depth(free_space: FreeSpace, points: Places) -> Depths:
    """Return how deep points lie in the support or in space seen to be empty [m], 0 if in neither."""
    return _classify(free_space, points, None)[1]


def weigh(free_space: FreeSpace, points: Places, normals: Places) -> tuple[Bool[np.ndarray, "*batch"], Depths]:
    """Return which points are confirmed (on seen surface, facing a camera), and each point's contradiction, 0 to 1."""
    confirmed, deep = _classify(free_space, points, normals)
    return confirmed, np.clip((deep - free_space.slack) / CONTRADICTION_DEPTH_M, 0.0, 1.0)


def on_seen(free_space: FreeSpace, points: Places) -> Bool[np.ndarray, "*batch"]:
    """Return which points lie on seen surface, within 1.5 times the tolerance."""
    found = np.zeros(points.shape[:-1], dtype=bool)
    for view_depth in free_space.view_depths:
        empty, behind = _look(view_depth, points)
        depth = np.where(np.isfinite(behind), np.abs(behind), 0.0)
        found |= (empty < 1.5 * free_space.tolerance) & (depth < 1.5 * free_space.tolerance)
    return found


def facing(free_space: FreeSpace, points: Points, normals: Points) -> Float[np.ndarray, "n"]:
    """Return the cosine between each normal and the direction to the camera that the normal faces most."""
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
    """Return how deep points lie in empty space, and how far behind seen surface (infinite outside the outline) [m]."""
    local = (points - view_depth.eye) @ view_depth.frame
    forward = np.maximum(local[..., 2], 1e-6)
    place = (local[..., :2] / forward[..., None] - view_depth.low) / view_depth.cell
    inner = np.clip(place, 0, np.array(view_depth.depth.shape) - 1)
    index = tuple(np.moveaxis(inner.astype(int), -1, 0))
    # For points beyond the image, the distance to the image is added.
    beside = (view_depth.beside[index] + np.abs(place - inner).sum(-1)) * view_depth.cell * forward
    before = np.maximum(view_depth.nearest[index] - local[..., 2], 0.0)
    within = view_depth.beside[index] == 0
    depth = view_depth.depth[index]
    return np.where(within, before, beside), np.where(within & np.isfinite(depth), local[..., 2] - depth, np.inf)


def view_frame(view: PointCloud) -> Float[np.ndarray, "3 3"]:
    """Return the axes of a camera that looks at the mean of the points, as columns right, down and forward."""
    forward = view.points.mean(0) - view.viewpoint
    length = float(np.linalg.norm(forward))
    forward = forward / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
    right = perpendicular(forward)
    return np.column_stack([right, np.cross(forward, right), forward])
