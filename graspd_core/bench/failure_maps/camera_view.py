"""Success over the angle and the noise of a single depth view: planned on what it shows, tried on the truth."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from graspd_core.bench.failure_maps.map_case import Done, MapCase, plan, settings, try_grasps
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.surface_queries import make_surface, surface_distance
from graspd_core.rendering.depth_noise import DEFAULT, NONE, DepthNoise
from graspd_core.rendering.tabletop import CAMERA, ring_poses, tabletop, views_of
from graspd_core.scene.scene import ObjectModel, Scene, build_scene
from graspd_core.scene.scene_from_views import scene_from_views
from graspd_core.trials.world import PROTOCOLS
from graspd_core.types import TriangleMesh

ELEVATIONS = (15.0, 30.0, 50.0, 80.0)
NOISES = (0.0, 1.0, 2.0, 4.0)
THINGS = ("mug",)
_YAW, _AZIMUTH = 0.3, np.deg2rad(20.0)
_SAMPLES = 4000
# True surface nearer than this to the reconstruction counts as found [m].
_FOUND = 0.005


def run(case: MapCase) -> Done:
    """Plan on the reconstruction of one view at that elevation [deg]; try on the true object in its place."""
    (noise,) = case.up
    truth, scene = _seen(case.thing, float(case.across), float(noise), case.seed, settings(case.preset).resolution)
    hand, grasps = plan(case, scene)
    cell = try_grasps(case, noise, hand, truth, grasps, PROTOCOLS["standard"])
    return Done((cell,), _errors(truth.mesh, scene.object.mesh))


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


def _errors(truth: TriangleMesh, found: TriangleMesh) -> dict[str, float]:
    """Share of the true surface that was found, and how far the reconstruction's strays from it, 90th percentile."""
    missing = surface_distance(make_surface(found), surface_samples(truth, _SAMPLES, 0)[0])
    stray = surface_distance(make_surface(truth), surface_samples(found, _SAMPLES, 0)[0])
    return {"complete": float((missing < _FOUND).mean()), "stray_mm": 1e3 * float(np.quantile(stray, 0.9))}
