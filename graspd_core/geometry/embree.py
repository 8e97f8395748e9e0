"""Exact queries to a triangle mesh by Open3D's bounding volume hierarchy (Embree). No gradient.

Embree counts in float32: coordinates are taken about the mesh's centre, so that they need not be near the origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Integer

from graspd_core.types import TriangleMesh


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh prepared for many queries.

    Attributes:
        centre: what the hierarchy's coordinates are about [m].
        hierarchy: the `open3d.t.geometry.RaycastingScene`.
    """

    centre: Float[np.ndarray, "3"]
    hierarchy: Any


def make_surface(mesh: TriangleMesh) -> Surface:
    """Prepare a mesh: a few milliseconds."""
    import open3d as o3d

    centre = 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
    hierarchy = o3d.t.geometry.RaycastingScene()
    hierarchy.add_triangles(_tensor(mesh.vertices - centre, np.float32), _tensor(mesh.faces, np.uint32))
    return Surface(centre, hierarchy)


def surface_distance(surface: Surface, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Unsigned distance to the nearest triangle [m]."""
    return surface.hierarchy.compute_distance(_tensor(points - surface.centre, np.float32)).numpy().astype(float)


def closest_points(
    surface: Surface, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """The closest surface points [m], and the unit normals of the faces they lie on."""
    answer = surface.hierarchy.compute_closest_points(_tensor(points - surface.centre, np.float32))
    closest = answer["points"].numpy().astype(float) + surface.centre
    return closest, answer["primitive_normals"].numpy().astype(float)


def first_hits(
    mesh: TriangleMesh, directions: Float[np.ndarray, "*batch 3"]
) -> tuple[Float[np.ndarray, "*batch"], Integer[np.ndarray, "*batch"], Float[np.ndarray, "*batch 3"]]:
    """Of rays from the origin: how many `directions` long until they hit (infinite: never), face index, unit normal."""
    surface = make_surface(mesh)
    origins = np.broadcast_to(-surface.centre, directions.shape)
    hits = surface.hierarchy.cast_rays(_tensor(np.concatenate([origins, directions], -1), np.float32))
    normals = hits["primitive_normals"].numpy().astype(float)
    return hits["t_hit"].numpy().astype(float), hits["primitive_ids"].numpy(), normals


def _tensor(array: np.ndarray, dtype: type):
    import open3d as o3d

    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array, dtype=dtype))
