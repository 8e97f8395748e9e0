"""Pieces of one thing that occlusion set apart: the far wall of a cup behind the near one, a rim over its bottom.

Two pieces are one thing only if they touch in some camera's image, for the edge between them is then an occlusion, and
if they are near enough, or one stands within the other's outline on the support. A piece that ends above the support
hangs on the nearest that stands, unless it may be a thing that stands behind what hides its foot.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from graspd_core.config import SegmentationConfig
from graspd_core.segmentation.clusters import extent, renumber
from graspd_core.segmentation.planes import FlatPart

# Beyond so many pieces the rest is noise.
MAX_PIECES = 40
# What ends so many link lengths above the support does not stand on it, unless it hides this share of the place below.
FLOATING_LINKS, HIDDEN_FOOT_SHARE = 0.5, 0.5
# What ends above the support may stand there by itself, its foot hidden, if it has this share of the other's surface,
# and if it is seen over this share of its height or ends at another height than the other [m]. Handles fall short of
# the first, walls of cups of both others.
OWN_SURFACE_SHARE, SEEN_HEIGHT_SHARE, LEVEL_TOPS_M = 0.12, 0.5, 0.01
# It is part of the other nevertheless if it is so many link lengths from it.
NEAR_LINKS = 1.5
# Outlines this many link lengths apart touch in an image: pixels at edges are lost.
IMAGE_GAP_LINKS = 1.5
# Share of a piece that lies within another's outline.
OUTLINE_SHARE = 0.6


def merge_occluded(
    points: Float[np.ndarray, "n 3"],
    distance: Float[np.ndarray, "n"],
    label: Int[np.ndarray, "n"],
    viewpoints: Float[np.ndarray, "views 3"],
    *,
    link: float,
    settings: SegmentationConfig,
    support: FlatPart | None,
) -> Int[np.ndarray, "n"]:
    """The clusters with such pieces joined, numbered from the largest; -1: a stray.

    Args:
        points: evenly dense [m].
        distance: of each from its camera [m].
        label: their clusters, numbered from the largest; -1: a stray.
        viewpoints: where the cameras stood [m].
        link: distance at which points were linked [m].
        settings: pieces that are longer than its largest object together are not one thing.
        support: what the things stand on; pieces that end well above it hang on others.
    """
    many = min(int(label.max(initial=-1)) + 1, MAX_PIECES)
    pieces = [points[label == k] for k in range(many)]
    small = [k for k in range(many) if extent(pieces[k]) <= settings.largest_object]
    hangs = [
        support is not None and _hangs(pieces[k], distance[label == k], support, viewpoints, link) for k in range(many)
    ]
    owner = list(range(many))
    for apart, a, b in sorted((_apart(pieces[a], pieces[b]), a, b) for a, b in combinations(small, 2)):
        group = [pieces[k] for k in small if owner[k] in (owner[a], owner[b])]
        if owner[a] == owner[b] or extent(np.vstack(group)) > settings.largest_object:
            continue
        one = _near(pieces[a], pieces[b], (hangs[a], hangs[b]), apart, link, settings, support)
        if one and any(_touch_in_image(pieces[a], pieces[b], eye, IMAGE_GAP_LINKS * link) for eye in viewpoints):
            root, leaf = sorted((owner[a], owner[b]))
            owner = [root if k == leaf else k for k in owner]
            # What hangs on one thing does not hang on the next: it would make one of all that are near it.
            stands = not (hangs[a] and hangs[b])
            hangs = [hangs[k] and not (stands and owner[k] == root) for k in range(many)]
    joined = label.copy()
    known = (label >= 0) & (label < many)
    joined[known] = np.asarray(owner, dtype=int)[label[known]]
    return renumber(joined)


def _near(
    a: Float[np.ndarray, "n 3"],
    b: Float[np.ndarray, "m 3"],
    hang: tuple[bool, bool],
    apart: float,
    link: float,
    settings: SegmentationConfig,
    support: FlatPart | None,
) -> bool:
    """Whether two pieces, the larger first, are near enough to be one thing, as far as each hangs on others."""
    if support is None:  # nothing tells one thing behind another from one thing's two sides
        return apart <= settings.unsupported_reach
    if apart <= max(link, settings.gap) or _share_within(b, a, support) >= OUTLINE_SHARE:
        return True
    reach = [
        NEAR_LINKS * link if _may_stand(piece, other, support) else settings.hanging_reach
        for piece, other, hangs in ((a, b, hang[0]), (b, a, hang[1]))
        if hangs
    ]
    return apart <= max(reach, default=0.0)


def _hangs(
    piece: Float[np.ndarray, "n 3"],
    distance: Float[np.ndarray, "n"],
    support: FlatPart,
    viewpoints: Float[np.ndarray, "views 3"],
    link: float,
) -> bool:
    """Whether a piece ends above the support and does not itself hide, from all cameras, what it might stand on."""
    height = support.height(piece)
    if (height - support.tolerance(distance)).min() <= FLOATING_LINKS * link:
        return False
    below = piece - height[:, None] * support.plane.normal
    for eye in viewpoints:
        (seen, near), (foot, far) = _directions(piece, eye), _directions(below, eye)
        apart, which = _tree(seen).query(foot)
        if np.mean((apart * near[which] <= link) & (near[which] < far)) >= HIDDEN_FOOT_SHARE:
            return False
    return True


def _may_stand(piece: Float[np.ndarray, "n 3"], other: Float[np.ndarray, "m 3"], support: FlatPart) -> bool:
    """Whether a piece that ends above the support may be a thing of its own beside the other, its foot hidden."""
    height, top = support.height(piece), float(support.height(other).max())
    level = abs(float(height.max()) - top) <= LEVEL_TOPS_M
    own = np.ptp(height) > SEEN_HEIGHT_SHARE * height.max() or not level
    return len(piece) >= OWN_SURFACE_SHARE * len(other) and bool(own)


def _touch_in_image(
    a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "m 3"], eye: Float[np.ndarray, "3"], gap: float
) -> bool:
    """Whether a camera there sees less than `gap` between them, at the distance of the nearer one [m]."""
    (one, near), (other, far) = _directions(a, eye), _directions(b, eye)
    return _apart(one, other) <= gap / min(float(np.median(near)), float(np.median(far)))


def _directions(
    points: Float[np.ndarray, "n 3"], eye: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Unit vectors from a camera to points, and how far they are [m]."""
    away = np.linalg.norm(points - eye, axis=1).clip(1e-6)
    return (points - eye) / away[:, None], away


def _apart(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "m 3"]) -> float:
    """Least distance between two sets of points."""
    return float(_tree(a).query(b)[0].min())


def _tree(points: Float[np.ndarray, "n 3"]):
    from scipy.spatial import KDTree

    return KDTree(points)


def _share_within(small: Float[np.ndarray, "n 3"], large: Float[np.ndarray, "m 3"], support: FlatPart) -> float:
    """Share of a piece that is inside the other's convex outline on the support."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        edges = ConvexHull(large @ support.axes).equations
    except (QhullError, ValueError):
        return 0.0
    return float(((small @ support.axes) @ edges[:, :2].T + edges[:, 2] <= 0).all(1).mean())
