"""Scenes from every kind of source, from what a camera saw of a crowded table, and of an object far from the origin."""

import dataclasses

import numpy as np
import pytest
import torch
from expected import some
from shape_volumes import shape_volume

from graspd_bench.rendering.tabletop import CAMERA, ring_poses, tabletop, views_of
from graspd_core import PointCloud, Target, load_preset, load_scene, make_shape, scene_from_views, verify_grasps
from graspd_core.errors import CloudError, MeshError
from graspd_core.io.grasps_json import grasps_of, load_document, save_result
from graspd_core.mesh.mesh_files import save_mesh, surface_samples
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.mesh.topology import far_centre, moved_mesh
from graspd_core.perception.cloud.free_space import FreeSpace, empty_depth, make_view_depths
from graspd_core.perception.reconstruct.reconstruct import reconstruct
from graspd_core.perception.scene import build_scene, moved_object, object_parts
from graspd_core.perception.segment.segment import segment
from graspd_core.planning.plan_grasps import plan_grasps, planning_scene
from graspd_core.types import Outcome, Plane, TriangleMesh, Verdict


def test_file_scale_and_value_agree(tmp_path):
    box = make_shape("box")
    millimetres = dataclasses.replace(box, vertices=box.vertices * 1000)
    save_mesh(tmp_path / "box.ply", millimetres)
    from_file = load_scene(tmp_path / "box.ply", scale=1e-3, resolution=16)
    from_value = load_scene(millimetres, scale=1e-3, resolution=16)
    assert from_file.object.volume == pytest.approx(from_value.object.volume, rel=1e-5)
    assert torch.allclose(from_file.sdf.field[0], from_value.sdf.field[0], atol=1e-6)


def test_a_cloud_becomes_a_scene_in_its_own_frame():
    """The side of a sphere that a camera at the origin sees, a third of a metre ahead."""
    ball, normals = surface_samples(make_shape("sphere"), 6000, 0)
    ball = ball + np.array([0.0, 0.0, 0.33])
    points = ball[(normals * ball).sum(1) < 0]
    view = PointCloud(np.vstack([points, np.full((9, 3), np.nan)]), np.zeros(3))
    scene = scene_from_views([view], mass=0.2, friction=0.9, resolution=16)
    thing = scene.object
    assert (thing.source, thing.mass, thing.friction, thing.scale) == ("cloud", 0.2, 0.9, 1.0)
    # The unseen half is guessed: some millimetres.
    assert thing.center_of_mass == pytest.approx([0.0, 0.0, 0.33], abs=0.006)
    assert thing.volume == pytest.approx(shape_volume("sphere"), rel=0.2)
    assert any("guess" in warning for warning in thing.warnings)
    assert scene.sdf.field.shape == (4, 16, 16, 16)


def test_a_cloud_that_shows_nothing_is_refused_and_so_is_a_bad_mass():
    with pytest.raises(CloudError, match="empty"):
        scene_from_views([PointCloud(np.zeros((0, 3)), np.zeros(3))])
    with pytest.raises(MeshError, match="mass"):
        scene_from_views([PointCloud(np.random.default_rng(0).random((100, 3)), np.zeros(3))], mass=-1.0)


def test_unknown_endings_list_meshes_and_clouds(tmp_path):
    (tmp_path / "a.docx").write_text("x")
    with pytest.raises(MeshError, match=r"docx'; valid endings: dae, .*npy.*stl"):
        load_scene(tmp_path / "a.docx")


MAP = np.array([512_345.25, 5_401_234.5, 370.0])


def at(place) -> TriangleMesh:
    return moved_mesh(make_shape("box"), np.asarray(place, dtype=float))


def test_far_is_a_hundred_times_the_size_and_near_the_origin_nothing_is_moved():
    size = 0.09
    assert not far_centre(at((99 * size, 0, 0)).vertices).any()
    assert far_centre(at((0, 101 * size, 0)).vertices) == pytest.approx([0, 101 * size, 0])
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
    ours, theirs = object_parts(moved_object(far, -MAP)), object_parts(near)
    assert sum(len(p.vertices) for p in ours) == sum(len(p.vertices) for p in theirs)
    assert np.concatenate([p.vertices for p in ours]).min(0) == pytest.approx(near.mesh.vertices.min(0), abs=1e-3)


def test_a_far_scene_is_planned_about_its_object():
    table = Plane(np.array([0.0, 0.0, 1.0]), MAP[2] - 0.045)
    scene = build_scene(at(MAP), support=table, resolution=16)
    planned, far = planning_scene(scene, 16)
    assert far == pytest.approx(MAP)
    assert some(planned.support).offset == pytest.approx(-0.045, abs=1e-9)
    assert np.abs(planned.object.mesh.vertices).max() < 0.1
    corner = planned.sdf.origin.new_tensor(planned.object.mesh.vertices)
    assert sample_sdf(planned.sdf, corner)[0].abs().max() < 0.005


def test_grasps_of_a_far_object_hold_there(hand, tmp_path):
    scene = build_scene(at(MAP))
    result = plan_grasps(scene, hand, count=2, seed=3, preset="fast")
    assert result.outcome is Outcome.SUCCEEDED
    save_result(tmp_path / "grasps.json", result, scene.object, hand, load_preset("fast"))
    kept = [g for g in grasps_of(load_document(tmp_path / "grasps.json")) if g.verdict is Verdict.VERIFIED]
    assert len(kept) == 2
    again = verify_grasps(scene, hand, kept)
    assert [(g.verdict, g.grasp) for g in again] == [(Verdict.VERIFIED, g.grasp) for g in kept]
    for grasp in kept:
        for posture in (grasp.pregrasp, grasp.grasp, grasp.squeeze):
            assert np.linalg.norm(posture.position - MAP) < 0.4
        gaps = [np.abs(np.array(contact.position) - MAP) for contact in grasp.contacts]
        # Contacts lie on the box, to the planner's grid.
        assert np.array(gaps) == pytest.approx(np.clip(gaps, 0, [0.03, 0.03, 0.045]), abs=0.003)


# A box that hides the lower part of a ball from the camera.
CROWDED = tabletop("sphere", obstacles=(("box", 0.115, 0.02),))
VIEWS = views_of(CROWDED, CAMERA, ring_poses(1, elevation=np.deg2rad(40.0), azimuth=np.deg2rad(10.0)))
TARGET = Target(point=np.array([0.0, 0.0, 0.035]))


def test_what_something_hides_may_be_there():
    seen = segment(VIEWS, target=TARGET)
    whole = reconstruct(seen.views, seen.support, whole=VIEWS)
    truth = CROWDED.truth.vertices
    assert seen.views[0].points[:, 2].min() > 0.015
    assert whole.mesh.vertices.min(0) == pytest.approx(truth.min(0), abs=0.006)
    assert whole.mesh.vertices.max(0) == pytest.approx(truth.max(0), abs=0.006)
    points, _ = surface_samples(CROWDED.truth, 4000, 0)
    knowing, blind = (FreeSpace(make_view_depths(seen.views, around), True) for around in (VIEWS, ()))
    assert (empty_depth(knowing, points) > 0.005).mean() < 0.01
    assert (empty_depth(blind, points) > 0.005).mean() > 0.1, "what is hidden counted as empty"


def test_a_scene_knows_what_its_views_hide():
    scene = scene_from_views(VIEWS, target=TARGET)
    assert scene.object.mesh.vertices[:, 2].min() == pytest.approx(0.0, abs=0.006)
    assert len(scene.obstacles) == 1


def test_before_an_occluder_it_is_empty_and_behind_it_nobody_knows():
    """A wall a metre away, and a strip that hides its right half, half a metre away."""
    ticks = np.linspace(-0.1, 0.1, 80)
    x, y = (axis.ravel() for axis in np.meshgrid(ticks, ticks))
    wall = np.column_stack([x, y, np.ones_like(x)])[x < 0]
    strip = np.column_stack([0.5 * x, 0.5 * y, np.full_like(x, 0.5)])[x > 0]
    eye = np.zeros(3)
    alone, whole = PointCloud(wall, eye), PointCloud(np.concatenate([wall, strip]), eye)
    (depth,) = make_view_depths([alone], [whole])
    hidden, before = np.array([[0.05, 0.0, 1.0], [0.05, 0.0, 0.8]]), np.array([[0.02, 0.0, 0.4]])
    known = FreeSpace((depth,), standing=False)
    assert empty_depth(known, hidden) == pytest.approx(0.0)
    assert empty_depth(known, before)[0] == pytest.approx(0.1, abs=0.01)
    assert (empty_depth(FreeSpace(make_view_depths([alone]), standing=False), hidden) > 0.03).all()
