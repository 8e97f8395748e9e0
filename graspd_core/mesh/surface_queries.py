"""Exact queries to a triangle mesh by libigl's bounding volume hierarchy, in float64. No gradient.

Rays alone go by Open3D (Embree), which takes half a second to import: no plan on a mesh needs it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Integer

from graspd_core.types import TriangleMesh

# Questions per call: libigl holds Python's lock during one, so this bounds how long other threads wait (about 1 ms).
_CHUNK = 256


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh prepared for many queries.

    Attributes:
        mesh: its arrays as libigl takes them: contiguous, float64 [m] and int64.
        normals: of the faces, unit; zero where a face has no area.
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
    a, b, c = vertices[faces].transpose(1, 0, 2)
    cross = np.cross(b - a, c - a)
    normals = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300)
    hierarchy = igl.AABB()
    hierarchy.init(vertices, faces)
    return Surface(TriangleMesh(vertices, faces), normals, hierarchy)


def surface_distance(surface: Surface, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Unsigned distance to the nearest triangle [m]; infinite for a point that is not finite."""
    return np.sqrt(_nearest(surface, points)[0])


def closest_points(
    surface: Surface, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """The closest surface points [m] and the unit normals of their faces; NaN of points that are not finite."""
    squared, faces, closest = _nearest(surface, points)
    # libigl leaves the face and the point unset where no distance is finite.
    found = np.isfinite(squared)
    normals = surface.normals[np.where(found, faces, 0)]
    return np.where(found[:, None], closest, np.nan), np.where(found[:, None], normals, np.nan)


def first_hits(
    mesh: TriangleMesh, directions: Float[np.ndarray, "*batch 3"]
) -> tuple[Float[np.ndarray, "*batch"], Integer[np.ndarray, "*batch"], Float[np.ndarray, "*batch 3"]]:
    """Of rays from the origin: how many `directions` long until they hit (infinite: never), face index, unit normal."""
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
    """Squared distance [m²], face and point of the surface nearest to each point."""
    vertices, faces = surface.mesh.vertices, surface.mesh.faces
    points = np.ascontiguousarray(points, dtype=float)
    # One call at least: without points, too, the arrays have their shapes.
    starts = range(0, max(len(points), 1), _CHUNK)
    parts = [surface.hierarchy.squared_distance(vertices, faces, points[i : i + _CHUNK]) for i in starts]
    squared, face, closest = (np.concatenate(part) for part in zip(*parts, strict=True))
    # The wheel says long long, which NumPy holds to be another type.
    return squared, face.astype(np.int64), closest


def _tensor(array: np.ndarray, dtype: type):
    import open3d as o3d

    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array, dtype=dtype))
