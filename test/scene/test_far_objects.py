"""An object far from the origin, as in the coordinates of a map, is planned and tried like one at the origin."""

from __future__ import annotations

import numpy as np
import pytest

from graspd_core.hands.library import load_hand
from graspd_core.io.grasps_json import grasps_of, load_document, save_result
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.mesh.shapes import make_shape, shape_volume
from graspd_core.mesh.topology import far_centre
from graspd_core.optimize.plan_config import load_preset
from graspd_core.perception.load_scene import load_scene
from graspd_core.perception.scene import build_scene, object_parts
from graspd_core.planning.plan_grasps import plan_grasps, planning_scene
from graspd_core.types import Outcome, Plane, TriangleMesh, Verdict
from graspd_core.verify.hold_trial import hold_trial
from graspd_core.verify.world import PROTOCOLS, build_world

MAP = np.array([512_345.25, 5_401_234.5, 370.0])


def at(place, shape: str = "box") -> TriangleMesh:
    mesh = make_shape(shape)
    return TriangleMesh(mesh.vertices + np.asarray(place, dtype=float), mesh.faces)


def test_far_is_a_hundred_times_the_size():
    size = 0.09
    assert not far_centre(at((99 * size, 0, 0)).vertices).any()
    assert far_centre(at((0, 101 * size, 0)).vertices) == pytest.approx([0, 101 * size, 0])


def test_near_the_origin_nothing_is_moved():
    scene = load_scene("shape:box", resolution=16)
    planned, far = planning_scene(scene, 16)
    assert planned is scene
    assert not far.any()


def test_a_far_object_is_measured_like_a_near_one():
    far = build_scene(at(MAP), resolution=16).object
    near = build_scene(at((0, 0, 0)), resolution=16).object
    # A coordinate of five million metres is known to a nanometre.
    assert far.volume == pytest.approx(shape_volume("box"), rel=1e-6)
    assert far.center_of_mass - MAP == pytest.approx(near.center_of_mass, abs=1e-8)
    assert far.inertia == pytest.approx(near.inertia, rel=1e-5)
    ours, theirs = object_parts(far), object_parts(near)
    assert sum(len(p.vertices) for p in ours) == sum(len(p.vertices) for p in theirs)
    assert np.concatenate([p.vertices for p in ours]).min(0) - MAP == pytest.approx(near.mesh.vertices.min(0), abs=1e-3)


def test_a_far_scene_is_planned_about_its_object():
    table = Plane(np.array([0.0, 0.0, 1.0]), MAP[2] - 0.045)
    scene = build_scene(at(MAP), support=table, resolution=16)
    planned, far = planning_scene(scene, 16)
    assert far == pytest.approx(MAP)
    assert planned.support is not None
    assert planned.support.offset == pytest.approx(-0.045, abs=1e-9)
    assert np.abs(planned.object.mesh.vertices).max() < 0.1
    corner = planned.sdf.origin.new_tensor(planned.object.mesh.vertices)
    assert sample_sdf(planned.sdf, corner)[0].abs().max() < 0.005


@pytest.fixture(scope="module")
def hand():
    return load_hand("allegro_right")


def test_grasps_of_a_far_object_hold_there(hand, tmp_path):
    scene = build_scene(at(MAP))
    result = plan_grasps(scene, hand, count=2, seed=3, preset="fast")
    assert result.outcome is Outcome.SUCCEEDED
    save_result(tmp_path / "grasps.json", result, scene.object, hand, load_preset("fast"))
    kept = [g for g in grasps_of(load_document(tmp_path / "grasps.json")) if g.verdict is Verdict.VERIFIED]
    assert len(kept) == 2
    protocol = PROTOCOLS["standard"]
    world = build_world(hand, scene.object, object_parts(scene.object), protocol)
    for grasp in kept:
        for posture in (grasp.pregrasp, grasp.grasp, grasp.squeeze):
            assert np.linalg.norm(posture.position - MAP) < 0.4
        gaps = [np.abs(np.array(contact.position) - MAP) for contact in grasp.contacts]
        # Contacts lie on the box, to the planner's grid.
        assert np.array(gaps) == pytest.approx(np.clip(gaps, 0, [0.03, 0.03, 0.045]), abs=0.003)
        assert hold_trial(world, grasp, protocol).passed
