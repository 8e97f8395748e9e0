"""Oriented points to a closed surface: screened Poisson (Kazhdan and Hoppe 2013), cut by the cameras' free space.

Where points are missing Poisson's surface balloons or runs off. It is sampled on a grid, cut by the space that was seen
to be empty and by the support, and surfaced again, which closes it.

The field is found on a regular grid by Fourier transforms (Kazhdan 2005), or by Open3D on an adaptive one. On grids of
few nodes the first takes a sixth of the time. As in screened Poisson, the field is then drawn to zero at the points.
This fits noise too, so the points are first checked to be of one surface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from graspd_core.errors import CloudError
from graspd_core.mesh.surface_queries import closest_points, make_surface
from graspd_core.perception.cloud.free_space import FreeSpace, empty_depth
from graspd_core.perception.cloud.point_cloud import Points, convex_hull
from graspd_core.perception.reconstruct.merge_views import Surfels
from graspd_core.types import TriangleMesh

# Cells of the grid along the object's longest side.
GRID_CELLS = 60
# Cells that a wall is made thick, if it is thinner.
MIN_WALL_CELLS = 2.2
# The sides of a wall face apart by this cosine at least.
OPPOSITE_COSINE = 0.7
# Beyond so many cells from the Poisson surface a node's side is its region's.
BAND_CELLS = 2
# A floor looks up by this cosine and is this much higher than the lowest points seen, at most [m].
MIN_FLOOR_COSINE, MAX_FLOOR_RISE_M = 0.95, 0.002
# Nodes whose distances to the facets of a hull are looked at together: these stay in the cache.
_NODES_AT_ONCE = 1000
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

# The nodes of a grid of cubes [m], and values at them.
Nodes = Float[np.ndarray, "x y z 3"]
Grid = Float[np.ndarray, "x y z"]
# Signed distance near a surface through surfels [m], at the nodes of a grid of cubes of that width [m].
Field = Callable[[Surfels, Nodes, float], Grid]


def grid_cell(surfels: Surfels, least: float, cells: int = GRID_CELLS) -> float:
    """Return the width of the cells that a surface through these points is closed on, at least `least` [m]."""
    return max(float(np.ptp(surfels.points, axis=0).max()) / cells, least)


def part_walls(surfels: Surfels, cell: float) -> Surfels:
    """Move the two sides of walls too thin for the grid apart by a millimetre or two, for they would cancel."""
    from scipy.spatial import KDTree

    points, normals = surfels.points, surfels.normals
    thinnest = MIN_WALL_CELLS * cell
    # Nearest in place and in opposite normal: the other side of a wall. None is farther away in these six dimensions.
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
    """Return the signed distance [m] to Open3D's Poisson surface at the nodes of a grid of cubes, `cell` apart [m].

    The surface is open where it leaves the cube of 1.2 times the points' size. Its finest cells are about as wide as
    `finest` [m]: its grid halves from level to level. Raises CloudError: no surface fits the points.
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
    """Return the closed surface of what a surface fitted to the surfels encloses, without the known empty space.

    Args:
        field: signed distance near that surface, at the nodes of a grid.
        cell: width of that grid's cells [m].
    """
    from scipy.ndimage import gaussian_filter

    known = surfels.points
    if free_space.standing:
        known = np.concatenate([known, _beneath_floors(surfels, free_space.lowest)])
    low, high = known.min(0), known.max(0)
    axes = [np.arange(low[k] - 3.5 * cell, high[k] + 4.5 * cell, cell) for k in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    value = field(surfels, nodes, cell)
    inner = value < BAND_CELLS * cell
    beyond = (
        np.maximum(empty_depth(free_space, nodes[inner]), _outside_hull(known, nodes[inner], cell)) - free_space.slack
    )
    value[inner] = np.maximum(value[inner], beyond)
    value = gaussian_filter(value, 0.5)
    if free_space.standing:
        value = np.maximum(value, -nodes[..., 2])
    return march(_one_solid(value, cell), axes)


def _beneath_floors(surfels: Surfels, lowest: float) -> Points:
    """Return points of the support beneath a cup's low floor, where the hull of the seen points would be too thin."""
    floor = (surfels.normals[:, 2] > MIN_FLOOR_COSINE) & (surfels.points[:, 2] < lowest + MAX_FLOOR_RISE_M)
    return surfels.points[floor] * np.array([1.0, 1.0, 0.0])


def march(value: Grid, axes: Sequence[Float[np.ndarray, "_"]]) -> TriangleMesh:
    """Return the zero surface of a field on a grid of cubes, facing where the field grows."""
    import igl

    cell = float(axes[0][1] - axes[0][0])
    # Kept off zero at the nodes, where the surface would pinch to nothing.
    value = np.where(np.abs(value) < 0.02 * cell, np.where(value < 0, -0.02, 0.02) * cell, value)
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    # igl counts the first coordinate fastest.
    columns = nodes.transpose(2, 1, 0, 3).reshape(-1, 3)
    marching: Any = igl.marching_cubes
    vertices, faces = marching(value.ravel(order="F"), columns, *value.shape, 0.0)[:2]
    a, b, c = vertices[faces].transpose(1, 0, 2)
    if np.einsum("ij,ij->", a, np.cross(b, c)) < 0:
        faces = faces[:, ::-1]
    return TriangleMesh(np.asarray(vertices), np.asarray(faces, dtype=np.int64))


def _signed(surface: TriangleMesh, nodes: Nodes, cell: float) -> Grid:
    """Return signed distance at the nodes near the surface, and a signed `BAND_CELLS` of cells elsewhere.

    The surface has no border within the grid, so it parts it into regions. A region away from it takes the side of most
    of its nodes next to the surface, by the nearest face's normal.
    """
    from scipy.ndimage import label

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
    """Return the nodes within some two cells of the surface, whose faces are smaller than a cell or two."""
    from scipy.ndimage import binary_dilation

    points = np.concatenate([surface.vertices, surface.vertices[surface.faces].mean(1)])
    index = np.round((points - nodes[0, 0, 0]) / cell).astype(int)
    index = index[((index >= 0) & (index < nodes.shape[:3])).all(1)]
    touched = np.zeros(nodes.shape[:3], dtype=bool)
    touched[tuple(index.T)] = True
    return np.asarray(binary_dilation(touched, np.ones((3, 3, 3)), iterations=BAND_CELLS), dtype=bool)


def _outside_hull(points: Points, nodes: Float[np.ndarray, "m 3"], cell: float) -> Float[np.ndarray, "m"]:
    """Return how far nodes lie outside the convex hull of points [m], in which any surface through them may close."""
    hull = convex_hull(np.unique(np.round(points / (3 * cell)), axis=0) * 3 * cell)
    if hull is None:
        return np.zeros(len(nodes))
    # In parts that stay in the cache: all nodes by all facets would take half a gigabyte, and eight times as long.
    parts = np.array_split(np.vstack([nodes.T, np.ones(len(nodes))]), 1 + len(nodes) // _NODES_AT_ONCE, axis=1)
    return np.maximum(np.concatenate([(hull.equations @ part).max(0) for part in parts]), 0.0)


def _one_solid(value: Grid, cell: float) -> Grid:
    """Keep the largest part alone, without bubbles, free of the grid's border."""
    from scipy.ndimage import label

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
    """Return the signed distance near the points' surface [m] at the nodes of a grid of cubes, limited to a band.

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
    near = float((np.abs(there) < 1.0).mean())
    if near < _MIN_NEAR:
        raise CloudError(f"cloud: no surface fits its {len(there)} points ({near:.0%} do)")
    for _ in range(_STEPS):
        push, pushed = at_points(spread(-weights * there) * blur / (square + _REACH**-2))
        # As far along it as leaves least at the points.
        share = -(weights * there * pushed).sum() / max((weights * pushed**2).sum(), 1e-300)
        field, there = field + share * push, there + share * pushed
    inner = tuple(slice(low, low + count) for low, count in zip(before, counts, strict=True))
    return cell * np.clip(field.reshape(shape)[inner], -BAND_CELLS, BAND_CELLS)


def _trilinear(place: Float[np.ndarray, "points 3"], shape: tuple[int, ...]) -> Any:
    """Return the matrix, points by nodes, that reads a field at places given in cells."""
    from scipy.sparse import csr_array

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


def _slope(field: Grid, at: Any, normals: Float[np.ndarray, "points 3"]) -> float:
    gradient = np.stack([at @ part.ravel() for part in np.gradient(field)], -1)
    return float(np.median((gradient * normals).sum(1)))
