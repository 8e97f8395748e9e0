"""Pieces of one thing that occlusion set apart: the far wall of a cup behind the near one, a rim over its bottom.

Two pieces are one thing only if they touch in some camera's image, for the edge between them is then an occlusion, and
if they are near enough, or one stands within the other's outline on the support.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from graspd_core.geometry.clusters import extent, renumber
from graspd_core.geometry.planes import FlatPart

# Beyond so many pieces the rest is noise.
MOST_PIECES = 40
# What ends so many link lengths above the support has its foot hidden.
FLOATING = 0.5
# A piece whose foot is hidden is one with what hides it, if it is this near [m].
HIDDEN_FOOT = 0.03
# Without a support nothing tells one thing behind another from one thing's two sides: this near, they are one [m].
UNSUPPORTED = 0.15
# Outlines this many link lengths apart touch in an image: pixels at edges are lost.
IMAGE_GAP = 1.5
# Share of a piece that lies within another's outline.
WITHIN = 0.6


def join_pieces(
    points: Float[np.ndarray, "n 3"],
    distance: Float[np.ndarray, "n"],
    label: Int[np.ndarray, "n"],
    viewpoints: Float[np.ndarray, "views 3"],
    *,
    link: float,
    largest: float,
    support: FlatPart | None,
) -> Int[np.ndarray, "n"]:
    """The clusters with such pieces joined, numbered from the largest; -1: a stray.

    Args:
        points: evenly dense [m].
        distance: of each from its camera [m].
        label: their clusters, numbered from the largest; -1: a stray.
        viewpoints: where the cameras stood [m].
        link: distance at which points were linked [m].
        largest: pieces that would be longer than this together are not one thing [m].
        support: what the things stand on; a piece that ends well above it has its foot hidden.
    """
    from scipy.spatial import KDTree

    many = min(int(label.max(initial=-1)) + 1, MOST_PIECES)
    pieces = [points[label == k] for k in range(many)]
    trees = [KDTree(piece) for piece in pieces]
    small = [k for k in range(many) if extent(pieces[k]) <= largest]
    hidden = [False] * many
    if support is not None:
        clear = support.height(points) - support.tolerance(distance)
        hidden = [bool(clear[label == k].min() > FLOATING * link) for k in range(many)]
    owner = list(range(many))
    for a, b in combinations(small, 2):
        reach = UNSUPPORTED if support is None else HIDDEN_FOOT if hidden[a] or hidden[b] else link
        near = np.isfinite(trees[a].query(pieces[b], distance_upper_bound=reach)[0]).any()
        if not near and (support is None or _share_within(pieces[b], pieces[a], support) < WITHIN):
            continue
        if extent(np.vstack([pieces[a], pieces[b]])) > largest:
            continue
        if any(_touch_in_image(pieces[a], pieces[b], eye, IMAGE_GAP * link) for eye in viewpoints):
            root, leaf = sorted((owner[a], owner[b]))
            owner = [root if k == leaf else k for k in owner]
    joined = label.copy()
    known = (label >= 0) & (label < many)
    joined[known] = np.asarray(owner, dtype=int)[label[known]]
    return renumber(joined)


def _touch_in_image(
    a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "m 3"], eye: Float[np.ndarray, "3"], gap: float
) -> bool:
    """Whether a camera there sees less than `gap` between them, at the distance of the nearer one [m]."""
    from scipy.spatial import KDTree

    ranges = [np.linalg.norm(cloud - eye, axis=1, keepdims=True).clip(1e-6) for cloud in (a, b)]
    nearer = min(float(np.median(reach)) for reach in ranges)
    apart, _ = KDTree((a - eye) / ranges[0]).query((b - eye) / ranges[1])
    return float(apart.min()) <= gap / nearer


def _share_within(small: Float[np.ndarray, "n 3"], large: Float[np.ndarray, "m 3"], support: FlatPart) -> float:
    """Share of a piece that is inside the other's convex outline on the support."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        edges = ConvexHull(large @ support.axes).equations
    except (QhullError, ValueError):
        return 0.0
    return float(((small @ support.axes) @ edges[:, :2].T + edges[:, 2] <= 0).all(1).mean())
