"""Fit bodies of revolution: find the axis, revolve the seen profile about it, and close its ends.

All normals meet the axis, so they give a first axis. For a point p with normal n, the axis through c along a obeys
n·(c × a) + (p × n)·a = 0, which is linear in (a, c × a) (Pottmann and Wallner, Computational Line Geometry, 2001).
Normals are noisy, so the points then refine the axis. Rotated into one half-plane, the points must form a thin profile.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from graspd_core.mesh.topology import packed_rows
from graspd_core.perception.cloud.free_space import FreeSpace, weigh
from graspd_core.perception.cloud.point_cloud import Points, Vector
from graspd_core.perception.reconstruct.merge_views import Surfels
from graspd_core.perception.reconstruct.symmetry import CONTRADICTION_WEIGHT, UP
from graspd_core.se3 import perpendicular

# A normal whose component around the axis is larger than this belongs to another part, such as a handle or a spout.
MAX_SKEW = 0.3
# Gauss-Newton steps to refine an axis, least number of points, and damping. Damping keeps an axis that the points leave
# free: any axis through its centre fits a ball.
GAUSS_NEWTON_STEPS, MIN_AXIS_POINTS, DAMPING = 6, 30, 1e-3
# Number of points of each ring around the axis, and greatest fraction of a ring that the cameras may contradict.
RING_SAMPLES, MAX_CONTRADICTED_SHARE = 24, 0.15
# If the cosine of its tilt is above this, a standing body is taken to be upright.
UPRIGHT_COSINE = 0.985
# Without a support, z points to the first camera, so this direction lies across the view.
ACROSS_VIEW = np.array([1.0, 0.0, 0.0])

# Height along the axis and distance from the axis [m], then the normal's components along the axis and away from it.
Rows = Float[np.ndarray, "_ 4"]


@dataclass(frozen=True)
class Axis:
    """A line: a point on it [m] and its unit direction."""

    point: Vector
    direction: Vector


def fit_axis(surfels: Surfels, direction: Vector) -> Axis:
    """Return the line along `direction` that the normals pass nearest to, by iteratively reweighted least squares."""
    centre = surfels.points.mean(0)
    points, normals = surfels.points - centre, surfels.normals
    turning = np.cross(points, normals) @ direction
    # n·(c × a) = c·(a × n)
    lever = np.cross(direction, normals)
    weights = np.ones(len(points))
    size = float(np.abs(points).max())
    place = np.zeros(3)
    for round_ in range(12):
        system = (lever * weights[:, None]).T @ lever + 1e-3 * np.outer(direction, direction) * len(points)
        system += 1e-6 * len(points) * np.eye(3)
        place = -np.linalg.solve(system, lever.T @ (weights * turning))
        miss = turning + lever @ place
        scale = max(0.3 * size / 1.6**round_, 0.002)
        weights = 1.0 / (1.0 + np.square(miss / scale)) ** 2
    return Axis(centre + place, direction)


def meeting_direction(surfels: Surfels) -> Vector:
    """Return the direction of the line that the normals meet best, by iteratively reweighted least squares."""
    centre = surfels.points.mean(0)
    size = float(np.abs(surfels.points - centre).max())
    points = (surfels.points - centre) / size
    lines = np.column_stack([np.cross(points, surfels.normals), surfels.normals])
    weights = np.ones(len(points))
    direction = np.zeros(3)
    for _ in range(10):
        system = (lines * weights[:, None]).T @ lines / weights.sum()
        moment = system[3:, 3:] + 1e-4 * np.eye(3)
        reduced = system[:3, :3] - system[:3, 3:] @ np.linalg.solve(moment, system[3:, :3])
        direction = np.linalg.eigh(reduced)[1][:, 0]
        place = -np.linalg.solve(moment, system[3:, :3] @ direction)
        miss = lines @ np.concatenate([direction, place])
        weights = 1.0 / (1.0 + np.square(miss / 0.05))
    return direction


def half_plane(surfels: Surfels, axis: Axis) -> tuple[Points, Float[np.ndarray, "n 4"]]:
    """Rotate points about the axis into one half-plane.

    Return the unit direction of each point from the axis, and one row per point. A row holds height along the axis [m],
    distance from the axis [m], and the normal's components along the axis and away from the axis.
    """
    offset = surfels.points - axis.point
    height = offset @ axis.direction
    outward = offset - np.outer(height, axis.direction)
    radius = np.linalg.norm(outward, axis=1)
    outward /= np.maximum(radius, 1e-9)[:, None]
    normals = surfels.normals
    return outward, np.column_stack([height, radius, normals @ axis.direction, (normals * outward).sum(1)])


def turned(rows: Float[np.ndarray, "n 4"], step: float) -> Bool[np.ndarray, "n"]:
    """Return which rows of `half_plane` fit a body of revolution: off the axis, normals nearly through the axis."""
    return (rows[:, 2] ** 2 + rows[:, 3] ** 2 > 1 - MAX_SKEW**2) & (rows[:, 1] > 0.5 * step)


def settle_axis(surfels: Surfels, axis: Axis, step: float) -> Axis:
    """Tilt the axis by Gauss-Newton steps until the profile of the points is as thin as possible.

    Points far from the profile, such as those of a handle, count less and less. Each step shifts and tilts the axis,
    but only the tilts are used. `fit_axis` then shifts the axis by the normals, because points seen from one side leave
    its position uncertain along the view.
    """
    for round_ in range(GAUSS_NEWTON_STEPS):
        right = perpendicular(axis.direction)
        up = np.cross(axis.direction, right)
        outward, rows = half_plane(surfels, axis)
        fits = turned(rows, step)
        if fits.sum() < MIN_AXIS_POINTS:
            break
        offset = surfels.points[fits] - axis.point
        # Velocities of the points, relative to an axis that shifts or tilts.
        shifts = [np.broadcast_to(-right, offset.shape), np.broadcast_to(-up, offset.shape)]
        motions = [*shifts, -np.cross(right, offset), -np.cross(up, offset)]
        rates = np.stack([np.column_stack([m @ axis.direction, (m * outward[fits]).sum(1)]) for m in motions])
        *_, a, b = _thinner(rows[fits], rates, step, max(4 * step / 1.6**round_, step))
        direction = axis.direction + np.cross(a * right + b * up, axis.direction)
        axis = fit_axis(surfels, direction / np.linalg.norm(direction))
    return axis


def _thinner(
    rows: Float[np.ndarray, "n 4"], rates: Float[np.ndarray, "4 n 2"], step: float, scale: float
) -> Float[np.ndarray, "4"]:
    """Return a Gauss-Newton step of four motions of the axis: two shifts [m] and two tilts [rad].

    `rates` holds how fast each motion changes a point's height and radius. Cells group points of the profile. A point's
    residual is its distance from its cell's mean, along the cell's normal. Residuals above `scale` [m] count little.
    """
    height, radius, along, across = rows.T
    wall = np.abs(across) > np.abs(along)
    place = np.floor(np.where(wall, height, radius) / (2 * step)).astype(int)
    cells = np.column_stack([place, 2 * wall + (np.where(wall, across, along) > 0)])
    cell = np.unique(packed_rows(cells), return_inverse=True)[1]
    moved = np.concatenate([rows[None, :, :2], rates])
    weight, moves = np.ones(len(rows)), moved[..., 0]
    for _ in range(3):
        normal = np.column_stack([_mean(along, cell, weight), _mean(across, cell, weight)])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        moves = (moved * normal).sum(2)
        moves = np.stack([move - _mean(move, cell, weight) for move in moves])
        weight = 1.0 / (1.0 + np.square(moves[0] / scale)) ** 2
    residual, system = moves[0], moves[1:]
    # Tilts are measured in metres at the object's radius, so that shifts and tilts are damped equally.
    lever = np.array([1.0, 1.0, *[float(np.median(radius))] * 2])
    held = np.diag(DAMPING * len(rows) * lever**2)
    return -np.linalg.solve((system * weight) @ system.T + held, system @ (weight * residual))


def _mean(
    value: Float[np.ndarray, "n"], cell: Int[np.ndarray, "n"], weight: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    total = np.maximum(np.bincount(cell, weight), 1e-12)
    return (np.bincount(cell, weight * value) / total)[cell]


@dataclass(frozen=True)
class Revolution:
    """The surface made by revolving the seen part about an axis.

    Attributes:
        surfels: surfels of the whole surface.
        agree, wrong: fractions of the surface that the cameras confirm and contradict.
        share: fraction of the seen points that lie on the surface.
    """

    surfels: Surfels
    agree: float
    wrong: float
    share: float


def find_revolution(surfels: Surfels, free_space: FreeSpace, step: float) -> Revolution | None:
    """Return the best body of revolution, or None if none fits.

    Try up to two axes: the axis that the normals meet best, and a vertical axis. Without a support, try an axis across
    the view instead of the vertical axis.
    """
    met = meeting_direction(surfels)
    # Every axis through its centre fits a ball. An axis across the view turns the seen side to the hidden side.
    axes = [fit_axis(surfels, UP if free_space.standing else ACROSS_VIEW)]
    # A body that is nearly upright is taken as upright, because the support is known more precisely than the axis.
    if not free_space.standing or abs(met @ UP) < UPRIGHT_COSINE:
        axes.append(settle_axis(surfels, fit_axis(surfels, met), step))
    good = [found for axis in axes if (found := revolve(surfels, free_space, axis, step)) is not None]
    worth = lambda f: f.share + 4 * f.agree * (1 - f.agree) - CONTRADICTION_WEIGHT * f.wrong  # noqa: E731
    return max(good, key=worth, default=None)


def revolve(surfels: Surfels, free_space: FreeSpace, axis: Axis, step: float) -> Revolution | None:
    """Revolve the seen profile about the axis, without rings that the cameras contradict. Return None if few remain."""
    _, rows = half_plane(surfels, axis)
    fits = turned(rows, step)
    if fits.sum() < MIN_AXIS_POINTS:
        return None
    profile = _profile(rows[fits], step)
    row = np.repeat(np.arange(len(profile)), RING_SAMPLES)
    confirmed, wrong = _confirmed_and_wrong(profile, axis, free_space)
    good = np.bincount(row, wrong) / RING_SAMPLES < MAX_CONTRADICTED_SHARE
    if good.sum() < 5:
        return None
    weight = profile[:, 1] / profile[good, 1].sum()
    kept = good[row]
    mean = lambda x: float((x * weight[row] / RING_SAMPLES)[kept].sum())  # noqa: E731
    explained = float((KDTree(profile[good, :2]).query(rows[:, :2])[0] < 2 * step).mean())
    closed = np.vstack([profile[good], *_ends(profile[good], axis, free_space, step)])
    counts = np.maximum(np.ceil(2 * np.pi * closed[:, 1] / step), 3).astype(int)
    return Revolution(_ring(closed, axis, counts), mean(confirmed), mean(wrong), explained)


def _ends(profile: Rows, axis: Axis, free_space: FreeSpace, step: float) -> list[Rows]:
    """Return rows that close each end of the profile that is off the axis: a flat cap, or a curve down to the support.

    A cap is added only if the cameras saw empty space beyond the rim. Neither cap nor curve may contradict the cameras.
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
            # A ring has no surface near its axis, so it has no foot there.
            middle = profile[:, 1].min() < 0.3 * rim[1]
            patch = _foot(rim, way, float(axis.point[2]), step) if middle else np.zeros((0, 4))
        else:
            patch = np.column_stack([np.full((n := int(rim[1] / step)), way * end), np.linspace(0.3 * step, rim[1], n)])
            patch = np.column_stack([patch, np.full(n, way), np.zeros(n)])
            beyond = patch[-1:] + np.array([[0.008 * way, 0, 0, 0]])
            if (_confirmed_and_wrong(beyond, axis, free_space)[1] > 0.1).mean() < 0.2:
                continue
        if len(patch) and _confirmed_and_wrong(patch, axis, free_space)[1].mean() < 0.1:
            found.append(patch)
    return found


def _foot(rim, way: float, ground: float, step: float) -> Rows:
    """Return rows of a parabola that continues the rim's slope and ends where axis and support meet, or no rows."""
    height, radius = way * -rim[0] + ground, rim[1]
    along, across = way * rim[2], rim[3]
    if along < 0.15 or height < 2 * step:
        return np.zeros((0, 4))
    # The tangent goes inwards by `along` for every `across` downwards.
    corner = float(np.clip(radius - height * along / max(across, 1e-3), 0.0, radius))
    t = np.linspace(0, 0.98, max(int(1.5 * (radius + height) / step), 3))[1:]
    r = (1 - t) ** 2 * radius + 2 * t * (1 - t) * corner
    z = (1 - t) ** 2 * height
    slope = np.column_stack([2 * (1 - t) * (corner - radius) - 2 * t * corner, -2 * (1 - t) * height])
    slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9)
    return np.column_stack([way * (ground - z), r, -way * slope[:, 0], -slope[:, 1]])


def _confirmed_and_wrong(rows: Rows, axis: Axis, free_space: FreeSpace) -> tuple[np.ndarray, np.ndarray]:
    ring = _ring(rows, axis, np.full(len(rows), RING_SAMPLES))
    return weigh(free_space, ring.points, ring.normals)


def _profile(rows: Float[np.ndarray, "n 4"], step: float) -> Float[np.ndarray, "m 4"]:
    """Group rows of `half_plane` by height, radius and facing direction. Return the mean row of each group."""
    side = np.where(np.abs(rows[:, 2]) > np.abs(rows[:, 3]), 2 + (rows[:, 2] > 0), rows[:, 3] > 0)
    cells = np.column_stack([np.floor(rows[:, :2] / step).astype(int), side.astype(int)])
    _, which, count = np.unique(packed_rows(cells), return_inverse=True, return_counts=True)
    mean = np.column_stack([np.bincount(which, rows[:, k]) for k in range(4)]) / count[:, None]
    mean[:, 2:] /= np.maximum(np.linalg.norm(mean[:, 2:], axis=1, keepdims=True), 1e-9)
    # Cells with a single point are outliers.
    return mean[count > 1] if (count > 1).sum() > 10 else mean


def _ring(profile: Rows, axis: Axis, counts: Int[np.ndarray, "rows"]) -> Surfels:
    """Turn each profile row about the axis. Return the surfels. `counts` gives the number of surfels for each row."""
    right = perpendicular(axis.direction)
    rows = np.repeat(np.arange(len(profile)), counts)
    place = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    turn = 2 * np.pi * place / np.repeat(counts, counts)
    outward = np.cos(turn)[:, None] * right + np.sin(turn)[:, None] * np.cross(axis.direction, right)
    height, radius, along, across = profile[rows].T
    points = axis.point + height[:, None] * axis.direction + radius[:, None] * outward
    normals = along[:, None] * axis.direction + across[:, None] * outward
    return Surfels(points, normals)
