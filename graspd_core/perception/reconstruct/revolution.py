"""Bodies of revolution: the seen profile turned about its axis, and its closure.

The axis comes first from the normals, which all meet it. With p and n a point and its normal, the axis through c along
a obeys n·(c × a) + (p × n)·a = 0, which is linear in (a, c × a) (Pottmann and Wallner, Computational Line Geometry,
2001). Normals are noisy, so the points then settle the axis: turned into one half-plane, points of one place of the
profile must coincide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from graspd_core.mesh.topology import packed_rows
from graspd_core.perception.cloud.free_space import FreeSpace, weigh
from graspd_core.perception.cloud.point_cloud import Points, Vector
from graspd_core.perception.reconstruct.merge_views import Surfels
from graspd_core.perception.reconstruct.symmetry import CONTRADICTION_WEIGHT, UP
from graspd_core.se3 import perpendicular

# Normals that pass the axis by more than this share of their direction are of something else: a handle, a spout.
MAX_SKEW = 0.3
# Gauss-Newton steps to settle an axis, points that it takes, and the share of the identity that holds what they leave
# free: a ball any direction.
GAUSS_NEWTON_STEPS, MIN_AXIS_POINTS, DAMPING = 6, 30, 1e-3
# Places around the axis that each ring of the profile is judged at, and the share of them that may contradict it.
RING_SAMPLES, MAX_CONTRADICTED_SHARE = 24, 0.15
# Cosine of the tilt below which a body that stands is upright.
UPRIGHT_COSINE = 0.985
# Without a support the first camera looks down on things: up is towards it.
ACROSS_VIEW = np.array([1.0, 0.0, 0.0])

# Height along the axis and distance from it [m], then the normal's part along and away from it.
Rows = Float[np.ndarray, "_ 4"]


@dataclass(frozen=True)
class Axis:
    """A line: a point on it [m] and its unit direction."""

    point: Vector
    direction: Vector


def fit_axis(surfels: Surfels, direction: Vector) -> Axis:
    """Return the line of that direction that the normals pass nearest to, by robust weights."""
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
    """Return the direction of the line that all normals meet best, by iterated weights."""
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
    """Turn points about the axis into one half-plane.

    Returns the direction of each point from the axis, and rows. Rows hold height along the axis, distance from it [m],
    and the normal's part along and away from it.
    """
    offset = surfels.points - axis.point
    height = offset @ axis.direction
    outward = offset - np.outer(height, axis.direction)
    radius = np.linalg.norm(outward, axis=1)
    outward /= np.maximum(radius, 1e-9)[:, None]
    normals = surfels.normals
    return outward, np.column_stack([height, radius, normals @ axis.direction, (normals * outward).sum(1)])


def turned(rows: Float[np.ndarray, "n 4"], step: float) -> Bool[np.ndarray, "n"]:
    """Return which rows may be of a body of revolution: their normals meet the axis."""
    return (rows[:, 2] ** 2 + rows[:, 3] ** 2 > 1 - MAX_SKEW**2) & (rows[:, 1] > 0.5 * step)


def settle_axis(surfels: Surfels, axis: Axis, step: float) -> Axis:
    """Tilt the axis to make the thinnest profile by Gauss-Newton.

    Its place follows from the normals. Points far from the profile, as of a handle, count less and less. The shifts
    that go with a tilt are not taken. A half seen from one side does not show its place along the line of sight, but
    its normals do.
    """
    for round_ in range(GAUSS_NEWTON_STEPS):
        right = perpendicular(axis.direction)
        up = np.cross(axis.direction, right)
        outward, rows = half_plane(surfels, axis)
        fits = turned(rows, step)
        if fits.sum() < MIN_AXIS_POINTS:
            break
        offset = surfels.points[fits] - axis.point
        # How points move, seen from an axis that shifts or tilts.
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
    """Return the step by each motion, given the rates at which points rise and move outwards by it.

    A point's residual is its distance from the others of its cell of the profile, along that cell's normal. Its rate is
    measured in the same way. Residuals beyond `scale` [m] count little.
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
    # In metres at the object's radius, so that shifts and tilts are held alike.
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
    """The surface of revolution of the seen part about an axis.

    Attributes:
        surfels: of the whole surface.
        agree, wrong: share of places on it that confirm and that contradict it.
        share: how much of the seen part it accounts for.
    """

    axis: Axis
    surfels: Surfels
    agree: float
    wrong: float
    share: float


def find_revolution(surfels: Surfels, free_space: FreeSpace, step: float) -> Revolution | None:
    """Return the best revolution: about an upright axis, if the object stands, or about one that all normals meet."""
    met = meeting_direction(surfels)
    # A ball has all axes: one across the view shows its back.
    axes = [fit_axis(surfels, UP if free_space.standing else ACROSS_VIEW)]
    # What nearly stands upright does: the support is known better than any axis.
    if not free_space.standing or abs(met @ UP) < UPRIGHT_COSINE:
        axes.append(settle_axis(surfels, fit_axis(surfels, met), step))
    good = [found for axis in axes if (found := revolve(surfels, free_space, axis, step)) is not None]
    worth = lambda f: f.share + 4 * f.agree * (1 - f.agree) - CONTRADICTION_WEIGHT * f.wrong  # noqa: E731
    return max(good, key=worth, default=None)


def revolve(surfels: Surfels, free_space: FreeSpace, axis: Axis, step: float) -> Revolution | None:
    """Turn the seen profile about the axis. Rings that the cameras contradict are left out."""
    from scipy.spatial import KDTree

    _, rows = half_plane(surfels, axis)
    fits = turned(rows, step)
    if fits.sum() < MIN_AXIS_POINTS:
        return None
    profile = _profile(rows[fits], step)
    right = perpendicular(axis.direction)
    up = np.cross(axis.direction, right)
    row = np.repeat(np.arange(len(profile)), RING_SAMPLES)
    confirmed, wrong = _confirmed_and_wrong(profile, axis, right, up, free_space)
    good = np.bincount(row, wrong) / RING_SAMPLES < MAX_CONTRADICTED_SHARE
    if good.sum() < 5:
        return None
    weight = profile[:, 1] / profile[good, 1].sum()
    kept = good[row]
    mean = lambda x: float((x * weight[row] / RING_SAMPLES)[kept].sum())  # noqa: E731
    explained = float((KDTree(profile[good, :2]).query(rows[:, :2])[0] < 2 * step).mean())
    closed = np.vstack([profile[good], *_ends(profile[good], axis, right, up, free_space, step)])
    counts = np.maximum(np.ceil(2 * np.pi * closed[:, 1] / step), 3).astype(int)
    return Revolution(axis, _ring(closed, axis, right, up, counts), mean(confirmed), mean(wrong), explained)


def _ends(profile: Rows, axis: Axis, right, up, free_space: FreeSpace, step: float) -> list[Rows]:
    """Return what closes a profile that stops away from the axis: a flat cap, or a curve down to the support.

    A cap needs a rim that the cameras saw to be the end. Neither may contradict the cameras.
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
            if (_confirmed_and_wrong(beyond, axis, right, up, free_space)[1] > 0.1).mean() < 0.2:
                continue
        if len(patch) and _confirmed_and_wrong(patch, axis, right, up, free_space)[1].mean() < 0.1:
            found.append(patch)
    return found


def _foot(rim, way: float, ground: float, step: float) -> Rows:
    """Return the parabola from an overhanging rim, along its tangent, to where the axis meets the support."""
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


def _confirmed_and_wrong(rows: Rows, axis: Axis, right, up, free_space: FreeSpace) -> tuple[np.ndarray, np.ndarray]:
    ring = _ring(rows, axis, right, up, np.full(len(rows), RING_SAMPLES))
    return weigh(free_space, ring.points, ring.normals)


def _profile(rows: Float[np.ndarray, "n 4"], step: float) -> Float[np.ndarray, "m 4"]:
    """Return the means over cells of height, radius and the side that they face."""
    side = np.where(np.abs(rows[:, 2]) > np.abs(rows[:, 3]), 2 + (rows[:, 2] > 0), rows[:, 3] > 0)
    cells = np.column_stack([np.floor(rows[:, :2] / step).astype(int), side.astype(int)])
    _, which, count = np.unique(packed_rows(cells), return_inverse=True, return_counts=True)
    mean = np.column_stack([np.bincount(which, rows[:, k]) for k in range(4)]) / count[:, None]
    mean[:, 2:] /= np.maximum(np.linalg.norm(mean[:, 2:], axis=1, keepdims=True), 1e-9)
    # Single points are strays.
    return mean[count > 1] if (count > 1).sum() > 10 else mean


def _ring(profile, axis: Axis, right, up, counts) -> Surfels:
    """Turn each row of the profile to `counts` places."""
    rows = np.repeat(np.arange(len(profile)), counts)
    place = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    turn = 2 * np.pi * place / np.repeat(counts, counts)
    outward = np.cos(turn)[:, None] * right + np.sin(turn)[:, None] * up
    height, radius, along, across = profile[rows].T
    points = axis.point + height[:, None] * axis.direction + radius[:, None] * outward
    normals = along[:, None] * axis.direction + across[:, None] * outward
    return Surfels(points, normals)
