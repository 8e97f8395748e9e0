"""Point clouds [m] of one camera, and functions that transform and clean them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from graspd_core.errors import CloudError, Extra
from graspd_core.mesh.topology import voxel_keys

# Several positions or directions, a single position or direction, and the camera positions of several views.
Points = Float[np.ndarray, "n 3"]
Vector = Float[np.ndarray, "3"]
Eyes = Float[np.ndarray, "views 3"]

MIN_POINTS = 50
# Points are outliers if they are farther from the cloud's median than this many times the cloud's size.
MAX_DISTANCE_IN_SIZES = 1e3
# Points nearer to the camera than this [m] are not measurements. Some drivers send such points for missing depth.
CAMERA_PLACE_TOLERANCE_M = 1e-5
# Cropping cuts a surface where points this near to a side [m] continue outside, in steps of this length [m], each at
# most this far aside [m], to a distance in this range [m]. Nearer points may show the wall of a bin.
_AT_SIDE, _STEP, _ASIDE, _BEYOND = 0.005, 0.01, 0.008, (0.02, 0.04)
# Greatest error of a rotation matrix times its transpose, as in a `TransformBuffer`.
RIGID = 1e-3


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points that one camera saw. Several views of a scene are several point clouds in one frame.

    Attributes:
        points: positions [m]. They may hold NaN until cleaned.
        viewpoint: position of the camera, in the same frame [m].
        forward: unit direction of the camera's optical axis, in the same frame, None if unknown.
        posed: True if the viewpoint is certain and needs no check, for example for the pixels of a depth image.
        ends: points where `crop` cut a seen surface, each with a point of the same surface beyond the cut [m]. The
            same point may occur several times.
    """

    points: Float[np.ndarray, "points 3"]
    viewpoint: Vector
    forward: Vector | None = None
    posed: bool = False
    ends: Float[np.ndarray, "ends 2 3"] = field(default_factory=lambda: np.empty((0, 2, 3)))

    def thinned(self, size: float) -> PointCloud:
        """Keep the first point in every voxel of side `size` [m]."""
        return replace(self, points=self.points[np.unique(voxel_keys(self.points, size), return_index=True)[1]])


def is_rigid(pose: np.ndarray, tolerance: float = RIGID) -> bool:
    """Return True if a matrix is 4×4 and holds a rotation (within `tolerance`), a finite position and a row 0 0 0 1."""
    if pose.shape != (4, 4):
        return False
    turn = np.nan_to_num(pose[:3, :3]).clip(-2, 2)
    square = np.abs(turn @ turn.T - np.eye(3)).max() < tolerance and np.linalg.det(turn) > 0
    return bool(np.isfinite(pose).all() and square and np.allclose(pose[3], (0, 0, 0, 1)))


def transform_cloud(cloud: PointCloud, T_a_b: Float[np.ndarray, "4 4"]) -> PointCloud:
    """Transform a cloud from frame b to frame a, together with the position and axis of its camera.

    Raises CloudError if the transform is not rigid. A mirrored or scaled cloud would be another scene.
    """
    if not is_rigid(T_a_b):
        told = np.asarray(T_a_b).tolist()
        raise CloudError(f"cloud: {told} is not a rigid transform; valid: a rotation, a finite position, and 0 0 0 1")
    rotation, position = T_a_b[:3, :3], T_a_b[:3, 3]
    points = cloud.points @ rotation.T
    points += position
    forward = None if cloud.forward is None else rotation @ cloud.forward
    viewpoint, ends = rotation @ cloud.viewpoint + position, cloud.ends @ rotation.T + position
    return replace(cloud, points=points, viewpoint=viewpoint, forward=forward, ends=ends)


def crop(cloud: PointCloud, low: Sequence[float], high: Sequence[float]) -> tuple[PointCloud, Bool[np.ndarray, "n"]]:
    """Return the cloud inside a box from `low` to `high` [m], and a mask of the points inside. NaN is outside."""
    inside = near = np.ones(len(cloud.points), dtype=bool)
    for column, least, most in zip(cloud.points.T, low, high, strict=True):
        near = near & (column > least - _BEYOND[1]) & (column < most + _BEYOND[1])
        inside = inside & (column >= least) & (column <= most)
    kept, left, found = cloud.points[inside], cloud.points[near & ~inside], [cloud.ends]
    for way, corner in ((-1.0, low), (1.0, high)) if len(left) else ():
        for axis, side in enumerate(corner):
            at_side = kept[way * (kept[:, axis] - side) > -_AT_SIDE]
            found.append(_continued(at_side, left, way * (left[:, axis] - side), axis))
    return replace(cloud, points=kept, ends=np.concatenate(found)), inside


def _continued(
    at_side: Points, left: Float[np.ndarray, "left 3"], beyond: Float[np.ndarray, "left"], axis: int
) -> Float[np.ndarray, "ends 2 3"]:
    """Follow surfaces from points `at_side` of a box out through `left`. Return pairs of points (inside, outside)."""
    origin = front = at_side
    found = [np.empty((0, 2, 3))]
    for begin in np.arange(0.0, _BEYOND[1], _STEP):
        more = left[(beyond > begin) & (beyond <= begin + _STEP)]
        if len(front) == 0 or len(more) == 0:
            break
        across = [np.delete(points, axis, axis=1) for points in (front, more)]
        apart, nearest = map(np.asarray, KDTree(across[0]).query(across[1], distance_upper_bound=_ASIDE))
        origin, front = origin[nearest[apart < np.inf]], more[apart < np.inf]
        if begin >= _BEYOND[0]:
            found.append(np.stack([origin, front], 1))
    return np.concatenate(found)


def measured(points: Points, viewpoint: Vector) -> Bool[np.ndarray, "n"]:
    """Return which points were measured. Drivers set missing points to NaN, infinity, zero or the camera's position."""
    zero = near = finite = np.ones(len(points), dtype=bool)
    # Computed column by column, because NumPy takes ten times as long for `all` over many short rows.
    for column, place in zip(points.T, viewpoint, strict=True):
        zero = zero & (column == 0)
        near = near & (np.abs(column - place) < CAMERA_PLACE_TOLERANCE_M)
        finite = finite & np.isfinite(column)
    return finite & ~(zero | near)


def longest_side(points: Float[np.ndarray, "n k"]) -> float:
    """Return the longest side of the axis-aligned bounding box, in the unit of the points."""
    return max(float(np.ptp(column)) for column in points.T)


def least_axes(spreads: Float[np.ndarray, "n 3 3"]) -> Points:
    """Return the unit eigenvector of each matrix's least eigenvalue. If all three eigenvalues are equal, take any.

    The closed form (trigonometric roots of a cubic) takes a quarter of the time of `eigh` for thousands of matrices.
    """
    xx, yy, zz = (spreads[:, i, i] for i in range(3))
    xy, xz, yz = spreads[:, 0, 1], spreads[:, 0, 2], spreads[:, 1, 2]
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    size = np.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    half_determinant = 0.5 * (a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz))
    cosine = np.clip(half_determinant / np.maximum(size**3, 1e-300), -1.0, 1.0)
    least = 2 * size * np.cos(np.arccos(cosine) / 3 + 2 * np.pi / 3)
    a, b, c = a - least, b - least, c - least
    # The eigenvector is normal to the plane of the three rows. Take the longest cross product of two rows.
    normals = np.stack(
        [
            np.column_stack([xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy]),
            np.column_stack([xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz]),
            np.column_stack([b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz]),
        ]
    )
    lengths = np.sqrt((normals**2).sum(-1))
    best = lengths.argmax(0)
    rows = np.arange(len(spreads))
    longest = lengths[best, rows]
    found = normals[best, rows] / np.maximum(longest, 1e-300)[:, None]
    # If the rows lie on a line, or all eigenvalues are equal, all cross products are almost zero.
    unclear = longest <= 1e-9 * mean**2
    found[unclear] = np.linalg.eigh(spreads[unclear])[1][:, :, 0]
    return found


def plane_normals(groups: Float[np.ndarray, "n k 3"]) -> Points:
    """Return the unit normal of the plane through each group of points. The sign is arbitrary."""
    spread = groups - groups.mean(1, keepdims=True)
    return least_axes(np.swapaxes(spread, 1, 2) @ spread)


def clean_cloud(points: Points) -> Float[np.ndarray, "kept 3"]:
    """Drop points [m] that are not finite, thin the rest to an even density, and drop outliers.

    Raises CloudError if fewer than 50 points are left, or if the points are all in one place or too far apart.
    """
    with Extra("clouds"):
        import open3d as o3d

    if len(points) == 0:
        raise CloudError("cloud: empty, no points at all")
    finite = np.asarray(points, dtype=float)[np.isfinite(points).all(1)]
    if len(finite) == 0:
        raise CloudError(f"cloud: all {len(points)} points are NaN or infinite")
    _refuse_few(len(finite), len(points), "finite")
    # Sums of numbers near the largest float are infinite.
    with np.errstate(over="ignore", invalid="ignore"):
        spread = np.percentile(finite, 98, axis=0) - np.percentile(finite, 2, axis=0)
        size = float(np.linalg.norm(spread))
        near = np.abs(finite - np.median(finite, axis=0)).max(1) <= MAX_DISTANCE_IN_SIZES * size
    if size <= 0:
        raise CloudError(f"cloud: all {len(finite)} points are in one place")
    if not np.isfinite(size):
        raise CloudError(f"cloud: its {len(finite)} points lie too far apart to measure")
    finite = finite[near] if not near.all() else finite
    _refuse_few(len(finite), len(points), "plausible")
    # Voxels of a hundredth of the object's diagonal keep the shape, and leave at most about 10⁴ points on its surface.
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(finite))
    thinned = cloud.voxel_down_sample(size / 100)
    _refuse_few(len(thinned.points), len(points), "distinct")
    kept, _ = thinned.remove_statistical_outlier(nb_neighbors=20, std_ratio=2.5)
    result = np.asarray(kept.points)
    _refuse_few(len(result), len(points), "plausible")
    return result


def _refuse_few(left: int, given: int, kind: str) -> None:
    if left < MIN_POINTS:
        raise CloudError(f"cloud: only {left} {kind} points of {given}; at least {MIN_POINTS} are needed")
