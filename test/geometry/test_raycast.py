"""Depth images and pictures."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd_core.geometry.raycast import (
    BACKGROUND,
    PinholeCamera,
    cloud_from_depth,
    look_at,
    render_depth,
    render_shaded,
    save_png,
)
from graspd_core.geometry.shapes import SPHERE_RADIUS, make_shape
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


def test_the_cloud_lies_on_the_object():
    pose = look_at((0.3, 0.3, 0.3), (0, 0, 0))
    points = cloud_from_depth(render_depth(make_shape("sphere"), CAMERA, pose), CAMERA)
    world = points @ pose[:3, :3].T + pose[:3, 3]
    # Flat faces lie up to 0.1 mm inside the ball.
    assert np.linalg.norm(world, axis=1) == pytest.approx(np.full(len(world), SPHERE_RADIUS), abs=2e-4)
    assert len(world) > 50


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
