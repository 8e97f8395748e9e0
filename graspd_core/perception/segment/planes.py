"""Find large flat parts of a scene by RANSAC, and refine them by weighted least squares.

The noise of a depth camera grows with the square of the distance, because stereo and structured light measure
disparity. A plane's tolerance grows with the square of the distance too, by a factor estimated from the residuals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation, label

from graspd_core.config import SegmentationConfig
from graspd_core.errors import Extra
from graspd_core.mesh.convex_parts import convex_hull
from graspd_core.mesh.topology import packed_rows
from graspd_core.perception.cloud.point_cloud import Eyes, Points, Vector, longest_side
from graspd_core.types import Plane

# Greatest number of points for RANSAC, chosen evenly.
RANSAC_POINTS = 10_000
# For a true plane, the median residual is at most this fraction of the search width, and the tolerance at most this
# multiple of the search width. The residuals of a curved surface fill any search width.
MAX_MEDIAN_RESIDUAL_SHARE, MAX_GATE_GROWTH = 0.4, 1.5
# Points within this many standard deviations are on the plane.
INLIER_DEVIATIONS = 4.0
# The plane is fitted to points within this many standard deviations.
FIT_DEVIATIONS = 3.0
MAX_PLANES = 4
# Cell size of the raster that measures a plane's visible part [m]. Gaps of a few cells are bridged.
RASTER_CELL_M = 0.01
# Greatest number of raster cells along a side. For larger parts the cells are wider.
MAX_RASTER_CELLS = 2000
BRIDGED_CELLS = 3


@dataclass(frozen=True)
class FlatPart:
    """A plane and its visible part.

    Attributes:
        plane: the plane, its normal towards the cameras.
        axes: two unit vectors in the plane, as columns.
        noise: standard deviation of the points from the plane, divided by their squared distance from the camera [1/m].
        least: lower limit of `tolerance`, the height up to which points belong to the plane [m].
        most: upper limit of `tolerance` [m].
        inliers: which of the scene's points lie on the plane.
        sides: length and width of the visible part [m].
        hull: convex hull of the visible part: rows (n, c) with n·x + c <= 0, in the coordinates of `axes`.
        area: area of the hull [m²].
        filled: fraction of the hull's area that is visible.
    """

    plane: Plane
    axes: Float[np.ndarray, "3 2"]
    noise: float
    least: float
    most: float
    inliers: Bool[np.ndarray, "points"]
    sides: tuple[float, float]
    hull: Float[np.ndarray, "edges 3"]
    area: float
    filled: float

    def height(self, points: Points) -> Float[np.ndarray, "n"]:
        """Return the height of points above the plane, towards the cameras [m]."""
        return points @ self.plane.normal - self.plane.offset

    def tolerance(self, distance: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the height up to which points belong to the plane [m]. It grows with `distance` to the camera [m]."""
        return np.clip(INLIER_DEVIATIONS * self.noise * distance**2, self.least, self.most)

    def clearance(self, points: Points, distance: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return how far points are above the tolerance band [m], which widens with `distance` from the camera [m]."""
        return self.height(points) - self.tolerance(distance)

    def as_support(self, distance: Float[np.ndarray, "n"]) -> Plane:
        """Return the plane as a support. Its `margin` is the camera noise [m] at `distance` from the camera [m]."""
        return replace(self.plane, margin=float(np.median(self.tolerance(distance))) / INLIER_DEVIATIONS)

    def beneath(self, points: Points, margin: float) -> Bool[np.ndarray, "n"]:
        """Return which points project into the hull of the visible part, or at most `margin` [m] outside the hull."""
        flat = points @ self.axes
        return np.asarray((flat @ self.hull[:, :2].T + self.hull[:, 2] <= margin).all(1))


def known_part(points: Points, plane: Plane, settings: SegmentationConfig) -> FlatPart | None:
    """Return a known plane as a flat part beneath all points [m]. Return None if the points have no hull.

    The camera's noise is unknown, so the tolerance is half the greatest one.
    """
    axes = np.linalg.svd(plane.normal[None])[2][1:].T
    flat, most = points @ axes, 0.5 * settings.max_plane_tolerance
    inliers, hull = np.abs(points @ plane.normal - plane.offset) < most, convex_hull(flat)
    sides = tuple(sorted(np.ptp(flat, axis=0).tolist(), reverse=True))
    return hull and FlatPart(plane, axes, 0.0, most, most, inliers, sides, hull.equations, float(hull.volume), 1.0)


def find_planes(
    points: Points, distance: Float[np.ndarray, "n"], viewpoints: Eyes, settings: SegmentationConfig
) -> list[FlatPart]:
    """Find flat parts, the largest first. Each point belongs to at most one part.

    Args:
        points: evenly dense points [m].
        distance: distance of each point from its camera [m].
        viewpoints: camera positions [m].
        settings: sizes and tolerances. Parts too small for a support are ignored.
    """
    with Extra("clouds"):
        import open3d as o3d

    left, wide = np.arange(len(points)), settings.plane_search_width
    parts: list[FlatPart] = []
    for _ in range(MAX_PLANES):
        if len(left) < max(50, (settings.support_size / 0.02) ** 2):
            break
        some = left[:: 1 + len(left) // RANSAC_POINTS]
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[some]))
        part, guess, gate = None, np.zeros(4), wide
        # A wide search may fit one sloped plane to both levels of a stepped table. Then a narrow search is tried.
        for gate in (wide, min(settings.plane_tolerance, 0.5 * wide)):
            # Run all trials (probability 1). If threads could stop early, the plane would differ between runs.
            o3d.utility.random.seed(0)
            guess = np.asarray(cloud.segment_plane(gate, 3, settings.ransac_trials, 1.0)[0])
            part = _refine(points, distance, left, guess, viewpoints.mean(0), gate, settings)
            if part is not None:
                break
        if part is not None and part.sides[1] >= settings.support_size:
            parts.append(part)
            left = left[~part.inliers[left]]
        else:
            left = left[np.abs(points[left] @ guess[:3] + guess[3]) >= gate]
    return parts


def _refine(
    points: Points,
    distance: Float[np.ndarray, "n"],
    left: Int[np.ndarray, "left"],
    guess: Float[np.ndarray, "4"],
    viewpoint: Vector,
    gate: float,
    settings: SegmentationConfig,
) -> FlatPart | None:
    """Fit the plane `guess` (n·x + d = 0) to the points `left`. Return None for few inliers or a curved surface."""
    least, most = settings.plane_tolerance, settings.max_plane_tolerance
    size = float(np.linalg.norm(guess[:3]))
    if not size > 0:
        return None
    normal, offset = guess[:3] / size, -float(guess[3]) / size
    near, far = points[left], distance[left] ** 2
    coarse = width = gate * far.clip(1.0)
    noise = 0.0
    for step in range(4):
        residual = near @ normal - offset
        inlier = np.abs(residual) < width
        if inlier.sum() < 20:
            return None
        weight = 1.0 / far[inlier].clip(1e-4) ** 2
        centre = weight @ near[inlier] / weight.sum()
        spread = near[inlier] - centre
        _, vectors = np.linalg.eigh((spread * weight[:, None]).T @ spread)
        normal = vectors[:, 0]
        offset = float(normal @ centre)
        residual = np.abs(near[inlier] @ normal - offset)
        noise = 1.4826 * float(np.median(residual / far[inlier].clip(1e-4)))
        runs_away = INLIER_DEVIATIONS * noise * np.median(far[inlier] / coarse[inlier]) > MAX_GATE_GROWTH
        if runs_away or (step == 0 and np.median(residual / width[inlier]) > MAX_MEDIAN_RESIDUAL_SHARE):
            return None
        # The width is below the tolerance. Otherwise the feet of objects on the plane would tilt the plane.
        width = np.clip(FIT_DEVIATIONS * noise * far, 0.25 * least, most)
    if normal @ viewpoint < offset:
        normal, offset = -normal, -offset
    inliers = np.zeros(len(points), dtype=bool)
    inliers[left] = np.abs(near @ normal - offset) < np.clip(INLIER_DEVIATIONS * noise * far, least, most)
    return _measure(points, inliers, Plane(normal, offset), noise, settings)


def _measure(
    points: Points, inliers: Bool[np.ndarray, "n"], plane: Plane, noise: float, settings: SegmentationConfig
) -> FlatPart | None:
    """Return the largest connected region of the inliers as a flat part, or None if the region has no hull."""
    axes = np.linalg.svd(plane.normal[None])[2][1:].T
    rows = np.flatnonzero(inliers)
    flat = points[rows] @ axes
    low = flat.min(0)
    width = max(RASTER_CELL_M, longest_side(flat) / MAX_RASTER_CELLS)
    cell = np.round((flat - low) / width).astype(int) + BRIDGED_CELLS
    raster = np.zeros(cell.max(0) + 2 * BRIDGED_CELLS, dtype=bool)
    raster[tuple(cell.T)] = True
    names, _ = label(binary_dilation(raster, iterations=BRIDGED_CELLS))  # pyright: ignore[reportGeneralTypeIssues]
    name = names[tuple(cell.T)]
    largest = name == np.bincount(name)[1:].argmax() + 1
    flat = flat[largest]
    hull = convex_hull(flat)
    if hull is None:
        return None
    kept = np.zeros(len(points), dtype=bool)
    kept[rows[largest]] = True
    _, turn = np.linalg.eigh(np.cov(flat.T))
    short, long = sorted(np.ptp(np.percentile(flat @ turn, [1, 99], axis=0), axis=0).tolist())
    area = float(hull.volume)
    seen = len(np.unique(packed_rows(cell[largest]))) * width**2
    least, most = settings.plane_tolerance, settings.max_plane_tolerance
    return FlatPart(plane, axes, noise, least, most, kept, (long, short), hull.equations, area, seen / area)
