"""Exact distance and inside queries on a triangle mesh by libigl, in float64, without a grid or gradient.

Signed distances are negative inside. The generalised winding number (Barill et al. 2018) defines the inside, also of
open, overlapping, doubled and inverted surfaces. Only ray casting uses Open3D (Embree), whose import takes half a
second. Planning on a mesh casts no rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Integer

from graspd_core.errors import Extra
from graspd_core.mesh.topology import cut_long_faces, scaled_normals
from graspd_core.types import TriangleMesh


@dataclass(frozen=True, eq=False)
class DistanceQuery:
    """A mesh prepared for distance queries, safe to use from several threads."""

    surface: Surface
    tree: WindingTree


def make_distance_query(mesh: TriangleMesh) -> DistanceQuery:
    """Prepare a mesh for distance queries. This takes about 30 ms for 16,000 faces."""
    return DistanceQuery(make_surface(mesh), make_winding_tree(mesh))


def signed_distance(
    query: DistanceQuery, points: Float[np.ndarray, "n 3"], *, reach: float = np.inf
) -> Float[np.ndarray, "n"]:
    """Return the distance [m] to the nearest triangle, negative inside by the winding number.

    For points farther than `reach` [m] from the bounding box, return the distance to the box, which is a lower bound.
    """
    tree = query.tree
    distance = np.linalg.norm(np.maximum(0.0, np.maximum(tree.low - points, points - tree.high)), axis=1)
    near = distance <= reach
    distance[near] = surface_distance(query.surface, points[near])
    return np.where(is_inside(tree, points), -distance, distance)


# Points per call. libigl holds Python's global lock during a call, so other threads wait up to 2 ms.
_POINTS_AT_ONCE = 256
# Accuracy scales of the tree. The coarse scale takes a quarter of the time, and its winding numbers err by up to 0.3.
_COARSE, _FINE = 1.0, 2.0
# Coarse numbers this near to one half are computed again at the fine scale. Far from holes, the true winding number is
# an integer, so a wrong answer would need an error of 0.8.
_DOUBT = 0.3


@dataclass(frozen=True, eq=False)
class WindingTree:
    """A mesh prepared for winding number queries.

    Attributes:
        low, high: corners of the bounding box [m].
        centre: origin of the tree's coordinates, in the mesh's frame [m].
        tree: the `igl.FastWindingNumberBVH`.
    """

    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]
    centre: Float[np.ndarray, "3"]
    tree: Any


def make_winding_tree(mesh: TriangleMesh) -> WindingTree:
    """Prepare a mesh for winding number queries. This takes about 20 ms for 16,000 faces."""
    import igl

    low, high, centre = mesh.vertices.min(0), mesh.vertices.max(0), mesh.vertices.mean(0)
    # The mesh is centred, because the tree's expansion loses digits far from the origin. Long faces are cut, because
    # the tree sums such faces one by one at short distances. Slivers would take ten times as long.
    cut = cut_long_faces(TriangleMesh(mesh.vertices - centre, mesh.faces), float((high - low).max()) / 10)
    tree = igl.FastWindingNumberBVH()
    tree.init(np.asarray(cut.vertices, dtype=float), np.asarray(cut.faces, dtype=np.int64))
    return WindingTree(low, high, centre, tree)


def is_inside(tree: WindingTree, points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, "points"]:
    """Return which points lie inside: in the bounding box, with an absolute winding number above one half."""
    inside = np.all((points >= tree.low) & (points <= tree.high), axis=1)
    queries = points[inside] - tree.centre
    number = _numbers(tree, queries, _COARSE)
    doubtful = np.abs(number - 0.5) < _DOUBT
    number[doubtful] = _numbers(tree, queries[doubtful], _FINE)
    inside[inside] = number > 0.5
    return inside


def winding_inside(mesh: TriangleMesh, points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, "points"]:
    """Return which points lie inside a mesh. For several sets of points, make the tree once and use `is_inside`."""
    return is_inside(make_winding_tree(mesh), points)


def _numbers(tree: WindingTree, points: Float[np.ndarray, "n 3"], accuracy: float) -> Float[np.ndarray, "n"]:
    chunks = [points[i : i + _POINTS_AT_ONCE] for i in range(0, len(points), _POINTS_AT_ONCE)]
    numbers = [np.abs(tree.tree.winding_number(np.ascontiguousarray(chunk), accuracy)) for chunk in chunks]
    return np.concatenate(numbers) if numbers else np.zeros(0)


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh prepared for closest point queries.

    Attributes:
        mesh: the mesh with contiguous arrays of float64 [m] and int64, as libigl needs them.
        normals: unit normals of the faces, zero for a face without area.
        hierarchy: the `igl.AABB` tree.
    """

    mesh: TriangleMesh
    normals: Float[np.ndarray, "faces 3"]
    hierarchy: Any


def make_surface(mesh: TriangleMesh) -> Surface:
    """Prepare a mesh for closest point queries. This takes about 10 ms for 16,000 faces."""
    import igl

    vertices = np.ascontiguousarray(mesh.vertices, dtype=float)
    faces = np.ascontiguousarray(mesh.faces, dtype=np.int64)
    cross = scaled_normals(vertices, faces)
    normals = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300)
    hierarchy = igl.AABB()
    hierarchy.init(vertices, faces)
    return Surface(TriangleMesh(vertices, faces), normals, hierarchy)


def surface_distance(surface: Surface, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Return the unsigned distance to the nearest triangle [m], infinite for a point that is not finite."""
    return np.sqrt(_nearest(surface, points)[0])


def closest_points(
    surface: Surface, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return the closest surface points [m] and the unit normals of their faces, NaN for points that are not finite."""
    squared, faces, closest = _nearest(surface, points)
    # libigl leaves the face and the point unset where no distance is finite.
    found = np.isfinite(squared)
    normals = surface.normals[np.where(found, faces, 0)]
    return np.where(found[:, None], closest, np.nan), np.where(found[:, None], normals, np.nan)


# Faces within this distance of a point [m] contribute to its normal: two at an edge, or many at a rounded edge.
_ABOUT = 3e-4
# Maximum number of rounds that adjust the weights of these faces. They end if no weight changes by more than this.
_SWEEPS, _SETTLED = 100, 1e-7
# Directions in which these faces are searched: towards the corners and face centres of a cube.
_AROUND = np.array([way for way in product((-1, 0, 1), repeat=3) if np.abs(way).sum() in (1, 3)])
_AROUND = _AROUND / np.linalg.norm(_AROUND, axis=1, keepdims=True)


def pressed_points(
    surface: Surface, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return the closest surface points [m], and at each point the outward unit normal nearest to that in `normals`.

    On a face, this is the face's normal. On an edge or a corner, it lies between the normals of the faces.
    """
    closest, own = closest_points(surface, points)
    around = closest_points(surface, (closest[:, None] + _ABOUT * _AROUND).reshape(-1, 3))[1]
    between = np.concatenate([own[:, None], around.reshape(len(points), -1, 3)], 1)
    # Fit `normals` by a weighted sum of face normals. No weight is negative, and one weight is fitted after the other.
    weights, rest = np.zeros(between.shape[:2]), np.array(normals)
    for _ in range(_SWEEPS):
        before = weights.copy()
        for face in range(between.shape[1]):
            change = np.maximum((rest * between[:, face]).sum(1), -weights[:, face])
            weights[:, face] += change
            rest -= change[:, None] * between[:, face]
        if np.abs(weights - before).max(initial=0.0) < _SETTLED:
            break
    nearest, length = normals - rest, np.linalg.norm(normals - rest, axis=1, keepdims=True)
    return closest, np.where(length > _SETTLED, nearest / np.maximum(length, _SETTLED), own)


def first_hits(
    mesh: TriangleMesh, directions: Float[np.ndarray, "*batch 3"]
) -> tuple[Float[np.ndarray, "*batch"], Integer[np.ndarray, "*batch"], Float[np.ndarray, "*batch 3"]]:
    """Cast rays from the origin. Return distances in lengths of `directions` (inf: no hit), hit faces and normals."""
    with Extra("clouds"):
        import open3d as o3d

    # Embree uses float32. Centring the mesh keeps the precision of a mesh far from the origin.
    centre = 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
    scene: Any = o3d.t.geometry.RaycastingScene()
    scene.add_triangles((mesh.vertices - centre).astype(np.float32), mesh.faces.astype(np.uint32))
    origins = np.broadcast_to(-centre, directions.shape)
    hits = scene.cast_rays(np.concatenate([origins, directions], -1).astype(np.float32))
    normals = hits["primitive_normals"].numpy().astype(float)
    return hits["t_hit"].numpy().astype(float), hits["primitive_ids"].numpy(), normals


def _nearest(
    surface: Surface, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n"], Integer[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Return the squared distance [m²], face and position [m] of the surface point nearest to each point."""
    vertices, faces = surface.mesh.vertices, surface.mesh.faces
    points = np.ascontiguousarray(points, dtype=float)
    # At least one call is made, so that the arrays have their shapes even without points.
    starts = range(0, max(len(points), 1), _POINTS_AT_ONCE)
    parts = [surface.hierarchy.squared_distance(vertices, faces, points[i : i + _POINTS_AT_ONCE]) for i in starts]
    squared, face, closest = (np.concatenate(part) for part in zip(*parts, strict=True))
    # libigl returns long long, which NumPy treats as another type than int64.
    return squared, face.astype(np.int64), closest
