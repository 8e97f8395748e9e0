"""Contact area and intersection volume of a hand that is given as one closed surface: a skinned human hand.

The same definitions as for hands of solids (docs/metrics.md), on the skin itself instead of the hulls that stand for it
while planning.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from graspd_core.mesh.mesh_distance import DistanceQuery, inside, make_distance_query, signed_distance
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.types import TriangleMesh

# Distances within which skin counts as touching [m]: the project's own, and two that others use.
CONTACT_DISTANCES = (0.002, 0.005, 0.010)
VOXEL = 0.001
# About 1 mm between samples on an adult's hand.
_SAMPLES, _SEED = 40_000, 7


@dataclass(frozen=True)
class SkinMetrics:
    """Figures of one placed skin.

    Attributes:
        contact_area: skin within each of `CONTACT_DISTANCES` of the object's surface, on either side of it [m²].
        intersection_volume: of the skin's inside and the object, in 1 mm voxels [m³].
        penetration: greatest depth of the skin in the object [m].
    """

    contact_area: tuple[float, ...]
    intersection_volume: float
    penetration: float


def measure_skin(query: DistanceQuery, skin: TriangleMesh) -> SkinMetrics:
    """Measure a closed skin in the object's frame against an object (`make_distance_query` of its mesh)."""
    points, _ = surface_samples(skin, _SAMPLES, _SEED)
    distance = signed_distance(query, points, reach=2 * CONTACT_DISTANCES[-1])
    corners = skin.vertices[skin.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    each = 0.5 * float(np.linalg.norm(cross, axis=1).sum()) / len(points)
    return SkinMetrics(
        contact_area=tuple(float((np.abs(distance) <= within).sum()) * each for within in CONTACT_DISTANCES),
        intersection_volume=_shared_volume(query, skin),
        penetration=float(max(0.0, -distance.min())),
    )


def _shared_volume(query: DistanceQuery, skin: TriangleMesh) -> float:
    """Volume inside both [m³]: 1 mm voxels over the box that the two share, counted by their middles."""
    low = np.maximum(query.tree.low, skin.vertices.min(0))
    high = np.minimum(query.tree.high, skin.vertices.max(0))
    if (high <= low).any():
        return 0.0
    axes = [_middles(a, b) for a, b in zip(low, high, strict=True)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    cells = cells[inside(query, cells)]
    if len(cells) == 0:
        return 0.0
    return float(inside(make_distance_query(skin), cells).sum()) * VOXEL**3


def _middles(low: float, high: float) -> Float[np.ndarray, "n"]:
    return (np.arange(np.floor(low / VOXEL), np.ceil(high / VOXEL)) + 0.5) * VOXEL
