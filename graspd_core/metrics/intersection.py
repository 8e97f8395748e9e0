"""How far a placed hand and an object, or the hand and itself, share the same space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from graspd_core.hands.collision_tensors import CollisionTensors, local_distance, make_collision_tensors
from graspd_core.hands.link_distance import bounds, depth_inside, hull_planes
from graspd_core.hands.model import HandModel, Primitive
from graspd_core.mesh.mesh_distance import inside, unsigned_distance
from graspd_core.mesh.unique_rows import packed_rows
from graspd_core.metrics.hand_contacts import PlacedHand
from graspd_core.metrics.metrics_context import MetricsContext

VOXEL = 0.001
# Cells are halved until they are voxels: 16 mm, 8, 4, 2, 1.
_HALVINGS = 4
# Half the diagonal of a cube of side 1, with room for float32 distances.
_HALF_DIAGONAL = 0.5 * np.sqrt(3.0) * 1.001


def penetration(placed: PlacedHand) -> float:
    """Greatest depth of a hand sample inside the object [m]."""
    return float(max(0.0, -placed.distance.min()))


def self_penetration(context: MetricsContext, placed: PlacedHand) -> float:
    """Greatest depth of a hand sample inside a link that is not adjacent to its own [m]."""
    hand, worst = context.hand, 0.0
    for link in range(hand.num_links):
        others = placed.points[~hand.adjacent[link][placed.links]]
        local = (others - placed.translations[link]) @ placed.rotations[link]
        worst = max(worst, float(depth_inside(hand, link, local).max(initial=0.0)))
    return worst


def intersection_volume(context: MetricsContext, placed: PlacedHand) -> float:
    """Volume of the hand inside the object [m³], counted in 1 mm voxels of a lattice fixed in the hand's base frame.

    An octree of each solid finds them: a cell is dropped when its centre is farther outside solid or object than its
    half diagonal, and known to be wholly inside the object when it is that far inside; no overlap is too small or too
    thin to be visited. Cells have integer coordinates in voxels, so that what solids share is counted once.
    """
    solids = _placed_solids(context.hand, placed)
    cells, which = _root_cells(solids, placed)
    # Whether a cell is known to lie inside the object as a whole.
    known = np.zeros(len(cells), dtype=bool)
    for halving in range(_HALVINGS + 1):
        size = 2 ** (_HALVINGS - halving)
        half_diagonal = _HALF_DIAGONAL * size * VOXEL if size > 1 else 0.0
        centers = (cells + 0.5 * size) * VOXEL @ placed.rotations[0].T + placed.translations[0]
        kept = _solid_distance(solids, which, centers) < half_diagonal
        cells, which, known, centers = cells[kept], which[kept], known[kept], centers[kept]
        if size == 1:
            known[~known] = inside(context.query, centers[~known])
            return len(np.unique(packed_rows(cells[known]))) * VOXEL**3
        kept, known = _against_object(context, centers, known, half_diagonal)
        cells, which, known = _halve(cells[kept], size // 2), np.repeat(which[kept], 8), np.repeat(known[kept], 8)
    return 0.0


@dataclass(frozen=True, eq=False)
class _PlacedSolids:
    """The collision primitives of a hand at its grasp, hulls last.

    Attributes:
        primitives: those of the hand.
        rotations: `R_object_primitive`.
        translations: primitive origins in the object frame [m].
        smooth: those that are no hulls, for distances.
    """

    primitives: tuple[Primitive, ...]
    rotations: Float[np.ndarray, "solids 3 3"]
    translations: Float[np.ndarray, "solids 3"]
    smooth: CollisionTensors


def _placed_solids(hand: HandModel, placed: PlacedHand) -> _PlacedSolids:
    primitives = tuple(sorted(hand.primitives, key=lambda primitive: primitive.kind == "hull"))
    rotations = np.array([placed.rotations[p.link] @ p.rotation for p in primitives]).reshape(-1, 3, 3)
    origins = [placed.rotations[p.link] @ p.translation + placed.translations[p.link] for p in primitives]
    smooth = make_collision_tensors(hand, "cpu", torch.float64)
    return _PlacedSolids(primitives, rotations, np.reshape(origins, (-1, 3)), smooth)


def _root_cells(
    solids: _PlacedSolids, placed: PlacedHand
) -> tuple[Int[np.ndarray, "cells 3"], Int[np.ndarray, "cells"]]:
    """Cells of the coarsest size over the boxes of all solids, base frame, in voxels; and the solid of each, rising."""
    size, base, cells = 2**_HALVINGS, placed.rotations[0], [np.zeros((0, 3), dtype=np.int64)]
    for primitive in solids.primitives:
        low, high = bounds(primitive)
        rotation = base.T @ placed.rotations[primitive.link]
        center = (placed.translations[primitive.link] - placed.translations[0]) @ base + rotation @ (low + high) / 2
        reach = np.abs(rotation) @ (high - low) / 2
        ends = np.floor((center - reach) / (size * VOXEL)), np.ceil((center + reach) / (size * VOXEL))
        cells.append(size * _lattice(*(end.astype(np.int64) for end in ends)))
    return np.concatenate(cells), np.repeat(np.arange(len(solids.primitives)), [len(some) for some in cells[1:]])


def _solid_distance(
    solids: _PlacedSolids, which: Int[np.ndarray, "n"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n"]:
    """Signed distance [m] of points of the object frame each to one solid, `which` rising; of hulls a lower bound."""
    local = np.einsum("nji,nj->ni", solids.rotations[which], points - solids.translations[which])
    hulls = int(np.searchsorted(which, len(solids.smooth.link)))
    smooth = local_distance(solids.smooth, torch.as_tensor(local[:hulls]), torch.as_tensor(which[:hulls])).numpy()
    parts = [smooth]
    for hull in np.unique(which[hulls:]):
        normals, offsets = hull_planes(solids.primitives[hull])
        parts.append((local[which == hull] @ normals.T - offsets).max(1))
    return np.concatenate(parts)


def _against_object(
    context: MetricsContext,
    centers: Float[np.ndarray, "cells 3"],
    known: Bool[np.ndarray, "cells"],
    half_diagonal: float,
) -> tuple[Bool[np.ndarray, "cells"], Bool[np.ndarray, "cells"]]:
    """Which cells may share space with the object, and which are known to lie inside it as a whole."""
    kept, whole = np.ones(len(centers), dtype=bool), known.copy()
    unknown = np.flatnonzero(~known)
    clear = unknown[unsigned_distance(context.query, centers[unknown]) > half_diagonal]
    whole[clear] = kept[clear] = inside(context.query, centers[clear])
    return kept, whole


def _halve(cells: Int[np.ndarray, "cells 3"], size: int) -> Int[np.ndarray, "children 3"]:
    return (cells[:, None] + size * _lattice(np.zeros(3, dtype=int), np.full(3, 2))).reshape(-1, 3)


def _lattice(low: Int[np.ndarray, "3"], high: Int[np.ndarray, "3"]) -> Int[np.ndarray, "n 3"]:
    """All integer points from `low` to before `high`."""
    return np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), -1).reshape(-1, 3)
