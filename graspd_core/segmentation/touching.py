"""Things that touch: one cluster of points, and a seam or a narrow waist in it that parts two which both stand.

A surface that turns towards itself over a finger's breadth is a seam; things of one height that touch along a line are
joined by a bridge of points across their tops, far narrower than either. One thing may have such places as well, where
a leg meets a body. So this is a doubt, never a cut. Two boxes that stand flush are one to a camera.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from graspd_core.pointcloud.point_cloud import least_axes

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


def touching_things(
    points: Float[np.ndarray, "n 3"],
    eyes: Float[np.ndarray, "views 3"],
    height: Float[np.ndarray, "n"],
    spacing: float,
) -> tuple[Float[np.ndarray, "3"], ...]:
    """Middles of the parts of a cluster that seams and waists set apart and that stand on their own; empty where there
    is one.

    Args:
        points: thinned evenly [m].
        eyes: where the cameras stood [m].
        height: of the points above the support [m].
        spacing: of the points [m].
    """
    from scipy.spatial import KDTree

    if len(points) < 2 * _NEIGHBOURS:
        return ()
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
            return tuple(points[mine].mean(0) for mine in things)
    return ()


def _normals(
    points: Float[np.ndarray, "n 3"], near: Int[np.ndarray, "n near"], eyes: Float[np.ndarray, "views 3"]
) -> Float[np.ndarray, "n 3"]:
    """Unit normals of planes through neighbours, towards the camera that sees each the least from the side."""
    spread = points[near] - points[near].mean(1, keepdims=True)
    normals = least_axes(spread.transpose(0, 2, 1) @ spread)
    way = eyes[:, None] - points
    facing = (way * normals).sum(-1) / np.linalg.norm(way, axis=-1)
    best = np.take_along_axis(facing, np.abs(facing).argmax(0)[None], 0)[0]
    return normals * np.where(best < 0, -1.0, 1.0)[:, None]


def _outline(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], near: Int[np.ndarray, "n near"]
) -> Bool[np.ndarray, "n"]:
    """Which points have a wide sector about them, in the surface, without any of their neighbours; -1 is none."""
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
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    one: Int[np.ndarray, "pairs"],
    other: Int[np.ndarray, "pairs"],
) -> Float[np.ndarray, "n"]:
    """Mean curvature about each point [1/m], of pairs `_REACH_M` apart at most; negative where it is hollow."""
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
    """The connected part that each of the kept points is of; -1 of the others."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    one, other = links[kept[links].all(1)].T
    graph = coo_matrix((np.ones(len(one), dtype=bool), (one, other)), shape=(len(kept), len(kept)))
    return np.where(kept, connected_components(graph, directed=False)[1], -1)
