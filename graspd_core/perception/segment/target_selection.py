"""Select the object by a point, a box or a mask. Without them, select the object nearest the view axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from graspd_core.config import SegmentationConfig
from graspd_core.errors import CloudError, NoObjectError
from graspd_core.perception.cloud.point_cloud import PointCloud, Points, Vector
from graspd_core.perception.cloud.voxel_downsample import Labels, Mask, VoxelScene, rows_of
from graspd_core.perception.segment.clusters import extent, share_within

# Greatest number of objects in an error message.
MAX_LISTED_THINGS = 4
# Greatest distance between a point and its object's surface, and between a line of sight and voxels on it, in voxels.
SURFACE_VOXELS, RAY_VOXELS = 3.0, 1.5
MIDDLE_SHARE = 0.4  # greatest depth of a point well inside an object, as a fraction of the object's length


@dataclass(frozen=True)
class Target:
    """Selection of the object to grasp. At most one attribute is given.

    Attributes:
        point: a point on or near the object, in the clouds' frame [m].
        box: two opposite corners of a box around the object, along the axes of the clouds' frame [m].
        mask: one value for each point of the first view, True if the point shows the object.
    """

    point: Vector | None = None
    box: tuple[Vector, Vector] | None = None
    mask: Bool[np.ndarray, "points"] | None = None


def check_target(target: Target, views: Sequence[PointCloud]) -> None:
    """Check a target.

    Raises CloudError: several kinds are given, a value is not finite, the box is empty, or the mask selects no point,
    has another length than the first view, or another type than bool.
    """
    given = [name for name in ("point", "box", "mask") if getattr(target, name) is not None]
    if len(given) > 1:
        raise CloudError(f"target: {' and '.join(given)} given; valid: only one of point, box, mask")
    for corner in (target.point, *(target.box or ())):
        if corner is not None and np.shape(corner) != (3,):
            raise CloudError(f"target: a point of shape {np.shape(corner)}; valid: x, y, z")
    if target.point is not None and not np.isfinite(target.point).all():
        raise CloudError(f"target: point {_place(target.point)}; valid: finite numbers")
    if target.box is not None:
        low, high = target.box
        if not (np.isfinite(low).all() and np.isfinite(high).all() and np.not_equal(low, high).all()):
            raise CloudError(f"target: box from {_place(low)} to {_place(high)}; valid: finite, with a volume above 0")
    if target.mask is not None:
        if len(target.mask) != len(views[0].points):
            many = len(views[0].points)
            raise CloudError(
                f"target: mask of length {len(target.mask)}; valid: {many}, the number of points in the first view"
            )
        # Pictures have masks of 0 and 255. NumPy would take these numbers for indices.
        kind = np.asarray(target.mask).dtype
        if kind != np.dtype(bool):
            raise CloudError(f"target: mask of {kind}; valid: bool, True where a point shows the object")
        if not np.any(target.mask):
            raise CloudError("target: mask selects no point; valid: at least one True")


def select_target(
    scene: VoxelScene,
    label: Labels,
    free: Sequence[int],
    target: Target,
    views: Sequence[PointCloud],
    settings: SegmentationConfig,
) -> Mask:
    """Return the voxels of the selected object. For a box or mask, this is the object with most points in it.

    A mask also selects every object of which it covers at least half.

    Args:
        label: object number of each voxel, -1 for none.
        free: indices of the objects to choose from if the target is empty.
        target: a valid target (`check_target`).
        settings: `target_reach` is used for a point. A box or mask that covers less than `target_share` of an object
            selects only the covered voxels, otherwise the whole object.

    Raises:
        NoObjectError: no object is at the target. The message lists the objects.
    """
    if target.point is not None:
        return label == _thing_of(target.point, scene, label, views, settings)
    if target.box is None and target.mask is None:
        return label == min(free, key=lambda k: _off_axis(scene.mean[label == k], scene, views))
    meant, many = _meant(scene, target), int(label.max(initial=-1)) + 1
    # A box covers voxels of all views, a mask points of the first view.
    rows = np.arange(len(label)) if target.mask is None else scene.voxel[scene.of_view(0)]
    rows = rows[label[rows] >= 0]
    shown, covered = (np.bincount(label[part], minlength=many) for part in (rows, rows[meant[rows]]))
    if not covered.any() and target.box is not None:
        low, high = (_place(corner) for corner in target.box)
        raise NoObjectError(f"target: nothing in the box from {low} to {high}; {seen(scene, label)}")
    if not covered.any():
        raise NoObjectError(f"target: nothing but background under the mask; {seen(scene, label)}")
    share, things = covered / np.maximum(shown, 1), [int(covered.argmax())]
    if target.mask is not None:
        things += np.flatnonzero(share >= 0.5).tolist()
    return _covered(label, meant, things, share, settings.target_share)


def select_part(
    scene: VoxelScene, part: Labels, target: Target, views: Sequence[PointCloud], settings: SegmentationConfig
) -> Mask:
    """Return the voxels of the parts that the target selects, among the parts of the selected object.

    Args:
        part: part number of each voxel of the selected object, split at seams, -1 for other voxels.
        target: a point, a box or a mask.
    """
    if part.max(initial=-1) < 1:
        return part >= 0
    if target.point is not None:
        return part == _thing_of(target.point, scene, part, views, settings)
    meant, shown = _meant(scene, target), part >= 0
    if target.mask is not None:
        shown &= np.isin(np.arange(len(part)), scene.voxel[scene.of_view(0)])
    many = int(part.max()) + 1
    count = np.bincount(part[shown], minlength=many)
    share = np.bincount(part[shown & meant], minlength=many) / np.maximum(count, 1)
    return _covered(part, meant, list(range(many)), share, settings.target_share)


def _meant(scene: VoxelScene, target: Target) -> Mask:
    """Return the voxels in the box or under the mask."""
    if target.box is not None:
        low, high = np.minimum(*target.box) - scene.size, np.maximum(*target.box) + scene.size
        return np.asarray(((scene.mean >= low) & (scene.mean <= high)).all(1))
    meant = np.zeros(len(scene.mean), dtype=bool)
    meant[scene.voxel[scene.of_view(0)][np.asarray(target.mask)[scene.rows[0]]]] = True
    return meant


def seen(scene: VoxelScene, label: Labels) -> str:
    """Return the number of objects and the centres of the largest as text, for error messages."""
    many = int(label.max(initial=-1)) + 1
    if many == 0:
        return "no object is seen"
    places = [_place(scene.mean[rows].mean(0)) for rows in rows_of(label)[:MAX_LISTED_THINGS]]
    told = f"{many} objects are seen, the largest" if many > 1 else "one object is seen,"
    return f"{told} at {', '.join(places)} m"


def _thing_of(
    point: Vector, scene: VoxelScene, label: Labels, views: Sequence[PointCloud], settings: SegmentationConfig
) -> int:
    """Return the index of the object that contains a point, else of the nearest object within `target_reach`.

    An object contains points in its hull or hidden behind it, at most half its length from the seen surface. For a
    point deeper than `MIDDLE_SHARE` of the length, the nearest object within `target_reach` is preferred.
    """
    away = np.linalg.norm(scene.mean - point, axis=1)
    things = rows_of(label)
    depth = [float(away[rows].min()) for rows in things]
    order = sorted(range(len(things)), key=depth.__getitem__)
    if order and depth[order[0]] <= SURFACE_VOXELS * scene.size:
        return order[0]
    hiding = _hiding(point, scene, views)
    length = [extent(scene.mean[rows]) for rows in things]
    inside = [
        k
        for k, rows in enumerate(things)
        if depth[k] <= 0.5 * length[k] and (hiding[rows].any() or share_within(point[None], scene.mean[rows]))
    ]
    near = [k for k in order[:1] if depth[k] <= settings.target_reach]
    if not inside + near:
        reach = f"within {settings.target_reach:g} m of the point {_place(point)}, and none contains it"
        raise NoObjectError(f"target: no object {reach}; {seen(scene, label)}")
    middle = [k for k in inside if depth[k] <= MIDDLE_SHARE * length[k]]
    return min(middle or near or inside, key=lambda k: depth[k] / length[k])


def _hiding(point: Vector, scene: VoxelScene, views: Sequence[PointCloud]) -> Mask:
    """Return voxels that hide a point from a camera. If a camera sees only surface behind the point, return none."""
    hiding = np.zeros(len(scene.mean), dtype=bool)
    for view in views:
        ray = point - view.viewpoint
        distance = max(float(np.linalg.norm(ray)), 1e-6)
        way = scene.mean - view.viewpoint
        along = way @ ray / distance
        on = np.linalg.norm(way - along[:, None] * ray / distance, axis=1) < RAY_VOXELS * scene.size
        before = on & (along > 0) & (along < distance)
        if not before.any() and on.any():
            return np.zeros(len(scene.mean), dtype=bool)
        hiding |= before
    return hiding


def _covered(label: Labels, meant: Mask, things: list[int], share: Float[np.ndarray, "things"], least: float) -> Mask:
    """Return all voxels of objects covered at least to the fraction `least`, and the covered voxels of the others."""
    whole = [k for k in things if share[k] >= least]
    return np.isin(label, whole) | (np.isin(label, things) & meant)


def _off_axis(thing: Points, scene: VoxelScene, views: Sequence[PointCloud]) -> float:
    """Return the 5th percentile of an object's angles [rad] from the axis of the first non-empty view."""
    first = next(k for k, rows in enumerate(scene.rows) if len(rows))
    axis, viewpoint = views[first].forward, views[first].viewpoint
    if axis is None:
        axis = scene.points[scene.of_view(first)].mean(0) - viewpoint
    ray = thing - viewpoint
    along = ray @ axis
    across = np.linalg.norm(np.cross(ray, axis), axis=1)
    return float(np.percentile(np.arctan2(across, along), 5))


def _place(point: Vector) -> str:
    return f"({', '.join(f'{value:.3f}' for value in point)})"
