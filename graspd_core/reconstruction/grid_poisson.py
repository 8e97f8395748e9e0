"""Poisson's field of oriented points on a regular grid, by Fourier transforms (Kazhdan 2005).

On grids of few nodes it takes a sixth of the time of Open3D's adaptive one, and spares finding the distance to a mesh.
As in screened Poisson (Kazhdan and Hoppe 2013), the field is then drawn to zero at the points. Points that are of no
surface, as noise, are so fitted too: whether they are of one is asked before.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float

from graspd_core.errors import CloudError
from graspd_core.reconstruction.merge_views import Surfels
from graspd_core.reconstruction.poisson import BAND_CELLS

# Standard deviations, in cells: of the blur of the field, and of the one that the points' density is read from.
_BLUR, _DENSITY_BLUR = 1.0, 2.0
# Points count for no more than where they are this much sparser than the median.
_SPARSEST = 0.2
# Of the points at least this share lies within a cell of the surface before it is drawn to them: of 120 views of shapes
# and scans 0.82 and more, of noise 0.48 and less.
_MIN_NEAR = 0.7
# Steps that draw the field to zero at the points, and how far each reaches, in cells.
_STEPS, _REACH = 3, 2.0
# The transforms are of what repeats: so many cells lie between the object and its next image.
_MARGIN = 16


def grid_poisson_field(
    surfels: Surfels, nodes: Float[np.ndarray, "x y z 3"], cell: float
) -> Float[np.ndarray, "x y z"]:
    """Signed distance near the points' surface [m] at the nodes of a grid of cubes, outside positive, at most a band.

    Args:
        surfels: all within the grid.
        nodes: of the grid, `cell` apart [m].

    Raises:
        CloudError: the points and normals are not those of one surface.
    """
    import scipy.fft

    counts = nodes.shape[:3]
    fft: Any = scipy.fft  # of which no types are known: SciPy declares these as what they dispatch by
    shape = tuple(int(fft.next_fast_len(count + _MARGIN, real=True)) for count in counts)
    before = [(most - count) // 2 for most, count in zip(shape, counts, strict=True)]
    at = _trilinear((surfels.points - nodes[0, 0, 0]) / cell + before, shape)
    waves = _waves(shape)
    square = sum(wave**2 for wave in waves)

    # In float32, whose last digit is far less than noise: transforms are most of the time, and take a third of it so.
    def spread(values: Float[np.ndarray, "points"]) -> np.ndarray:
        return fft.rfftn((at.T @ values).astype(np.float32).reshape(shape))

    def at_points(spectrum: np.ndarray) -> tuple[Float[np.ndarray, "nodes"], Float[np.ndarray, "points"]]:
        field = fft.irfftn(spectrum, shape).ravel()
        return field, at @ field

    _, density = at_points(spread(np.ones(len(surfels.points))) * np.exp(-0.5 * _DENSITY_BLUR**2 * square))
    weights = 1.0 / np.maximum(density, _SPARSEST * np.median(density))
    blur = np.exp(-0.5 * _BLUR**2 * square)
    # The gradient of the field is the normals' vector field.
    flow = sum(wave * spread(weights * along) for wave, along in zip(waves, surfels.normals.T, strict=True))
    field, there = at_points(-1j * flow * blur / np.maximum(square, 1e-12))
    slope = _slope(field.reshape(shape), at, surfels.normals)
    if not slope > 0:
        raise CloudError(f"cloud: the normals of its {len(surfels.points)} points are of no surface")
    field, there = ((values - np.average(there, weights=weights)) / slope for values in (field, there))
    _refuse_far(there)
    for _ in range(_STEPS):
        push, pushed = at_points(spread(-weights * there) * blur / (square + _REACH**-2))
        # As far along it as leaves least at the points.
        share = -(weights * there * pushed).sum() / max((weights * pushed**2).sum(), 1e-300)
        field, there = field + share * push, there + share * pushed
    inner = tuple(slice(low, low + count) for low, count in zip(before, counts, strict=True))
    return cell * np.clip(field.reshape(shape)[inner], -BAND_CELLS, BAND_CELLS)


def _refuse_far(there: Float[np.ndarray, "points"]) -> None:
    """Refuse a field that most points do not lie near the zero of; `there` is what it is at them, in cells."""
    near = float((np.abs(there) < 1.0).mean())
    if near < _MIN_NEAR:
        raise CloudError(f"cloud: no surface fits its {len(there)} points ({near:.0%} do)")


def _trilinear(place: Float[np.ndarray, "points 3"], shape: tuple[int, ...]) -> Any:
    """The matrix, points by nodes, that reads a field at places given in cells."""
    from scipy.sparse import csr_array

    corners = np.array(list(product((0, 1), repeat=3)))
    low = np.floor(place).astype(int)
    share = (place - low)[:, None]
    weights = np.where(corners, share, 1 - share).prod(-1)
    nodes = np.ravel_multi_index(tuple(np.moveaxis(low[:, None] + corners, -1, 0)), shape)
    ends = np.arange(len(place) + 1) * len(corners)
    return csr_array((weights.ravel(), nodes.ravel(), ends), shape=(len(place), int(np.prod(shape))))


def _waves(shape: tuple[int, ...]) -> list[np.ndarray]:
    """Wave numbers [rad per cell] of a real field's spectrum along each axis, to be broadcast."""
    turns = [np.fft.fftfreq(shape[0]), np.fft.fftfreq(shape[1]), np.fft.rfftfreq(shape[2])]
    waves = ((2 * np.pi * turn).astype(np.float32) for turn in turns)
    return list(np.meshgrid(*waves, indexing="ij", sparse=True))


def _slope(field: Float[np.ndarray, "x y z"], at: Any, normals: Float[np.ndarray, "points 3"]) -> float:
    """How much a field grows from cell to cell along the normals: the median over the points."""
    gradient = np.stack([at @ part.ravel() for part in np.gradient(field)], -1)
    return float(np.median((gradient * normals).sum(1)))
