"""Fit closed surfaces to oriented points: screened Poisson (Kazhdan and Hoppe 2013), cut by the cameras' free space.

Where points are missing, a Poisson surface bulges outwards or stays open. So the surface's distance field is sampled on
a grid, cut by the space seen to be empty and by the support, and meshed again. The new mesh is closed.

The field is computed on a regular grid by Fourier transforms (Kazhdan 2005), or by Open3D on an adaptive grid. On small
grids, Fourier transforms take a sixth of the time. The field is then pulled to zero at the points, as in screened
Poisson. This would also fit noise, so the points are first checked to lie on one surface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import numpy as np
import scipy.fft
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation, gaussian_filter, label
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from graspd_core.errors import CloudError
from graspd_core.mesh.convex_parts import convex_hull
from graspd_core.mesh.surface_queries import closest_points, make_surface
from graspd_core.perception.cloud.free_space import FreeSpace, empty_depth
from graspd_core.perception.cloud.point_cloud import Points
from graspd_core.perception.reconstruct.merge_views import Surfels
from graspd_core.types import TriangleMesh

# Cells of the grid along the object's longest side.
GRID_CELLS = 60
# Least thickness of walls, in cells. Thinner walls are made thicker.
MIN_WALL_CELLS = 2.2
# Two points can be on opposite sides of a wall only if the cosine between their normals is below minus this.
OPPOSITE_COSINE = 0.7
# Signed distances are computed within this many cells of the surface. Farther nodes get the sign of their region.
BAND_CELLS = 2
# A floor faces up by at least this cosine, and is at most this much above the lowest seen points [m].
MIN_FLOOR_COSINE, MAX_FLOOR_RISE_M = 0.95, 0.002
# Number of nodes whose distances to a hull are computed together, so that the arrays stay in the cache.
_NODES_AT_ONCE = 1000
# Standard deviations [cells] of the blur of the field, and of the blur that measures the density of the points.
_BLUR, _DENSITY_BLUR = 1.0, 2.0
# A point's weight is the inverse of the point density. Densities below this fraction of the median are raised to it.
_SPARSEST = 0.2
# Least fraction of points within a cell of the surface, before the field is drawn to the points. On 120 views of shapes
# and scans, the fraction is 0.82 or more. On noise, it is 0.48 or less.
_MIN_NEAR = 0.7
# Steps that draw the field to zero at the points, and the reach of each step [cells].
_STEPS, _REACH = 3, 2.0
# Fourier transforms treat the grid as periodic. At least this many cells separate the grid from its periodic image.
_MARGIN = 16

# The nodes of a grid of cubes [m], and values at them.
Nodes = Float[np.ndarray, "x y z 3"]
Grid = Float[np.ndarray, "x y z"]
# Function of surfels, grid nodes and cell width [m] that returns the signed distance [m] near a fitted surface.
Field = Callable[[Surfels, Nodes, float], Grid]


def grid_cell(surfels: Surfels, least: float, cells: int = GRID_CELLS) -> float:
    """Return the cell width [m]: the points' longest side divided by `cells`, but at least `least` [m]."""
    return max(float(np.ptp(surfels.points, axis=0).max()) / cells, least)


def part_walls(surfels: Surfels, cell: float) -> Surfels:
    """Thicken thin walls to `MIN_WALL_CELLS` cells, because the sides of a thinner wall cancel on the grid."""
    points, normals = surfels.points, surfels.normals
    thinnest = MIN_WALL_CELLS * cell
    # The other side of a wall is nearest in position and opposite normal. `farthest` is the limit in six dimensions.
    tree = KDTree(np.hstack([points, thinnest * normals]))
    farthest = np.sqrt(2 + 2 * (1 - OPPOSITE_COSINE)) * thinnest
    _, other = tree.query(np.hstack([points, -thinnest * normals]), distance_upper_bound=farthest, workers=-1)
    other = np.minimum(other, len(points) - 1)
    offset = points - points[other]
    thickness = (offset * normals).sum(1)
    beside = np.linalg.norm(offset - thickness[:, None] * normals, axis=1)
    opposite = (normals * normals[other]).sum(1) < -OPPOSITE_COSINE
    wall = opposite & (np.abs(thickness) < thinnest) & (beside < thinnest)
    return Surfels(points + np.where(wall, (thinnest - thickness) / 2, 0.0)[:, None] * normals, normals)


def poisson_field(surfels: Surfels, nodes: Nodes, cell: float, finest: float) -> Grid:
    """Return the signed distance [m] to Open3D's Poisson surface, at grid nodes that are `cell` [m] apart.

    The surface is open where it leaves a cube of 1.2 times the points' size. `finest` [m] is the approximate width of
    the solver's finest cells. Cells halve from level to level. Raises CloudError if no surface fits the points.
    """
    import open3d as o3d

    size = float(np.ptp(surfels.points, axis=0).max())
    depth = int(np.clip(np.round(np.log2(1.2 * size / finest)), 5, 7))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(surfels.points))
    cloud.normals = o3d.utility.Vector3dVector(surfels.normals)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        surface, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth, scale=1.2, n_threads=1)
    faces = np.array(surface.triangles, dtype=np.int64)
    if len(faces) == 0:
        raise CloudError(f"cloud: no surface fits its {len(surfels.points)} points; more views are needed")
    return _signed(TriangleMesh(np.array(surface.vertices), faces), nodes, cell)


def close_surface(surfels: Surfels, field: Field, free_space: FreeSpace, cell: float) -> TriangleMesh:
    """Fit a surface to the surfels, cut away the space seen to be empty, and return the closed mesh of the rest.

    Args:
        field: function that returns the signed distance near the fitted surface, at the nodes of a grid.
        cell: cell width of this grid [m].
    """
    known = surfels.points
    if free_space.standing:
        known = np.concatenate([known, _beneath_floors(surfels, free_space.lowest)])
    low, high = known.min(0), known.max(0)
    axes = [np.arange(low[k] - 3.5 * cell, high[k] + 4.5 * cell, cell) for k in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    value = field(surfels, nodes, cell)
    inner = value < BAND_CELLS * cell
    beyond = np.maximum(empty_depth(free_space, nodes[inner]), _outside_hull(known, nodes[inner], cell))
    value[inner] = np.maximum(value[inner], beyond - free_space.slack)
    value = gaussian_filter(value, 0.5)
    if free_space.standing:
        value = np.maximum(value, -nodes[..., 2])
    return march(_one_solid(value, cell), axes)


def _beneath_floors(surfels: Surfels, lowest: float) -> Points:
    """Return points of low floors, e.g. of a cup, moved down to the support, so that the hull reaches the support."""
    floor = (surfels.normals[:, 2] > MIN_FLOOR_COSINE) & (surfels.points[:, 2] < lowest + MAX_FLOOR_RISE_M)
    return surfels.points[floor] * np.array([1.0, 1.0, 0.0])


def march(value: Grid, axes: Sequence[Float[np.ndarray, "_"]]) -> TriangleMesh:
    """Return the zero surface of a field on nodes at the coordinates `axes` [m]. Normals point to higher values."""
    import igl

    cell = float(axes[0][1] - axes[0][0])
    # Values at the nodes are kept off zero, because zeros would make degenerate faces.
    value = np.where(np.abs(value) < 0.02 * cell, np.where(value < 0, -0.02, 0.02) * cell, value)
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    # igl expects the first coordinate to vary fastest.
    columns = nodes.transpose(2, 1, 0, 3).reshape(-1, 3)
    marching: Any = igl.marching_cubes
    vertices, faces = marching(value.ravel(order="F"), columns, *value.shape, 0.0)[:2]
    a, b, c = vertices[faces].transpose(1, 0, 2)
    if np.einsum("ij,ij->", a, np.cross(b, c)) < 0:
        faces = faces[:, ::-1]
    return TriangleMesh(np.asarray(vertices), np.asarray(faces, dtype=np.int64))


def _signed(surface: TriangleMesh, nodes: Nodes, cell: float) -> Grid:
    """Return the signed distance [m] at nodes near the surface, and plus or minus `BAND_CELLS` cells at other nodes.

    The surface has no border within the grid, so it divides the grid into regions. Near the surface, the normal of the
    nearest face gives a node's sign. Each region takes the sign of most of its nodes near the surface.
    """
    near = _touched(surface, nodes, cell)
    closest, normals = closest_points(make_surface(surface), nodes[near])
    offset = nodes[near] - closest
    side = np.where((offset * normals).sum(1) < 0, -1.0, 1.0)
    value = np.full(near.shape, BAND_CELLS * cell)
    value[near] = np.linalg.norm(offset, axis=1)
    signs = np.zeros(near.shape)
    signs[near] = side
    labelled: Any = label(value > 0.9 * cell)
    region, count = labelled
    votes = np.bincount(region.ravel(), signs.ravel(), count + 1)
    return value * np.where(region > 0, np.where(votes[region] < 0, -1.0, 1.0), signs)


def _touched(surface: TriangleMesh, nodes: Nodes, cell: float) -> Bool[np.ndarray, "x y z"]:
    """Return which nodes are within about two cells of the surface. The faces must be smaller than two cells."""
    points = np.concatenate([surface.vertices, surface.vertices[surface.faces].mean(1)])
    index = np.round((points - nodes[0, 0, 0]) / cell).astype(int)
    index = index[((index >= 0) & (index < nodes.shape[:3])).all(1)]
    touched = np.zeros(nodes.shape[:3], dtype=bool)
    touched[tuple(index.T)] = True
    return np.asarray(binary_dilation(touched, np.ones((3, 3, 3)), iterations=BAND_CELLS), dtype=bool)


def _outside_hull(points: Points, nodes: Float[np.ndarray, "m 3"], cell: float) -> Float[np.ndarray, "m"]:
    """Return how far nodes lie outside the convex hull of points [m]. The surface must close within the hull."""
    hull = convex_hull(np.unique(np.round(points / (3 * cell)), axis=0) * 3 * cell)
    if hull is None:
        return np.zeros(len(nodes))
    # The parts stay in the cache. One array of all nodes by all facets would take 0.5 GB and eight times as long.
    parts = np.array_split(np.vstack([nodes.T, np.ones(len(nodes))]), 1 + len(nodes) // _NODES_AT_ONCE, axis=1)
    return np.maximum(np.concatenate([(hull.equations @ part).max(0) for part in parts]), 0.0)


def _one_solid(value: Grid, cell: float) -> Grid:
    """Return the field with only its largest body. Fill cavities of the body, and close it at the grid's border."""
    border = np.ones(value.shape, dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    value = np.where(border, np.maximum(value, 0.5 * cell), value)
    labelled: Any = label(value < 0)
    part, count = labelled
    if count == 0:
        raise CloudError("cloud: its points enclose nothing; more views are needed")
    size = np.bincount(part.ravel())
    value = np.where((part > 0) & (part != 1 + size[1:].argmax()), 0.5 * cell, value)
    bubbles: Any = label(value >= 0)
    return np.where((value >= 0) & (bubbles[0] != bubbles[0][0, 0, 0]), -0.5 * cell, value)


def grid_poisson_field(surfels: Surfels, nodes: Nodes, cell: float) -> Grid:
    """Return the signed distance [m] to a surface through the surfels at grid nodes, limited to `BAND_CELLS` cells.

    Args:
        surfels: points with normals, all within the grid.
        nodes: positions of the grid nodes, `cell` [m] apart.

    Raises:
        CloudError: the points and normals do not fit one surface.
    """
    counts = nodes.shape[:3]
    fft: Any = scipy.fft  # typed as Any, because SciPy declares only the dispatch types
    shape = tuple(int(fft.next_fast_len(count + _MARGIN, real=True)) for count in counts)
    before = [(most - count) // 2 for most, count in zip(shape, counts, strict=True)]
    at = _trilinear((surfels.points - nodes[0, 0, 0]) / cell + before, shape)
    waves = _waves(shape)
    square = sum(wave**2 for wave in waves)

    # float32 is far more precise than the noise. The transforms take most of the time, and a third as long in float32.
    def spread(values: Float[np.ndarray, "points"]) -> np.ndarray:
        return fft.rfftn((at.T @ values).astype(np.float32).reshape(shape))

    def at_points(spectrum: np.ndarray) -> tuple[Float[np.ndarray, "nodes"], Float[np.ndarray, "points"]]:
        field = fft.irfftn(spectrum, shape).ravel()
        return field, at @ field

    _, density = at_points(spread(np.ones(len(surfels.points))) * np.exp(-0.5 * _DENSITY_BLUR**2 * square))
    weights = 1.0 / np.maximum(density, _SPARSEST * np.median(density))
    blur = np.exp(-0.5 * _BLUR**2 * square)
    # The gradient of the field shall equal the vector field of the normals.
    flow = sum(wave * spread(weights * along) for wave, along in zip(waves, surfels.normals.T, strict=True))
    field, there = at_points(-1j * flow * blur / np.maximum(square, 1e-12))
    gradient = np.stack([at @ part.ravel() for part in np.gradient(field.reshape(shape))], -1)
    slope = float(np.median((gradient * surfels.normals).sum(1)))
    if not slope > 0:
        raise CloudError(f"cloud: the normals of its {len(surfels.points)} points fit no surface; add more views")
    field, there = ((values - np.average(there, weights=weights)) / slope for values in (field, there))
    near = float((np.abs(there) < 1.0).mean())
    if near < _MIN_NEAR:
        raise CloudError(f"cloud: only {near:.0%} of its {len(there)} points fit one surface; add more views")
    for _ in range(_STEPS):
        push, pushed = at_points(spread(-weights * there) * blur / (square + _REACH**-2))
        # The step length minimises the squared field at the points.
        share = -(weights * there * pushed).sum() / max((weights * pushed**2).sum(), 1e-300)
        field, there = field + share * push, there + share * pushed
    inner = tuple(slice(low, low + count) for low, count in zip(before, counts, strict=True))
    return cell * np.clip(field.reshape(shape)[inner], -BAND_CELLS, BAND_CELLS)


def _trilinear(place: Float[np.ndarray, "points 3"], shape: tuple[int, ...]) -> Any:
    """Return the matrix (points × nodes) that interpolates a field. `place` holds the points' positions in cells."""
    corners = np.array(list(product((0, 1), repeat=3)))
    low = np.floor(place).astype(int)
    share = (place - low)[:, None]
    weights = np.where(corners, share, 1 - share).prod(-1)
    nodes = np.ravel_multi_index(tuple(np.moveaxis(low[:, None] + corners, -1, 0)), shape)
    ends = np.arange(len(place) + 1) * len(corners)
    return csr_array((weights.ravel(), nodes.ravel(), ends), shape=(len(place), int(np.prod(shape))))


def _waves(shape: tuple[int, ...]) -> list[np.ndarray]:
    turns = [np.fft.fftfreq(shape[0]), np.fft.fftfreq(shape[1]), np.fft.rfftfreq(shape[2])]
    waves = ((2 * np.pi * turn).astype(np.float32) for turn in turns)
    return list(np.meshgrid(*waves, indexing="ij", sparse=True))
