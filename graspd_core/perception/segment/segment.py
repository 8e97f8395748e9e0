"""Segment an object from depth camera views: crop, downsample, find the support, cluster, select."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from graspd_core.config import SegmentationConfig
from graspd_core.errors import CloudError, NoObjectError
from graspd_core.perception.cloud.camera import MIN_BORDER_POINTS, reaches_image_border
from graspd_core.perception.cloud.point_cloud import MIN_POINTS, Eyes, PointCloud, Vector, measured
from graspd_core.perception.cloud.voxel_downsample import Labels, Mask, VoxelScene, rows_of, voxel_downsample
from graspd_core.perception.segment import clusters
from graspd_core.perception.segment.planes import FlatPart, find_planes, known_part
from graspd_core.perception.segment.support_plane import find_ground, stands_on
from graspd_core.perception.segment.target_selection import (
    SURFACE_VOXELS,
    Target,
    check_target,
    seen,
    select_part,
    select_target,
)
from graspd_core.runtime.disk_cache import digest
from graspd_core.types import Plane

# A scene nearer than this to its cameras is probably not in metres [m].
MIN_SCENE_DISTANCE_M = 0.02
# Greatest offset of a target point from the middle of its object's visible part, as fractions of half the object's
# length: sideways, and towards the camera. A point nearer to the centroid than the third fraction is valid too. Chosen
# on 90 touching pairs and 60 single objects, seeds from 0 (docs/inputs.md).
_MOST_ASIDE, _MOST_AHEAD, _AT_CENTROID = 0.3, 0.25, 0.25
# In a pile, an object may continue behind another one if this fraction of its voxels is, in the image, within
# `_ADJACENT` voxels of something that is nearer by `_NEARER` [m]. Chosen on 35 parts in 16 bins (seeds 200 to 215).
_HIDDEN, _ADJACENT, _NEARER = 0.03, 2.0, 0.01


@dataclass(frozen=True)
class Segmentation:
    """A segmented object and its surroundings, in the frame of the clouds.

    Attributes:
        views: the object's points in each view, at full density. Views that do not show the object are left out.
        numbers: index of each of `views` among the clouds given to `segment`.
        support: support plane of the object. None if none was seen.
        obstacles: downsampled points of each other object or surface nearby [m].
        warnings: warnings for the user.
        cut: why the object may extend beyond what the views show. Empty if one view shows its whole outline.
        beside: why `views` may show only a part of the object, or several objects. Empty if there is no doubt.
    """

    views: tuple[PointCloud, ...]
    numbers: tuple[int, ...]
    support: Plane | None
    obstacles: tuple[Float[np.ndarray, "_ 3"], ...]
    warnings: tuple[str, ...]
    cut: str = ""
    beside: str = ""


def segment(
    views: Sequence[PointCloud],
    *,
    target: Target | None = None,
    settings: SegmentationConfig | None = None,
    surface: Plane | None = None,
) -> Segmentation:
    """Segment the object in one or several views of a scene.

    Args:
        views: point cloud of each camera, in one frame. Points may be NaN.
        target: selects the object. If None, the object nearest the first view's optical axis is taken. An unknown axis
            is assumed to point to the mean of the points.
        settings: sizes and tolerances.
        surface: known plane beneath the objects. It is the support if the views show none.

    Raises:
        CloudError: a cloud is empty, all NaN or has too few points, or the target is not valid.
        NoObjectError: the scene is usable, but does not contain the requested object.
    """
    settings, target = settings or SegmentationConfig(), target or Target()
    parted = _parted(views, settings, target, surface)
    scene, label = parted.scene, parted.label
    free = _candidates(parted)
    marked = target.box is not None or target.mask is not None
    named = marked or target.point is not None
    if not free and not (named and label.max(initial=-1) >= 0):
        raise NoObjectError(_nothing(parted))
    chosen = select_target(scene, label, free, target, views, settings)
    parts = _parts(parted, chosen)
    if named:
        chosen = select_part(scene, parts, target, views, settings)
    if not free and not marked and clusters.extent(scene.mean[chosen]) > settings.largest_object:
        raise NoObjectError(_nothing(parted))
    found = _cut_out(views, scene, chosen, parted.support)
    total = sum(len(view.points) for view in found.values())
    if total < MIN_POINTS:
        raise CloudError(f"cloud: only {total} points show the object; at least {MIN_POINTS} are needed")
    obstacles = _obstacles(parted, chosen, parts)
    warnings = _warnings(parted, bool(obstacles))
    support = parted.support and parted.support.as_support(scene.mean_distance[chosen])
    touching = () if marked else _touching(scene, chosen, parts)
    beside = "" if target.point is None or len(views) > 1 else _beside(parted, chosen, target.point)
    if parted.settings.piled and target.point is not None and touching:
        # In a pile, a part need not stand on the support, so the seam may also lie within one object.
        touching, beside = (), "a seam divides the target from its neighbour, and both may be one object"
    elif parted.settings.piled and target.point is not None and _hidden_share(parted, chosen, found) > _HIDDEN:
        beside = "a nearer object hides a part of the target"
    told = (*warnings, *touching)
    return Segmentation(
        tuple(found.values()), tuple(found), support, obstacles, told, _cut(parted, chosen, views), beside
    )


def find_things(
    views: Sequence[PointCloud], settings: SegmentationConfig | None = None, surface: Plane | None = None
) -> tuple[Float[np.ndarray, "_ 3"], ...]:
    """Return the points [m] of each object that `segment` can select. Touching objects are split at seams.

    To select an object, give any of its points as target. The result is empty if no object is found. `surface` is a
    known plane beneath the objects.

    Raises CloudError: a cloud is empty, all NaN, or has too few points.
    """
    parted = _parted(views, settings or SegmentationConfig(), None, surface)
    scene, label, most = parted.scene, parted.label, parted.settings.largest_object
    known, found = _candidates(parted), []
    # If a cluster is too large for an object, its parts between seams may be objects.
    large = [k for k, rows in enumerate(rows_of(label)) if clusters.extent(scene.mean[rows]) > most]
    for k in [*known, *(k for k in large if k not in known)]:
        part = _parts(parted, label == k)
        small = [n for n, rows in enumerate(rows_of(part)) if clusters.extent(scene.mean[rows]) <= most]
        found += [scene.points[part[scene.voxel] == n] for n in small]
    return tuple(found)


@dataclass(frozen=True)
class _Parted:
    """A scene with its camera positions `eyes` [m], its flat parts and the object number of each voxel (`label`).

    Objects are numbered from the largest. Background and noise are -1. `parts` caches the results of `_parts`.
    """

    scene: VoxelScene
    eyes: Eyes
    support: FlatPart | None
    background: tuple[FlatPart, ...]
    label: Labels
    settings: SegmentationConfig
    parts: dict[bytes, Labels] = field(default_factory=dict)


# The last scene, by a hash of its clouds and settings. If any object may be grasped, it serves each of them.
_LAST: dict[str, _Parted] = {}


def _parted(
    views: Sequence[PointCloud], settings: SegmentationConfig, target: Target | None, surface: Plane | None
) -> _Parted:
    key = digest((*views, settings, surface))
    parted = _LAST.get(key)
    scene = voxel_downsample(views, settings) if parted is None else parted.scene
    if target is not None:
        check_target(target, views)
    if parted is None:
        eyes = np.array([view.viewpoint for view in views], dtype=float)
        parts = find_planes(scene.mean, scene.mean_distance, eyes, settings)
        support, background, left = find_ground(scene, parts, eyes, settings)
        if support is None and surface is not None:
            support = known_part(scene.mean, surface, settings)
            left &= support is None or support.clearance(scene.mean, scene.mean_distance) > 0
        label = _things(scene, left, support, eyes, settings)
        parted = _Parted(scene, eyes, support, background, label, settings)
        _LAST.clear()
        _LAST[key] = parted
    return parted


def _things(
    scene: VoxelScene, left: Mask, support: FlatPart | None, eyes: Eyes, settings: SegmentationConfig
) -> Labels:
    points, distance = scene.mean[left], scene.mean_distance[left]
    link = clusters.link_length(points, settings)
    found = clusters.link_points(points, scene.weight[left], link, settings.neighbour_share)
    found = clusters.merge_occluded(points, distance, found, eyes, link=link, settings=settings, support=support)
    label = np.full(len(left), -1)
    label[left] = found
    for rows in rows_of(label):
        own = scene.mean[rows]
        small = scene.count[rows].sum() < settings.min_points or clusters.extent(own) < settings.smallest_object
        if small or (support is not None and support.height(own).max() < settings.smallest_object):
            label[rows] = -1
    return clusters.renumber(label)


def _candidates(parted: _Parted) -> list[int]:
    """Return indices of objects of graspable size that stand on the support. In a pile, all may lie on others.

    If no object stands on the support, ignore the support.
    """
    scene, label, settings, part = parted.scene, parted.label, parted.settings, parted.support
    things = rows_of(label)
    fits = [k for k, rows in enumerate(things) if clusters.extent(scene.mean[rows]) <= settings.largest_object]
    if part is None or settings.piled:
        return fits
    distance = scene.mean_distance
    standing = [k for k in fits if stands_on(part, scene.mean[things[k]], distance[things[k]], parted.eyes, settings)]
    return standing or fits


def _cut_out(
    views: Sequence[PointCloud], scene: VoxelScene, chosen: Mask, support: FlatPart | None
) -> dict[int, PointCloud]:
    """Return the object's points in every view that shows the object, by the index of the view."""
    wanted = chosen[scene.voxel]
    if support is not None:
        wanted[wanted] = support.clearance(scene.points[wanted], scene.distance[wanted]) > 0
    found = {}
    for k, view in enumerate(views):
        part = scene.of_view(k)
        if wanted[part].any():
            found[k] = replace(view, points=scene.points[part][wanted[part]])
    return found


def _obstacles(parted: _Parted, chosen: Mask, part: Labels) -> tuple[Float[np.ndarray, "_ 3"], ...]:
    """Return the points of other objects and large flat parts within reach of the object's bounding box [m].

    Each part of the cluster that holds the object (`part`, from `_parts`) is an object of its own.
    """
    mean, label, reach = parted.scene.mean, parted.label, parted.settings.obstacle_range
    mine = mean[chosen]
    low, high = mine.min(0) - reach, mine.max(0) + reach
    near = ((mean >= low) & (mean <= high)).all(1) & ~chosen
    others = [*rows_of(part), *rows_of(np.where(part < 0, label, -1))]
    others += [np.flatnonzero(flat.inliers & (label < 0)) for flat in parted.background]
    return tuple(mean[rows[near[rows]]] for rows in others if near[rows].any())


def _warnings(parted: _Parted, crowded: bool) -> tuple[str, ...]:
    """Return warnings about the segmentation. `crowded` is True if there are obstacles."""
    scene, settings = parted.scene, parted.settings
    warnings = []
    if scene.size > 0.5 * settings.gap:
        warnings.append(
            f"cloud: {len(scene.points)} points were thinned to one per {1e3 * scene.size:.1f} mm; finer gaps are lost"
        )
    blind = [str(k) for k, rows in enumerate(scene.rows, 1) if len(rows) == 0]
    if blind:
        warnings.append(f"cloud: of {len(scene.rows)} views these show nothing within range: {', '.join(blind)}")
    if parted.support is None and crowded:
        warnings.append("cloud: no support is seen; the object may include what is behind it in the image")
    return tuple(warnings)


def _cut(parted: _Parted, chosen: Mask, views: Sequence[PointCloud]) -> str:
    """Return why the object may extend beyond what the views show, or ""."""
    scene, width = parted.scene, parted.settings.border_width
    if _cut_off(parted, chosen):
        return "the object reaches the border of the workspace; the rest of it is not seen"
    # Without surroundings, the object's own outline is the outline of the view.
    if parted.support is None and not parted.background:
        return ""
    for k, view in enumerate(views):
        # The points outside the workspace count too, because its border is no border of the image.
        mine, seen = np.zeros(len(view.points), dtype=bool), measured(view.points, view.viewpoint)
        mine[scene.rows[k]] = chosen[scene.voxel[scene.of_view(k)]]
        if mine.any() and not reaches_image_border(view.points[seen], parted.eyes[k], mine[seen], width):
            return ""
    return "the object reaches the border of the image, and may extend beyond it"


def _parts(parted: _Parted, chosen: Mask) -> Labels:
    """Split the chosen object at seams. Return each voxel's part number, -1 outside.

    Without a support, only a pile is split. In a full bin, objects may hide the whole floor.
    """
    scene, support, key = parted.scene, parted.support, chosen.tobytes()
    if key in parted.parts:
        return parted.parts[key]
    part = np.where(chosen, 0, -1)
    points, eyes = scene.mean[chosen], parted.eyes
    if parted.settings.piled:
        part[chosen] = clusters.heaped_things(points, eyes, scene.size)
    elif support is not None:
        part[chosen] = clusters.touching_things(points, eyes, support.height(points), scene.size)
    parted.parts[key] = part
    return part


def _touching(scene: VoxelScene, chosen: Mask, part: Labels) -> tuple[str, ...]:
    """Return a warning that the object may be several objects, or that parts beyond a seam were left out."""
    parts = rows_of(part)
    apart = [rows for rows in parts if not chosen[rows].any()]
    if len(parts) < 2:
        return ()
    places = " and ".join("({:.3f}, {:.3f}, {:.3f})".format(*scene.mean[rows].mean(0)) for rows in apart or parts)
    if apart:
        return (f"cloud: the target touches another object with its centre at {places} m; the target ends at the seam",)
    return (
        f"cloud: the object may be {len(parts)} objects that touch, with centres at {places} m; "
        "give a point, a box or a mask as target",
    )


def _hidden_share(parted: _Parted, chosen: Mask, seen_by: Iterable[int]) -> float:
    """Return the fraction of the object's voxels that border on a nearer object, the least of all views that show it.

    The workspace's surroundings and pieces too small for an object do not count.
    """
    scene, others, shares = parted.scene, (parted.label >= 0) & ~chosen, [1.0]
    if not others.any():
        return 0.0
    for eye in parted.eyes[list(seen_by)]:
        (mine, away), (theirs, reach) = (clusters.directions(scene.mean[rows], eye) for rows in (chosen, others))
        nearest = [
            reach[rows].min(initial=np.inf)
            for rows in KDTree(theirs).query_ball_point(mine, _ADJACENT * scene.size / float(np.median(away)))
        ]
        shares.append(float((away - np.array(nearest) > _NEARER).mean()))
    return min(shares)


def _beside(parted: _Parted, chosen: Mask, point: Vector) -> str:
    """Return a warning if a target point inside the chosen object is far from its middle. Else, return "".

    A target point on the surface may be anywhere on the object. A point inside should be the object's middle, because
    pose estimators give the middle.
    """
    points, part = parted.scene.mean[chosen], parted.support
    if part is None or np.linalg.norm(points - point, axis=1).min() <= SURFACE_VOXELS * parted.scene.size:
        return ""
    flat, middle = (one @ part.axes for one in (points, point))
    half = 0.5 * float(np.ptp(flat, axis=0).max())
    if np.linalg.norm(np.median(flat, axis=0) - middle) < _AT_CENTROID * half:
        # The point is the centroid of visible points, for example of a mask. So it is nearer to the camera.
        return ""
    sight = flat.mean(0) - parted.eyes[0] @ part.axes
    sight /= max(float(np.linalg.norm(sight)), 1e-9)
    ways = np.array([sight, [-sight[1], sight[0]]]).T
    low, high = (flat @ ways).min(0), (flat @ ways).max(0)
    along, across = (middle @ ways - 0.5 * (low + high)) / (0.5 * max(high - low))
    if abs(across) <= _MOST_ASIDE and along >= -_MOST_AHEAD:
        return ""
    aside = 0.5e3 * max(high - low) * max(abs(across), -along)
    return f"the target is {aside:.0f} mm from the middle of the segment: two touching objects may be taken for one"


def _cut_off(parted: _Parted, chosen: Mask) -> bool:
    """Return True if the object reaches `max_range`, or is seen beyond the workspace too."""
    scene, support, ends = parted.scene, parted.support, parted.scene.ends
    if (scene.mean_distance[chosen] > parted.settings.max_range - 2 * scene.size).any():
        return True
    if support is not None:
        ends = ends[support.height(ends[:, 1]) > scene.size]
    near, _ = KDTree(scene.mean[chosen]).query(ends[:, 0], distance_upper_bound=2 * scene.size)
    return bool(np.isfinite(near).sum() >= MIN_BORDER_POINTS)


def _nothing(parted: _Parted) -> str:
    """Return the error message for a scene without a graspable object. It describes what was seen instead."""
    scene, label, settings = parted.scene, parted.label, parted.settings
    told = f"cloud: no graspable object among {len(scene.points)} points:"
    if label.max(initial=-1) >= 0:
        sizes = [clusters.extent(scene.mean[rows]) for rows in rows_of(label)]
        limit = f"longer than largest_object={settings.largest_object:g} m (the shortest {min(sizes):.2f} m)"
        return f"{told} {seen(scene, label)}, {limit}; give the wanted part as a box or a mask"
    part = parted.support or next(iter(parted.background), None)
    if part is None:
        near = float(np.median(scene.mean_distance))
        unit = f"; half of them are within {1e3 * near:.2g} mm of the camera: are they in metres?"
        return f"{told} {seen(scene, label)}{unit if near < MIN_SCENE_DISTANCE_M else ''}"
    away = float(np.median(scene.mean_distance[part.inliers]))
    return (
        f"{told} a plane of {part.sides[0]:.2f} by {part.sides[1]:.2f} m "
        f"at {away:.2f} m from the camera, and nothing on it that is higher than {1e3 * part.least:.0f} mm"
    )
