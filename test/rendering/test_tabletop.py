"""Authored scenes: things rest where they should, and cameras see what is there."""

import numpy as np
import pytest

from graspd_bench.rendering.depth_noise import DEFAULT, NONE
from graspd_bench.rendering.tabletop import (
    CAMERA,
    TABLE_HALF,
    depth_views,
    lowest_pose,
    moved,
    ring_poses,
    tabletop,
    views_of,
)
from graspd_core.errors import MeshError
from graspd_core.mesh.shapes import CAPSULE_RADIUS, HEAD_HALF, PLATE_HALF, SHAPES, make_shape
from graspd_core.perception.cloud.camera import PinholeCamera

SMALL = PinholeCamera(160, 120, 154.0, 154.0, 79.5, 59.5)


@pytest.mark.parametrize("name", SHAPES)
def test_every_shape_stands_on_the_table_above_the_origin(name):
    scene = tabletop(name, yaw=0.4)
    low, high = scene.truth.vertices.min(0), scene.truth.vertices.max(0)
    assert low[2] == pytest.approx(0, abs=1e-9)
    assert (low[:2] < 0).all()
    assert (high > 0).all()
    assert moved(make_shape(name), scene.T_world_object).vertices == pytest.approx(scene.truth.vertices)
    assert np.linalg.det(scene.T_world_object[:3, :3]) == pytest.approx(1)


@pytest.mark.parametrize(
    ("name", "height"),
    [("capsule", 2 * CAPSULE_RADIUS), ("plate", 2 * PLATE_HALF[2]), ("hammer", 2 * HEAD_HALF[1])],
)
def test_lowest_is_lying(name, height):
    resting = moved(make_shape(name), lowest_pose(make_shape(name)))
    # A capsule of 64 sides rests on one of them; a hammer leans from its head to the thinner end of its shaft.
    assert np.ptp(resting.vertices[:, 2]) == pytest.approx(height, abs=5e-4)


def test_turning_a_shape_turns_it_about_the_vertical():
    straight, turned = tabletop("box"), tabletop("box", yaw=0.5)
    assert turned.truth.vertices[:, 2] == pytest.approx(straight.truth.vertices[:, 2])
    assert turned.T_world_object[:2, 0] == pytest.approx([np.cos(0.5), np.sin(0.5)])


def test_cameras_stand_on_a_ring_and_look_at_the_object():
    poses = ring_poses(3, elevation=0.6, distance=0.5, azimuth=0.2, target=(0.1, 0.0, 0.05))
    eyes = np.array([pose[:3, 3] for pose in poses]) - [0.1, 0.0, 0.05]
    assert np.linalg.norm(eyes, axis=1) == pytest.approx(np.full(3, 0.5))
    assert eyes[:, 2] == pytest.approx(np.full(3, 0.5 * np.sin(0.6)))
    assert np.arctan2(eyes[0, 1], eyes[0, 0]) == pytest.approx(0.2)
    for pose, eye in zip(poses, eyes, strict=True):
        assert pose[:3, 2] == pytest.approx(-eye / 0.5)


def test_without_noise_points_lie_on_what_their_pixel_shows():
    scene = tabletop("box", obstacles=[("sphere", 0.12, 0.0)])
    pose = ring_poses(1, elevation=0.7, azimuth=1.2)
    ((depth, label),) = depth_views(scene, SMALL, pose)
    (cloud,) = views_of(scene, SMALL, pose)
    assert set(np.unique(label)) == {-1, 0, 1, 2}
    label = label[depth > 0]
    box, sphere, table = (cloud.points[label == index] for index in range(3))
    half = np.array([0.03, 0.03, 0.045])
    outside = np.abs(box - [0, 0, 0.045]) - half
    assert outside.max(1) == pytest.approx(np.zeros(len(box)), abs=1e-5)
    # The ball's faces lie up to 0.1 mm inside.
    assert np.linalg.norm(sphere - [0.12, 0, 0.035], axis=1) == pytest.approx(0.035, abs=2e-4)
    on_top = np.abs(table[:, :2]).max(1) < TABLE_HALF - 1e-3
    assert table[on_top, 2] == pytest.approx(np.zeros(on_top.sum()), abs=1e-5)
    assert scene.support.normal @ table[on_top].T == pytest.approx(
        np.full(on_top.sum(), scene.support.offset), abs=1e-5
    )


def test_views_carry_their_camera_and_their_own_noise():
    scene = tabletop("mug")
    poses = ring_poses(2, elevation=0.6)
    views = views_of(scene, CAMERA, poses, DEFAULT, seed=3)
    for view, pose in zip(views, poses, strict=True):
        assert view.viewpoint == pytest.approx(pose[:3, 3])
        assert view.forward == pytest.approx(pose[:3, 2])
        assert np.isfinite(view.points).all()
    again = views_of(scene, CAMERA, poses, DEFAULT, seed=3)
    other = views_of(scene, CAMERA, poses, DEFAULT, seed=4)
    assert all(np.array_equal(a.points, b.points) for a, b in zip(views, again, strict=True))
    assert len(views[0].points) != len(other[0].points)


def test_the_noise_of_the_table_is_that_of_the_camera():
    scene = tabletop("sphere")
    pose = ring_poses(1, elevation=0.8)
    (true, label), (seen, _) = (depth_views(scene, CAMERA, pose, noise)[0] for noise in (NONE, DEFAULT))
    table = (label == 1) & (seen > 0) & (true > 0.55) & (true < 0.65)
    # Jitter moves a pixel along the slope too; at the edges of things it moves it far, hence the median.
    spread = 1.4826 * np.median(np.abs((seen - true)[table]))
    assert spread == pytest.approx(DEFAULT.floor + DEFAULT.quadratic * 0.6**2, rel=0.25)


def test_an_unknown_shape_is_named():
    with pytest.raises(MeshError, match="teapot"):
        tabletop("teapot")
