"""Which of the things in a scene is meant: by a point, a box or a mask, else the one nearest the view axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from graspd_core.config import SegmentationConfig
from graspd_core.errors import CloudError, NoObjectError
from graspd_core.perception.cloud.point_cloud import PointCloud, Points, Vector
from graspd_core.perception.cloud.voxel_downsample import Labels, Mask, VoxelScene

# Errors list so many things.
MAX_LISTED_THINGS = 4


@dataclass(frozen=True)
class Target:
    """What tells the object from other things; at most one of these is given.

    Attributes:
        point: on or near the object, in the clouds' frame [m].
        box: two opposite corners of a box around it, along the axes of the clouds' frame [m].
        mask: which points of the first view, as given, show it.
    """

    point: Vector | None = None
    box: tuple[Vector, Vector] | None = None
    mask: Bool[np.ndarray, "points"] | None = None


def check_target(target: Target, views: Sequence[PointCloud]) -> None:
    """Refuse a target that cannot be meant.

    Raises:
        CloudError: two kinds at once, not finite, an empty box, a mask of another length or without any point.
    """
    given = [name for name in ("point", "box", "mask") if getattr(target, name) is not None]
    if len(given) > 1:
        raise CloudError(f"target: {' and '.join(given)} given; give one of point, box, mask")
    for corner in (target.point, *(target.box or ())):
        if corner is not None and np.shape(corner) != (3,):
            raise CloudError(f"target: a place of shape {np.shape(corner)}; give x, y, z")
    if target.point is not None and not np.isfinite(target.point).all():
        raise CloudError(f"target: point {_place(target.point)} is not finite")
    if target.box is not None:
        low, high = target.box
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (low != high).all()):
            raise CloudError(f"target: box from {_place(low)} to {_place(high)} holds no volume")
    if target.mask is not None:
        if len(target.mask) != len(views[0].points):
            many = len(views[0].points)
            raise CloudError(f"target: mask of {len(target.mask)} for the {many} points of the first view")
        if not target.mask.any():
            raise CloudError("target: mask shows no point at all")


def select_target(
    scene: VoxelScene,
    label: Labels,
    free: Sequence[int],
    target: Target,
    views: Sequence[PointCloud],
    settings: SegmentationConfig,
) -> Mask:
    """The voxels of the object.

    Args:
        label: the thing each voxel is part of, -1 for none.
        free: the things to choose from if no target says which.
        target: checked.
        views: as given.
        settings: how near a point, and how much of a thing a box or mask, must be.

    Raises:
        NoObjectError: nothing where the target says; it lists the things there are.
    """
    many = int(label.max(initial=-1)) + 1
    if target.point is not None:
        return label == _nearest(scene, label, many, target.point, settings.target_reach)
    if target.box is not None:
        low, high = np.minimum(*target.box) - scene.size, np.maximum(*target.box) + scene.size
        meant = np.asarray(((scene.mean >= low) & (scene.mean <= high)).all(1))
        inside = np.bincount(label[(label >= 0) & meant], minlength=many)
        if not inside.any():
            raise NoObjectError(
                f"target: nothing in the box from {_place(low)} to {_place(high)}; {seen(scene, label)}"
            )
        share = inside / np.bincount(label[label >= 0], minlength=many)
        return _covered(label, meant, [int(inside.argmax())], share, settings.target_share)
    if target.mask is not None:
        return _masked(scene, label, many, target.mask, settings.target_share)
    return label == min(free, key=lambda k: _off_axis(scene.mean[label == k], scene, views))


def seen(scene: VoxelScene, label: Labels) -> str:
    """Where there are things, for errors: the centres of the largest."""
    many = int(label.max(initial=-1)) + 1
    if many == 0:
        return "nothing stands anywhere in the scene"
    places = [_place(scene.mean[label == k].mean(0)) for k in range(min(many, MAX_LISTED_THINGS))]
    told = f"{many} things are seen, the largest" if many > 1 else "one thing is seen,"
    return f"{told} about {', '.join(places)} m"


def _nearest(scene: VoxelScene, label: Labels, many: int, point: Vector, reach: float) -> int:
    away = np.linalg.norm(scene.mean - point, axis=1)
    away[label < 0] = np.inf
    nearest = int(away.argmin())
    if many == 0 or away[nearest] > reach:
        raise NoObjectError(f"target: nothing within {reach:g} m of the point {_place(point)}; {seen(scene, label)}")
    return int(label[nearest])


def _masked(scene: VoxelScene, label: Labels, many: int, mask: Bool[np.ndarray, "points"], least: float) -> Mask:
    """A mask may cover several things, pieces of one that others hide in part; a few points of it may miss."""
    of_first = scene.voxel[scene.of_view(0)]
    masked = of_first[mask[scene.rows[0]]]
    shown, covered = (np.bincount(label[rows][label[rows] >= 0], minlength=many) for rows in (of_first, masked))
    if not covered.any():
        raise NoObjectError(f"target: nothing but background under the mask; {seen(scene, label)}")
    share = covered / np.maximum(shown, 1)
    meant = np.zeros(len(label), dtype=bool)
    meant[masked] = True
    main = int(covered.argmax())
    return _covered(label, meant, [main, *(k for k in range(many) if k != main and share[k] >= 0.5)], share, least)


def _covered(label: Labels, meant: Mask, things: list[int], share: Float[np.ndarray, "things"], least: float) -> Mask:
    whole = [k for k in things if share[k] >= least]
    return np.isin(label, whole) | (np.isin(label, things) & meant)


def _off_axis(thing: Points, scene: VoxelScene, views: Sequence[PointCloud]) -> float:
    """Angle between the axis of the first view that shows anything and a thing, to a twentieth of its points [rad]."""
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
