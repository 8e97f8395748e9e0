"""Cameras and their images: the lens can be undone, every encoding comes back as metres, clouds lie on the thing."""

from types import SimpleNamespace

import numpy as np
import pytest
from expected import refused, some
from hypothesis import given
from hypothesis import strategies as st

from graspd_bench.rendering.render import look_at, render_depth
from graspd_core import PinholeCamera, cloud_from_depth, depth_in_metres
from graspd_core.errors import CloudError
from graspd_core.io.messages import depth_from_message
from graspd_core.mesh.shapes import SPHERE_RADIUS, make_shape
from graspd_core.perception.cloud.camera import camera_from_calibration, camera_rays, distort, undistort

MATRIX = [500.0, 0, 320, 0, 510, 240, 0, 0, 1]

# Of a webcam, a wide-angle lens and an Azure Kinect: barrel, tangential, rational.
LENSES = [
    (0.1, -0.25, 0.002, -0.001, 0.1),
    (-0.32, 0.12, 0.0005, -0.0003, -0.02),
    (0.51, -2.7, 0.0008, -0.0001, 1.6, 0.39, -2.5, 1.53),
]


def real_lenses():
    """Coefficients within what calibrations of real lenses give."""
    size = st.floats(-1, 1)
    scale = np.array([0.15, 0.05, 0.003, 0.003, 0.01])
    return st.lists(size, min_size=5, max_size=5).map(lambda v: tuple((np.array(v) * scale).tolist()))


@given(lens=real_lenses(), x=st.floats(-0.7, 0.7), y=st.floats(-0.55, 0.55))
def test_undistortion_undoes_distortion(lens, x, y):
    ideal = np.array([x, y])
    assert undistort(distort(ideal, lens)[0], lens) == pytest.approx(ideal, abs=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_points_appear_where_their_rays_look(lens):
    camera = PinholeCamera(64, 48, 55.0, 56.0, 31.0, 24.5, lens)
    rays = camera_rays(camera)
    assert np.isfinite(rays).all()
    row, column = np.indices((48, 64))
    pixels = distort(rays[..., :2], lens)[0] * [55.0, 56.0] + [31.0, 24.5]
    assert pixels == pytest.approx(np.stack([column, row], -1), abs=1e-7)


def test_one_pixel_worked_by_hand():
    # x = 0.5, y = 0: r² = 0.25, radial 1 + 0.2·0.25 − 0.1·0.0625 + 0.4·0.015625 = 1.05;
    # x: 0.5·1.05 + 0.02·(0.25 + 2·0.25) = 0.54; y: 0.01·0.25 = 0.0025.
    assert distort(np.array([0.5, 0.0]), (0.2, -0.1, 0.01, 0.02, 0.4))[0] == pytest.approx([0.54, 0.0025])
    # With denominator 1 + 0.8·0.25 = 1.2 the radial factor is 0.875.
    assert distort(np.array([0.5, 0.0]), (0.2, -0.1, 0, 0, 0.4, 0.8))[0] == pytest.approx([0.4375, 0.0])


def test_the_ideal_camera_is_the_closed_form():
    rays = camera_rays(PinholeCamera(640, 480, 500.0, 510.0, 320.0, 240.0))
    assert rays[240, 320] == pytest.approx([0, 0, 1])
    assert rays[0, 0] == pytest.approx([-320 / 500, -240 / 510, 1])


def test_rays_are_computed_once_and_cannot_be_spoilt():
    camera = PinholeCamera(8, 6, 5.0, 5.0, 4.0, 3.0, (0.1,))
    rays = camera_rays(camera)
    assert camera_rays(PinholeCamera(8, 6, 5.0, 5.0, 4.0, 3.0, (0.1,))) is rays
    with pytest.raises(ValueError, match="read-only"):
        rays[0, 0] = 0


def test_pixels_that_the_lens_cannot_show_have_no_ray():
    # r·(1 − 0.5 r²) never exceeds 0.544, at r = 0.816: what lies farther out shows nothing.
    lens = (-0.5,)
    seen = np.array([[0.5, 0.0], [0.54, 0.0], [0.56, 0.0], [2.0, 1.0]])
    ideal = undistort(seen, lens)
    assert np.isfinite(ideal[:2]).all()
    assert np.isnan(ideal[2:]).all()
    assert distort(ideal[:2], lens)[0] == pytest.approx(seen[:2], abs=1e-9)
    # The near branch of the fold, not the far one.
    assert ideal[0, 0] < 0.816


def test_calibrations_are_read():
    camera = camera_from_calibration(640, 480, MATRIX, [0.1, -0.2, 0, 0], "plumb_bob")
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500, 510, 320, 240)
    assert camera.distortion == (0.1, -0.2, 0, 0)
    # Drivers of ideal cameras leave the model empty, or give zeros, as many as they like.
    assert camera_from_calibration(640, 480, MATRIX, [], "").distortion == ()
    assert camera_from_calibration(640, 480, MATRIX, [0.0] * 12, "plumb_bob").distortion == ()


@pytest.mark.parametrize(
    ("changes", "culprit"),
    [
        ({"model": "equidistant"}, "unknown distortion model 'equidistant'; valid: plumb_bob, rational_polynomial"),
        ({"model": "", "distortion": [0.1]}, "unknown distortion model ''; valid: plumb_bob"),
        ({"distortion": [0.1] * 6}, "6 distortion coefficients; plumb_bob has at most 5"),
        ({"matrix": [0.0] * 9}, "fx=0.0, fy=0.0"),
        ({"matrix": [float("nan")] * 9}, "is not a calibration"),
        ({"matrix": [1.0] * 4}, "its matrix K has 4 numbers; 9 are needed"),
        ({"width": 0}, "an image of 0 x 480 pixels"),
        ({"distortion": [float("inf")]}, "is not a calibration"),
    ],
)
def test_what_is_no_calibration_is_refused(changes, culprit):
    given = {"width": 640, "height": 480, "matrix": MATRIX, "distortion": [], "model": "plumb_bob", **changes}
    with refused(CloudError, culprit):
        camera_from_calibration(**given)


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
    st.sampled_from(["16UC1", "mono16", "32FC1", "64FC1"]),
    st.sampled_from("<>"),
    st.integers(0, 9),
    st.integers(1, 5),
    st.integers(1, 6),
    st.integers(0, 2**32 - 1),
)
def test_any_layout_comes_back_in_metres(encoding, order, padding, height, width, seed):
    millimetres = np.random.default_rng(seed).integers(0, 2**16, (height, width))
    kind = {"32FC1": "f4", "64FC1": "f8"}.get(encoding)
    pixels = (millimetres / 1000).astype(kind) if kind else millimetres.astype("u2")
    data, step = as_bytes(pixels, order, padding)
    sizes = {"width": width, "height": height, "step": step}
    depth = depth_from_message(SimpleNamespace(data=data, encoding=encoding, is_bigendian=order == ">", **sizes))
    assert depth == pytest.approx(millimetres / 1000, rel=1e-6)


def test_what_is_no_depth_is_zero_and_in_its_own_frame_the_camera_stands_at_the_origin():
    image = np.array([[0.5, np.nan, np.inf, -np.inf, -1.0, 0.0]], dtype=np.float32)
    assert depth_in_metres(image, "32FC1").tolist() == [[0.5, 0, 0, 0, 0, 0]]
    cloud = cloud_from_depth(np.full((61, 81), 0.5), CAMERA)
    assert cloud.viewpoint.tolist() == [0, 0, 0]
    assert some(cloud.forward).tolist() == [0, 0, 1]


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED], ids=["ideal", "distorted"])
def test_the_cloud_lies_on_the_object_in_the_frame_asked_for(camera):
    pose = look_at((0.3, -0.2, 0.3), (0, 0, 0))
    cloud = cloud_from_depth(render_depth(make_shape("sphere"), camera, pose), camera, pose)
    # Flat faces lie up to 0.1 mm inside the ball; Embree counts in float32.
    assert np.linalg.norm(cloud.points, axis=1) == pytest.approx(np.full(len(cloud.points), SPHERE_RADIUS), abs=2e-4)
    assert len(cloud.points) > 50
    assert cloud.viewpoint == pytest.approx([0.3, -0.2, 0.3])
    assert cloud.forward == pytest.approx(-cloud.viewpoint / np.linalg.norm(cloud.viewpoint))


GOOD = {"width": 4, "height": 3, "step": 8, "encoding": "16UC1", "is_bigendian": False, "data": bytes(24)}


@pytest.mark.parametrize(
    ("changes", "culprit"),
    [
        ({"encoding": "rgb8"}, "encoding 'rgb8'; valid for depth: 16UC1, mono16, 32FC1"),
        ({"width": 0}, "empty: width=0, height=3"),
        ({"height": 0}, "empty: width=4, height=0"),
        ({"step": 7}, "step=7 is smaller than width=4 pixels of 2 bytes"),
        ({"height": 4}, "24 bytes, but height=4, step=8 and width=4 need 32"),
        ({"encoding": "32FC1", "step": 16}, "24 bytes, but height=3"),
    ],
)
def test_a_broken_image_is_refused_by_name(changes, culprit):
    with refused(CloudError, culprit):
        depth_from_message(SimpleNamespace(**{**GOOD, **changes}))


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
    sizes = {"width": 640, "height": 480, "step": len(data) // 480}
    image = SimpleNamespace(data=data, encoding=encoding, is_bigendian=False, **sizes)
    assert bytecodes(lambda: cloud_from_depth(depth_from_message(image), camera)) < 480 * 640 / 10
