"""Exact queries to a triangle mesh by libigl's bounding volume hierarchy, in float64. No grid, no gradient.

Signed distances, which metrics use, are negative inside by the generalised winding number (Barill et al. 2018). Open,
overlapping, doubled and inverted surfaces have an inside too. Only rays use Open3D (Embree), which takes half a second
to import. No plan on a mesh needs them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Integer

from graspd_core.errors import Extra
from graspd_core.mesh.topology import cut_long_faces, scaled_normals
from graspd_core.types import TriangleMesh


@dataclass(frozen=True, eq=False)
class DistanceQuery:
    """A mesh prepared for queries of distance, safe to use from several threads."""

    surface: Surface
    tree: WindingTree


def make_distance_query(mesh: TriangleMesh) -> DistanceQuery:
    """Prepare a mesh: some 30 ms for 16,000 faces."""
    return DistanceQuery(make_surface(mesh), make_winding_tree(mesh))


def signed_distance(
    query: DistanceQuery, points: Float[np.ndarray, "n 3"], *, reach: float = np.inf
) -> Float[np.ndarray, "n"]:
    """Return the distance [m] to the nearest triangle, negative inside by the winding number.

    Points farther than `reach` [m] from the bounding box get their distance to the box, a lower bound above `reach`.
    """
    tree = query.tree
    distance = np.linalg.norm(np.maximum(0.0, np.maximum(tree.low - points, points - tree.high)), axis=1)
    near = distance <= reach
    distance[near] = surface_distance(query.surface, points[near])
    return np.where(inside(query, points), -distance, distance)


def inside(query: DistanceQuery, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Return which points are inside by the winding number, without a distance."""
    return is_inside(query.tree, points)


def unsigned_distance(query: DistanceQuery, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Return the distance [m] to the nearest triangle on either side, without a winding number."""
    return surface_distance(query.surface, points)


# Points per call: libigl holds Python's lock during one, so this bounds how long other threads wait (about 2 ms).
_POINTS_AT_ONCE = 256
# Accuracy scales of the tree: at the coarse one numbers are off by up to 0.3 at a quarter of the fine one's cost.
_COARSE, _FINE = 1.0, 2.0
# A coarse number this near to one half is asked for again. Far from holes the true number is whole, so that a wrong
# answer would take an error of 0.8.
_DOUBT = 0.3


@dataclass(frozen=True, eq=False)
class WindingTree:
    """A mesh prepared for many questions.

    Attributes:
        low, high: corners of the bounding box [m].
        centre: what the tree's coordinates are about [m].
        tree: the `igl.FastWindingNumberBVH`.
    """

    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]
    centre: Float[np.ndarray, "3"]
    tree: Any


def make_winding_tree(mesh: TriangleMesh) -> WindingTree:
    """Prepare a mesh: some 20 ms for 16,000 faces."""
    import igl

    low, high, centre = mesh.vertices.min(0), mesh.vertices.max(0), mesh.vertices.mean(0)
    # Centred, because the tree's expansion loses digits far from the origin. Cut up, because the tree sums every face
    # that is long for its distance, which makes slivers ten times slower.
    cut = cut_long_faces(TriangleMesh(mesh.vertices - centre, mesh.faces), float((high - low).max()) / 10)
    tree = igl.FastWindingNumberBVH()
    tree.init(np.asarray(cut.vertices, dtype=float), np.asarray(cut.faces, dtype=np.int64))
    return WindingTree(low, high, centre, tree)


def is_inside(tree: WindingTree, points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, "points"]:
    """Return which points lie inside: a winding number beyond one half, of either sign, within the bounding box."""
    inside = np.all((points >= tree.low) & (points <= tree.high), axis=1)
    asked = points[inside] - tree.centre
    number = _numbers(tree, asked, _COARSE)
    doubtful = np.abs(number - 0.5) < _DOUBT
    number[doubtful] = _numbers(tree, asked[doubtful], _FINE)
    inside[inside] = number > 0.5
    return inside


def winding_inside(mesh: TriangleMesh, points: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, "points"]:
    """Return `is_inside` for one set of points. For several, keep the mesh's tree."""
    return is_inside(make_winding_tree(mesh), points)


def _numbers(tree: WindingTree, points: Float[np.ndarray, "n 3"], accuracy: float) -> Float[np.ndarray, "n"]:
    chunks = [points[i : i + _POINTS_AT_ONCE] for i in range(0, len(points), _POINTS_AT_ONCE)]
    numbers = [np.abs(tree.tree.winding_number(np.ascontiguousarray(chunk), accuracy)) for chunk in chunks]
    return np.concatenate(numbers) if numbers else np.zeros(0)


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh prepared for many queries.

    Attributes:
        mesh: its arrays as libigl takes them: contiguous, float64 [m] and int64.
        normals: of the faces, unit, zero for a face without area.
        hierarchy: the `igl.AABB`.
    """

    mesh: TriangleMesh
    normals: Float[np.ndarray, "faces 3"]
    hierarchy: Any


def make_surface(mesh: TriangleMesh) -> Surface:
    """Prepare a mesh: some 10 ms for 16,000 faces."""
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


# How far about a point the faces lie that its normal may be of [m]: the two of an edge, the many of a rounding.
_ABOUT = 3e-4
# Rounds of weighing these faces at most, and a change of a weight that ends them.
_SWEEPS, _SETTLED = 100, 1e-7
# Directions in which they are looked for: to the corners and the middles of the faces of a cube.
_AROUND = np.array(
    [[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if abs(x) + abs(y) + abs(z) != 2]
)
_AROUND = _AROUND[np.abs(_AROUND).any(1)] / np.linalg.norm(_AROUND[np.abs(_AROUND).any(1)], axis=1, keepdims=True)


def pressed_points(
    surface: Surface, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return the closest surface points [m], and the outward unit normals there that are nearest to `normals`.

    On a face this is the face's own normal. On an edge or a corner every direction between those of its faces counts.
    """
    closest, own = closest_points(surface, points)
    around = closest_points(surface, (closest[:, None] + _ABOUT * _AROUND).reshape(-1, 3))[1]
    between = np.concatenate([own[:, None], around.reshape(len(points), -1, 3)], 1)
    # The nearest sum of the faces' normals with weights of at least zero, one weight after the other.
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
    """Cast rays from the origin. Return the lengths in `directions` (infinite: no hit), faces and unit normals."""
    with Extra("clouds"):
        import open3d as o3d

    # Embree counts in float32: about the mesh's centre it need not be near the origin.
    centre = 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(_tensor(mesh.vertices - centre, np.float32), _tensor(mesh.faces, np.uint32))
    origins = np.broadcast_to(-centre, directions.shape)
    hits = scene.cast_rays(_tensor(np.concatenate([origins, directions], -1), np.float32))
    normals = hits["primitive_normals"].numpy().astype(float)
    return hits["t_hit"].numpy().astype(float), hits["primitive_ids"].numpy(), normals


def _nearest(
    surface: Surface, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n"], Integer[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Return squared distance [m²], face and point of the surface nearest to each point."""
    vertices, faces = surface.mesh.vertices, surface.mesh.faces
    points = np.ascontiguousarray(points, dtype=float)
    # One call at least: without points, too, the arrays have their shapes.
    starts = range(0, max(len(points), 1), _POINTS_AT_ONCE)
    parts = [surface.hierarchy.squared_distance(vertices, faces, points[i : i + _POINTS_AT_ONCE]) for i in starts]
    squared, face, closest = (np.concatenate(part) for part in zip(*parts, strict=True))
    # The wheel says long long, which NumPy holds to be another type.
    return squared, face.astype(np.int64), closest


def _tensor(array: np.ndarray, dtype: type):
    import open3d as o3d

    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array, dtype=dtype))
