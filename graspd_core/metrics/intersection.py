"""How far a placed hand and an object, or the hand and itself, share the same space."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from graspd_core.hands.link_distance import depth_inside, hand_sdf, within_bounds
from graspd_core.mesh.mesh_distance import inside, unsigned_distance
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

    An octree finds them: a cell is dropped when its centre is farther outside hand or object than its half diagonal,
    and known to be wholly inside the object when it is that far inside; no overlap is too small or too thin to be
    visited. Cells have integer coordinates in voxels, so nothing is counted twice.
    """
    links = _links_within_reach(context, placed)
    cells = _root_cells(context, placed, links)
    # Whether a cell is known to lie inside the object as a whole.
    known = np.zeros(len(cells), dtype=bool)
    for halving in range(_HALVINGS + 1):
        size = 2 ** (_HALVINGS - halving)
        half_diagonal = _HALF_DIAGONAL * size * VOXEL if size > 1 else 0.0
        centers = (cells + 0.5 * size) * VOXEL @ placed.rotations[0].T + placed.translations[0]
        kept = _touches_hand(context, placed, links, centers, half_diagonal)
        cells, known, centers = cells[kept], known[kept], centers[kept]
        if size == 1:
            return float((known.sum() + inside(context.query, centers[~known]).sum()) * VOXEL**3)
        kept, known = _against_object(context, centers, known, half_diagonal)
        cells, known = _halve(cells[kept], size // 2), np.repeat(known[kept], 8)
    return 0.0


def _links_within_reach(context: MetricsContext, placed: PlacedHand) -> Int[np.ndarray, "near"]:
    """Links whose ball of solids reaches the object."""
    surface = context.surface
    centers = np.einsum("lij,lj->li", placed.rotations, surface.centers) + placed.translations
    distance = unsigned_distance(context.query, centers)
    within = (distance < surface.radii) | inside(context.query, centers)
    return np.flatnonzero(within & (surface.radii > 0))


def _root_cells(
    context: MetricsContext, placed: PlacedHand, links: Int[np.ndarray, "near"]
) -> Int[np.ndarray, "cells 3"]:
    """Cells of the coarsest size over the box about the near links' balls, base frame, in voxels."""
    if len(links) == 0:
        return np.zeros((0, 3), dtype=np.int64)
    surface, base = context.surface, placed.rotations[0]
    centers = np.einsum("lij,lj->li", placed.rotations[links], surface.centers[links]) + placed.translations[links]
    centers, radii = (centers - placed.translations[0]) @ base, surface.radii[links, None]
    size = 2**_HALVINGS
    low = np.floor((centers - radii).min(0) / (size * VOXEL)).astype(np.int64)
    high = np.ceil((centers + radii).max(0) / (size * VOXEL)).astype(np.int64)
    axes = [np.arange(a, b) * size for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


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
    corners = size * np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    return (cells[:, None] + corners).reshape(-1, 3)


def _touches_hand(
    context: MetricsContext,
    placed: PlacedHand,
    links: Int[np.ndarray, "near"],
    points: Float[np.ndarray, "n 3"],
    within: float,
) -> Bool[np.ndarray, "n"]:
    """Which points of the object frame are nearer than `within` [m] to one of some links; about hulls, perhaps more."""
    touches = np.zeros(len(points), dtype=bool)
    for link in links:
        local = (points - placed.translations[link]) @ placed.rotations[link]
        near = np.flatnonzero(~touches & within_bounds(context.hand.primitives_of[link], local, within))
        if len(near):
            touches[near] = hand_sdf(context.hand, int(link), torch.as_tensor(local[near])).numpy() < within
    return touches
