"""Depth images and pictures."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd_bench.rendering.render import BACKGROUND, look_at, render_depth, render_scene, render_shaded, save_png
from graspd_core.mesh.shapes import SPHERE_RADIUS, make_shape
from graspd_core.perception.cloud.camera import PinholeCamera, camera_rays, cloud_from_depth, project
from graspd_core.types import TriangleMesh

CAMERA = PinholeCamera(81, 61, 100.0, 100.0, 40.0, 30.0)

coordinate = st.floats(-1, 1)


@given(eye=st.tuples(coordinate, coordinate, coordinate).filter(lambda e: np.linalg.norm(e) > 0.1))
def test_looking_is_a_rigid_motion_that_puts_the_target_ahead(eye):
    pose = look_at(eye, (0, 0, 0))
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    assert pose[:3, :3] @ [0, 0, np.linalg.norm(eye)] + pose[:3, 3] == pytest.approx(np.zeros(3), abs=1e-9)


def test_up_is_up_in_the_image():
    # The image's y axis points down.
    assert look_at((1, 0, 0), (0, 0, 0))[:3, 1] == pytest.approx([0, 0, -1])


def test_depth_of_a_sphere_is_the_closed_form():
    depth = render_depth(make_shape("sphere"), CAMERA, look_at((0.5, 0, 0), (0, 0, 0)))
    assert depth[30, 40] == pytest.approx(0.5 - SPHERE_RADIUS, abs=1e-4)
    assert depth[0, 0] == 0
    # The outline lies where the line of sight is tangent: tan = r / √(d² − r²).
    radius = np.sqrt((depth > 0).sum() / np.pi)
    assert radius == pytest.approx(100 * SPHERE_RADIUS / np.sqrt(0.25 - SPHERE_RADIUS**2), rel=0.05)


def test_a_scene_is_seen_with_the_name_of_what_each_pixel_shows():
    sphere = make_shape("sphere")
    wall = TriangleMesh(
        np.array([[-1.0, -5, -5], [-1, 5, -5], [-1, 5, 5], [-1, -5, 5]]), np.array([[0, 1, 2], [0, 2, 3]])
    )
    pose = look_at((0.5, 0, 0), (0, 0, 0))
    depth, label = render_scene([wall, sphere], CAMERA, pose)
    assert set(np.unique(label)) == {0, 1}
    assert depth[label == 0] == pytest.approx(np.full((label == 0).sum(), 1.5), abs=1e-5)
    # Of a ray through x, y at unit depth: the nearer root of |z (x, y, 1) - (0, 0, 0.5)| = radius.
    ray = camera_rays(CAMERA)[label == 1]
    length = (ray**2).sum(1)
    z = (0.5 - np.sqrt((0.25 - length * (0.25 - SPHERE_RADIUS**2)).clip(0))) / length
    steep = (length - 1) < 0.8 * SPHERE_RADIUS**2 / 0.25
    assert depth[label == 1][steep] == pytest.approx(z[steep], abs=3e-4)
    alone, nothing = render_scene([sphere], CAMERA, pose)
    assert (alone[nothing < 0] == 0).all()
    assert (nothing == label - 1).all()


def test_a_scene_appears_where_the_lens_puts_it():
    lens = PinholeCamera(161, 121, 150.0, 150.0, 80.0, 60.0, (-0.2, 0.05, 0.002, -0.001, 0.0))
    pose = look_at((0.3, 0.2, 0.25), (0, 0, 0))
    balls = [make_shape("sphere"), make_shape("box")]
    balls[1] = TriangleMesh(balls[1].vertices + np.array([0.0, 0.12, 0.0]), balls[1].faces)
    depth, label = render_scene(balls, lens, pose)
    points = cloud_from_depth(depth, lens).points
    row, column = np.nonzero(depth)
    assert project(points, lens) == pytest.approx(np.stack([column, row], -1), abs=1e-6)
    world = points @ pose[:3, :3].T + pose[:3, 3]
    on_ball = label[row, column] == 0
    assert np.linalg.norm(world[on_ball], axis=1) == pytest.approx(np.full(on_ball.sum(), SPHERE_RADIUS), abs=2e-4)


def test_pixels_beyond_the_lens_see_nothing():
    # Strong barrel distortion folds back before the corners of the image.
    lens = PinholeCamera(81, 61, 30.0, 30.0, 40.0, 30.0, (-0.3,))
    blind = np.isnan(camera_rays(lens)[..., 0])
    assert blind.any()
    assert not blind.all()
    ball = make_shape("sphere")
    depth, label = render_scene([TriangleMesh(ball.vertices * 10, ball.faces)], lens, np.eye(4))
    assert (label[blind] == -1).all()
    assert (depth[blind] == 0).all()
    assert (label[~blind] == 0).all()


def test_pictures_show_every_mesh_in_its_colour(tmp_path):
    sphere, box = make_shape("sphere"), make_shape("box")
    left = TriangleMesh(box.vertices + np.array([0, -0.1, 0]), box.faces)
    scene = [(sphere, (1.0, 0.0, 0.0)), (left, (0.0, 0.0, 1.0))]
    image = render_shaded(scene, T_world_camera=look_at((0.6, 0, 0.2), (0, 0, 0)), width=160, height=120)
    assert image.shape == (120, 160, 3)
    assert (image[0, 0] == BACKGROUND).all()
    red = (image[..., 0] > 60) & (image[..., 2] == 0)
    blue = (image[..., 2] > 60) & (image[..., 0] == 0)
    assert red.sum() > 200
    assert blue.sum() > 200
    # Seen from +x with z up, −y is on the left.
    assert np.nonzero(blue)[1].mean() < np.nonzero(red)[1].mean()
    save_png(image, tmp_path / "picture.png")
    import open3d as o3d

    assert np.array_equal(np.asarray(o3d.io.read_image(tmp_path / "picture.png")), image)
