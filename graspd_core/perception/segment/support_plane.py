"""Classify a scene's flat parts: support, background, or face of an object.

A support faces the cameras, is larger than the objects on it, and has at least one object on it. The object reaches
down to the support, lies over the visible part of the support, and has a graspable size. Other flat parts fail this:
nothing is above a convex body's face, and no object touches a wall. A tray's floor does not support the tray's rim,
because the rim is not smaller than the floor.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from graspd_core.config import SegmentationConfig
from graspd_core.mesh.convex_parts import convex_hull
from graspd_core.perception.cloud.point_cloud import Eyes, Points
from graspd_core.perception.cloud.voxel_downsample import Mask, VoxelScene, rows_of
from graspd_core.perception.segment.clusters import extent, link_length, link_points
from graspd_core.perception.segment.planes import FlatPart

# Greatest height of an object's lowest visible point above the support, as a fraction of the object's width.
HIDDEN_HEIGHT_SHARE = 0.5
# Cosine of 15°. If the line of sight is within 15° of the support's normal, an object's sides are not visible. Then the
# object's lowest visible point may be high above the support.
MIN_UPRIGHT_COSINE = 0.966
# If less than this fraction of its hull is visible, a plane is a slice through several objects.
MIN_SEEN_SHARE = 0.3
# A flat part is a face of a body if the points within this many tolerances below exceed this fraction of its points.
EDGE_BAND_TOLERANCES, EDGE_BAND_SHARE = 4.0, 0.25
# A plane may cut through an object. A point is on the flat part only if ON_PLANE_SHARE of its neighbours are on the
# plane too. Neighbours lie within this many tolerances. On a wall that the plane cuts at right angles, 0.4 of them are.
NEIGHBOURHOOD_TOLERANCES, ON_PLANE_SHARE = 3.0, 0.6
# Number of neighbours to check. If noise widens the tolerance, there are more neighbours, and a random sample is used.
NEIGHBOUR_SAMPLES = 50
# Only this many clusters, the largest, are checked. Smaller clusters are noise.
MAX_CLUSTERS = 20


def find_ground(
    scene: VoxelScene, parts: list[FlatPart], viewpoints: Eyes, settings: SegmentationConfig
) -> tuple[FlatPart | None, tuple[FlatPart, ...], Mask]:
    """Find the support and the background among the flat parts of a scene. `viewpoints` are camera positions [m].

    Return the support (None if no object stands on a visible plane), the large flat parts that are not the support
    (such as walls, floors and empty tables), and which voxels may belong to objects.
    """
    margin = settings.support_margin
    parts = [part for part in parts if part.filled > MIN_SEEN_SHARE and not _falls_off(scene, part, margin)]
    large = [part for part in parts if part.sides[0] > settings.largest_object]

    # For a support that is the only large flat part, no covered voxels are needed.
    @cache
    def covered(k: int) -> Mask:
        return _covered(scene, large[k], margin)

    def left(support: FlatPart | None) -> Mask:
        """Return which voxels are above the support and on no other large part."""
        above = np.ones(len(scene.mean), dtype=bool)
        if support is not None:
            above = support.clearance(scene.mean, scene.mean_distance) > 0
        for k, other in enumerate(large):
            above &= other is support or ~covered(k)
        return above

    best, most = None, (0, 0)
    for part in parts:
        if (viewpoints @ part.plane.normal <= part.plane.offset).any():
            continue
        standing = _standing(scene, part, left(part), viewpoints, settings)
        if standing > most:
            best, most = part, standing
    return best, tuple(part for part in large if part is not best), left(best)


def _covered(scene: VoxelScene, part: FlatPart, margin: float) -> Mask:
    """Return which voxels are on a flat part, or in the part's plane at most `margin` [m] outside its hull."""
    height, tolerance = np.abs(part.height(scene.mean)), part.tolerance(scene.mean_distance)
    band = np.flatnonzero(height <= (1 + NEIGHBOURHOOD_TOLERANCES) * tolerance.max())
    band = band[part.beneath(scene.mean[band], 2 * margin)]
    on = band[(height[band] <= tolerance[band]) & part.beneath(scene.mean[band], margin)]
    if len(on) == 0:
        return np.zeros(len(scene.mean), dtype=bool)
    reach = NEIGHBOURHOOD_TOLERANCES * tolerance[on]
    # Fraction of the voxels to keep, so that about `NEIGHBOUR_SAMPLES` are within reach on a flat part.
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
    """Return the voxel counts of the objects that touch a flat part, and of all objects that may stand on the part."""
    points, distance = scene.mean[left], scene.mean_distance[left]
    label = link_points(points, scene.weight[left], link_length(points, settings), settings.neighbour_share)
    touching, standing = 0, 0
    for rows in rows_of(label)[:MAX_CLUSTERS]:
        if stands_on(part, points[rows], distance[rows], viewpoints, settings):
            standing += len(rows)
            touching += len(rows) if part.clearance(points[rows], distance[rows]).min() <= settings.contact else 0
    return touching, standing


def stands_on(
    part: FlatPart, thing: Points, distance: Float[np.ndarray, "n"], viewpoints: Eyes, settings: SegmentationConfig
) -> bool:
    """Return True if a cluster of voxels has the size and position of an object that stands on a flat part."""
    most = np.inf if settings.piled else settings.largest_object
    if not settings.smallest_object <= extent(thing) <= most:
        return False
    flat = thing @ part.axes
    # Seen from above, a round body hides its lower part, up to half its width.
    hidden = HIDDEN_HEIGHT_SHARE * float(np.ptp(flat, axis=0).max())
    sight = viewpoints - thing.mean(0)
    upright = (sight @ part.plane.normal > MIN_UPRIGHT_COSINE * np.linalg.norm(sight, axis=1)).all()
    hidden = settings.largest_object if upright else max(settings.contact, hidden)
    if part.clearance(thing, distance).min() > hidden or part.beneath(thing, settings.gap).mean() < 0.5:
        return False
    hull = None if settings.piled else convex_hull(flat)
    return hull is None or part.area >= settings.support_area_ratio * float(hull.volume)
