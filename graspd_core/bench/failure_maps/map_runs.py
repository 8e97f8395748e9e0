"""What each map does for a case: friction and mass, the object's size, a single depth view, the wall of a cup."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch

from graspd_core.bench.failure_maps.map_case import MapCase, MapCell, hand_for, plan, settings, try_grasps
from graspd_core.bench.stress.broken_meshes import thin_cup
from graspd_core.hands.fingers import find_fingers
from graspd_core.hands.kinematics import make_kinematics, points_in_base
from graspd_core.hands.model import HandModel
from graspd_core.mesh.sdf import build_sdf
from graspd_core.mesh.shapes import make_shape
from graspd_core.rendering.depth_noise import DEFAULT, NONE, DepthNoise
from graspd_core.rendering.tabletop import CAMERA, ring_poses, tabletop, views_of
from graspd_core.scene.load_scene import load_scene
from graspd_core.scene.scene import ObjectModel, Scene, build_scene
from graspd_core.scene.scene_from_views import scene_from_views
from graspd_core.trials.world import PROTOCOLS, at_friction
from graspd_core.types import TriangleMesh

_POSTURES = 4096
_YAW, _AZIMUTH = 0.3, np.deg2rad(20.0)


def run_friction_mass(case: MapCase) -> tuple[MapCell, ...]:
    """Plan at the friction of the case, for the 0.1 kg that planning supposes; try at every mass."""
    config = settings(case.preset)
    scene = load_scene(f"shape:{case.thing}", friction=float(case.across), resolution=config.resolution)
    hand, grasps = plan(case, scene)
    protocol = at_friction(PROTOCOLS["standard"], float(case.across))
    return tuple(try_grasps(case, mass, hand, at_mass(scene.object, mass), grasps, protocol) for mass in case.up)


def at_mass(target: ObjectModel, mass: float | str) -> ObjectModel:
    """The same object of another mass [kg], evenly spread as before."""
    share = float(mass) / target.mass
    return replace(target, mass=float(mass), inertia=target.inertia * share)


def run_size(case: MapCase) -> tuple[MapCell, ...]:
    """Plan and try on the shape scaled so that its least width is that share of the hand's span; 0.1 kg throughout."""
    config = settings(case.preset)
    width = float(case.across) * _span(case.hand, config.problem.fine_candidates)
    scale = width / least_width(make_shape(case.thing))
    scene = load_scene(f"shape:{case.thing}", scale=scale, resolution=config.resolution)
    hand, grasps = plan(case, scene)
    return tuple(try_grasps(case, up, hand, scene.object, grasps, PROTOCOLS["standard"]) for up in case.up)


def least_width(mesh: TriangleMesh) -> float:
    """The least extent along the axes of a mesh [m]: of the authored shapes, what a hand has to span."""
    return float(np.ptp(mesh.vertices, axis=0).min())


def hand_span(hand: HandModel) -> float:
    """The greatest distance between two fingertips that joints within their limits allow [m].

    The greatest of a few thousand seeded postures: about a millimetre short of the true one.
    """
    fingers = find_fingers(hand)
    draw = torch.Generator().manual_seed(0)
    lower, upper = torch.as_tensor(hand.lower), torch.as_tensor(hand.upper)
    shares = torch.rand(_POSTURES, hand.num_joints, generator=draw, dtype=torch.float64)
    # The greatest distances are at limits: half of the postures have every joint at one of its ends.
    shares[::2] = shares[::2].round()
    kinematics = make_kinematics(hand, dtype=torch.float64)
    tips = points_in_base(
        kinematics, lower + shares * (upper - lower), torch.as_tensor(fingers.points), torch.as_tensor(fingers.links)
    )
    return float(torch.cdist(tips, tips).max())


@lru_cache(maxsize=4)
def _span(hand: str, candidates: int) -> float:
    return hand_span(hand_for(hand, candidates))


def run_view(case: MapCase) -> tuple[MapCell, ...]:
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


def run_wall(case: MapCase) -> tuple[MapCell, ...]:
    """Plan on a grid of that resolution, and no finer, of a cup with walls of so many millimetres."""
    (wall,) = case.up
    scene = on_grid(cup(float(wall)), int(case.across))
    hand, grasps = plan(case, scene)
    return (try_grasps(case, wall, hand, scene.object, grasps, PROTOCOLS["standard"]),)


@lru_cache(maxsize=1)
def cup(wall: float) -> Scene:
    """A cup with walls of so many millimetres."""
    return build_scene(thin_cup(wall * 1e-3), source=f"cup of {wall:g} mm")


def on_grid(scene: Scene, resolution: int) -> Scene:
    """The same scene with the distances of another grid, however much too coarse."""
    return replace(scene, sdf=build_sdf(scene.object.mesh, resolution=resolution))
