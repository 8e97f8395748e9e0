"""Depth images of every encoding and layout, their cameras, and which calibration belongs to which image."""

from __future__ import annotations

import array
import random

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from hypothesis import given
from hypothesis import strategies as st
from sensor_msgs.msg import CameraInfo, Image, RegionOfInterest
from std_msgs.msg import Header

from graspd_core.errors import CloudError
from graspd_core.io.bags import camera_from_message
from graspd_ros.inputs.sensor_frames import ImagePairs, depth_and_camera

SECOND = 1_000_000_000
DTYPES = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}


def header(stamp: int = 0, frame: str = "camera") -> Header:
    return Header(frame_id=frame, stamp=Time(sec=stamp // SECOND, nanosec=stamp % SECOND))


def image(depth: np.ndarray, encoding: str, big: bool = False, padding: int = 0, stamp: int = 0) -> Image:
    """An image of depth in metres, rows padded with bytes that mean nothing."""
    pixels = depth * 1000 if DTYPES[encoding] == "u2" else depth
    pixels = np.round(pixels) if DTYPES[encoding] == "u2" else pixels
    rows = pixels.astype((">" if big else "<") + DTYPES[encoding]).view(np.uint8).reshape(len(depth), -1)
    rows = np.hstack([rows, np.full((len(depth), padding), 0xEE, np.uint8)])
    return Image(
        header=header(stamp),
        height=depth.shape[0],
        width=depth.shape[1],
        encoding=encoding,
        is_bigendian=int(big),
        step=rows.shape[1],
        data=array.array("B", rows.tobytes()),
    )


def calibration(width: int = 64, height: int = 48, stamp: int = 0, **fields) -> CameraInfo:
    k = [60.0, 0.0, 31.5, 0.0, 60.0, 23.5, 0.0, 0.0, 1.0]
    p = [50.0, 0.0, 30.0, 0.0, 0.0, 50.0, 20.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    values = {"k": k, "p": p, "d": [0.1, -0.05, 0.001, 0.002, 0.0], "distortion_model": "plumb_bob", **fields}
    return CameraInfo(header=header(stamp), width=width, height=height, **values)


@given(
    st.sampled_from(sorted(DTYPES)),
    st.booleans(),
    st.integers(0, 7),
    st.integers(1, 9),
    st.integers(1, 9),
    st.randoms(),
)
def test_every_layout_gives_the_same_metres(
    encoding: str, big: bool, padding: int, width: int, height: int, random: random.Random
):
    depth = np.array([[random.randrange(0, 8000) / 1000 for _ in range(width)] for _ in range(height)])
    found, camera = depth_and_camera(image(depth, encoding, big, padding), calibration(width, height))
    np.testing.assert_allclose(found, depth, atol=1e-6)
    assert (camera.width, camera.height) == (width, height)


@pytest.mark.parametrize(
    ("change", "culprit"),
    [
        ({"encoding": "rgb8"}, "rgb8.*16UC1"),
        ({"width": 0}, "width=0"),
        ({"step": 3}, "step=3"),
        ({"height": 9}, "height=9"),
        ({"header": header(frame="elsewhere")}, "'elsewhere'.*'camera'"),
    ],
)
def test_a_malformed_image_is_refused_with_the_culprit(change: dict, culprit: str):
    message = image(np.ones((4, 4)), "16UC1")
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(CloudError, match=culprit):
        depth_and_camera(message, calibration(4, 4))


def test_an_uncalibrated_camera_is_refused():
    with pytest.raises(CloudError, match="fx=0"):
        camera_from_message(calibration(p=[0.0] * 12, k=[0.0] * 9))


def test_a_rectified_image_has_the_camera_of_p_and_no_distortion():
    camera = camera_from_message(calibration(), rectified=True)
    assert (camera.fx, camera.cx, camera.cy, camera.distortion) == (50.0, 30.0, 20.0, ())
    raw = camera_from_message(calibration())
    assert (raw.fx, raw.cx, raw.cy) == (60.0, 31.5, 23.5)
    assert raw.distortion == (0.1, -0.05, 0.001, 0.002, 0.0)
    # Without P, which simple drivers leave empty, K stands in.
    assert camera_from_message(calibration(p=[0.0] * 12), rectified=True).fx == 60.0


def test_binning_and_a_region_shift_and_scale_the_camera():
    info = calibration(
        64, 48, binning_x=2, binning_y=4, roi=RegionOfInterest(x_offset=10, y_offset=8, width=40, height=32)
    )
    camera = camera_from_message(info, rectified=True)
    assert (camera.width, camera.height) == (20, 8)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (25.0, 12.5, 10.0, 3.0)


# Pairs.


def test_images_and_calibrations_of_one_stamp_find_each_other_in_any_order():
    pairs = ImagePairs()
    first, second = image(np.ones((1, 1)), "16UC1", stamp=SECOND), image(np.ones((1, 1)), "16UC1", stamp=2 * SECOND)
    assert pairs.add(first) is None
    assert pairs.add(calibration(stamp=2 * SECOND)) is None
    found = pairs.add(calibration(stamp=SECOND))
    assert found is not None
    assert found[0] is first
    assert found[1].header.stamp.sec == 1
    found = pairs.add(second)
    assert found is not None
    assert (found[0], found[1].header.stamp.sec) == (second, 2)


def test_stamps_pair_within_the_slop_only():
    pairs = ImagePairs(slop=0.01)
    assert pairs.add(calibration(stamp=SECOND)) is None
    assert pairs.add(image(np.ones((1, 1)), "16UC1", stamp=SECOND + 10_000_001)) is None
    assert pairs.add(image(np.ones((1, 1)), "16UC1", stamp=SECOND + 10_000_000)) is not None


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 60)), max_size=80))
def test_memory_is_bounded_and_no_image_is_given_out_twice(arrivals: list[tuple[bool, int]]):
    pairs = ImagePairs(slop=0.001, capacity=3)
    given_out: list[Image] = []
    for is_image, tick in arrivals:
        stamp = tick * SECOND // 30
        message = image(np.ones((1, 1)), "16UC1", stamp=stamp) if is_image else calibration(1, 1, stamp=stamp)
        pair = pairs.add(message)
        assert len(pairs) <= 6
        if pair is not None:
            assert pair[0].header.stamp == pair[1].header.stamp
            assert not any(pair[0] is image for image in given_out)
            given_out.append(pair[0])
