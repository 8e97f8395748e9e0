"""Exact queries to a triangle mesh by Open3D's bounding volume hierarchy (Embree). No gradient.

Embree counts in float32: coordinates are taken about the mesh's centre, so that they need not be near the origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Integer

from graspd_core.types import TriangleMesh

# Questions per call: Open3D holds Python's lock during one, so this bounds how long other threads wait (some 2 ms).
_CHUNK = 256


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh prepared for many queries.

    Attributes:
        centre: what the hierarchy's coordinates are about [m].
        hierarchy: the `open3d.t.geometry.RaycastingScene`.
    """

    centre: Float[np.ndarray, "3"]
    hierarchy: Any


def load_library() -> None:
    """Import Open3D, which takes seconds the first time: where the time is nobody's, not within a deadline."""
    import open3d  # noqa: F401


def make_surface(mesh: TriangleMesh) -> Surface:
    """Prepare a mesh: a few milliseconds."""
    import open3d as o3d

    centre = 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
    hierarchy = o3d.t.geometry.RaycastingScene()
    hierarchy.add_triangles(_tensor(mesh.vertices - centre, np.float32), _tensor(mesh.faces, np.uint32))
    return Surface(centre, hierarchy)


def surface_distance(surface: Surface, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Unsigned distance to the nearest triangle [m]."""
    parts = [surface.hierarchy.compute_distance(part).numpy() for part in _slices(points - surface.centre)]
    return np.concatenate(parts).astype(float)


def closest_points(
    surface: Surface, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """The closest surface points [m], and the unit normals of the faces they lie on."""
    answers = [surface.hierarchy.compute_closest_points(part) for part in _slices(points - surface.centre)]
    closest, normals = (
        np.concatenate([answer[name].numpy() for answer in answers]).astype(float)
        for name in ("points", "primitive_normals")
    )
    return closest + surface.centre, normals


def first_hits(
    mesh: TriangleMesh, directions: Float[np.ndarray, "*batch 3"]
) -> tuple[Float[np.ndarray, "*batch"], Integer[np.ndarray, "*batch"], Float[np.ndarray, "*batch 3"]]:
    """Of rays from the origin: how many `directions` long until they hit (infinite: never), face index, unit normal."""
    surface = make_surface(mesh)
    origins = np.broadcast_to(-surface.centre, directions.shape)
    hits = surface.hierarchy.cast_rays(_tensor(np.concatenate([origins, directions], -1), np.float32))
    normals = hits["primitive_normals"].numpy().astype(float)
    return hits["t_hit"].numpy().astype(float), hits["primitive_ids"].numpy(), normals


def _slices(points: Float[np.ndarray, "n 3"]):
    """Tensors of the points, a few hundred each; one at least."""
    return [_tensor(points[i : i + _CHUNK], np.float32) for i in range(0, max(len(points), 1), _CHUNK)]


def _tensor(array: np.ndarray, dtype: type):
    import open3d as o3d

    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array, dtype=dtype))
