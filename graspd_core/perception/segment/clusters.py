"""Find objects in a scene: cluster points, join clusters of one object, and find clusters that may be several objects.

Occlusion splits one object into several clusters, for example into the near wall and the far wall of a cup. Two
clusters are joined only if they touch in some camera's image, because the edge between them is then an occlusion. They
must also be near each other, or one must lie within the outline of the other on the support. A cluster that ends above
the support belongs to the nearest standing cluster, except if it may be an object with a hidden foot.

Touching objects form one cluster. A concave seam or a narrow waist between two standing parts suggests two objects.
Objects of equal height that touch along a line are connected by a narrow bridge of points across their tops. A single
object can have seams and waists too, for example where a leg meets a body. Therefore, without a target, a seam only
causes a warning. Two boxes that stand flush look like one object to a camera.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from graspd_core.config import SegmentationConfig
from graspd_core.mesh.components import connected_parts
from graspd_core.mesh.convex_parts import convex_hull
from graspd_core.perception.cloud.point_cloud import Eyes, Points, Vector, longest_side, plane_normals
from graspd_core.perception.cloud.voxel_downsample import rows_of
from graspd_core.perception.segment.planes import FlatPart

# Flying pixels lie along lines of sight between two surfaces. The weight around a flying pixel is below this fraction
# of the usual weight, even if many views have flying pixels at the same edge.
MIN_WEIGHT_SHARE = 0.04
# The link length is this fraction of the least gap between objects. The rest of the gap allows for noise.
LINK_SHARE_OF_GAP = 0.75
# Points are dense if the link length is at least this many times the distance to the fourth neighbour.
DENSE_SPACING_RATIO = 1.6
# For sparse points, the link length is this many times the distance to the fourth neighbour. On surfaces seen at a
# grazing angle, points are far apart along the line of sight.
SPARSE_LINK_RATIO = 2.5
SPACING_SAMPLES = 2000  # points for which the distance to the fourth neighbour is measured
# Greatest distance of point pairs for measuring curvature [m], and concave curvature from which a surface is a seam
# [1/m]. Neither camera noise nor the inside of a bowl with a radius over 5 cm is a seam.
_REACH_M, _SEAM_BEND = 0.013, 20.0
# Points on one side of a seam are linked up to this many spacings apart.
_LINK_SPACINGS = 1.7
# Greatest width of a waist, as a fraction of the width of the parts on either side. Then half of each width to try [m].
_WAIST, _WAISTS_M = 0.3, (0.0, 0.003, 0.005, 0.007, 0.009, 0.012)
# A part of a cluster is an object if it has at least this fraction of the cluster's points, and its lowest points are
# within this height of the support [m]. A concave part is no object, because it may be the inside of a bowl. In a heap,
# which has many objects, this area is enough [m²]. It was chosen on eight bins (seeds 266 to 268 and 270 to 273).
_MIN_SHARE, _FOOT_M, _MIN_AREA = 0.12, 0.03, 0.0025
_NEIGHBOURS = 24  # points to which the plane at a point is fitted, including the point
# A point is on the outline of the visible surface if a sector wider than _OUTLINE_ANGLE around it has no neighbour.
# Only the nearest neighbours count, up to this number and up to this many spacings away.
_OUTLINE_NEIGHBOURS, _OUTLINE_SPACINGS, _OUTLINE_ANGLE = 16, 2.2, np.deg2rad(110.0)
# Only this many clusters, the largest, are joined. Smaller clusters stay separate.
MAX_PIECES = 40
# A cluster hangs if it ends more than FLOATING_LINKS link lengths above the support. If it hides HIDDEN_FOOT_SHARE of
# the place below it from a camera, it may stand.
FLOATING_LINKS, HIDDEN_FOOT_SHARE = 0.5, 0.5
# A hanging cluster may be an object with a hidden foot if it has OWN_SURFACE_SHARE of the other cluster's points. It
# must also be visible over SEEN_HEIGHT_SHARE of its height, or its top must differ from the other cluster's top by
# LEVEL_TOPS_M [m]. Handles have too few points. Walls of cups fail both other conditions.
OWN_SURFACE_SHARE, SEEN_HEIGHT_SHARE, LEVEL_TOPS_M = 0.12, 0.5, 0.01
# Even then, the hanging cluster is joined if it is at most this many link lengths away from the other cluster.
NEAR_LINKS = 1.5
# Clusters touch in an image if they are at most this many link lengths apart, because pixels at edges are lost.
IMAGE_GAP_LINKS = 1.5
# Two clusters may be one object if at least this fraction of the smaller one lies within the outline of the larger.
OUTLINE_SHARE = 0.6


def link_length(points: Points, settings: SegmentationConfig) -> float:
    """Return the distance up to which points are linked [m]. For dense points, it is below the gap between objects."""
    if len(points) < 5:
        return settings.gap
    some = points[:: max(1, len(points) // SPACING_SAMPLES)]
    spacing = float(np.median(KDTree(points).query(some, k=5)[0][:, -1]))
    link = LINK_SHARE_OF_GAP * settings.gap
    return link if DENSE_SPACING_RATIO * spacing <= link else min(SPARSE_LINK_RATIO * spacing, settings.max_link)


def link_points(
    points: Points, weight: Float[np.ndarray, "n"], link: float, neighbour_share: float
) -> Int[np.ndarray, "n"]:
    """Cluster points of even density. Return the cluster of each point. The largest cluster is 0, and noise is -1.

    As in DBSCAN, only core points (with enough neighbours) extend a cluster. Other points join the nearest core point.

    Args:
        points: one point per voxel [m].
        weight: point count of each voxel times its squared distance from the camera [m²] (`VoxelScene.weight`).
        link: distance up to which points are neighbours [m].
        neighbour_share: least number of neighbours of a core point, as a fraction of the median number.
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
    """Return the length along the longest principal axis [m]. It does not depend on rotation."""
    centred = points - points.mean(0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    return longest_side(centred @ axes)


def renumber(label: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Renumber clusters by falling size, from 0 without gaps. Noise stays -1."""
    answer, known = np.full(len(label), -1), label >= 0
    rank = np.argsort(np.argsort(-np.bincount(label[known]), kind="stable"))
    answer[known] = rank[label[known]]
    return answer


def touching_things(
    points: Points, eyes: Eyes, height: Float[np.ndarray, "n"], spacing: float, enough: float = np.inf
) -> Int[np.ndarray, "n"]:
    """Split a cluster at seams and waists into standing parts. Return each point's part number, all 0 for one part.

    Args:
        points: evenly downsampled points [m].
        eyes: camera positions [m].
        height: height of each point above the support [m].
        spacing: distance between neighbouring points [m].
        enough: number of points that make an object of a part, even if they are a small fraction of the cluster.
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
        large = np.flatnonzero(np.bincount(part[part >= 0], minlength=1) > min(_MIN_SHARE * len(points), enough))
        things = [
            mine
            for mine in (part == k for k in large)
            if np.percentile(height[mine], 5) < _FOOT_M + waist
            and np.median(bend[mine]) > 0
            and waist <= _WAIST * depth[mine].max()
        ]
        if len(things) > 1:
            # Points of the seam, and pieces separated by occlusion, belong to the nearest part.
            return np.argmin([KDTree(points[mine]).query(points)[0] for mine in things], axis=0)
    return one


def heaped_things(points: Points, eyes: Eyes, spacing: float) -> Int[np.ndarray, "n"]:
    """Split a heap at seams and waists until no part has a seam or waist. Return each point's part number.

    The arguments are those of `touching_things`. Parts need not stand, because objects of a heap lie on each other.
    """
    part = touching_things(points, eyes, np.zeros(len(points)), spacing, _MIN_AREA / spacing**2)
    if not part.any():
        return part
    number = np.full(len(points), -1)
    for k in range(int(part.max()) + 1):
        rows = np.flatnonzero(part == k)
        number[rows] = number.max() + 1 + heaped_things(points[rows], eyes, spacing)
    return number


def _normals(points: Points, near: Int[np.ndarray, "n near"], eyes: Eyes) -> Points:
    """Return unit normals of planes fitted to neighbours, oriented to the camera that sees the plane most frontally."""
    normals = plane_normals(points[near])
    way = eyes[:, None] - points
    facing = (way * normals).sum(-1) / np.linalg.norm(way, axis=-1)
    best = np.take_along_axis(facing, np.abs(facing).argmax(0)[None], 0)[0]
    return normals * np.where(best < 0, -1.0, 1.0)[:, None]


def _outline(points: Points, normals: Points, near: Int[np.ndarray, "n near"]) -> Bool[np.ndarray, "n"]:
    """Return which points have no neighbour in a wide sector of their plane. In `near`, -1 means no neighbour."""
    near = near[:, 1 : 1 + _OUTLINE_NEIGHBOURS]
    way = points[near] - points[:, None]
    right = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    angle = np.arctan2(*(np.einsum("nkd,nd->nk", way, axis) for axis in (np.cross(normals, right), right)))
    # Sorting moves NaN to the end. Gaps to NaN do not count.
    angle = np.sort(np.where(near < 0, np.nan, angle), axis=1)
    first, last = angle[:, 0], np.nan_to_num(angle, nan=-np.inf).max(1)
    gaps = np.diff(angle, axis=1, append=np.nan)
    return ~(np.maximum(np.nan_to_num(gaps).max(1), first + 2 * np.pi - last) <= _OUTLINE_ANGLE)


def _bend(
    points: Points, normals: Points, one: Int[np.ndarray, "pairs"], other: Int[np.ndarray, "pairs"]
) -> Float[np.ndarray, "n"]:
    """Return each point's curvature [1/m], averaged over the point's pairs (`one`, `other`). Concave is negative."""
    way = points[other] - points[one]
    squared = np.einsum("pd,pd->p", way, way)
    # Close pairs measure noise rather than curvature.
    far = squared > (0.4 * _REACH_M) ** 2
    one, other, way, squared = one[far], other[far], way[far], squared[far]
    bend = np.einsum("pd,pd->p", normals[other] - normals[one], way) / squared
    total = np.bincount(one, bend, len(points)) + np.bincount(other, bend, len(points))
    count = np.bincount(one, minlength=len(points)) + np.bincount(other, minlength=len(points))
    return total / np.maximum(count, 1)


def _linked(kept: Bool[np.ndarray, "n"], links: Int[np.ndarray, "links 2"]) -> Int[np.ndarray, "n"]:
    """Return the connected component of each kept point, -1 for the other points."""
    one, other = links[kept[links].all(1)].T
    return np.where(kept, connected_parts(len(kept), one, other), -1)


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
    """Join clusters that occlusion split. Return each point's cluster: 0 for the largest, -1 for noise.

    Args:
        points: evenly dense points [m].
        distance: distance of each point from its camera [m].
        label: cluster of each point, 0 for the largest, -1 for noise.
        viewpoints: camera positions [m].
        link: distance up to which points were linked [m].
        settings: sizes and distances. Clusters are not joined if the result would exceed the largest object.
        support: support plane, or None if not seen. Clusters that end well above it are joined to other clusters.
    """
    members = rows_of(label)[:MAX_PIECES]
    pieces, many = [points[rows] for rows in members], len(members)
    small = [k for k in range(many) if extent(pieces[k]) <= settings.largest_object]
    hangs = [support is not None and _hangs(points[m], distance[m], support, viewpoints, link) for m in members]
    owner = list(range(many))
    for apart, a, b in sorted((_apart(pieces[a], pieces[b]), a, b) for a, b in combinations(small, 2)):
        group = [pieces[k] for k in small if owner[k] in (owner[a], owner[b])]
        if owner[a] == owner[b] or extent(np.vstack(group)) > settings.largest_object:
            continue
        one = _near(pieces[a], pieces[b], (hangs[a], hangs[b]), apart, link, settings, support)
        if one and any(_touch_in_image(pieces[a], pieces[b], eye, IMAGE_GAP_LINKS * link) for eye in viewpoints):
            root, leaf = sorted((owner[a], owner[b]))
            owner = [root if k == leaf else k for k in owner]
            # A hanging cluster joins only one standing cluster. Otherwise it would connect all objects near it.
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
    """Return True if clusters `apart` [m] from each other may be one object. Hanging clusters may be farther apart."""
    if support is None:  # One object behind another looks like a second side of the first object.
        return apart <= settings.unsupported_reach
    if apart <= max(link, settings.gap) or share_within(b @ support.axes, a @ support.axes) >= OUTLINE_SHARE:
        return True
    reach = [
        NEAR_LINKS * link if _may_stand(piece, other, support) else settings.hanging_reach
        for piece, other, hangs in ((a, b, hang[0]), (b, a, hang[1]))
        if hangs
    ]
    return apart <= max(reach, default=0.0)


def _hangs(piece: Points, distance: Float[np.ndarray, "n"], support: FlatPart, viewpoints: Eyes, link: float) -> bool:
    """Return True if a cluster floats above the support and does not hide the place below it from any camera."""
    if support.clearance(piece, distance).min() <= FLOATING_LINKS * link:
        return False
    below = piece - support.height(piece)[:, None] * support.plane.normal
    for eye in viewpoints:
        (seen, near), (foot, far) = directions(piece, eye), directions(below, eye)
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
    (one, near), (other, far) = directions(a, eye), directions(b, eye)
    return _apart(one, other) <= gap / min(float(np.median(near)), float(np.median(far)))


def directions(points: Points, eye: Vector) -> tuple[Points, Float[np.ndarray, "n"]]:
    """Return unit directions from a camera to points, and the distances [m]."""
    away = np.linalg.norm(points - eye, axis=1).clip(1e-6)
    return (points - eye) / away[:, None], away


def _apart(a: Points, b: Float[np.ndarray, "m 3"]) -> float:
    return float(KDTree(a).query(b)[0].min())


def share_within(points: Float[np.ndarray, "n k"], corners: Float[np.ndarray, "m k"]) -> float:
    """Return the fraction of points in the convex hull of `corners`, 0 for a flat hull."""
    if (hull := convex_hull(corners)) is None:
        return 0.0
    return float((points @ hull.equations[:, :-1].T + hull.equations[:, -1] <= 0).all(1).mean())
