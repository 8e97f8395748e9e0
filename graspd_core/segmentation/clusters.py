"""Things in a scene: points linked to their neighbours, and pieces of one thing that occlusion set apart."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from graspd_core.config import SegmentationConfig
from graspd_core.pointcloud.point_cloud import longest_side

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


def link_length(points: Float[np.ndarray, "n 3"], settings: SegmentationConfig) -> float:
    """Points this near belong together [m]: less than the gap, unless the points are too sparse."""
    from scipy.spatial import KDTree

    if len(points) < 5:
        return settings.gap
    some = points[:: max(1, len(points) // SPACING_SAMPLES)]
    spacing = float(np.median(KDTree(points).query(some, k=5)[0][:, -1]))
    link = LINK_SHARE_OF_GAP * settings.gap
    return link if DENSE_SPACING_RATIO * spacing <= link else min(SPARSE_LINK_RATIO * spacing, settings.max_link)


def link_points(
    points: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, "n"], link: float, neighbour_share: float
) -> Int[np.ndarray, "n"]:
    """Clusters of evenly dense points, numbered from the largest; -1: a stray.

    As in DBSCAN, only points with enough neighbours carry a cluster on; the others join the nearest that does.

    Args:
        points: one a voxel [m].
        weight: how well each was seen: full points in its voxel, those that any camera would see taken as equal.
        link: points this near are neighbours [m].
        neighbour_share: points with a smaller share of the median number of neighbours are strays.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

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
    both = pairs[core[pairs].all(1)]
    graph = coo_matrix((np.ones(len(both), dtype=bool), tuple(both.T)), shape=(len(points), len(points)))
    _, component = connected_components(graph, directed=False)
    label[core] = component[core]
    edge = ~core & seen
    near, nearest = KDTree(points[core]).query(points[edge], distance_upper_bound=link)
    joins = np.flatnonzero(edge)[np.isfinite(near)]
    label[joins] = label[core][np.asarray(nearest)[np.isfinite(near)]]
    return renumber(label)


def extent(points: Float[np.ndarray, "n 3"]) -> float:
    """Length along the longest principal axis [m], however the points are turned."""
    centred = points - points.mean(0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    return longest_side(centred @ axes)


def renumber(label: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Number clusters from the largest, without gaps; strays (-1) stay."""
    answer = np.full(len(label), -1)
    known = label >= 0
    count = np.bincount(label[known])
    rank = np.zeros(len(count), dtype=int)
    rank[np.argsort(-count, kind="stable")] = np.arange(len(count))
    answer[known] = np.take(rank, label[known])
    return answer
