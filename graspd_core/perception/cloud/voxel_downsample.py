"""Crop point clouds to the workspace, and downsample them to one mean point per voxel.

Segmentation labels the mean points only. Every original point then gets the label of its voxel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from graspd_core.config import SegmentationConfig
from graspd_core.errors import CloudError
from graspd_core.mesh.topology import packed_rows
from graspd_core.perception.cloud.point_cloud import MIN_POINTS, PointCloud, Points, crop, longest_side, measured

# Mask: which voxels of a scene are chosen. Labels: the object of each voxel, 0 for the largest, -1 for no object.
Mask = Bool[np.ndarray, "voxels"]
Labels = Int[np.ndarray, "voxels"]


def rows_of(label: Int[np.ndarray, "n"]) -> list[Int[np.ndarray, "_"]]:
    """Return the row indices of each object, in the order of the objects' numbers. Rows with number -1 are left out."""
    order = np.argsort(label, kind="stable")
    return np.split(order, np.searchsorted(label[order], np.arange(label.max(initial=-1) + 1)))[1:]


# If there are more points than this, only every second (third, ...) point is used.
MAX_SCENE_POINTS = 5_000_000
# Units that clouds have by mistake, how many of them make a metre, and the least plausible camera distance [m].
UNITS_PER_METRE, MIN_CAMERA_DISTANCE_M = (("millimetres", "mm", 1000), ("centimetres", "cm", 100)), 0.1


@dataclass(frozen=True)
class VoxelScene:
    """The points of all views inside the workspace, and one mean point for each voxel.

    Attributes:
        points: the kept points of all views, one view after another [m].
        distance: distance of each kept point from its camera [m].
        rows: for each view, the indices of the kept points among all points of the view.
        voxel: for each kept point, the index of its voxel.
        mean: mean point of each voxel [m].
        mean_distance: mean distance of each voxel's points from their cameras [m].
        count: number of points in each voxel.
        size: side of a voxel [m].
        ends: points where the workspace cuts seen surfaces, and points beyond, as in a `PointCloud`.
    """

    points: Float[np.ndarray, "points 3"]
    distance: Float[np.ndarray, "points"]
    rows: tuple[Int[np.ndarray, "_"], ...]
    voxel: Int[np.ndarray, "points"]
    mean: Float[np.ndarray, "voxels 3"]
    mean_distance: Float[np.ndarray, "voxels"]
    count: Int[np.ndarray, "voxels"]
    size: float
    ends: Float[np.ndarray, "ends 2 3"]

    @property
    def weight(self) -> Float[np.ndarray, "voxels"]:
        """Return each voxel's point count times squared camera distance [m²], which hardly depends on the distance."""
        return self.count * self.mean_distance**2

    def of_view(self, view: int) -> slice:
        """Return the slice of a view's points in `points`."""
        start = sum(len(rows) for rows in self.rows[:view])
        return slice(start, start + len(self.rows[view]))


def voxel_downsample(views: Sequence[PointCloud], settings: SegmentationConfig) -> VoxelScene:
    """Crop all views to the workspace and downsample them to one mean point per voxel.

    Raises CloudError if views or measured points are missing or too few, or if cameras are too far apart.
    """
    given = sum(len(view.points) for view in views)
    if given == 0:
        raise CloudError("cloud: empty, no points at all" if len(views) else "cloud: no view at all")
    stride = -(-given // MAX_SCENE_POINTS)
    kept = [_inside(view, stride, settings) for view in views]
    finite = sum(number for *_, number in kept)
    if finite == 0 and any(np.isfinite(view.points).all(1).any() for view in views):
        raise CloudError(f"cloud: all {given} points are zero or at the camera, as drivers mark missing depth")
    if finite == 0:
        raise CloudError(f"cloud: all {given} points are NaN or infinite")
    rows = tuple(row for row, *_ in kept)
    _refuse_far_apart(views, rows, settings.max_range)
    points, distance, ends = (np.concatenate([part[k] for part in kept]) for k in (1, 2, 3))
    if len(points) < MIN_POINTS:
        few = f"only {len(points)} finite points of {given}"
        if len(points) < finite:
            roi = "" if settings.roi_low is None and settings.roi_high is None else " and in the region of interest"
            few = f"only {len(points)} of {finite} points are within {settings.max_range:g} m of the camera{roi}"
        raise CloudError(f"cloud: {few}; at least {MIN_POINTS} are needed{unit_hint(views, settings.max_range)}")
    voxel, size = _voxels(points, settings.voxel, settings.max_voxels)
    count = np.bincount(voxel)
    mean = np.column_stack([np.bincount(voxel, points[:, axis]) / count for axis in range(3)])
    if longest_side(mean) <= 0:
        within = longest_side(points)
        unit = f", within {1e3 * within:.2g} mm: are they in metres?" if within else "; no surface is seen"
        raise CloudError(f"cloud: all {len(points)} points are in one place{unit}")
    return VoxelScene(points, distance, rows, voxel, mean, np.bincount(voxel, distance) / count, count, size, ends)


def _inside(
    view: PointCloud, stride: int, settings: SegmentationConfig
) -> tuple[
    Int[np.ndarray, "kept"], Float[np.ndarray, "kept 3"], Float[np.ndarray, "kept"], Float[np.ndarray, "ends 2 3"], int
]:
    """Take every `stride`-th point. Return row indices, points and distances of the points in the workspace, the `ends`
    of surfaces at its border (see `PointCloud`), and the number of measured points.
    """
    rows = stride * np.flatnonzero(measured(view.points[::stride], view.viewpoint))
    points = view.points[rows].astype(float)
    distance = np.linalg.norm(points - view.viewpoint, axis=1)
    cropped, inside = crop(
        replace(view, points=points), settings.roi_low or (-np.inf,) * 3, settings.roi_high or (np.inf,) * 3
    )
    inside &= distance <= settings.max_range
    return rows[inside], points[inside], distance[inside], cropped.ends, len(rows)


def _refuse_far_apart(views: Sequence[PointCloud], rows: Sequence[Int[np.ndarray, "_"]], farthest: float) -> None:
    """Raise CloudError if two cameras are too far apart to see a common point."""
    first, *others = [k for k, kept in enumerate(rows) if len(kept)] or [0]
    for k in others:
        apart = float(np.linalg.norm(views[k].viewpoint - views[first].viewpoint))
        if apart > 2 * farthest:
            raise CloudError(
                f"cloud: the cameras of views {first + 1} and {k + 1} are {apart:.3g} m apart, but each sees at most "
                f"max_range={farthest:g} m far: are all poses in metres, and in one frame?"
            )


def unit_hint(views: Sequence[PointCloud], farthest: float) -> str:
    """Return a hint about the likely unit of points or cameras, for an error. Empty if distances are plausible."""
    away = _median_distance(views)
    if away <= farthest:
        return ""
    for name, unit, per_metre in UNITS_PER_METRE:
        told = f"; half of them are beyond {away:.0f} m: if"
        nearer = [replace(view, viewpoint=view.viewpoint / per_metre) for view in views]
        if MIN_CAMERA_DISTANCE_M <= _median_distance(nearer) <= farthest:
            place = ", ".join(f"{coordinate:g}" for coordinate in views[0].viewpoint)
            return f"{told} the camera's position ({place}) is in {name}, give it in metres"
        if MIN_CAMERA_DISTANCE_M <= away / per_metre <= farthest:
            return f"{told} they are in {name}, divide them by {per_metre} (--units {unit} for a file)"
    return f"; half of them are beyond {away:.1f} m: are the coordinates in metres? (--units or --scale for a file)"


def _median_distance(views: Sequence[PointCloud]) -> float:
    some = np.concatenate([view.points[:: 1 + len(view.points) // 10_000] - view.viewpoint for view in views])
    return float(np.median([0.0, *np.abs(some[np.isfinite(some).all(1)]).max(1, initial=0.0)]))


def _voxels(points: Points, size: float, most: int) -> tuple[Int[np.ndarray, "n"], float]:
    """Return each point's voxel index (no gaps) and the voxel side. Enlarge voxels until at most `most` are left."""
    # The minimum is computed by columns, because NumPy takes seven times as long for many short rows.
    low = np.array([column.min() for column in points.T])
    # A limit of 2^20 cells per axis lets the three indices fit into one integer.
    size = max(size, longest_side(points) / 2**20)
    cell, voxel = _distinct(((points - low) / size).astype(np.int64))
    while len(cell) > most:
        growth = max(1.2, (len(cell) / most) ** 0.5)
        size *= growth
        cell, coarser = _distinct(((cell + 0.5) / growth).astype(np.int64))
        voxel = coarser[voxel]
    return voxel, size


def _distinct(cells: Int[np.ndarray, "n 3"]) -> tuple[Int[np.ndarray, "m 3"], Int[np.ndarray, "n"]]:
    keys, which = np.unique(packed_rows(cells), return_inverse=True)
    example = np.empty(len(keys), dtype=np.int64)
    example[which] = np.arange(len(cells))
    return cells[example], which
