"""Approximate convex decomposition of an object by greedy planar cuts, in the object frame [m]. Hollows stay hollow.

Each part is the convex hull of a cluster of surface points. A cluster's bulge is how far the hull extends outside
the object, by the signed distance grid. Each cut divides the cluster with the largest bulge. Cutting ends when all
bulges are within tolerance or there are enough parts. Then touching clusters are joined.
"""

from __future__ import annotations

import heapq
from itertools import count

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, QhullError

from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.sdf import GridSDF, interpolate
from graspd_core.mesh.topology import drop_strays, scaled_normals
from graspd_core.types import TriangleMesh

SURFACE_POINTS = 6000
# How many points and hull samples measure a bulge during cutting. The final parts are hulls of all their points.
TRIAL_POINTS, TRIAL_SAMPLES = 320, 100
# Candidate cuts lie between this many slices of equal thickness. Segments between pairs of points score the cuts. Hulls
# then decide between the best cuts. Roberts' sequence spreads the pairs, as fractions of the list of points.
SLICES, SHORTLIST = 12, 3
PAIRS = np.modf(np.arange(1, 2001)[:, None] * [0.7548776662, 0.5698402910])[0]
# The bulge of two joined clusters is estimated on segments between all pairs of this many points of each cluster.
PAIRED_POINTS, PAIRED_QUANTILE = 12, 0.95
# Cutting continues to this many times `max_parts`, because many parts are joined again.
SURPLUS = 1.5
SHARES = (np.arange(TRIAL_SAMPLES) + 0.5) / TRIAL_SAMPLES
# Places within a triangle (barycentric), spread by the golden ratio.
_root, _along = np.sqrt(np.modf(SHARES * TRIAL_SAMPLES * 0.618034)[0]), SHARES
SPOTS = np.stack([1 - _root, _root * (1 - _along), _root * _along], 1)

# Neighbouring parts overlap by twice this [m], so that nothing slips between them.
OVERLAP = 0.0005
# Limits for the number of vertices of a part. The parts share `ALL_VERTICES` equally between these limits.
FEWEST_VERTICES, MOST_VERTICES, ALL_VERTICES = 48, 256, 1536
# Points of a large hull that are considered for each vertex of its simplified hull.
CHOICE = 12

# The number of rows is free, because the clusters of a list differ in size.
Points = Float[np.ndarray, "_ 3"]


# Direction and offset of a plane. A point p lies below the plane if p @ direction is at most the offset, else above.
_Cut = tuple[Float[np.ndarray, "3"], float]


def convex_parts(
    mesh: TriangleMesh,
    sdf: GridSDF,
    *,
    tolerance: float = 0.002,
    max_parts: int = 64,
    surface_points: int = SURFACE_POINTS,
) -> tuple[TriangleMesh, ...]:
    """Return convex closed meshes whose union approximates the object.

    Args:
        sdf: the object's signed distance grid.
        tolerance: largest bulge of a part [m]. 98 % of a part's surface lies at most this far outside the object.
        max_parts: maximum number of parts. If the object needs more, the bulges of some parts exceed the tolerance.
        surface_points: number of surface samples to cluster. Up to half as many mesh vertices are added.
    """
    points = np.vstack([_thin(mesh.vertices[np.unique(mesh.faces)], surface_points // 2),
                        surface_samples(mesh, surface_points, 0)[0]])  # fmt: skip
    if convex_hull(points) is None:
        return (_slab(points),)
    clusters = _join(sdf, _cut_up(sdf, points, tolerance, round(SURPLUS * max_parts)), tolerance, max_parts)
    corners = int(np.clip(ALL_VERTICES // len(clusters), FEWEST_VERTICES, MOST_VERTICES))
    return tuple(limited_hull(cluster, corners) for cluster in clusters)


def _cut_up(sdf: GridSDF, points: Points, tolerance: float, most: int) -> list[Points]:
    """Cut points into at most `most` clusters, largest bulge first, until all bulges are within `tolerance` [m]."""
    ticket = count()
    heap: list[tuple[float, int, Points]] = []
    done: list[Points] = []

    def sort(cluster: Points) -> None:
        bulge = _bulge(sdf, _thin(cluster, 2 * TRIAL_POINTS))
        if bulge > tolerance + _blur(sdf, cluster):
            # The ticket breaks ties, because arrays have no order.
            heapq.heappush(heap, (-bulge, next(ticket), cluster))
        else:
            done.append(cluster)

    sort(points)
    while heap and len(heap) + len(done) < most:
        _, _, cluster = heapq.heappop(heap)
        cut = _best_cut(sdf, cluster)
        if cut is None:
            done.append(cluster)
            continue
        direction, offset = cut
        along = cluster @ direction
        sort(cluster[along <= offset + OVERLAP])
        sort(cluster[along >= offset - OVERLAP])
    return done + [cluster for _, _, cluster in heap]


def _best_cut(sdf: GridSDF, cluster: Points) -> _Cut | None:
    cuts = _promising_cuts(sdf, cluster)
    trial = _thin(cluster, TRIAL_POINTS)
    return min(cuts, key=lambda cut: _bulge_left(sdf, trial, cut), default=None)


def _promising_cuts(sdf: GridSDF, cluster: Points) -> list[_Cut]:
    """Return at most `SHORTLIST` cuts, best first. Each is the best across one coordinate axis or principal axis.

    Segments between points of a cluster lie in its hull. So the bulge is measured by how far the midpoints of
    segments lie outside the object. A cut leaves only segments with both ends on one side. On each side, the mean of
    the distances times the number of points estimates the bulge's volume. So one set of segments scores all cuts.
    """
    pairs = (PAIRS * len(cluster)).astype(int)
    outside = (_outside(sdf, cluster[pairs].mean(1)) - _blur(sdf, cluster)).clip(0)
    pairs, outside = pairs[outside > 0], outside[outside > 0]
    directions = np.vstack([np.linalg.eigh(np.cov(cluster.T))[1].T[::-1], np.eye(3)])
    along = cluster @ directions.T
    low, span = along.min(0), np.ptp(along, axis=0)
    slices = np.minimum((along - low) * (SLICES / np.maximum(span, 1e-12)), SLICES - 1).astype(int)
    below = _sums_below(slices, np.ones(len(cluster)))
    above = len(cluster) - below
    left_below = _sums_below(slices[pairs].max(1), outside)
    left_above = outside.sum() - _sums_below(slices[pairs].min(1), outside)
    share = np.arange(1, SLICES) / SLICES
    # If no segment is outside the object, cuts near the middle are preferred.
    left = left_below / np.maximum(below, 1) + left_above / np.maximum(above, 1) + 1e-9 * np.abs(share - 0.5)
    # Fewer than four points span no hull. A side thinner than the overlap would get the other side's points again.
    thin = span[:, None] * np.minimum(share, 1 - share) < 2 * OVERLAP
    left[(below < 4) | (above < 4) | thin] = np.inf
    best = left.argmin(1)
    order = [k for k in np.argsort(left.min(1)) if np.isfinite(left[k, best[k]])]
    return [(directions[k], float(low[k] + share[best[k]] * span[k])) for k in order[:SHORTLIST]]


def _sums_below(
    slices: Int[np.ndarray, "n directions"], weights: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "directions cuts"]:
    directions = slices.shape[1]
    flat = (slices + SLICES * np.arange(directions)).ravel()
    # For empty weights, NumPy returns integers.
    sums = np.bincount(flat, np.repeat(weights, directions), minlength=SLICES * directions).astype(float, copy=False)
    return np.cumsum(sums.reshape(directions, SLICES), axis=1)[:, :-1]


def _bulge_left(sdf: GridSDF, points: Points, cut: _Cut) -> float:
    direction, offset = cut
    below = points @ direction <= offset
    hulls = [hull for hull in (convex_hull(points[below]), convex_hull(points[~below])) if hull is not None]
    return float(sum(hull.area * _outside(sdf, _hull_samples(hull)).mean() for hull in hulls))


def _join(sdf: GridSDF, clusters: list[Points], tolerance: float, most: int) -> list[Points]:
    """Join touching clusters, least bulge first. Stop above `tolerance` [m] if at most `most` clusters are left."""
    alive = dict(enumerate(clusters))
    boxes = {name: (cluster.min(0), cluster.max(0) + OVERLAP) for name, cluster in alive.items()}
    heap: list[tuple[float, bool, int, int]] = []

    def offer(one: int, others: list[int]) -> None:
        (low, high), corners = boxes[one], np.array([boxes[other] for other in others]).reshape(-1, 2, 3)
        touching = ((corners[:, 0] <= high) & (low <= corners[:, 1])).all(1)
        near = [other for other, touches in zip(others, touching, strict=True) if touches]
        for other, bulge in zip(near, _bulges_between(sdf, alive[one], [alive[k] for k in near]), strict=True):
            heapq.heappush(heap, (bulge, False, one, other))

    for one in alive:
        offer(one, [other for other in alive if other < one])
    names = count(len(clusters))
    while heap:
        bulge, measured, one, other = heapq.heappop(heap)
        if bulge > tolerance and len(alive) <= most:
            break
        if one not in alive or other not in alive:
            continue
        if not measured:
            union = np.vstack([_thin(alive[k], TRIAL_POINTS) for k in (one, other)])
            heapq.heappush(heap, (_bulge(sdf, union), True, one, other))
            continue
        union = np.vstack([alive.pop(one), alive.pop(other)])
        name = next(names)
        boxes[name] = (union.min(0), union.max(0) + OVERLAP)
        others = list(alive)
        alive[name] = union
        offer(name, others)
    return list(alive.values())


def _bulges_between(sdf: GridSDF, one: Points, others: list[Points]) -> Float[np.ndarray, "_"]:
    if not others:
        return np.zeros(0)
    first, *rest = (_evenly(points, PAIRED_POINTS)[:, None] for points in (one, *others))
    middles = (first[:, None] + np.array(rest)[:, None]) / 2
    return np.quantile(_outside(sdf, middles.reshape(-1, 3)).reshape(len(rest), -1), PAIRED_QUANTILE, axis=1)


def _bulge(sdf: GridSDF, cluster: Points) -> float:
    hull = convex_hull(cluster)
    return 0.0 if hull is None else _quantile(_outside(sdf, _hull_samples(hull)), 0.98)


def _blur(sdf: GridSDF, cluster: Points) -> float:
    return _quantile(_outside(sdf, _thin(cluster, 2 * TRIAL_POINTS)), 0.9)


def _quantile(values: Float[np.ndarray, "_"], share: float) -> float:
    rank = min(int(share * len(values)), len(values) - 1)
    return float(np.partition(values, rank)[rank])


def _hull_samples(hull: ConvexHull) -> Float[np.ndarray, "_ 3"]:
    """Return points spread evenly over the hull's area, faster than `surface_samples` does."""
    a, b, c = hull.points[hull.simplices].transpose(1, 0, 2)
    # The sums are of twice the area. `np.cross` would take as long as the rest of the function.
    (ux, uy, uz), (vx, vy, vz) = (b - a).T, (c - a).T
    total = np.cumsum(np.sqrt((uy * vz - uz * vy) ** 2 + (uz * vx - ux * vz) ** 2 + (ux * vy - uy * vx) ** 2))
    chosen = np.minimum(np.searchsorted(total, SHARES * total[-1]), len(total) - 1)
    return SPOTS[:, :1] * a[chosen] + SPOTS[:, 1:2] * b[chosen] + SPOTS[:, 2:] * c[chosen]


def _outside(sdf: GridSDF, points: Points) -> Float[np.ndarray, "_"]:
    unit = (torch.as_tensor(points, dtype=sdf.field.dtype) - sdf.origin) / sdf.half - 1
    return interpolate(sdf.field[:1], unit)[0].clamp_min(0.0).numpy()


def _thin(points: Points, most: int) -> Points:
    return points if len(points) <= most else _evenly(points, most)


def _evenly(points: Points, count: int) -> Float[np.ndarray, "count 3"]:
    return points[np.linspace(0, len(points) - 1, count).astype(int)]


def even_directions(count: int) -> Float[np.ndarray, "3 count"]:
    """Return unit vectors spread evenly over the sphere on a golden spiral, one per column."""
    turn = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * turn / count), np.pi * (1 + 5**0.5) * turn
    return np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)])


def limited_hull(points: Points, most: int) -> TriangleMesh:
    """Return the hull of at most `most` points, which approximates the hull of all. For flat points, return a plate."""
    hull = convex_hull(points)
    if hull is None:
        return _slab(points)
    corners = points[hull.vertices]
    if len(corners) > most:
        corners = _thin(corners, CHOICE * most)
        chosen = set((corners @ even_directions(most // 2)).argmax(0).tolist())
        while len(chosen) < most:
            found = convex_hull(corners[sorted(chosen)])
            if found is None:
                # The extremes lie in one plane, on a line or in a point. Add the extremes along the principal axes.
                along = corners @ np.linalg.eigh(np.cov(corners.T))[1]
                ends = {*along.argmin(0).tolist(), *along.argmax(0).tolist()}
                chosen |= ends if not ends <= chosen else set(range(len(corners)))
                continue
            gaps = (np.c_[corners, np.ones(len(corners))] @ found.equations.T).max(1)
            chosen |= set(np.argsort(gaps)[-min(4, most - len(chosen)) :].tolist())
        corners = corners[sorted(chosen)]
    return hull_surface(corners)


def _slab(points: Points) -> TriangleMesh:
    """Return a flat cluster as a plate that is one millimetre thick along the cluster's thinnest direction."""
    _, principal = np.linalg.eigh(np.cov(points.T))
    lift = principal[:, 0] * OVERLAP
    spread = np.vstack([points - lift, points + lift])
    hull = convex_hull(spread)
    if hull is not None:
        return hull_surface(spread[hull.vertices])
    # The points lie on a line or coincide, so a small box is put around them.
    corners = np.stack(np.meshgrid(*[(-OVERLAP, OVERLAP)] * 3), -1).reshape(-1, 3)
    return hull_surface(np.vstack([points.min(0) + corners, points.max(0) + corners]))


def convex_hull(points: Float[np.ndarray, "n k"]) -> ConvexHull | None:
    """Return SciPy's convex hull of points, or None if the points are too few, flat, or not finite."""
    try:
        return ConvexHull(points)
    except (QhullError, ValueError):
        return None


def hull_surface(corners: Points) -> TriangleMesh:
    """Return the convex hull of points as a mesh whose faces wind outwards."""
    hull = ConvexHull(corners)
    inward = (scaled_normals(corners, hull.simplices) * hull.equations[:, :3]).sum(1) < 0
    faces = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices).astype(np.int64)
    return drop_strays(TriangleMesh(corners, faces))[0]
