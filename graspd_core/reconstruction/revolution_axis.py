"""The axis of a body of revolution: first from the normals of what was seen of it, then from the points.

The normals of such a body all meet its axis: with p and n a point and its normal, the axis through c along a obeys
n·(c × a) + (p × n)·a = 0, which is linear in (a, c × a) (Pottmann and Wallner, Computational Line Geometry, 2001).
Normals are noisy where depth is, so that the axis is then settled by the points: turned into one half-plane, those of
one place of the profile must coincide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from graspd_core.mesh.unique_rows import packed_rows
from graspd_core.reconstruction.merge_views import Surfels
from graspd_core.se3 import perpendicular

# Normals that pass the axis by more than this share of their direction are of something else: a handle, a spout.
MAX_SKEW = 0.3
# Gauss-Newton steps to settle an axis, points that it takes, and the share of the identity that holds what they leave
# free: a ball any direction.
GAUSS_NEWTON_STEPS, MIN_AXIS_POINTS, DAMPING = 6, 30, 1e-3


@dataclass(frozen=True)
class Axis:
    """A line: a point on it [m] and its unit direction."""

    point: Float[np.ndarray, "3"]
    direction: Float[np.ndarray, "3"]


def fit_axis(surfels: Surfels, direction: Float[np.ndarray, "3"]) -> Axis:
    """The line of that direction that the normals pass nearest to, those that miss it by far left out."""
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


def meeting_direction(surfels: Surfels) -> Float[np.ndarray, "3"]:
    """The direction of the line that all normals meet best, by iterated weights."""
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


def half_plane(surfels: Surfels, axis: Axis) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"]]:
    """Points turned about the axis into one half-plane: the unit direction that each lies in, then its height along the
    axis and distance from it [m], and its normal's part along and away from it."""
    offset = surfels.points - axis.point
    height = offset @ axis.direction
    outward = offset - np.outer(height, axis.direction)
    radius = np.linalg.norm(outward, axis=1)
    outward /= np.maximum(radius, 1e-9)[:, None]
    normals = surfels.normals
    return outward, np.column_stack([height, radius, normals @ axis.direction, (normals * outward).sum(1)])


def turned(rows: Float[np.ndarray, "n 4"], step: float) -> Bool[np.ndarray, "n"]:
    """Which points, in the half-plane, may be of a body of revolution: their normals meet the axis."""
    return (rows[:, 2] ** 2 + rows[:, 3] ** 2 > 1 - MAX_SKEW**2) & (rows[:, 1] > 0.5 * step)


def settle_axis(surfels: Surfels, axis: Axis, step: float) -> Axis:
    """The axis tilted to where the points about it make the thinnest profile, its place by the normals as before.

    Gauss-Newton; points far from the profile, a handle, count less and less. The shifts that would go with a tilt are
    not taken: along the line of sight a half seen from one side does not tell its place, and its normals do.
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
    rows: Float[np.ndarray, "n 4"],
    rates: Float[np.ndarray, "4 n 2"],
    step: float,
    scale: float,
) -> Float[np.ndarray, "4"]:
    """How far to go by each motion, given the rates at which points rise and move outwards by it.

    A point's residual is how far it is from the others of its cell of the profile, along that cell's normal; so is its
    rate, for what moves all of a cell alike tells nothing. Residuals beyond `scale` [m] count little.
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
    """Each point's cell's weighted mean."""
    total = np.maximum(np.bincount(cell, weight), 1e-12)
    return (np.bincount(cell, weight * value) / total)[cell]
