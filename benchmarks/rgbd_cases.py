"""One case of benchmarks/rgbd.py: what a camera sees of a shape on a table, to grasps that are tried on the truth."""

from __future__ import annotations

import importlib
import time
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from graspd_core.errors import GraspdError

# Where a sphere of 5 mm about a true point meets the reconstruction, that point counts as found.
FOUND = 0.005
SAMPLES = 20_000

# Elevation of the camera at each of the three starts: a robot looks at its table from half above [deg].
ELEVATIONS = (40.0, 50.0, 30.0)
YAW = 0.3
CLUTTER = (("box", 0.115, 0.02), ("cylinder", -0.03, -0.115))


@dataclass(frozen=True)
class Case:
    """What to run.

    Attributes:
        shape: authored shape, or path of a mesh in metres.
        start: 0 to 2: azimuth of the first camera, elevation, and the seed of noise and grasps.
        views: cameras: 1, 3, 15; 0 plans on the true mesh.
        count: verified grasps asked for.
        preset: of the optimiser.
        noise: level of the sensor's noise.
        clutter: whether two other shapes stand beside.
        front: module:function that makes a scene of views.
    """

    shape: str
    start: int
    views: int
    count: int = 8
    preset: str = "balanced"
    noise: str = "default"
    clutter: bool = False
    front: str = "graspd_core.scene.scene_from_views:scene_from_views"

    @property
    def key(self) -> str:
        parts = [self.shape, self.start, self.views, self.count, self.preset, self.noise, self.clutter]
        return " ".join(map(str, [*parts, self.front]))


def camera_poses(case: Case) -> tuple[np.ndarray, ...]:
    """One camera, three around, or two rings of eight and seven."""
    from graspd_core.rendering.tabletop import ring_poses

    azimuth, elevation = np.deg2rad(20.0 + 120.0 * case.start), np.deg2rad(ELEVATIONS[case.start])
    if case.views <= 3:
        return ring_poses(case.views, elevation=elevation, azimuth=azimuth)
    upper = ring_poses(case.views // 2, elevation=np.deg2rad(60.0), azimuth=azimuth + 0.2)
    return (*ring_poses(case.views - case.views // 2, elevation=np.deg2rad(30.0), azimuth=azimuth), *upper)


@lru_cache(maxsize=1)
def warm_hand(preset: str) -> Any:
    """The hand, after the process has done its first-use work."""
    import torch

    from graspd_core.hands.library import load_hand
    from graspd_core.methods.plan_config import load_preset
    from graspd_core.planning.plan_grasps import warm_up

    torch.set_num_threads(1)
    hand = load_hand("allegro_right", candidates=load_preset(preset).problem.fine_candidates)
    warm_up(hand)
    return hand


@lru_cache(maxsize=1)
def warm_front(name: str) -> Any:
    """The function that makes a scene of views, after its libraries have been loaded by a view of a ball."""
    from graspd_core.rendering.tabletop import CAMERA, ring_poses, tabletop, views_of

    module, function = name.split(":")
    front = getattr(importlib.import_module(module), function)
    front(views_of(tabletop("sphere"), CAMERA, ring_poses(1, elevation=0.8)))
    return front


def run_case(case: Case) -> dict:
    """Everything that is reported of one case; a refusal is a result with its message."""
    from graspd_core.mesh.mesh_files import load_mesh
    from graspd_core.rendering.depth_noise import LEVELS
    from graspd_core.rendering.tabletop import CAMERA, tabletop, views_of
    from graspd_core.runtime import disk_cache as cache
    from graspd_core.scene.scene import build_scene

    hand = warm_hand(case.preset)
    thing = load_mesh(case.shape) if Path(case.shape).suffix else case.shape
    stage = tabletop(thing, yaw=YAW, obstacles=CLUTTER if case.clutter else ())
    if case.views:
        seed = 1000 * case.start
        clouds = views_of(stage, CAMERA, camera_poses(case), LEVELS[case.noise], seed)
        front = warm_front(case.front)
    # Or the full mesh would be met again at its next start.
    cache.forget()
    began = time.perf_counter()
    try:
        if case.views:
            scene = front(clouds)
        else:
            scene = replace(
                build_scene(stage.truth, source=case.shape), support=stage.support, obstacles=_obstacles(stage)
            )
    except GraspdError as error:
        return {**vars(case), "error": str(error), "scene_s": time.perf_counter() - began, "verified": 0}
    scene_s = time.perf_counter() - began
    return {**vars(case), "scene_s": scene_s, **reconstruction_error(scene, stage), **_grasps(case, scene, stage, hand)}


def _grasps(case: Case, scene: Any, stage: Any, hand: Any) -> dict:
    """Plan one grasp against the clock, then `count`; try all that were verified on the truth."""
    from graspd_core.planning.plan_grasps import plan_grasps
    from graspd_core.scene.scene import build_scene, object_parts
    from graspd_core.trials.hold_trial import hold_trial
    from graspd_core.trials.lift_trial import lift_trial
    from graspd_core.trials.world import PROTOCOLS, build_world
    from graspd_core.types import Verdict

    first = plan_grasps(scene, hand, count=1, seed=case.start, preset=case.preset)
    many = plan_grasps(scene, hand, count=case.count, seed=case.start, preset=case.preset)
    protocol = PROTOCOLS["standard"]
    truth = build_scene(stage.truth, source=case.shape).object
    parts = object_parts(truth)
    world = build_world(hand, truth, parts, protocol)
    table = build_world(hand, truth, parts, protocol, stage.support, _obstacles(stage))

    def verified(result: Any) -> list:
        return [grasp for grasp in result.grasps if grasp.verdict is Verdict.VERIFIED]

    one = [hold_trial(world, grasp, protocol) for grasp in verified(first)]
    all_holds = [hold_trial(world, grasp, protocol) for grasp in verified(many)]
    lifts = [
        lift_trial(table, hand, grasp, protocol)
        for grasp, hold in zip(verified(many), all_holds, strict=True)
        if hold.passed
    ]
    timing = first.timing
    return {
        "first_s": None if timing.first_verified is None else timing.first_verified - timing.load - timing.sdf,
        "outcome": many.outcome.name,
        "first_held": bool(one and one[0].passed),
        "best_held": bool(all_holds and all_holds[0].passed),
        "verified": len(all_holds),
        "candidates": len(many.grasps),
        "held": sum(h.passed for h in all_holds),
        "lifted": sum(lift.passed for lift in lifts),
        "reasons": [trial.reason for trial in (*all_holds, *lifts) if not trial.passed],
        "warnings": list(many.warnings),
    }


def _obstacles(stage: Any) -> tuple:
    from graspd_core.mesh.sdf import build_sdf
    from graspd_core.scene.scene import Obstacle

    return tuple(Obstacle(mesh, build_sdf(mesh, resolution=32, padding=0.02)) for mesh in stage.obstacles)


def reconstruction_error(scene: Any, stage: Any) -> dict:
    """Distances between the reconstruction's surface and the true one, and whether it is closed.

    chamfer_mm: mean of the mean distances either way [mm]; completeness: share of the true surface within 5 mm of the
    reconstruction; beyond_10mm: share of the reconstruction farther than 10 mm from the truth.
    """
    from graspd_core.mesh.mesh_files import surface_samples
    from graspd_core.mesh.surface_queries import make_surface, surface_distance
    from graspd_core.mesh.topology import is_closed
    from graspd_core.mesh.winding_number import winding_inside

    points, normals = surface_samples(stage.truth, SAMPLES, 0)
    # Bodies that overlap have surfaces that nobody could see.
    outer = points[~winding_inside(stage.truth, points + 1e-4 * normals)]
    found = surface_samples(scene.object.mesh, SAMPLES, 0)[0]
    missing = surface_distance(make_surface(scene.object.mesh), outer)
    stray = surface_distance(make_surface(stage.truth), found)
    return {
        "chamfer_mm": 500 * float(missing.mean() + stray.mean()),
        "completeness": float((missing < FOUND).mean()),
        "beyond_10mm": float((stray > 0.01).mean()),
        "watertight": bool(is_closed(scene.object.mesh)),
    }
