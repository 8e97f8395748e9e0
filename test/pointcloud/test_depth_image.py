"""Depth images: every encoding and layout of bytes comes back as metres, and the cloud lies where the thing is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd_bench.rendering.render import look_at, render_depth
from graspd_core.errors import CloudError
from graspd_core.mesh.shapes import SPHERE_RADIUS, make_shape
from graspd_core.perception.cloud.camera import (
    PinholeCamera,
    cloud_from_depth,
    depth_from_bytes,
    depth_in_metres,
    project,
)

LENS = (0.1, -0.25, 0.002, -0.001, 0.1)
CAMERA = PinholeCamera(81, 61, 100.0, 100.0, 40.0, 30.0)
DISTORTED = PinholeCamera(81, 61, 100.0, 100.0, 40.0, 30.0, LENS)


def as_bytes(pixels: np.ndarray, order: str, padding: int) -> tuple[memoryview, int]:
    """Rows of an image with junk after each; the bytes and the step."""
    height, width = pixels.shape
    step = width * pixels.itemsize + padding
    data = np.full(height * step, 0xAB, dtype=np.uint8)
    np.ndarray((height, width), order + pixels.dtype.str[1:], data, 0, (step, pixels.itemsize))[...] = pixels
    return memoryview(data.tobytes()), step


@given(
    st.sampled_from(["16UC1", "mono16", "32FC1"]),
    st.sampled_from("<>"),
    st.integers(0, 9),
    st.integers(1, 5),
    st.integers(1, 6),
    st.integers(0, 2**32 - 1),
)
def test_any_layout_comes_back_in_metres(encoding, order, padding, height, width, seed):
    millimetres = np.random.default_rng(seed).integers(0, 2**16, (height, width))
    pixels = millimetres.astype("u2") if encoding != "32FC1" else (millimetres / 1000).astype("f4")
    data, step = as_bytes(pixels, order, padding)
    depth = depth_from_bytes(data, width=width, height=height, step=step, encoding=encoding, is_bigendian=order == ">")
    assert depth == pytest.approx(millimetres / 1000, rel=1e-6)


def test_what_is_no_depth_is_zero():
    image = np.array([[0.5, np.nan, np.inf, -np.inf, -1.0, 0.0]], dtype=np.float32)
    assert depth_in_metres(image, "32FC1").tolist() == [[0.5, 0, 0, 0, 0, 0]]


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED], ids=["ideal", "distorted"])
def test_the_cloud_lies_on_the_object_in_the_frame_asked_for(camera):
    pose = look_at((0.3, -0.2, 0.3), (0, 0, 0))
    cloud = cloud_from_depth(render_depth(make_shape("sphere"), camera, pose), camera, pose)
    # Flat faces lie up to 0.1 mm inside the ball; Embree counts in float32.
    assert np.linalg.norm(cloud.points, axis=1) == pytest.approx(np.full(len(cloud.points), SPHERE_RADIUS), abs=2e-4)
    assert len(cloud.points) > 50
    assert cloud.viewpoint == pytest.approx([0.3, -0.2, 0.3])
    assert cloud.forward == pytest.approx(-cloud.viewpoint / np.linalg.norm(cloud.viewpoint))


def test_a_distorted_image_is_the_ideal_one_seen_through_the_lens():
    """Each pixel's point, put through the lens again, appears in that pixel."""
    depth = np.linspace(0.3, 0.9, 61 * 81).reshape(61, 81)
    cloud = cloud_from_depth(depth, DISTORTED)
    row, column = np.indices(depth.shape)
    assert project(cloud.points, DISTORTED) == pytest.approx(np.stack([column, row], -1).reshape(-1, 2), abs=1e-6)
    assert cloud.points[:, 2] == pytest.approx(depth.reshape(-1))


def test_the_ideal_camera_agrees_with_open3d():
    import open3d as o3d

    depth = np.random.default_rng(0).uniform(0.2, 0.9, (61, 81)).astype(np.float32)
    depth[::3] = 0
    image = o3d.geometry.Image(depth)  # pyright: ignore[reportCallIssue, reportArgumentType]
    intrinsic = o3d.camera.PinholeCameraIntrinsic(81, 61, 100.0, 100.0, 40.0, 30.0)
    truth = o3d.geometry.PointCloud.create_from_depth_image(image, intrinsic, depth_scale=1.0)
    assert cloud_from_depth(depth, CAMERA).points == pytest.approx(np.asarray(truth.points), abs=1e-6)


def test_in_its_own_frame_the_camera_stands_at_the_origin():
    cloud = cloud_from_depth(np.full((61, 81), 0.5), CAMERA)
    assert cloud.viewpoint.tolist() == [0, 0, 0]
    assert cloud.forward is not None
    assert cloud.forward.tolist() == [0, 0, 1]


def test_pixels_beyond_the_lens_give_no_points():
    # The corners of this image lie beyond where the lens folds back.
    camera = PinholeCamera(81, 61, 60.0, 60.0, 40.0, 30.0, (-0.6,))
    points = cloud_from_depth(np.full((61, 81), 0.5), camera).points
    assert 1000 < len(points) < 61 * 81
    assert np.isfinite(points).all()


GOOD = {"width": 4, "height": 3, "step": 8, "encoding": "16UC1"}


@pytest.mark.parametrize(
    ("changes", "culprit"),
    [
        ({"encoding": "rgb8"}, "encoding 'rgb8' is no depth; valid: 16UC1, mono16, 32FC1"),
        ({"width": 0}, "empty: width=0, height=3"),
        ({"height": 0}, "empty: width=4, height=0"),
        ({"step": 7}, "step=7 is smaller than width=4 pixels of 2 bytes"),
        ({"height": 4}, "24 bytes, but height=4, step=8 and width=4 need 32"),
        ({"encoding": "32FC1", "step": 16}, "24 bytes, but height=3"),
    ],
)
def test_a_broken_image_is_refused_by_name(changes, culprit):
    with pytest.raises(CloudError) as refused:
        depth_from_bytes(memoryview(bytes(24)), **{**GOOD, **changes})
    assert culprit in str(refused.value)
    assert "\n" not in str(refused.value)


def test_an_image_of_another_type_or_size_is_refused():
    with pytest.raises(CloudError, match="pixels are float32, but encoding 16UC1 holds uint16"):
        depth_in_metres(np.zeros((2, 2), np.float32), "16UC1")
    with pytest.raises(CloudError, match="pixels are uint16, but encoding 32FC1 holds float32"):
        depth_in_metres(np.zeros((2, 2), np.uint16), "32FC1")
    with pytest.raises(CloudError, match="4 x 3 pixels, but its camera has 81 x 61"):
        cloud_from_depth(np.zeros((3, 4)), CAMERA)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_a_camera_image_is_converted_without_looking_at_each_pixel(bytecodes, encoding):
    camera = PinholeCamera(640, 480, 600.0, 600.0, 319.5, 239.5, LENS)
    pixels = np.random.default_rng(0).integers(300, 2000, (480, 640)).astype("u2")
    pixels[::4, ::3] = 0
    data = memoryview((pixels if encoding == "16UC1" else (pixels / 1000).astype("f4")).tobytes())
    layout = {"width": 640, "height": 480, "step": len(data) // 480, "encoding": encoding}
    assert bytecodes(lambda: cloud_from_depth(depth_from_bytes(data, **layout), camera)) < 480 * 640 / 10
