"""Things in a scene: points linked to their neighbours, and which of these clusters are one thing, or two.

Pieces of one thing that occlusion set apart, as the far wall of a cup behind the near one or a rim over its bottom, are
joined. Two pieces are one thing only if they touch in some camera's image, for the edge between them is then an
occlusion, and if they are near enough, or one stands within the other's outline on the support. A piece that ends above
the support hangs on the nearest that stands, unless it may be a thing that stands behind what hides its foot.

Things that touch are one cluster of points, and a seam or a narrow waist in it parts two which both stand. A surface
that turns towards itself over a finger's breadth is a seam. Things of one height that touch along a line are joined by
a bridge of points across their tops, far narrower than either. One thing may have such places as well, where a leg
meets a body. So this is a doubt, never a cut. Two boxes that stand flush are one to a camera.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from graspd_core.config import SegmentationConfig
from graspd_core.perception.cloud.point_cloud import Eyes, Points, Vector, convex_hull, least_axes, longest_side
from graspd_core.perception.segment.planes import FlatPart

# Flying pixels, which are spread along their lines of sight between two surfaces, have less than this share of the
# weight around a usual point: it tells them where many views have filled the space around an edge with them.
MIN_WEIGHT_SHARE = 0.04
# Points are linked over this share of the gap between things; noise takes the rest.
LINK_SHARE_OF_GAP = 0.75
# Points are dense if their fourth neighbours are so many times nearer than that.
DENSE_SPACING_RATIO = 1.6
# Sparse ones are linked over this many times the distance to the fourth neighbour: surfaces seen at a small angle have
# their points far apart along the line of sight.
SPARSE_LINK_RATIO = 2.5
SPACING_SAMPLES = 2000
# Points so far apart tell how a surface bends [m], and how much bend inwards is a seam [1/m]: a bowl's inside, of a
# radius over 5 cm, is none, nor is a camera's noise.
_REACH_M, _SEAM_BEND = 0.013, 20.0
# Points on one side of a seam are linked over this many spacings.
_LINK_SPACINGS = 1.7
# A waist is no wider than this share of what is on either side of it; half the widths that are looked for [m].
_WAIST, _WAISTS_M = 0.3, (0.0, 0.003, 0.005, 0.007, 0.009, 0.012)
# Each of two things has this share of the points at least, and some of its seen surface so near to the support [m];
# the inside of a bowl is none, which is hollow.
_MIN_SHARE, _FOOT_M = 0.12, 0.03
_NEIGHBOURS = 24
# A point is on the outline of what is seen if, of as many neighbours as lie within so many spacings, none is in a
# sector of this angle about it.
_OUTLINE_NEIGHBOURS, _OUTLINE_SPACINGS, _OUTLINE_ANGLE = 16, 2.2, np.deg2rad(110.0)
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


def link_length(points: Points, settings: SegmentationConfig) -> float:
    """Points this near belong together [m]: less than the gap, unless the points are too sparse."""
    if len(points) < 5:
        return settings.gap
    some = points[:: max(1, len(points) // SPACING_SAMPLES)]
    spacing = float(np.median(KDTree(points).query(some, k=5)[0][:, -1]))
    link = LINK_SHARE_OF_GAP * settings.gap
    return link if DENSE_SPACING_RATIO * spacing <= link else min(SPARSE_LINK_RATIO * spacing, settings.max_link)


def link_points(
    points: Points, weight: Float[np.ndarray, "n"], link: float, neighbour_share: float
) -> Int[np.ndarray, "n"]:
    """Link evenly dense points to clusters, numbered from the largest. A stray is -1.

    As in DBSCAN, only points with enough neighbours carry a cluster on. The others join the nearest that does.

    Args:
        points: one a voxel [m].
        weight: how well each was seen: full points in its voxel, those that any camera would see taken as equal.
        link: points this near are neighbours [m].
        neighbour_share: points with a smaller share of the median number of neighbours are strays.
    """
    label = np.full(len(points), -1)
    if len(points) == 0:
        return label
    tree = KDTree(points)
    pairs = tree.query_pairs(link, output_type="ndarray")
    degree = np.bincount(pairs.ravel(), minlength=len(points))
    if len(pairs) == 0:
        return label
    around = weight + sum(np.bincount(pairs[:, k], weight[pairs[:, 1 - k]], minlength=len(points)) for k in (0, 1))
    usual = degree > 0
    core = degree >= max(2.0, neighbour_share * float(np.median(degree[usual])))
    seen = around >= MIN_WEIGHT_SHARE * float(np.median(around[usual]))
    core &= seen
    if not core.any():
        return label
    label = _linked(core, pairs)
    edge = ~core & seen
    near, nearest = KDTree(points[core]).query(points[edge], distance_upper_bound=link)
    joins = np.flatnonzero(edge)[np.isfinite(near)]
    label[joins] = label[core][np.asarray(nearest)[np.isfinite(near)]]
    return renumber(label)


def extent(points: Points) -> float:
    """Length along the longest principal axis [m], however the points are turned."""
    centred = points - points.mean(0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    return longest_side(centred @ axes)


def renumber(label: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Give clusters their numbers from the largest, without gaps. Strays (-1) stay."""
    answer = np.full(len(label), -1)
    known = label >= 0
    count = np.bincount(label[known])
    rank = np.zeros(len(count), dtype=int)
    rank[np.argsort(-count, kind="stable")] = np.arange(len(count))
    answer[known] = np.take(rank, label[known])
    return answer


def touching_things(points: Points, eyes: Eyes, height: Float[np.ndarray, "n"], spacing: float) -> Int[np.ndarray, "n"]:
    """Tell apart the parts of a cluster that seams and waists bound and that stand on their own, all 0 where one is.

    Args:
        points: thinned evenly [m].
        eyes: where the cameras stood [m].
        height: of the points above the support [m].
        spacing: of the points [m].
    """
    one = np.zeros(len(points), dtype=int)
    if len(points) < 2 * _NEIGHBOURS:
        return one
    tree = KDTree(points)
    distance, near = map(np.asarray, tree.query(points, k=_NEIGHBOURS))
    normals = _normals(points, near, eyes)
    bend = _bend(points, normals, *tree.query_pairs(_REACH_M, output_type="ndarray").T)
    seam = bend < -_SEAM_BEND
    bounds = seam | _outline(points, normals, np.where(distance < _OUTLINE_SPACINGS * spacing, near, -1))
    depth = KDTree(points[bounds]).query(points)[0] if bounds.any() else np.full(len(points), np.inf)
    links = tree.query_pairs(_LINK_SPACINGS * spacing, output_type="ndarray")
    for waist in _WAISTS_M:
        part = _linked(~seam & (depth >= waist), links)
        large = np.flatnonzero(np.bincount(part[part >= 0], minlength=1) > _MIN_SHARE * len(points))
        things = [
            mine
            for mine in (part == k for k in large)
            if np.percentile(height[mine], 5) < _FOOT_M + waist
            and np.median(bend[mine]) > 0
            and waist <= _WAIST * depth[mine].max()
        ]
        if len(things) > 1:
            # The seam itself, and pieces that occlusion set apart, belong to the part that is nearest.
            return np.argmin([KDTree(points[mine]).query(points)[0] for mine in things], axis=0)
    return one


def _normals(points: Points, near: Int[np.ndarray, "n near"], eyes: Eyes) -> Points:
    """Return unit normals of planes through neighbours, towards the camera that sees each the least from the side."""
    spread = points[near] - points[near].mean(1, keepdims=True)
    normals = least_axes(spread.transpose(0, 2, 1) @ spread)
    way = eyes[:, None] - points
    facing = (way * normals).sum(-1) / np.linalg.norm(way, axis=-1)
    best = np.take_along_axis(facing, np.abs(facing).argmax(0)[None], 0)[0]
    return normals * np.where(best < 0, -1.0, 1.0)[:, None]


def _outline(points: Points, normals: Points, near: Int[np.ndarray, "n near"]) -> Bool[np.ndarray, "n"]:
    """Tell which points have a wide sector about them, in the surface, without any of their neighbours. -1 is none."""
    near = near[:, 1 : 1 + _OUTLINE_NEIGHBOURS]
    way = points[near] - points[:, None]
    right = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    angle = np.arctan2(*(np.einsum("nkd,nd->nk", way, axis) for axis in (np.cross(normals, right), right)))
    # NaN is sorted to the end, and no gap to it is wider than any.
    angle = np.sort(np.where(near < 0, np.nan, angle), axis=1)
    first, last = angle[:, 0], np.nan_to_num(angle, nan=-np.inf).max(1)
    gaps = np.diff(angle, axis=1, append=np.nan)
    return ~(np.maximum(np.nan_to_num(gaps).max(1), first + 2 * np.pi - last) <= _OUTLINE_ANGLE)


def _bend(
    points: Points, normals: Points, one: Int[np.ndarray, "pairs"], other: Int[np.ndarray, "pairs"]
) -> Float[np.ndarray, "n"]:
    """Measure the mean curvature about each point [1/m], of pairs `_REACH_M` apart at most, negative in hollows."""
    way = points[other] - points[one]
    squared = np.einsum("pd,pd->p", way, way)
    # Near ones say more of noise than of the surface.
    far = squared > (0.4 * _REACH_M) ** 2
    one, other, way, squared = one[far], other[far], way[far], squared[far]
    bend = np.einsum("pd,pd->p", normals[other] - normals[one], way) / squared
    total = np.bincount(one, bend, len(points)) + np.bincount(other, bend, len(points))
    count = np.bincount(one, minlength=len(points)) + np.bincount(other, minlength=len(points))
    return total / np.maximum(count, 1)


def _linked(kept: Bool[np.ndarray, "n"], links: Int[np.ndarray, "links 2"]) -> Int[np.ndarray, "n"]:
    """Return the connected part that each of the kept points is of, -1 for the others."""
    one, other = links[kept[links].all(1)].T
    graph = coo_matrix((np.ones(len(one), dtype=bool), (one, other)), shape=(len(kept), len(kept)))
    return np.where(kept, connected_components(graph, directed=False)[1], -1)


def merge_occluded(
    points: Points,
    distance: Float[np.ndarray, "n"],
    label: Int[np.ndarray, "n"],
    viewpoints: Eyes,
    *,
    link: float,
    settings: SegmentationConfig,
    support: FlatPart | None,
) -> Int[np.ndarray, "n"]:
    """Return the clusters with such pieces joined, numbered from the largest. A stray is -1.

    Args:
        points: evenly dense [m].
        distance: of each from its camera [m].
        label: their clusters, numbered from the largest, -1 for a stray.
        viewpoints: where the cameras stood [m].
        link: distance at which points were linked [m].
        settings: pieces that are longer than its largest object together are not one thing.
        support: what the things stand on. Pieces that end well above it hang on others.
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
    a: Points,
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


def _hangs(piece: Points, distance: Float[np.ndarray, "n"], support: FlatPart, viewpoints: Eyes, link: float) -> bool:
    """Whether a piece ends above the support and does not itself hide, from all cameras, what it might stand on."""
    height = support.height(piece)
    if (height - support.tolerance(distance)).min() <= FLOATING_LINKS * link:
        return False
    below = piece - height[:, None] * support.plane.normal
    for eye in viewpoints:
        (seen, near), (foot, far) = _directions(piece, eye), _directions(below, eye)
        apart, which = KDTree(seen).query(foot)
        if np.mean((apart * near[which] <= link) & (near[which] < far)) >= HIDDEN_FOOT_SHARE:
            return False
    return True


def _may_stand(piece: Points, other: Float[np.ndarray, "m 3"], support: FlatPart) -> bool:
    height, top = support.height(piece), float(support.height(other).max())
    level = abs(float(height.max()) - top) <= LEVEL_TOPS_M
    own = np.ptp(height) > SEEN_HEIGHT_SHARE * height.max() or not level
    return len(piece) >= OWN_SURFACE_SHARE * len(other) and bool(own)


def _touch_in_image(a: Points, b: Float[np.ndarray, "m 3"], eye: Vector, gap: float) -> bool:
    (one, near), (other, far) = _directions(a, eye), _directions(b, eye)
    return _apart(one, other) <= gap / min(float(np.median(near)), float(np.median(far)))


def _directions(points: Points, eye: Vector) -> tuple[Points, Float[np.ndarray, "n"]]:
    away = np.linalg.norm(points - eye, axis=1).clip(1e-6)
    return (points - eye) / away[:, None], away


def _apart(a: Points, b: Float[np.ndarray, "m 3"]) -> float:
    return float(KDTree(a).query(b)[0].min())


def _share_within(small: Points, large: Float[np.ndarray, "m 3"], support: FlatPart) -> float:
    hull = convex_hull(large @ support.axes)
    if hull is None:
        return 0.0
    edges = hull.equations
    return float(((small @ support.axes) @ edges[:, :2].T + edges[:, 2] <= 0).all(1).mean())
