"""Things that touch: one cluster of points, and a seam in it that parts two which both stand on the support.

A surface that turns towards itself over a finger's breadth is a seam; one thing may have one as well, where a leg meets
a body. So this is a doubt, never a cut. Two things whose surfaces go on in each other have no seam that a camera sees.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

# Points so far apart tell how a surface bends [m], and how much bend inwards is a seam [1/m]: a bowl's inside, of a
# radius over 5 cm, is none, nor is a camera's noise.
_REACH_M, _SEAM_BEND = 0.013, 20.0
# Points on one side of a seam are linked over this many spacings.
_LINK_SPACINGS = 1.7
# Each of two things has this share of the points at least, and some of its seen surface so near to the support [m].
_MIN_SHARE, _FOOT_M = 0.12, 0.03
_NEIGHBOURS = 24


def touching_things(
    points: Float[np.ndarray, "n 3"],
    eyes: Float[np.ndarray, "views 3"],
    height: Float[np.ndarray, "n"],
    spacing: float,
) -> tuple[Float[np.ndarray, "3"], ...]:
    """Middles of the parts of a cluster that seams set apart and that stand on their own; empty where there is one.

    Args:
        points: thinned evenly [m].
        eyes: where the cameras stood [m].
        height: of the points above the support [m].
        spacing: of the points [m].
    """
    if len(points) < 2 * _NEIGHBOURS:
        return ()
    inward = _bend(points, _normals(points, eyes)) < -_SEAM_BEND
    part = _linked(points, np.flatnonzero(~inward), _LINK_SPACINGS * spacing)
    large = np.flatnonzero(np.bincount(part[part >= 0], minlength=1) > _MIN_SHARE * len(points))
    standing = [part == k for k in large if np.percentile(height[part == k], 5) < _FOOT_M]
    return tuple(points[mine].mean(0) for mine in standing) if len(standing) > 1 else ()


def _normals(points: Float[np.ndarray, "n 3"], eyes: Float[np.ndarray, "views 3"]) -> Float[np.ndarray, "n 3"]:
    """Unit normals of planes through neighbours, towards the camera that sees each the least from the side."""
    from scipy.spatial import KDTree

    near = points[KDTree(points).query(points, k=_NEIGHBOURS)[1]]
    near = near - near.mean(1, keepdims=True)
    normals = np.linalg.eigh(near.transpose(0, 2, 1) @ near)[1][:, :, 0]
    way = eyes[:, None] - points
    facing = (way * normals).sum(-1) / np.linalg.norm(way, axis=-1)
    best = np.take_along_axis(facing, np.abs(facing).argmax(0)[None], 0)[0]
    return normals * np.where(best < 0, -1.0, 1.0)[:, None]


def _bend(points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Mean curvature about each point [1/m], of pairs about `_REACH_M` apart; negative where the surface is hollow."""
    from scipy.spatial import KDTree

    one, other = KDTree(points).query_pairs(_REACH_M, output_type="ndarray").T
    way = points[other] - points[one]
    squared = (way**2).sum(1)
    # Near ones say more of noise than of the surface.
    far = squared > (0.4 * _REACH_M) ** 2
    one, other, way, squared = one[far], other[far], way[far], squared[far]
    bend = ((normals[other] - normals[one]) * way).sum(1) / squared
    total = np.bincount(one, bend, len(points)) + np.bincount(other, bend, len(points))
    return total / np.maximum(np.bincount(one, minlength=len(points)) + np.bincount(other, minlength=len(points)), 1)


def _linked(points: Float[np.ndarray, "n 3"], rows: Int[np.ndarray, "rows"], link: float) -> Int[np.ndarray, "n"]:
    """The connected part that each of some rows is of; -1 of the others."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    part = np.full(len(points), -1)
    if len(rows) == 0:
        return part
    pairs = KDTree(points[rows]).query_pairs(link, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), dtype=bool), tuple(pairs.T)), shape=(len(rows), len(rows)))
    part[rows] = connected_components(graph, directed=False)[1]
    return part
