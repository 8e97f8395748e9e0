"""Exact signed distance of points to a mesh: what metrics are measured with. No grid, no gradient.

Negative where the winding number says inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from graspd_core.mesh.surface_queries import Surface, make_surface, surface_distance
from graspd_core.mesh.winding_number import WindingTree, is_inside, make_winding_tree
from graspd_core.types import TriangleMesh


@dataclass(frozen=True, eq=False)
class DistanceQuery:
    """A mesh prepared for questions of distance; safe to ask from several threads."""

    surface: Surface
    tree: WindingTree


def make_distance_query(mesh: TriangleMesh) -> DistanceQuery:
    """Prepare a mesh: some 30 ms for 16,000 faces."""
    return DistanceQuery(make_surface(mesh), make_winding_tree(mesh))


def signed_distance(
    query: DistanceQuery, points: Float[np.ndarray, "n 3"], *, reach: float = np.inf
) -> Float[np.ndarray, "n"]:
    """Distance [m] to the nearest triangle, negative where the winding number says inside.

    Points farther than `reach` [m] from the bounding box get their distance to the box, a lower bound above `reach`.
    """
    tree = query.tree
    distance = np.linalg.norm(np.maximum(0.0, np.maximum(tree.low - points, points - tree.high)), axis=1)
    near = distance <= reach
    distance[near] = surface_distance(query.surface, points[near])
    return np.where(inside(query, points), -distance, distance)


def inside(query: DistanceQuery, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Whether the winding number says inside; needs no distance."""
    return is_inside(query.tree, points)


def unsigned_distance(query: DistanceQuery, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Distance [m] to the nearest triangle on either side; needs no winding number."""
    return surface_distance(query.surface, points)
