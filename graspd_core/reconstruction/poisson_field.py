"""Screened Poisson (Kazhdan and Hoppe 2013) on a uniform grid: a field that is negative within oriented points.

The field's differences along the grid's edges are fitted to the normals, and its values near a point to those of a step
that is two cells wide. Coarse grids are solved first and start the finer ones, which then need few iterations. Where
points are missing the field goes on smoothly.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter

from graspd_core.reconstruction.merge_views import Surfels

# Weight of the points' places against that of their normals, both by area.
SCREENING = 2.0
# Conjugate-gradient steps on each grid, and the longest side of the first one in nodes.
ITERATIONS, COARSEST_NODES = 12, 12
# The weight at which the grid's border is held to be outside.
BORDER_WEIGHT = 1.0
# Faces of cells that a point stands for at most: lone points say little.
MAX_AREA = 3.0
# Cells over which the density of the points is measured.
DENSITY_CELLS = 2.0
# Cells from the surface at which the field is cut off.
BAND_CELLS = 2.0

_CORNERS = np.array(list(np.ndindex(2, 2, 2)))

Grid = Float[np.ndarray, "_ _ _"]


def poisson_field(surfels: Surfels, axes: list[Float[np.ndarray, "_"]], finest: float) -> Grid:
    """About the signed distance from the surface [m] at the nodes, at most some cells of it.

    Args:
        surfels: points of the surface, within the grid.
        axes: places of the nodes along x, y and z, in steps of one cell [m].
        finest: features smaller than this are smoothed away [m].
    """
    cell = float(axes[0][1] - axes[0][0])
    shape = tuple(len(axis) for axis in axes)
    places = (surfels.points - [axis[0] for axis in axes]) / cell
    area = _areas(places, shape)
    last = max(int(np.floor(np.log2(max(finest / cell, 1.0)))), 0)
    first = max(int(np.ceil(np.log2(max(shape) / COARSEST_NODES))), last)
    field = np.zeros(tuple(-(-(n - 1) // 2 ** (first + 1)) + 1 for n in shape))
    for level in range(first, last - 1, -1):
        size = tuple(-(-(n - 1) // 2**level) + 1 for n in shape)
        field = _solved(_doubled(field, size), places / 2**level, surfels.normals, area / 4**level)
    field -= np.average(map_coordinates(field, places.T / 2**last, order=1, mode="nearest"), weights=area)
    slope = np.sqrt(sum(np.square(rise) for rise in np.gradient(field)))
    field = 2.0**last * field / np.maximum(maximum_filter(slope, 3), 1e-6)
    for level in range(last - 1, -1, -1):
        field = _doubled(field, tuple(-(-(n - 1) // 2**level) + 1 for n in shape))
    return cell * np.clip(field, -BAND_CELLS, BAND_CELLS).astype(float)


def _solved(
    start: Grid, places: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], area: Float[np.ndarray, "n"]
) -> Grid:
    """Nearer than `start` by some conjugate-gradient steps; places in cells of this grid, areas in faces of them."""
    shape = start.shape
    low, part = _cell(places, shape)
    shares = SCREENING * area[:, None] * _shares(part)
    height = np.clip((_CORNERS - part[:, None]) @ normals[..., None], -1, 1)[..., 0]
    weight = _splat(low, shares, shape)
    right = _splat(low, shares * height * (1 - 0.5 * np.abs(height)), shape)
    for axis in range(3):
        # Along its own axis a normal falls on the edges between the nodes.
        low, part = _cell(places - np.eye(3)[axis] / 2, shape)
        rise = np.moveaxis(_splat(low, (area * normals[:, axis])[:, None] * _shares(part), shape), axis, 0)[:-1]
        sums = np.moveaxis(right, axis, 0)
        sums[:-1] -= rise
        sums[1:] += rise
    border = np.ones(shape, dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    weight[border] += BORDER_WEIGHT
    right[border] += 0.5 * BORDER_WEIGHT
    return _conjugate_gradient(start.astype(np.float32), right.astype(np.float32), weight.astype(np.float32))


def _cell(
    places: Float[np.ndarray, "n 3"], shape: tuple[int, ...]
) -> tuple[Int[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """The lowest corner of the cell around each place, and the way from there to it."""
    low = np.clip(places.astype(int), 0, np.array(shape) - 2)
    return low, places - low


def _shares(part: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 8"]:
    """How much of a place each of its cell's corners takes: trilinear."""
    x, y, z = np.stack([1 - part, part], -1).transpose(1, 0, 2)
    return (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None]).reshape(-1, 8)


def _splat(low: Int[np.ndarray, "n 3"], values: Float[np.ndarray, "n 8"], shape: tuple[int, ...]) -> Grid:
    """The sum at each node of the values at the corners of cells."""
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    index = (low @ strides)[:, None] + _CORNERS @ strides
    return np.bincount(index.ravel(), values.ravel(), int(np.prod(shape))).reshape(shape)


def _areas(places: Float[np.ndarray, "n 3"], shape: tuple[int, ...]) -> Float[np.ndarray, "n"]:
    """The surface that each point stands for [faces of cells], from how densely they lie."""
    low, part = _cell(places, shape)
    count = _splat(low, _shares(part), shape)
    wide = np.sqrt(DENSITY_CELLS**2 + 1 / 6)
    density = gaussian_filter(count, DENSITY_CELLS, truncate=2.5)
    area = 1 / (np.sqrt(2 * np.pi) * wide * map_coordinates(density, places.T, order=1, mode="nearest"))
    return np.minimum(area, MAX_AREA)


def _doubled(field: Grid, size: tuple[int, ...]) -> Grid:
    """The field on nodes twice as close, so many of them."""
    for axis, count in enumerate(size):
        known = np.moveaxis(field, axis, 0)
        finer = np.empty((2 * len(known), *known.shape[1:]), field.dtype)
        finer[::2] = known
        finer[1:-1:2] = 0.5 * (known[1:] + known[:-1])
        finer[-1] = known[-1]
        field = np.moveaxis(finer[:count], 0, axis)
    return np.ascontiguousarray(field)


def _conjugate_gradient(x: Grid, right: Grid, weight: Grid) -> Grid:
    diagonal = weight + 6
    r = right - _applied(x, weight)
    z = r / diagonal
    p, rz = z.copy(), float(np.vdot(r, z))
    for _ in range(ITERATIONS):
        if rz < 1e-12:
            break
        q = _applied(p, weight)
        step = rz / float(np.vdot(p, q))
        x = x + step * p
        r -= step * q
        z = r / diagonal
        rz, old = float(np.vdot(r, z)), rz
        p *= rz / old
        p += z
    return x


def _applied(x: Grid, weight: Grid) -> Grid:
    """Minus the Laplacian, no flow through the border, plus the weights."""
    out = weight * x
    for axis in range(3):
        rise = np.diff(x, axis=axis)
        sums = np.moveaxis(out, axis, 0)
        rise = np.moveaxis(rise, axis, 0)
        sums[:-1] -= rise
        sums[1:] += rise
    return out
