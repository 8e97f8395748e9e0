"""The clouds that break things: each ends in a grasp, or in one line that says what is wrong (docs/clouds.md)."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from expected import some

from graspd_bench.rendering.depth_noise import DEFAULT, HIGH
from graspd_bench.rendering.tabletop import CAMERA, TabletopScene, depth_views, ring_poses, tabletop, views_of
from graspd_bench.stress.broken_clouds import bled
from graspd_core import Outcome, Verdict, plan_grasps, scene_from_views
from graspd_core.mesh.surface_queries import make_surface, surface_distance
from graspd_core.mesh.topology import is_closed
from graspd_core.perception.segment.segment import Target

PAGE = Path(__file__).parents[2] / "docs" / "clouds.md"
POSES = ring_poses(3, elevation=0.7, azimuth=0.5)

# From pixels to a trial, in ten CPU seconds each.
pytestmark = pytest.mark.timeout(300)


def grasp_of(views, hand, preset: str = "fast", **options):
    """The scene of the views and its best grasp; the case fails unless one of three seeds leads to a verified one.

    Which seed does depends on the processor, where several things stand together.
    """
    scene = scene_from_views(views, **options)
    assert is_closed(scene.object.mesh)
    results = (plan_grasps(scene, hand, count=1, preset=preset, seed=seed) for seed in range(3))
    result = some(next((each for each in results if each.outcome is Outcome.SUCCEEDED), None))
    assert result.grasps[0].verdict is Verdict.VERIFIED
    best = result.grasps[0].grasp
    assert np.isfinite([*best.position, *best.quaternion_wxyz, *best.joint_positions]).all()
    return scene, result.grasps[0]


def stray(scene, stage: TabletopScene) -> float:
    """How far the reconstruction's bounding box sticks out of the truth's [m]."""
    ours, true = scene.object.mesh.vertices, stage.truth.vertices
    return float(max((true.min(0) - ours.min(0)).max(), (ours.max(0) - true.max(0)).max()))


def test_the_python_of_the_page_runs():
    (block,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    ((depth, _),) = depth_views(tabletop("cylinder"), CAMERA, POSES[:1], DEFAULT)
    names: dict = {"image": np.round(1000 * depth).astype(np.uint16), "T_frame_camera": POSES[0]}
    exec(compile(block, PAGE.name, "exec"), names)
    assert names["result"].outcome is Outcome.SUCCEEDED


@pytest.mark.slow
def test_flying_pixels_do_not_make_the_object_larger(hand):
    stage = tabletop("box", yaw=0.3)
    views = views_of(stage, CAMERA, POSES, replace(HIGH, flying=1.0, edge_loss=0.0))
    scene, _ = grasp_of(views, hand)
    assert stray(scene, stage) < 0.015


def test_table_points_that_bleed_into_the_object_do_no_harm(hand):
    scene, _ = grasp_of(bled(), hand, alone=True, mass=0.3)
    assert stray(scene, tabletop("mug", yaw=0.3)) < 0.03


def test_of_two_touching_objects_the_masked_one_is_taken(hand):
    stage = tabletop("box", obstacles=[("cylinder", 0.063, 0.0)])
    pose = ring_poses(1, elevation=0.9, azimuth=-1.57)
    ((depth, label),) = depth_views(stage, CAMERA, pose, DEFAULT)
    (view,) = views_of(stage, CAMERA, pose, DEFAULT)
    scene, _ = grasp_of([view], hand, "balanced", target=Target(mask=label[depth > 0] == 0), mass=0.1)
    assert stray(scene, stage) < 0.02
    # The other is in the way: a neighbour covers what the camera saw of it.
    other = view.points[label[depth > 0] == 1]
    covered = [surface_distance(make_surface(near.mesh), other) < 0.01 for near in scene.obstacles]
    assert np.any(covered, axis=0).mean() > 0.95
