"""Spheres that fill the links, for a cheap differentiable self-collision term.

An approximation by choice: spheres bulge out of the flat faces of long boxes by up to a fifth of their half thickness,
and leave edges and corners bare. Metrics use signed distances instead.

The term looks at every pair of spheres, so that they are bounded: solids thinner than a few millimetres get spheres
that bulge, and of those of a hand of many or large solids only the ones are kept that stick out of each other farthest.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int

from graspd_core.hands.kinematics import in_base, link_poses
from graspd_core.hands.model import HandModel, Primitive

# The most spheres of a rigid group of links, and of a hand; one of more groups than that has one for each.
MOST_OF_GROUP, MOST_OF_HAND = 64, 160
# The finest radius that solids are filled with [m]; they may themselves be smaller.
_FINEST = 0.003
# What the spheres of a crowded hand leave bare where there are enough, and a disc around its one sphere [m].
_BARE, _RIM = 0.001, 0.01


@lru_cache(maxsize=8)
def collision_spheres(
    hand: HandModel,
) -> tuple[Float[np.ndarray, "spheres 3"], Float[np.ndarray, "spheres"], Int[np.ndarray, "spheres"]]:
    """Centres in link frames [m], radii [m] and links of spheres that fill the solids, at most `MOST_OF_HAND`."""
    centers, radii, links = [], [], []
    for primitive in hand.primitives:
        at, radius = _fill(primitive)
        at = at @ primitive.rotation.T + primitive.translation
        centers.append(at)
        radii.append(np.full(len(at), radius))
        links.append(np.full(len(at), primitive.link))
    center, radius, link = np.concatenate(centers), np.concatenate(radii), np.concatenate(links)
    groups = hand.link_group[link]
    if len(link) > MOST_OF_HAND or np.bincount(groups).max() > MOST_OF_GROUP:
        kept = _spread(in_base(link_poses(hand, hand.open_posture), center, link), radius, groups)
        return center[kept], radius[kept], link[kept]
    return center, radius, link


def _spread(
    centers: Float[np.ndarray, "n 3"], radii: Float[np.ndarray, "n"], groups: Int[np.ndarray, "n"]
) -> Int[np.ndarray, "kept"]:
    """The largest sphere of each group, then whichever sticks farthest out of those of its group that were chosen.

    So chosen, they leave about as much bare everywhere: farthest-point sampling (Gonzalez 1985).
    """
    # Farther out than any sphere can stick: nothing of its group has been chosen.
    bare = 1e3 + radii
    chosen: list[int] = []
    while bare.max() > _BARE and (len(chosen) < MOST_OF_HAND or bare.max() > 1e3):
        last = int(bare.argmax())
        chosen.append(last)
        mates = np.flatnonzero(groups == groups[last])
        away = np.linalg.norm(centers[mates] - centers[last], axis=1)
        bare[mates] = np.minimum(bare[mates], away + radii[mates] - radii[last])
        if (groups[chosen] == groups[last]).sum() == MOST_OF_GROUP:
            bare[mates] = 0.0
    return np.sort(chosen)


def _fill(primitive: Primitive) -> tuple[Float[np.ndarray, "spheres 3"], float]:
    """Sphere centres in the primitive's frame and their common radius [m]."""
    size = primitive.size
    if primitive.kind == "sphere":
        return np.zeros((1, 3)), size[0]
    if primitive.kind == "box":
        return _fill_box(np.asarray(size))
    if primitive.kind == "hull":
        low, high = primitive.vertices.min(0), primitive.vertices.max(0)
        centers, radius = _fill_box(0.5 * (high - low))
        return centers + 0.5 * (low + high), 0.9 * radius
    radius, half = size
    if primitive.kind == "cylinder" and radius > half + _RIM:
        centers, ball = _fill_box(np.array([radius, radius, half]))
        return centers[np.linalg.norm(centers[:, :2], axis=1) <= radius], ball
    reach = half if primitive.kind == "capsule" else half - radius
    if reach <= 0:
        return np.zeros((1, 3)), min(radius, half) if primitive.kind == "cylinder" else radius
    heights = _row(reach, max(radius, _FINEST, reach / 32))
    return np.column_stack([np.zeros((len(heights), 2)), heights]), radius


def _fill_box(half: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "spheres 3"], float]:
    small, middle, large = np.sort(half)
    radius = float(max(min(0.5 * (small + middle), 1.2 * small), min(_FINEST, large)))
    step, rows = radius, [_row(extent - radius, radius) for extent in half]
    while np.prod([len(row) for row in rows]) > MOST_OF_GROUP:
        step *= 1.1
        rows = [_row(extent - radius, step) for extent in half]
    return np.stack(np.meshgrid(*rows, indexing="ij"), -1).reshape(-1, 3), radius


def _row(reach: float, step: float) -> Float[np.ndarray, "n"]:
    """Positions from −reach to +reach no more than 1.2 steps apart; one in the middle where the reach is short."""
    if reach < 0.2 * step:
        return np.zeros(1)
    return np.linspace(-reach, reach, int(np.ceil(2 * reach / (1.2 * step))) + 1)
