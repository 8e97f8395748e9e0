"""Which flat part of a scene is what things stand on, which are background, and which a face of a thing.

A support has the cameras on its free side, is larger than what stands on it, and something stands on it: comes down to
it, lies over its seen part, and is of a size to be grasped. A face of a convex body has nothing on its free side. The
floor of a tray has only a rim that is as wide as itself. A wall has things before it that do not come down to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from graspd_core.config import SegmentationConfig
from graspd_core.perception.cloud.point_cloud import Eyes, Points, convex_hull
from graspd_core.perception.cloud.voxel_downsample import Mask, VoxelScene
from graspd_core.perception.segment.clusters import extent, link_length, link_points
from graspd_core.perception.segment.planes import FlatPart

# Share of its width by which the lowest seen point of a thing may be above its support.
HIDDEN_HEIGHT_SHARE = 0.5
# Lines of sight this near to upright [cosine, 15°] show no sides, however high: what they end on rests on something.
MIN_UPRIGHT_COSINE = 0.966
# Less of a plane's hull seen than this share, it is a slice through several things.
MIN_SEEN_SHARE = 0.3
# Points down to so many tolerances below a part, as many as this share of its own, are a body's other faces.
EDGE_BAND_TOLERANCES, EDGE_BAND_SHARE = 4.0, 0.25
# A point is on a flat part, and not where the part's plane cuts through a thing, if of the points within so many
# tolerances at least this share is on the plane too: on a wall that it cuts squarely, four in ten are.
NEIGHBOURHOOD_TOLERANCES, ON_PLANE_SHARE = 3.0, 0.6
# Of so many points around it is asked; where there are more, as noise makes it wide, some of them stand for all.
NEIGHBOUR_SAMPLES = 50
# Beyond so many clusters the rest is noise.
MAX_CLUSTERS = 20


@dataclass(frozen=True)
class Ground:
    """What a scene's things stand on, and what is left when all background is taken away.

    Attributes:
        support: None where nothing is seen to stand on anything.
        background: large flat parts that are no support: walls, floors, an empty table.
        left: which of the scene's voxels may belong to things.
    """

    support: FlatPart | None
    background: tuple[FlatPart, ...]
    left: Mask


def find_ground(scene: VoxelScene, parts: list[FlatPart], viewpoints: Eyes, settings: SegmentationConfig) -> Ground:
    """Sort the flat parts."""
    margin = settings.support_margin
    parts = [part for part in parts if part.filled > MIN_SEEN_SHARE and not _falls_off(scene, part, margin)]
    large = [part for part in parts if part.sides[0] > settings.largest_object]
    # As they are asked for: of a table alone in view, which is the support, never.
    known: dict[int, Mask] = {}

    def covered(others: Sequence[FlatPart]) -> list[Mask]:
        known.update({id(part): _covered(scene, part, margin) for part in others if id(part) not in known})
        return [known[id(part)] for part in others]

    best, most = None, (0, 0)
    for part in parts:
        if (viewpoints @ part.plane.normal <= part.plane.offset).any():
            continue
        others = covered([x for x in large if x is not part])
        standing = _standing(scene, part, _left(scene, part, others), viewpoints, settings)
        if standing > most:
            best, most = part, standing
    background = tuple(part for part in large if part is not best)
    return Ground(best, background, _left(scene, best, covered(background)))


def _left(scene: VoxelScene, support: FlatPart | None, background: Sequence[Mask]) -> Mask:
    """Tell what is above the support and not part of the background."""
    left = np.ones(len(scene.mean), dtype=bool)
    if support is not None:
        left = support.height(scene.mean) > support.tolerance(scene.mean_distance)
    for covered in background:
        left &= ~covered
    return left


def _covered(scene: VoxelScene, part: FlatPart, margin: float) -> Mask:
    """Which voxels are on a flat part, what goes on beside it and no camera saw whole included."""
    height, tolerance = np.abs(part.height(scene.mean)), part.tolerance(scene.mean_distance)
    band = np.flatnonzero(height <= (1 + NEIGHBOURHOOD_TOLERANCES) * tolerance.max())
    band = band[part.beneath(scene.mean[band], 2 * margin)]
    on = band[(height[band] <= tolerance[band]) & part.beneath(scene.mean[band], margin)]
    if len(on) == 0:
        return np.zeros(len(scene.mean), dtype=bool)
    reach = NEIGHBOURHOOD_TOLERANCES * tolerance[on]
    # A flat part has so many voxels within reach.
    share = NEIGHBOUR_SAMPLES * scene.size**2 / (np.pi * np.median(reach) ** 2)
    band = band[np.random.default_rng(0).random(len(band)) < share]
    around, alike = (
        KDTree(scene.mean[rows]).query_ball_point(scene.mean[on], r=reach, return_length=True)
        for rows in (band, np.intersect1d(band, on))
    )
    covered = np.zeros(len(scene.mean), dtype=bool)
    covered[on[alike >= ON_PLANE_SHARE * around]] = True
    return covered


def _falls_off(scene: VoxelScene, part: FlatPart, margin: float) -> bool:
    height, tolerance = part.height(scene.mean), part.tolerance(scene.mean_distance)
    below = (height < -tolerance) & (height > -EDGE_BAND_TOLERANCES * tolerance)
    below[below] = part.beneath(scene.mean[below], margin)
    return bool(below.sum() > EDGE_BAND_SHARE * part.inliers.sum())


def _standing(
    scene: VoxelScene, part: FlatPart, left: Mask, viewpoints: Eyes, settings: SegmentationConfig
) -> tuple[int, int]:
    """How many voxels belong to things that touch that part, and to things that may stand on it."""
    points, distance = scene.mean[left], scene.mean_distance[left]
    label = link_points(points, scene.weight[left], link_length(points, settings), settings.neighbour_share)
    touching, standing = 0, 0
    for k in range(min(int(label.max(initial=-1)) + 1, MAX_CLUSTERS)):
        rows = np.flatnonzero(label == k)
        if stands_on(part, points[rows], distance[rows], viewpoints, settings):
            standing += len(rows)
            touching += len(rows) if _clearance(part, points[rows], distance[rows]) <= settings.contact else 0
    return touching, standing


def stands_on(
    part: FlatPart, thing: Points, distance: Float[np.ndarray, "n"], viewpoints: Eyes, settings: SegmentationConfig
) -> bool:
    """Whether a cluster of voxels is a thing on that support."""
    most = np.inf if settings.piled else settings.largest_object
    if not settings.smallest_object <= extent(thing) <= most:
        return False
    flat = thing @ part.axes
    # From above, a round body hides as much of its height as half its width.
    hidden = HIDDEN_HEIGHT_SHARE * float(np.ptp(flat, axis=0).max())
    sight = viewpoints - thing.mean(0)
    upright = (sight @ part.plane.normal > MIN_UPRIGHT_COSINE * np.linalg.norm(sight, axis=1)).all()
    hidden = settings.largest_object if upright else max(settings.contact, hidden)
    if _clearance(part, thing, distance) > hidden:
        return False
    if part.beneath(thing, settings.gap).mean() < 0.5:
        return False
    hull = None if settings.piled else convex_hull(flat)
    return hull is None or part.area >= settings.support_area_ratio * float(hull.volume)


def _clearance(part: FlatPart, thing: Points, distance: Float[np.ndarray, "n"]) -> float:
    return float((part.height(thing) - part.tolerance(distance)).min())
