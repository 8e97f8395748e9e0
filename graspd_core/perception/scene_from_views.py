"""Build scenes from depth camera views: segment an object, reconstruct its surface, and make obstacles around it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from graspd_core.config import SceneConfig, SegmentationConfig
from graspd_core.errors import CloudError
from graspd_core.perception.cloud.point_cloud import PointCloud, Points
from graspd_core.perception.cloud.viewpoint_check import (
    check_scene,
    check_viewpoint,
    check_views,
    fits_nowhere,
    refuse_no_place,
)
from graspd_core.perception.obstacles import make_obstacles
from graspd_core.perception.reconstruct.merge_views import Evidence, is_all_round, is_unposed
from graspd_core.perception.reconstruct.reconstruct import Reconstruction, reconstruct
from graspd_core.perception.scene import ObjectModel, Obstacle, Scene, build_scene, refuse_numbers
from graspd_core.perception.segment.segment import Segmentation, find_things, segment
from graspd_core.perception.segment.target_selection import Target
from graspd_core.runtime.worker_process import run_isolated
from graspd_core.types import Plane

# Farther from the origin than this [m], float32 coordinates are coarser than a camera's data. Coordinates of `_ENDLESS`
# or more count as missing, because their squares overflow.
_FAR, _ENDLESS = 100.0, 1e100
# Least range of depth cameras [m], and fraction of points out of range above which the unit of a scene is doubtful.
_NEAREST, _CUT_OFF = 0.1, 0.3
# Views whose cameras are nearer to each other than this [m] show the object from one side.
_SAME_PLACE = 0.01
# In a pile, an object may lie on others if its lowest seen point is higher than this above the support [m].
_DEEP = 0.04
_STRAY = 0.01  # share of an object's points that may be too low by error


def scene_from_views(
    views: Sequence[PointCloud],
    *,
    target: Target | None = None,
    alone: bool = False,
    settings: SceneConfig | None = None,
    mass: float | None = None,
    friction: float = 0.6,
    source: str = "cloud",
    resolution: int = 48,
    device: torch.device | str = "cpu",
    surface: Plane | None = None,
    ahead: Callable[[ObjectModel, Evidence], None] | None = None,
) -> Scene:
    """Build a scene from one or several views, in their common frame. The scene's warnings name what was guessed.

    Args:
        views: point cloud of each camera [m]. Points may be NaN.
        target: selects the object. If None, the object nearest the first view's optical axis is taken.
        alone: True if the views show only the object. Then all points belong to the object.
        settings: settings for segmentation, reconstruction and obstacles.
        mass: mass of the object [kg]. None assumes `heavy_mass` of its volume and adds a warning.
        friction: Coulomb friction coefficient between hand and object.
        source: name of the views, for messages.
        resolution: the distance grid has at most `resolution`³ nodes.
        surface: known plane beneath the objects. It is the support if the views show none.
        ahead: called with object and evidence before the grid is built, to start work that does not need the grid.

    Raises:
        CloudError: the views show no usable object. The error is a NoObjectError if they do not show the target.
        MeshError: the object is too small or too large, or a number is out of range.
    """
    started = time.perf_counter()
    refuse_numbers(source, mass=mass, friction=friction, resolution=resolution)
    settings = settings or SceneConfig()
    # The distance grid is built in this process, so that the child process is free for other work.
    whole, support, obstacles, warnings = run_isolated(reconstruct_object, views, target, alone, settings, surface)
    scene = build_scene(
        whole.mesh,
        source=source,
        mass=mass,
        friction=friction,
        resolution=resolution,
        device=device,
        warnings=warnings + whole.warnings,
        started=started,
        support=support,
        obstacles=obstacles,
        confidence=whole.confidence,
        ahead=ahead and (lambda model: ahead(model, whole.evidence)),
    )
    return replace(scene, evidence=whole.evidence)


def things_from_views(
    views: Sequence[PointCloud], settings: SegmentationConfig | None = None, surface: Plane | None = None
) -> tuple[Points, ...]:
    """Return the points [m] of each object that `scene_from_views` can select. See `find_things`.

    The segmentation is cached. The next scenes from the same views and settings reuse it.
    """
    return run_isolated(find_things, [replace(view, points=_single(view.points)) for view in views], settings, surface)


def reconstruct_object(
    views: Sequence[PointCloud],
    target: Target | None,
    alone: bool,
    settings: SceneConfig,
    surface: Plane | None = None,
) -> tuple[Reconstruction, Plane | None, tuple[Obstacle, ...], tuple[str, ...]]:
    """Return the object's reconstructed surface, its support, its obstacles and the warnings.

    Raises CloudError like `segment` and `reconstruct`, and if a camera cannot have been at its stated position.
    """
    for view in views:
        refuse_no_place(view.viewpoint)
    # Round to float32, so that a cloud gives the same scene in float32 and float64.
    views = [replace(view, points=_single(view.points)) for view in views]
    alone = alone or _is_whole_object(views)
    if alone:
        seen = Segmentation(tuple(views), tuple(range(len(views))), None, (), ())
    else:
        seen = segment(views, target=target, settings=settings.segmentation, surface=surface)
    doubts = ()
    if seen.views:
        about_units = _unit_doubts(seen, views, settings.segmentation.max_range)
        doubts = (*about_units, *_camera_doubts(seen, views), *filter(None, (seen.cut, seen.beside)))
    height = 0.0 if seen.support is None else _lowest(seen.views, seen.support)
    if settings.segmentation.piled and height > _DEEP:
        doubts += (f"the object may lie on others, {1e3 * height:.0f} mm above the support",)
    whole = reconstruct(seen.views, seen.support, settings.reconstruction, () if alone else views)
    whole = replace(whole, evidence=replace(whole.evidence, doubts=doubts, piled=settings.segmentation.piled))
    told = tuple(f"cloud: {doubt}; no grasp counts as verified" for doubt in doubts)
    reach = settings.segmentation.obstacle_range
    obstacles = make_obstacles(seen.obstacles, seen.support, whole.mesh, reach, settings.obstacles)
    return whole, seen.support, obstacles, seen.warnings + told


def _lowest(views: Sequence[PointCloud], support: Plane) -> float:
    """Return the height of the object's lowest seen points above the support [m]. 0 without points."""
    points = np.concatenate([np.zeros((0, 3)), *(view.points for view in views)])
    heights = (points @ support.normal - support.offset)[np.isfinite(points).all(1)]
    return float(np.quantile(heights, _STRAY)) if len(heights) else 0.0


def _single(points: Points) -> Points:
    farthest = np.abs(points[np.isfinite(points)]).max(initial=0.0)
    if farthest < _FAR:
        return points.astype(np.float32).astype(float)
    return points if farthest < _ENDLESS else _single(np.where(np.abs(points) < _ENDLESS, points, np.nan))


def _unit_doubts(seen: Segmentation, views: Sequence[PointCloud], farthest: float) -> tuple[str, ...]:
    away = np.concatenate([np.linalg.norm(view.points[::50] - view.viewpoint, axis=1) for view in views])
    beyond = float((away[np.isfinite(away)] > farthest).mean()) if np.isfinite(away).any() else 0.0
    first = np.linalg.norm(seen.views[0].points - seen.views[0].viewpoint, axis=1)
    thing = float(np.median(first[np.isfinite(first)])) if np.isfinite(first).any() else 0.0
    asked = "are the coordinates in metres? (the camera's depth unit; --units or --scale for a file)"
    if thing < _NEAREST and seen.views[0].posed:
        return (f"the object is {1e3 * thing:.0f} mm from its camera, nearer than depth cameras see: {asked}",)
    if seen.support is None and (seen.cut or beyond > _CUT_OFF):
        told = f"no support is seen, and {100 * beyond:.0f} % of the points are beyond {farthest:g} m"
        return (f"{told if beyond > _CUT_OFF else 'no support is seen, and the object is cut off'}: {asked}",)
    return ()


def _camera_doubts(seen: Segmentation, views: Sequence[PointCloud]) -> tuple[str, ...]:
    up = None if seen.support is None else np.asarray(seen.support.normal, dtype=float)
    try:
        told = [check_viewpoint(thing, views[k], up) for k, thing in zip(seen.numbers, seen.views, strict=True)]
    except CloudError:
        if _needs_no_camera(seen.views):
            return ()
        raise
    if len(views) > 1 and (apart := check_views(seen.views, views)):
        return (apart,)
    # Views from several sides confirm each other. Several clouds of one camera that stood still do not.
    if np.ptp([thing.viewpoint for thing in seen.views], axis=0).max() > _SAME_PLACE or not any(told):
        return ()
    return () if _needs_no_camera(seen.views) else tuple(filter(None, told))[:1]


def _is_whole_object(views: Sequence[PointCloud]) -> bool:
    """Return False if `check_scene` accepts the views, True if it refuses a single all-round cloud. Else, raise."""
    try:
        check_scene(views)
    except CloudError:
        if len(views) == 1 and is_all_round(views[0]):
            return True
        raise
    return False


def _needs_no_camera(views: Sequence[PointCloud]) -> bool:
    """Return True if the only view has no camera pose and shows its object from all sides."""
    first = views[0]
    all_round = len(views) == 1 and is_unposed(first, first.forward is not None)
    return all_round and (fits_nowhere(first) or is_all_round(first))
