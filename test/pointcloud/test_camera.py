"""Cameras: what the lens does can be undone, and calibrations that make no sense are refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd_core.errors import CloudError
from graspd_core.perception.cloud.camera import (
    PinholeCamera,
    camera_from_calibration,
    camera_rays,
    distort,
    project,
    undistort,
)

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
    assert undistort(distort(ideal, lens), lens) == pytest.approx(ideal, abs=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_points_appear_where_their_rays_look(lens):
    camera = PinholeCamera(64, 48, 55.0, 56.0, 31.0, 24.5, lens)
    rays = camera_rays(camera)
    assert np.isfinite(rays).all()
    row, column = np.indices((48, 64))
    assert project(0.7 * rays, camera) == pytest.approx(np.stack([column, row], -1), abs=1e-7)


def test_one_pixel_worked_by_hand():
    # x = 0.5, y = 0: r² = 0.25, radial 1 + 0.2·0.25 − 0.1·0.0625 + 0.4·0.015625 = 1.05;
    # x: 0.5·1.05 + 0.02·(0.25 + 2·0.25) = 0.54; y: 0.01·0.25 = 0.0025.
    assert distort(np.array([0.5, 0.0]), (0.2, -0.1, 0.01, 0.02, 0.4)) == pytest.approx([0.54, 0.0025])
    # With denominator 1 + 0.8·0.25 = 1.2 the radial factor is 0.875.
    assert distort(np.array([0.5, 0.0]), (0.2, -0.1, 0, 0, 0.4, 0.8)) == pytest.approx([0.4375, 0.0])


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
    assert distort(ideal[:2], lens) == pytest.approx(seen[:2], abs=1e-9)
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
        ({"matrix": [float("nan")] * 9}, "is no calibration"),
        ({"matrix": [1.0] * 4}, "its matrix K has 4 numbers; 9 are needed"),
        ({"width": 0}, "an image of 0 x 480 pixels"),
        ({"distortion": [float("inf")]}, "is no calibration"),
    ],
)
def test_what_is_no_calibration_is_refused(changes, culprit):
    given = {"width": 640, "height": 480, "matrix": MATRIX, "distortion": [], "model": "plumb_bob", **changes}
    with pytest.raises(CloudError) as refused:
        camera_from_calibration(**given)
    assert culprit in str(refused.value)
    assert "\n" not in str(refused.value)
