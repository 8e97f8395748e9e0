"""Bodies of revolution: the seen profile turned about the axis, and what closes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from graspd_core.mesh.unique_rows import packed_rows
from graspd_core.pointcloud.free_space import FreeSpace, weigh
from graspd_core.reconstruction.merge_views import Surfels
from graspd_core.reconstruction.revolution_axis import (
    MIN_AXIS_POINTS,
    Axis,
    fit_axis,
    half_plane,
    meeting_direction,
    settle_axis,
    turned,
)
from graspd_core.reconstruction.symmetry import CONTRADICTION_WEIGHT, UP
from graspd_core.se3 import perpendicular

# Places around the axis that each ring of the profile is judged at, and the share of them that may contradict it.
RING_SAMPLES, MAX_CONTRADICTED_SHARE = 24, 0.15
# Cosine of the tilt below which a body that stands is upright.
UPRIGHT_COSINE = 0.985
# Without a support the first camera looks down on things: up is towards it.
ACROSS_VIEW = np.array([1.0, 0.0, 0.0])


# Height along the axis and distance from it [m], then the normal's part along and away from it.
Rows = Float[np.ndarray, "_ 4"]


@dataclass(frozen=True)
class Revolution:
    """The surface that turning what was seen about an axis gives.

    Attributes:
        surfels: of the whole surface.
        agree, wrong: share of places on it that confirm and that contradict it.
        share: how much of what was seen it accounts for.
    """

    axis: Axis
    surfels: Surfels
    agree: float
    wrong: float
    share: float


def find_revolution(surfels: Surfels, free_space: FreeSpace, step: float) -> Revolution | None:
    """The revolution that shows most: about an upright axis, if the object stands, or one that all normals meet."""
    met = meeting_direction(surfels)
    # A ball has all axes: one across the view shows its back.
    axes = [fit_axis(surfels, UP if free_space.standing else ACROSS_VIEW)]
    # What nearly stands upright does: the support is known better than any axis.
    if not free_space.standing or abs(met @ UP) < UPRIGHT_COSINE:
        axes.append(settle_axis(surfels, fit_axis(surfels, met), step))
    found = [revolve(surfels, free_space, axis, step) for axis in axes]
    good = [f for f in found if f is not None]
    return (
        max(good, key=lambda f: f.share + 4 * f.agree * (1 - f.agree) - CONTRADICTION_WEIGHT * f.wrong)
        if good
        else None
    )


def revolve(surfels: Surfels, free_space: FreeSpace, axis: Axis, step: float) -> Revolution | None:
    """The seen profile turned about the axis; rings that the cameras contradict are left out."""
    _, rows = half_plane(surfels, axis)
    fits = turned(rows, step)
    if fits.sum() < MIN_AXIS_POINTS:
        return None
    profile = _profile(rows[fits], step)
    right = perpendicular(axis.direction)
    up = np.cross(axis.direction, right)
    scored = _ring(profile, axis, right, up, np.full(len(profile), RING_SAMPLES))
    row = np.repeat(np.arange(len(profile)), RING_SAMPLES)
    confirmed, wrong = weigh(free_space, scored.points, scored.normals)
    good = np.bincount(row, wrong) / RING_SAMPLES < MAX_CONTRADICTED_SHARE
    if good.sum() < 5:
        return None
    weight = profile[:, 1] / profile[good, 1].sum()
    kept = good[row]
    mean = lambda x: float((x * weight[row] / RING_SAMPLES)[kept].sum())  # noqa: E731
    explained = _explained(profile[good], rows[:, :2], step)
    closed = np.vstack([profile[good], *_ends(profile[good], axis, right, up, free_space, step)])
    counts = np.maximum(np.ceil(2 * np.pi * closed[:, 1] / step), 3).astype(int)
    return Revolution(axis, _ring(closed, axis, right, up, counts), mean(confirmed), mean(wrong), explained)


def _ends(profile: Rows, axis: Axis, right, up, free_space: FreeSpace, step: float) -> list[Rows]:
    """What closes a profile that stops away from the axis: a flat cap, or a curve down to the support.

    A cap only where the cameras saw the rim to be the end, and neither where they contradict it.
    """
    found = []
    outer = profile[profile[:, 3] > 0.1]
    for way in (-1.0, 1.0) if len(outer) else ():
        end = (way * outer[:, 0]).max()
        last = outer[way * outer[:, 0] > end - 2.5 * step]
        rim = last[last[:, 1] > last[:, 1].max() - 2 * step].mean(0)
        ended = way * profile[:, 0] > end - 2.5 * step
        if rim[1] < 3 * step or (way * profile[ended, 2] > 0.8).mean() > 0.2:
            continue
        if free_space.standing and way * axis.direction[2] < -0.95:
            # A ring has nothing near its axis to stand on.
            middle = profile[:, 1].min() < 0.3 * rim[1]
            patch = _foot(rim, way, float(axis.point[2]), step) if middle else np.zeros((0, 4))
        else:
            patch = np.column_stack([np.full((n := int(rim[1] / step)), way * end), np.linspace(0.3 * step, rim[1], n)])
            patch = np.column_stack([patch, np.full(n, way), np.zeros(n)])
            beyond = patch[-1:] + np.array([[0.008 * way, 0, 0, 0]])
            if (
                weigh(free_space, *_both(_ring(beyond, axis, right, up, np.full(1, RING_SAMPLES))))[1] > 0.1
            ).mean() < 0.2:
                continue
        if (
            len(patch)
            and weigh(free_space, *_both(_ring(patch, axis, right, up, np.full(len(patch), RING_SAMPLES))))[1].mean()
            < 0.1
        ):
            found.append(patch)
    return found


def _foot(rim, way: float, ground: float, step: float) -> Rows:
    """From an overhanging rim to where the axis meets the support: the parabola that leaves the rim along its tangent.

    Of a ball cut at 30° below its middle it misses the rest by a hundredth of the radius.
    """
    height, radius = way * -rim[0] + ground, rim[1]
    along, across = way * rim[2], rim[3]
    if along < 0.15 or height < 2 * step:
        return np.zeros((0, 4))
    # The tangent comes inwards by `along` for every `across` downwards.
    corner = float(np.clip(radius - height * along / max(across, 1e-3), 0.0, radius))
    t = np.linspace(0, 0.98, max(int(1.5 * (radius + height) / step), 3))[1:]
    r = (1 - t) ** 2 * radius + 2 * t * (1 - t) * corner
    z = (1 - t) ** 2 * height
    slope = np.column_stack([2 * (1 - t) * (corner - radius) - 2 * t * corner, -2 * (1 - t) * height])
    slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9)
    return np.column_stack([way * (ground - z), r, -way * slope[:, 0], -slope[:, 1]])


def _both(surfels: Surfels):
    return surfels.points, surfels.normals


def _profile(rows: Float[np.ndarray, "n 4"], step: float) -> Float[np.ndarray, "m 4"]:
    """Means over cells of height, radius and the side they face."""
    side = np.where(np.abs(rows[:, 2]) > np.abs(rows[:, 3]), 2 + (rows[:, 2] > 0), rows[:, 3] > 0)
    cells = np.column_stack([np.floor(rows[:, :2] / step).astype(int), side.astype(int)])
    _, which, count = np.unique(packed_rows(cells), return_inverse=True, return_counts=True)
    mean = np.column_stack([np.bincount(which, rows[:, k]) for k in range(4)]) / count[:, None]
    mean[:, 2:] /= np.maximum(np.linalg.norm(mean[:, 2:], axis=1, keepdims=True), 1e-9)
    # Single points are strays.
    return mean[count > 1] if (count > 1).sum() > 10 else mean


def _ring(profile, axis: Axis, right, up, counts) -> Surfels:
    """Each row of the profile turned to so many places."""
    rows = np.repeat(np.arange(len(profile)), counts)
    place = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    turn = 2 * np.pi * place / np.repeat(counts, counts)
    outward = np.cos(turn)[:, None] * right + np.sin(turn)[:, None] * up
    height, radius, along, across = profile[rows].T
    points = axis.point + height[:, None] * axis.direction + radius[:, None] * outward
    normals = along[:, None] * axis.direction + across[:, None] * outward
    return Surfels(points, normals)


def _explained(profile: Rows, places: Float[np.ndarray, "n 2"], step: float) -> float:
    """Share of points that lie on the profile."""
    from scipy.spatial import KDTree

    distance, _ = KDTree(profile[:, :2]).query(places)
    return float((distance < 2 * step).mean())
