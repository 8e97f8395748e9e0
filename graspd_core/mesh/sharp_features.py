"""Sample points on the sharp convex parts of a surface: edges, corners, rims, thin walls.

An object's edge can enter the hand between the hand's points. Points on the edge detect such an overlap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.surface_queries import DistanceQuery, make_distance_query, signed_distance
from graspd_core.mesh.topology import edge_counts, face_edges, packed_rows, scaled_normals
from graspd_core.types import TriangleMesh

Points = Float[np.ndarray, "n 3"]

# Depth of the probe below a point [m]. The point is sharp if the surface is nearer to the probe by this fraction.
_PROBE, _SHARP = 0.003, 0.15
_POOL = 6000  # candidates at vertices, and as many on edges
# An edge is flat if its face normals differ by less than 20°. This is the cosine of half that angle.
_FLAT_EDGE = float(np.cos(np.deg2rad(10.0)))
# Fraction of thin surface from which an object counts as thin-walled.
THIN_WALLED = 0.6
# A finger can pass through a thin wall between sparse points. So a thin-walled object gets one point for each area of
# this size [m²], but at most this many times the requested number of points.
_AREA_OF_POINT, _MOST = 5e-5, 16


def sharp_points(mesh: TriangleMesh, count: int, *, pool: int = _POOL) -> tuple[Points, float]:
    """Return evenly spread points [m] on edges, corners and thin walls, where little material lies below the surface.

    A probe point is placed 3 mm below each candidate. Under a flat surface, the probe is 3 mm from the surface. Under
    an edge or in a thin wall, the probe is nearer. Thin-walled objects get more than `count` points, smooth objects
    fewer or none. The points are in farthest-point order, so the first k points are evenly spread for every k.

    Args:
        pool: number of candidates at vertices. As many lie on edges, and half as many on faces.

    Returns:
        The points, and the fraction of the surface with less than 6 mm of material below it. The fraction is near one
        for cups and sheets.
    """
    query = make_distance_query(mesh)
    points, normals = _pool(mesh, pool)
    sharp = points[_is_thin(query, points, normals, _PROBE)]
    samples, sample_normals = surface_samples(mesh, pool // 6, 0)
    share = float(_is_thin(query, samples, sample_normals, 2 * _PROBE).mean())
    if share > THIN_WALLED:
        walls = share * 0.5 * float(np.linalg.norm(scaled_normals(mesh.vertices, mesh.faces), axis=1).sum())
        count = min(max(count, round(walls / _AREA_OF_POINT)), _MOST * count)
    return sharp[farthest_points(sharp, count)], share


def _is_thin(query: DistanceQuery, points: Points, normals: Points, probe: float) -> Bool[np.ndarray, "n"]:
    return -signed_distance(query, points - probe * normals) < (1 - _SHARP) * probe


def crease_points(mesh: TriangleMesh, count: int, seed: int) -> Float[np.ndarray, "points 3"]:
    """Return `count` points [m], spread evenly along open edges and along edges where face normals differ by over 20°.

    If there are no such edges, return no points.
    """
    scaled, faces = scaled_normals(mesh.vertices, mesh.faces), mesh.faces
    normals = scaled / np.maximum(np.linalg.norm(scaled, axis=1, keepdims=True), 1e-300)
    sides = np.sort(face_edges(faces))
    _, first, of, faces_at = np.unique(packed_rows(sides), return_index=True, return_inverse=True, return_counts=True)
    turned = np.zeros((len(first), 3))
    np.add.at(turned, of, np.tile(normals, (3, 1)))
    # Two unit normals at an angle a add up to a vector of length 2 cos(a/2).
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
    """Return the indices of at most `count` points by farthest-point sampling, which starts at the first point."""
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
    """Return indices of points. Each is the farthest from all points chosen before (Gonzalez 1985).

    Args:
        size: number of points.
        count: maximum number of indices to return. All of `chosen` are returned even if they are more.
        chosen: indices of the first points.
        distances: function that returns distances from a chosen point to its `mates`. Squared distances will do too.
        mates: function that returns the points near a chosen point. Other points count as infinitely far from it.
    """
    picked, gap = [int(index) for index in chosen], np.full(size, np.inf)
    for number in range(max(min(count, size), len(picked))):
        if number == len(picked):
            picked.append(int(gap.argmax()))
        rows = mates(picked[number])
        gap[rows] = np.minimum(gap[rows], distances(picked[number]))
    return np.array(picked, dtype=np.int64)


def neighbours_together(points: Points) -> Int[np.ndarray, "n"]:
    """Return an order of the points in which neighbours are close, by recursive halving along the widest side.

    From the first point on, each block of sixteen points is compact, and so is each block of eight or four.
    """
    if len(points) <= 4:
        return np.arange(len(points))
    along = points[:, np.ptp(points, axis=0).argmax()].argsort(kind="stable")
    step = 16 if len(points) > 16 else 4 if len(points) <= 8 else 8
    half = step * -(-len(points) // (2 * step))
    first, rest = along[:half], along[half:]
    return np.concatenate([first[neighbours_together(points[first])], rest[neighbours_together(points[rest])]])


def _pool(mesh: TriangleMesh, size: int) -> tuple[Points, Points]:
    """Return positions and unit normals of up to `size` vertices, `size` edge points and `size // 2` face points."""
    scaled = scaled_normals(mesh.vertices, mesh.faces)
    vertex_normals = np.zeros_like(mesh.vertices)
    for corner in range(3):
        np.add.at(vertex_normals, mesh.faces[:, corner], scaled)
    vertex_normals /= np.maximum(np.linalg.norm(vertex_normals, axis=-1, keepdims=True), 1e-20)
    rng = np.random.default_rng(0)
    edges, _ = edge_counts(mesh.faces)
    lengths = np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=-1)
    along = rng.choice(len(edges), size=size, p=lengths / lengths.sum())
    a = rng.random((size, 1))
    start, end = edges[along].T
    # An edge point's normal blends the normals of both ends: the bisector on a sharp edge, the face's on a flat edge.
    on_edges = (1 - a) * mesh.vertices[start] + a * mesh.vertices[end]
    edge_normals = (1 - a) * vertex_normals[start] + a * vertex_normals[end]
    edge_normals /= np.maximum(np.linalg.norm(edge_normals, axis=-1, keepdims=True), 1e-20)
    vertices = rng.permutation(len(mesh.vertices))[:size]
    samples, sample_normals = surface_samples(mesh, size // 2, 0)
    return (
        np.concatenate([mesh.vertices[vertices], on_edges, samples]),
        np.concatenate([vertex_normals[vertices], edge_normals, sample_normals]),
    )
