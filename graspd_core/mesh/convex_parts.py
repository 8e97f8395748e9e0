"""Convex parts that fill an object and leave its hollows hollow, by greedy planar cuts.

A cluster of surface points stands for the convex hull of its points. The cluster whose hull reaches farthest outside
the object (measured in the signed distance field) is cut by the plane that leaves the least of that, until no hull
bulges by more than the tolerance or the parts are used up. All in metres, in the object's frame.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from itertools import count

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError
from torch.nn.functional import grid_sample

from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.sdf import GridSDF, build_sdf
from graspd_core.types import TriangleMesh

SURFACE_POINTS = 6000
# Points and hull samples that candidate cuts are compared on; the parts themselves are hulls of all their points.
TRIAL_POINTS, TRIAL_SAMPLES = 160, 100
CUTS = (0.2, 0.5, 0.8)
# Cuts go on to this many times the parts asked for, because many are joined again.
SURPLUS = 1.5
SHARES = (np.arange(TRIAL_SAMPLES) + 0.5) / TRIAL_SAMPLES
# Places within a triangle (barycentric), spread by the golden ratio.
_root, _along = np.sqrt(np.modf(SHARES * TRIAL_SAMPLES * 0.618034)[0]), SHARES
SPOTS = np.stack([1 - _root, _root * (1 - _along), _root * _along], 1)

# Parts overlap by twice this [m], so that nothing slips between them.
OVERLAP = 0.0005
# Corners of a part: the fewer the parts, the more each can have.
FEWEST_VERTICES, MOST_VERTICES, ALL_VERTICES = 48, 256, 1536

# Any number of rows: clusters of one list differ in theirs.
Points = Float[np.ndarray, "_ 3"]


@dataclass(frozen=True)
class _Cut:
    """The points with `points @ direction` below and above `offset`."""

    direction: Float[np.ndarray, "3"]
    offset: float


def convex_parts(mesh: TriangleMesh, *, tolerance: float = 0.002, max_parts: int = 64) -> tuple[TriangleMesh, ...]:
    """Convex closed meshes whose union approximates the object.

    Args:
        tolerance: how far a part may reach outside the object [m] (98th percentile of its surface) before it is cut.
        max_parts: parts at most; an object that needs more keeps its last parts bulging.
    """
    points = np.vstack([_thin(mesh.vertices[np.unique(mesh.faces)], SURFACE_POINTS // 2),
                        surface_samples(mesh, SURFACE_POINTS, 0)[0]])  # fmt: skip
    if _hull(points) is None:
        return (_slab(points),)
    # The grid is finer than the planner's, and tight: walls are what it must see.
    sdf = build_sdf(mesh, resolution=56, padding=0.005)
    clusters = _join(sdf, _cut_up(sdf, points, tolerance, round(SURPLUS * max_parts)), tolerance, max_parts)
    corners = int(np.clip(ALL_VERTICES // len(clusters), FEWEST_VERTICES, MOST_VERTICES))
    return tuple(limited_hull(cluster, corners) for cluster in clusters)


def _cut_up(sdf: GridSDF, points: Points, tolerance: float, most: int) -> list[Points]:
    """Cut the worst cluster until none bulges by more than the tolerance, or there are `most`."""
    ticket = count()
    heap: list[tuple[float, int, Points]] = []
    done: list[Points] = []

    def sort(clusters: list[Points]) -> None:
        trials = [_thin(cluster, 2 * TRIAL_POINTS) for cluster in clusters]
        for cluster, trial, (bulge, _) in zip(clusters, trials, _bulges(sdf, trials), strict=True):
            # Where details are finer than the grid, the surface itself looks outside, and no cut would mend that.
            blur = np.quantile(_distance(sdf, trial).clip(0), 0.9)
            if bulge > tolerance + blur:
                # The ticket settles ties, because arrays have no order.
                heapq.heappush(heap, (-bulge, next(ticket), cluster))
            else:
                done.append(cluster)

    sort([points])
    while heap and len(heap) + len(done) < most:
        _, _, cluster = heapq.heappop(heap)
        cut = _best_cut(sdf, cluster)
        if cut is None:
            done.append(cluster)
            continue
        along = cluster @ cut.direction
        sort([cluster[along <= cut.offset + OVERLAP], cluster[along >= cut.offset - OVERLAP]])
    return done + [cluster for _, _, cluster in heap]


def _join(sdf: GridSDF, clusters: list[Points], tolerance: float, most: int) -> list[Points]:
    """Join touching clusters, least bulge first, while that stays in tolerance, and on until `most` are left."""
    alive = dict(enumerate(clusters))
    heap: list[tuple[float, int, int]] = []

    def offer(one: int, others: list[int]) -> None:
        touching = [other for other in others if _touch(alive[one], alive[other])]
        unions = [np.vstack([_thin(alive[k], TRIAL_POINTS) for k in (one, other)]) for other in touching]
        for other, (bulge, _) in zip(touching, _bulges(sdf, unions) if unions else [], strict=True):
            heapq.heappush(heap, (bulge, one, other))

    for one in alive:
        offer(one, [other for other in alive if other < one])
    while heap:
        bulge, one, other = heapq.heappop(heap)
        if bulge > tolerance and len(alive) <= most:
            break
        if one in alive and other in alive:
            union = np.vstack([alive.pop(one), alive.pop(other)])
            name = max(one, other, *alive, len(clusters)) + 1
            alive[name] = union
            offer(name, [other for other in alive if other != name])
    return list(alive.values())


def _touch(a: Points, b: Points) -> bool:
    return bool((a.min(0) <= b.max(0) + OVERLAP).all() and (b.min(0) <= a.max(0) + OVERLAP).all())


def _best_cut(sdf: GridSDF, cluster: Points) -> _Cut | None:
    """The cut with the least volume of bulge left on both sides; None when nothing can be cut."""
    trial = _thin(cluster, TRIAL_POINTS)
    _, principal = np.linalg.eigh(np.cov(trial.T))
    cuts, sides = [], []
    for direction in np.vstack([np.eye(3), principal.T]):
        along = trial @ direction
        low, span = along.min(), np.ptp(along)
        for share in CUTS:
            cut = _Cut(direction, float(low + share * span))
            below = along <= cut.offset
            # Fewer than four points a side span no hull.
            if below.sum() >= 4 and (~below).sum() >= 4:
                cuts.append(cut)
                sides += [trial[below], trial[~below]]
    if not cuts:
        return None
    left = np.array([volume for _, volume in _bulges(sdf, sides)]).reshape(-1, 2).sum(1)
    return cuts[int(left.argmin())]


def _bulges(sdf: GridSDF, clusters: list[Points]) -> list[tuple[float, float]]:
    """How far each cluster's hull reaches outside the object: 98th percentile [m], and area times mean [m³]."""
    hulls = [_hull(cluster) for cluster in clusters]
    samples = [np.zeros((TRIAL_SAMPLES, 3)) if hull is None else _hull_samples(hull) for hull in hulls]
    outside = _distance(sdf, np.concatenate(samples)).clip(0).reshape(len(hulls), TRIAL_SAMPLES)
    far, mean = np.quantile(outside, 0.98, axis=1), outside.mean(1)
    return [
        (0.0, 0.0) if hull is None else (float(f), float(m * hull.area))
        for hull, f, m in zip(hulls, far, mean, strict=True)
    ]


def _hull(points: Points) -> ConvexHull | None:
    """None where the points are too few or lie in a plane."""
    if len(points) < 4:
        return None
    try:
        return ConvexHull(points)
    except QhullError:
        return None


def _hull_samples(hull: ConvexHull) -> Float[np.ndarray, "_ 3"]:
    """One point per equal share of the hull's area. Leaner than `surface_samples`: called thousands of times."""
    a, b, c = hull.points[hull.simplices].transpose(1, 0, 2)
    total = np.cumsum(np.sqrt((np.cross(b - a, c - a) ** 2).sum(1)))
    chosen = np.minimum(np.searchsorted(total, SHARES * total[-1]), len(total) - 1)
    return SPOTS[:, :1] * a[chosen] + SPOTS[:, 1:2] * b[chosen] + SPOTS[:, 2:] * c[chosen]


def _distance(sdf: GridSDF, points: Points) -> Float[np.ndarray, "_"]:
    """φ alone, which is all that is asked here and a quarter of `sample_sdf`'s work."""
    unit = (torch.as_tensor(points, dtype=sdf.field.dtype) - sdf.origin) / sdf.half - 1
    field = sdf.field[None, :1].permute(0, 1, 4, 3, 2)
    return grid_sample(field, unit[None, None, None], align_corners=True, padding_mode="border").flatten().numpy()


def _thin(points: Points, most: int) -> Points:
    """Every n-th point: surface samples come in no particular place order within a face, so this is even."""
    if len(points) <= most:
        return points
    return points[np.linspace(0, len(points) - 1, most).astype(int)]


def limited_hull(points: Points, most: int) -> TriangleMesh:
    """The hull of at most `most` of the points: extremes along even directions, then whichever is farthest out."""
    hull = _hull(points)
    if hull is None:
        return _slab(points)
    corners = points[hull.vertices]
    if len(corners) > most:
        turn = np.arange(most // 2) + 0.5
        polar, azimuth = np.arccos(1 - 2 * turn / len(turn)), np.pi * (1 + 5**0.5) * turn
        rays = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)])
        chosen = set((corners @ rays).argmax(0).tolist())
        while len(chosen) < most:
            found = _hull(corners[sorted(chosen)])
            if found is None:
                # All even directions ended in one plane, or in less: so thin that only its own axes span it.
                along = corners @ np.linalg.eigh(np.cov(corners.T))[1]
                ends = {*along.argmin(0).tolist(), *along.argmax(0).tolist()}
                chosen |= ends if not ends <= chosen else set(range(len(corners)))
                continue
            planes = found.equations
            gaps = (corners @ planes[:, :3].T + planes[:, 3]).max(1)
            chosen |= set(np.argsort(gaps)[-min(4, most - len(chosen)) :].tolist())
        corners = corners[sorted(chosen)]
    return _closed(corners)


def _slab(points: Points) -> TriangleMesh:
    """A flat cluster as a plate one millimetre thick, across its thinnest direction."""
    _, principal = np.linalg.eigh(np.cov(points.T))
    lift = principal[:, 0] * OVERLAP
    spread = np.vstack([points - lift, points + lift])
    hull = _hull(spread)
    if hull is not None:
        return _closed(spread[hull.vertices])
    # All on a line, or one point: a small box about them.
    corners = np.stack(np.meshgrid(*[(-OVERLAP, OVERLAP)] * 3), -1).reshape(-1, 3)
    return _closed(np.vstack([points.min(0) + corners, points.max(0) + corners]))


def _closed(corners: Points) -> TriangleMesh:
    """The hull's surface, wound outwards."""
    hull = ConvexHull(corners)
    a, b, c = corners[hull.simplices].transpose(1, 0, 2)
    inward = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(1) < 0
    faces = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices).astype(np.int64)
    used, compact = np.unique(faces, return_inverse=True)
    return TriangleMesh(corners[used], compact.reshape(-1, 3))
