"""Spheres that fill the links, for a cheap differentiable self-collision term.

An approximation by choice: spheres bulge out of the flat faces of long boxes by up to a fifth of their half thickness,
and leave edges and corners bare. Judges use signed distances instead.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int

from graspd_core.hands.model import HandModel, Primitive


@lru_cache(maxsize=8)
def collision_spheres(
    hand: HandModel,
) -> tuple[Float[np.ndarray, "spheres 3"], Float[np.ndarray, "spheres"], Int[np.ndarray, "spheres"]]:
    """Centres in link frames [m], radii [m] and links of spheres that fill every primitive."""
    centers, radii, links = [], [], []
    for primitive in hand.primitives:
        at, radius = _fill(primitive)
        at = at @ primitive.rotation.T + primitive.translation
        centers.append(at)
        radii.append(np.full(len(at), radius))
        links.append(np.full(len(at), primitive.link))
    return np.concatenate(centers), np.concatenate(radii), np.concatenate(links)


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
    reach = half if primitive.kind == "capsule" else half - radius
    if reach <= 0:
        return np.zeros((1, 3)), min(radius, half) if primitive.kind == "cylinder" else radius
    heights = _row(reach, radius)
    return np.column_stack([np.zeros((len(heights), 2)), heights]), radius


def _fill_box(half: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "spheres 3"], float]:
    small, middle, _ = np.sort(half)
    radius = float(min(0.5 * (small + middle), 1.2 * small))
    rows = [_row(extent - radius, radius) for extent in half]
    return np.stack(np.meshgrid(*rows, indexing="ij"), -1).reshape(-1, 3), radius


def _row(reach: float, radius: float) -> Float[np.ndarray, "n"]:
    """Positions from −reach to +reach no more than 1.2 radii apart; one in the middle where the reach is short."""
    if reach < 0.2 * radius:
        return np.zeros(1)
    return np.linspace(-reach, reach, int(np.ceil(2 * reach / (1.2 * radius))) + 1)
