"""Success over the angle and the noise of a single depth view: planned on what it shows, tried on the truth."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from graspd_core.bench.failure_maps.map_case import MapCase, MapCell, plan, settings, try_grasps
from graspd_core.rendering.depth_noise import DEFAULT, NONE, DepthNoise
from graspd_core.rendering.tabletop import CAMERA, ring_poses, tabletop, views_of
from graspd_core.scene.scene import ObjectModel, Scene, build_scene
from graspd_core.scene.scene_from_views import scene_from_views
from graspd_core.trials.world import PROTOCOLS

ELEVATIONS = (15.0, 30.0, 50.0, 80.0)
NOISES = (0.0, 1.0, 2.0, 4.0)
THINGS = ("mug",)
_YAW, _AZIMUTH = 0.3, np.deg2rad(20.0)


def run(case: MapCase) -> tuple[MapCell, ...]:
    """Plan on the reconstruction of one view at that elevation [deg]; try on the true object in its place."""
    (noise,) = case.up
    truth, scene = _seen(case.thing, float(case.across), float(noise), case.seed, settings(case.preset).resolution)
    hand, grasps = plan(case, scene)
    return (try_grasps(case, noise, hand, truth, grasps, PROTOCOLS["standard"]),)


def noise_at(times: float) -> DepthNoise:
    """The usual sensor with its errors and losses so many times as large; none at all at zero.

    Its resolution, its range and the angles at which it goes blind stay: they are no noise.
    """
    if not times:
        return NONE
    grown = {name: getattr(DEFAULT, name) * times for name in ("floor", "quadratic", "jitter")}
    shares = {name: min(getattr(DEFAULT, name) * times, 1.0) for name in ("flying", "edge_loss", "loss")}
    return replace(DEFAULT, **grown, **shares)


@lru_cache(maxsize=1)
def _seen(thing: str, elevation: float, noise: float, seed: int, resolution: int) -> tuple[ObjectModel, Scene]:
    """The true object, and the scene that one view of it makes; the same for every method.

    Raises:
        CloudError: the view shows no usable object.
    """
    stage = tabletop(thing, yaw=_YAW)
    poses = ring_poses(1, elevation=float(np.deg2rad(elevation)), azimuth=float(_AZIMUTH))
    views = views_of(stage, CAMERA, poses, noise_at(noise), seed)
    scene = scene_from_views(views, resolution=resolution)
    return build_scene(stage.truth, source=thing, resolution=resolution).object, scene
