"""Points on the sharp convex parts of a surface: edges, corners, rims, thin walls.

A hand sampled every few millimetres misses an edge that sinks in between its samples. These points do not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.surface_queries import DistanceQuery, make_distance_query, signed_distance
from graspd_core.mesh.topology import packed_rows, scaled_normals
from graspd_core.types import TriangleMesh

Points = Float[np.ndarray, "n 3"]

# How deep below the surface the probe looks [m], and how much nearer than that the surface must be to count as sharp.
_PROBE, _SHARP = 0.003, 0.15
_POOL = 6000
# Cosine of half the angle at which an edge is no longer flat.
_FLAT_EDGE = float(np.cos(np.deg2rad(10.0)))
# Share of thin surface from which an object counts as thin-walled.
THIN_WALLED = 0.6
# A finger goes through a wall between points that are far apart: a thin-walled object has at least one point on so much
# of its surface [m²], up to so many times the points asked for.
_AREA_OF_POINT, _MOST = 5e-5, 16


def sharp_points(mesh: TriangleMesh, count: int, seed: int = 0, *, pool: int = _POOL) -> tuple[Points, float]:
    """Return evenly spread surface points [m] with less than a probe's depth of material below them.

    A point a depth d below a flat surface is d away from it. Below an edge or in a thin wall it is nearer. There are at
    most `count` points, more for thin walls, fewer on a smooth object, possibly none. Each is the farthest from all
    before, so that the first of them are evenly spread too.

    Args:
        pool: number of candidate places: of vertices, of edges, and half as many of faces.

    Returns:
        The points, and the share of the surface with less than two probe depths of material below it: near one for
        cups and sheets.
    """
    query = make_distance_query(mesh)
    points, normals = _pool(mesh, seed, pool)
    sharp = points[_is_thin(query, points, normals, _PROBE)]
    samples, sample_normals = surface_samples(mesh, pool // 6, seed)
    share = float(_is_thin(query, samples, sample_normals, 2 * _PROBE).mean())
    if share > THIN_WALLED:
        walls = share * 0.5 * float(np.linalg.norm(scaled_normals(mesh.vertices, mesh.faces), axis=1).sum())
        count = min(max(count, round(walls / _AREA_OF_POINT)), _MOST * count)
    return sharp[farthest_points(sharp, count)], share


def _is_thin(query: DistanceQuery, points: Points, normals: Points, probe: float) -> Bool[np.ndarray, "n"]:
    return -signed_distance(query, points - probe * normals) < (1 - _SHARP) * probe


def crease_points(mesh: TriangleMesh, count: int, seed: int) -> Float[np.ndarray, "points 3"]:
    """Return `count` points evenly along the edges where faces meet at over 20°, or end [m].

    None without such edges.
    """
    scaled, faces = scaled_normals(mesh.vertices, mesh.faces), mesh.faces
    normals = scaled / np.maximum(np.linalg.norm(scaled, axis=1, keepdims=True), 1e-300)
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]))
    _, first, of, faces_at = np.unique(packed_rows(sides), return_index=True, return_inverse=True, return_counts=True)
    turned = np.zeros((len(first), 3))
    np.add.at(turned, of, np.tile(normals, (3, 1)))
    # Two normals that enclose an angle add up to twice the cosine of its half.
    sharp = (faces_at != 2) | (np.linalg.norm(turned, axis=1) < 2 * _FLAT_EDGE)
    start, end = mesh.vertices[sides[first[sharp]].T]
    lengths = np.linalg.norm(end - start, axis=1)
    if not lengths.sum() > 0:
        return np.zeros((0, 3))
    rng = np.random.default_rng(seed)
    places = (np.arange(count) + rng.random(count)) / count * lengths.sum()
    on = np.minimum(np.searchsorted(np.cumsum(lengths), places), len(lengths) - 1)
    a = rng.random((count, 1))
    return (1 - a) * start[on] + a * end[on]


def farthest_points(points: Points, count: int) -> np.ndarray:
    """Return the indices of at most `count` points by farthest-point sampling, starting from the first."""
    if len(points) == 0:
        return np.zeros(0, dtype=int)
    columns = np.ascontiguousarray(points.T)

    def squared(chosen: int) -> np.ndarray:
        x, y, z = (column - column[chosen] for column in columns)
        return x * x + y * y + z * z

    return farthest_first(len(points), count, [0], squared)


def farthest_first(
    size: int,
    count: int,
    chosen: Sequence[int],
    distances: Callable[[int], np.ndarray],
    mates: Callable[[int], np.ndarray | slice] = lambda _: slice(None),
) -> Int[np.ndarray, "count"]:
    """Choose points, each the farthest from all that were chosen before (Gonzalez 1985).

    Args:
        size: how many points there are.
        count: how many are chosen at most, but all of `chosen`.
        chosen: indices of the first ones.
        distances: of a chosen point to its mates, in any unit that grows with the distance.
        mates: the points that a chosen point counts for. All others are infinitely far from it.
    """
    picked, gap = [int(index) for index in chosen], np.full(size, np.inf)
    for number in range(max(min(count, size), len(picked))):
        if number == len(picked):
            picked.append(int(gap.argmax()))
        rows = mates(picked[number])
        gap[rows] = np.minimum(gap[rows], distances(picked[number]))
    return np.array(picked, dtype=np.int64)


def neighbours_together(points: Points) -> Int[np.ndarray, "n"]:
    """Return an order in which successive points lie near each other, by halving along the widest side.

    Every sixteen from the first lie together, and so do any eight or four of them.
    """
    if len(points) <= 4:
        return np.arange(len(points))
    along = points[:, np.ptp(points, axis=0).argmax()].argsort(kind="stable")
    step = 16 if len(points) > 16 else 4 if len(points) <= 8 else 8
    half = step * -(-len(points) // (2 * step))
    first, rest = along[:half], along[half:]
    return np.concatenate([first[neighbours_together(points[first])], rest[neighbours_together(points[rest])]])


def _pool(mesh: TriangleMesh, seed: int, size: int) -> tuple[Points, Points]:
    """Return vertices, points along edges, and surface samples, with normals, at most `size` of each."""
    scaled = scaled_normals(mesh.vertices, mesh.faces)
    vertex_normals = np.zeros_like(mesh.vertices)
    for corner in range(3):
        np.add.at(vertex_normals, mesh.faces[:, corner], scaled)
    vertex_normals /= np.maximum(np.linalg.norm(vertex_normals, axis=-1, keepdims=True), 1e-20)
    rng = np.random.default_rng(seed)
    pairs = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]))
    edges = pairs[np.unique(packed_rows(pairs), return_index=True)[1]]
    lengths = np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=-1)
    along = rng.choice(len(edges), size=size, p=lengths / lengths.sum())
    a = rng.random((size, 1))
    start, end = edges[along].T
    # An edge point's normal is that of its two ends blended: on a sharp edge the bisector, on a flat one the face's.
    on_edges = (1 - a) * mesh.vertices[start] + a * mesh.vertices[end]
    edge_normals = (1 - a) * vertex_normals[start] + a * vertex_normals[end]
    edge_normals /= np.maximum(np.linalg.norm(edge_normals, axis=-1, keepdims=True), 1e-20)
    vertices = rng.permutation(len(mesh.vertices))[:size]
    samples, sample_normals = surface_samples(mesh, size // 2, seed)
    return (
        np.concatenate([mesh.vertices[vertices], on_edges, samples]),
        np.concatenate([vertex_normals[vertices], edge_normals, sample_normals]),
    )
