"""Layouts of clouds and depth images, their cameras, and where a cloud's camera stood."""

import array
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bag_writer import packed_depth
from builtin_interfaces.msg import Time
from expected import refused, some
from geometry_msgs.msg import Point
from graspd_msgs.msg import GraspRequest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2, PointField
from std_msgs.msg import Header

from graspd_bench.rendering.depth_noise import DEFAULT
from graspd_bench.rendering.tabletop import depth_views, ring_poses, tabletop
from graspd_core import PointCloud, make_shape
from graspd_core.errors import CloudError, TransformError
from graspd_core.io.messages import camera_from_message, depth_and_camera, depth_from_message, frame_fault, image_size
from graspd_core.perception.cloud.camera import PinholeCamera, camera_rays
from graspd_core.transforms import SECOND
from graspd_ros.error_codes import RequestError
from graspd_ros.inputs import sensor_frames
from graspd_ros.inputs.request_builder import RequestBuilder, frame_views
from graspd_ros.inputs.sensor_frames import ImagePairs, Views, cloud_frame, depth_sensor_frame, place_of, seen_by_camera
from graspd_ros.parameters import Settings
from graspd_ros.request import Request

CAMERA = PinholeCamera(160, 120, 154.0, 154.0, 79.5, 59.5)
OPTICAL, BASE = "camera_depth_optical_frame", "base_link"
NOW = Time(sec=1000)
HEIGHT = float(np.ptp(make_shape("bottle").vertices[:, 2]))
ANY_AGE = Settings(cloud_max_age=0.0)
DTYPES = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4", "64FC1": "f8"}


def header(stamp: int = 0) -> Header:
    return Header(frame_id="camera", stamp=Time(sec=stamp // SECOND, nanosec=stamp % SECOND))


def image(depth: np.ndarray, encoding: str, stamp: int = 0) -> Image:
    """An image of depth in metres."""
    pixels = np.round(depth * 1000) if DTYPES[encoding] == "u2" else depth
    rows = pixels.astype("<" + DTYPES[encoding]).view(np.uint8).reshape(len(depth), -1)
    return Image(
        header=header(stamp),
        height=depth.shape[0],
        width=depth.shape[1],
        encoding=encoding,
        step=rows.shape[1],
        data=array.array("B", rows.tobytes()),
    )


def calibration(width: int = 64, height: int = 48, stamp: int = 0, **fields) -> CameraInfo:
    k = [60.0, 0.0, 31.5, 0.0, 60.0, 23.5, 0.0, 0.0, 1.0]
    p = [50.0, 0.0, 30.0, 0.0, 0.0, 50.0, 20.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    values = {"k": k, "p": p, "d": [0.1, -0.05, 0.001, 0.002, 0.0], "distortion_model": "plumb_bob", **fields}
    return CameraInfo(header=header(stamp), width=width, height=height, **values)


def test_a_rectified_image_has_the_camera_of_p_and_no_distortion():
    camera = camera_from_message(calibration(), rectified=True)
    assert (camera.fx, camera.cx, camera.cy, camera.distortion) == (50.0, 30.0, 20.0, ())
    raw = camera_from_message(calibration())
    assert (raw.fx, raw.cx, raw.cy) == (60.0, 31.5, 23.5)
    assert raw.distortion == (0.1, -0.05, 0.001, 0.002, 0.0)
    # Without P, which simple drivers leave empty, K stands in.
    assert camera_from_message(calibration(p=[0.0] * 12), rectified=True).fx == 60.0


def packed(depth: np.ndarray, encoding: str = "16UC1", kind: str = "compressedDepth png") -> CompressedImage:
    """What image_transport sends of a depth image [m], with the 12 bytes of compressedDepth or without."""
    data = packed_depth(depth, encoding)[0 if "compressedDepth" in kind else 12 :]
    return CompressedImage(header=header(), format=f"{encoding}; {kind}", data=array.array("B", data))


DEPTH = np.random.default_rng(0).integers(300, 4000, (5, 7)) / 1000 * (np.arange(35).reshape(5, 7) % 6 > 0)


@pytest.mark.parametrize(
    ("message", "off"),
    [
        (packed(DEPTH), 1e-6),
        (packed(DEPTH, kind="compressedDepth"), 1e-6),  # as older ones write it
        (packed(DEPTH, kind="png compressed 16UC1"), 1e-6),
        (packed(DEPTH, "32FC1"), 8e-4),  # half of a step of the inverse depth is 0.5 z² / 10100, 0.8 mm at 4 m
        (image(DEPTH, "64FC1"), 1e-9),
    ],
)
def test_depth_comes_packed_too(message, off: float):
    found, camera = depth_and_camera(message, calibration(7, 5), rectified=True)
    np.testing.assert_allclose(found, DEPTH, atol=off)
    assert (found == 0).sum() == (DEPTH == 0).sum()
    pairs = ImagePairs()
    pairs.add(calibration(7, 5))
    assert pairs.add(message) is not None
    read = depth_sensor_frame(message, calibration(7, 5), 0).read()
    np.testing.assert_allclose(read.points[:, 2], DEPTH[DEPTH > 0], atol=off)
    assert camera.width == 7


@pytest.mark.parametrize(
    ("message", "culprit"),
    [
        (CompressedImage(format="16UC1; compressedDepth rvl", data=bytes(40)), "data is not a PNG; valid: "),
        (CompressedImage(format="16UC1; compressedDepth png", data=packed(DEPTH).data[:60]), "its PNG is broken"),
        (CompressedImage(format="16UC1; compressedDepth png", data=packed(DEPTH).data[:30]), "its PNG is cut off"),
        (
            CompressedImage(format="rgb8; png compressed bgr8", data=packed(DEPTH).data),
            "a colour picture: name the depth",
        ),
        (CompressedImage(format="32FC1; png", data=packed(DEPTH, kind="png").data), "12 bytes of its quantisation"),
        (Image(encoding="8UC1", height=1, width=1, step=1, data=bytes(1)), "publish 16UC1 .millimetres. or 32FC1"),
    ],
)
def test_what_holds_no_depth_is_refused_with_what_to_publish(message, culprit: str):
    with pytest.raises(CloudError, match=culprit):
        depth_from_message(message)


def test_an_image_takes_the_last_calibration_of_its_frame_and_size():
    now = [0.0]
    pairs = ImagePairs(lambda: now[0])
    first, *others = (image(np.ones((48, 64)), "16UC1", stamp=k * SECOND) for k in range(4))
    assert pairs.add(first) is None
    # Other cameras' calibrations are not taken, and theirs stay theirs.
    assert pairs.add(calibration(32, 24)) is None
    other = calibration()
    other.header.frame_id = "elsewhere"
    assert pairs.add(other) is None
    assert pairs.unpaired() == ""
    now[0] = sensor_frames.UNPAIRED
    assert pairs.unpaired() == (
        "depth images: 1 images and 2 CameraInfos received, but no pair matches; last image: 64 x 48 in 'camera', "
        "last CameraInfo: 64 x 48 in 'elsewhere'; valid: a CameraInfo of the same frame and size"
    )
    # Once, without a stamp, and long before or after: it holds for all images.
    own = calibration(stamp=0)
    assert pairs.add(own) == (first, own)
    assert pairs.unpaired() == ""
    for later in others:
        assert pairs.add(later) == (later, own)
    # A newer one takes its place, whatever its stamp.
    newer = calibration(stamp=30_000_000)
    assert pairs.add(newer) is None
    assert pairs.add(first) == (first, newer)


def test_after_a_reset_no_older_image_is_given_out_and_calibrations_stay():
    pairs, (old, new), own = ImagePairs(), [image(np.ones((48, 64)), "16UC1", stamp=k) for k in (1, 2)], calibration()
    assert pairs.add(old) is None
    pairs.forget()
    assert pairs.add(own) is None
    pairs.forget()
    assert pairs.add(new) == (new, own)


def test_images_without_any_calibration_are_counted():
    now = [0.0]
    pairs = ImagePairs(lambda: now[0])
    for _ in range(200):
        assert pairs.add(image(np.ones((48, 64)), "16UC1")) is None
        now[0] += 0.2
    assert pairs.unpaired().startswith("depth images: 200 images and 0 CameraInfos received")
    assert pairs.unpaired().endswith("last CameraInfo: none; valid: a CameraInfo of the same frame and size")
    # Of binned and cropped images the size counts that they are sent with; one without a frame is of any.
    binned = calibration(128, 96, binning_x=2, binning_y=2)
    binned.header.frame_id = ""
    assert pairs.add(binned) is not None


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 20)), max_size=80))
def test_memory_is_bounded_and_no_image_is_given_out_twice(arrivals: list[tuple[bool, int]]):
    pairs = ImagePairs()
    given_out: list[Any] = []
    for is_image, width in arrivals:
        message = image(np.ones((1, width + 1)), "16UC1") if is_image else calibration(width + 1, 1)
        pair = pairs.add(message)
        assert len(pairs._infos) <= sensor_frames.MOST_CALIBRATIONS
        if pair is not None:
            assert image_size(pair[0]) == image_size(pair[1])
            assert not any(pair[0] is image for image in given_out)
            given_out.append(pair[0])


def test_a_cloud_without_a_frame_or_with_a_stamp_of_another_clock_is_refused(scene):
    grid, _, T = scene
    cloud = message(grid, "", True)
    with refused(RequestError, match=r"the cloud has an empty header.frame_id", code="BAD_CLOUD"):
        asked(T, Settings(), cloud=cloud)
    cloud.header = Header(frame_id=OPTICAL, stamp=Time(sec=NOW.sec + 60))
    with refused(
        RequestError, match=r"has a stamp 60.0 s in the future, more than cloud_max_age=5 s", code="STALE_CLOUD"
    ):
        asked(T, Settings(), cloud=cloud)
    cloud.header.stamp.sec = NOW.sec + 2
    (told, *_) = asked(T, Settings(), cloud=cloud).load().object.warnings
    assert told == "the cloud came 2.0 s before its stamp: the sensor's clock is ahead of the node's"
    _, warnings = frame_views(cloud_frame(cloud, (NOW.sec + 2) * SECOND), ANY_AGE, place_of(ANY_AGE), lambda *_: T)()
    assert warnings == ()


def test_data_that_contradicts_the_name_of_its_frame_is_told(scene):
    grid, _, T = scene
    body = grid[..., [2, 0, 1]] * [1, -1, -1]  # x forward, y left, z up
    doubted = "by its name the camera looks along"
    for points, frame, told in (
        (grid, OPTICAL, False), (grid, "camera", False), (grid, "camera_link", True),
        (grid, "camera_depth_frame", True), (body, "camera_link", False), (body, OPTICAL, True),
    ):  # fmt: skip
        seen = cloud_frame(message(points, frame, True), 0)
        _, warnings = frame_views(seen, ANY_AGE, place_of(ANY_AGE), lambda *_: T)()
        assert (doubted in str(warnings)) is told, frame
    assert frame_fault("camera_link", body.reshape(-1, 3)) == ""


def test_a_workspace_without_a_point_says_where_they_are_and_names_the_unit(scene):
    grid, _, T = scene
    with refused(RequestError, "they lie from [", match="none of .* lies in the workspace.* in millimetres, divide"):
        asked(T, cloud=message(1000 * grid, OPTICAL, False)).load()
    behind = replace(ANY_AGE, roi_max=[10.0, 10.0, 0.0])
    masked = {"cloud": message(grid, OPTICAL, True), "target_mask": mask_of(np.isfinite(grid[..., 0]))}
    with refused(RequestError, "roi_max=[10.0, 10.0, 0.0]; they lie from"):
        asked(T, behind, **masked).load()


@pytest.mark.parametrize(("frame", "axis"), [(BASE, 1), (OPTICAL, 0)])
def test_an_object_that_the_workspace_cuts_is_doubted(scene, frame, axis):
    grid, _, T = scene
    points = grid if frame == OPTICAL else in_base(grid, T)
    middle = points[len(points) // 2, points.shape[1] // 2]
    cloud = message(points, frame, frame == OPTICAL)
    for beside, cut in ((0.0, True), (0.3, False)):
        corner = np.full(3, 10.0)
        corner[axis] = middle[axis] + beside
        found = asked(T, replace(ANY_AGE, roi_max=corner.tolist()), cloud=cloud, sensor_frame=OPTICAL).load()
        assert ("reaches the border of the" in str(found.evidence)) is cut


@pytest.fixture(scope="module")
def scene():
    """A bottle and a box on a table; what a camera sees, and its pose in base_link, half a metre beside the bottle."""
    shown = tabletop("bottle", obstacles=[("box", 0.0, 0.16)])
    T_world_camera = ring_poses(1, elevation=0.7, azimuth=0.3)[0]
    depth, label = depth_views(shown, CAMERA, [T_world_camera], DEFAULT, seed=3)[0]
    T_base_camera = T_world_camera.copy()
    T_base_camera[:3, 3] += [0.5, 0.0, 0.0]
    return camera_rays(CAMERA) * np.where(depth > 0, depth, np.nan)[..., None], label, T_base_camera


def message(grid: np.ndarray, frame: str, organised: bool) -> PointCloud2:
    points = grid if organised else grid.reshape(1, -1, 3)[:, np.isfinite(grid.reshape(-1, 3)).all(1)]
    fields = [PointField(name=n, offset=4 * i, datatype=PointField.FLOAT32, count=1) for i, n in enumerate("xyz")]
    height, width = points.shape[:2]
    cloud = PointCloud2(height=height, width=width, fields=fields, point_step=12, row_step=12 * width)
    cloud.header.frame_id = frame
    cloud.data = array.array("B", points.astype("<f4").tobytes())
    return cloud


def builder(T_base_camera: np.ndarray) -> RequestBuilder:
    def lookup(target: str, source: str, stamp: Time) -> np.ndarray:
        if (target, source) != (BASE, OPTICAL):
            raise TransformError(f"{source} -> {target}: not connected")
        return T_base_camera

    return RequestBuilder("allegro_right", lambda: NOW, lookup)


def asked(T_base_camera: np.ndarray, settings: Settings = ANY_AGE, /, **fields: Any) -> Request:
    return builder(T_base_camera).from_message("r", settings, GraspRequest(**fields))


def in_base(grid: np.ndarray, T_base_camera: np.ndarray) -> np.ndarray:
    return grid @ T_base_camera[:3, :3].T + T_base_camera[:3, 3]


@pytest.mark.parametrize("organised", [True, False])
def test_a_cloud_of_another_frame_is_refused_unless_somebody_says_where_its_camera_stood(scene, organised):
    grid, _, T = scene
    cloud = message(in_base(grid, T), BASE, organised)
    at = {"use_target_point": True, "target_point": Point(x=0.5, z=0.1), "cloud": cloud}
    with refused(CloudError, match="its camera did not stand at the origin of its frame", code="BAD_CLOUD"):
        asked(T, **at).load()
    x, y, z = map(float, T[:3, 3])
    for said in ({"sensor_frame": OPTICAL}, {"use_view_point": True, "view_point": Point(x=x, y=y, z=z)}):
        loaded = asked(T, **at, **said).load()
        np.testing.assert_allclose(some(loaded.support).normal, [0, 0, 1], atol=0.02)
        assert np.ptp(loaded.object.mesh.vertices[:, 2]) == pytest.approx(HEIGHT, abs=0.012)
    with pytest.raises(TransformError, match="not connected"):
        asked(T, **at, sensor_frame="elbow").load()
    # In its own frame the same cloud needs no word.
    assert asked(T, cloud=message(grid, OPTICAL, organised)).load().support is not None


def test_the_request_goes_before_the_parameters_and_a_point_before_a_frame():
    settings = Settings(sensor_frame="head", view_point=[0.0, 0.0, 1.0])
    assert place_of(Settings()) == sensor_frames.CameraPlace()
    assert place_of(settings) == sensor_frames.CameraPlace((0.0, 0.0, 1.0), "head")
    assert place_of(settings, GraspRequest()) == place_of(settings)
    assert place_of(settings, GraspRequest(sensor_frame="wrist")) == sensor_frames.CameraPlace(sensor_frame="wrist")
    said = GraspRequest(sensor_frame="wrist", use_view_point=True)
    assert place_of(settings, said) == sensor_frames.CameraPlace((0.0, 0.0, 0.0))


def test_a_cloud_that_came_unasked_is_seen_from_where_the_parameters_say(scene):
    grid, _, T = scene
    frame, taker = cloud_frame(message(in_base(grid, T), BASE, False), 0), builder(T)
    with pytest.raises(CloudError, match="did not stand"):
        taker.from_sensor_frame("r", ANY_AGE, frame).load()
    settings = replace(ANY_AGE, sensor_frame=OPTICAL)
    assert taker.from_sensor_frame("r", settings, frame).load().support is not None
    seen = seen_by_camera(frame, place_of(settings), lambda *_: T)
    np.testing.assert_array_equal(np.r_[seen.viewpoint, some(seen.forward)], np.r_[T[:3, 3], T[:3, 2]])
    taker.newest = frame
    with pytest.raises(CloudError, match="did not stand"):
        taker.add_view(ANY_AGE)
    taker.add_view(settings)
    assert len(taker.views.clouds) == 1


def mask_of(shown: np.ndarray, **fields) -> Image:
    height, width = shown.shape
    data = array.array("B", (255 * shown).astype(np.uint8).tobytes())
    return Image(**{"height": height, "width": width, "encoding": "mono8", "step": width, "data": data, **fields})


def test_a_mask_says_which_object_is_meant(scene):
    grid, label, T = scene
    cloud, settings = message(grid, OPTICAL, True), replace(ANY_AGE, voxel_size=0.01)
    # In the camera's frame the two are 16 cm apart.
    for number in (0, 1):
        truth = np.nanmean(grid[label == number], axis=0)
        loaded = asked(T, settings, cloud=cloud, target_mask=mask_of(label == number)).load()
        middle = loaded.object.mesh.vertices.mean(0)
        assert np.linalg.norm(middle - truth) < 0.06
    for bad, culprit in (
        (mask_of(label == 0, encoding="rgb8"), "160 x 120 'rgb8'; valid: mono8, 160 x 120"),
        (mask_of((label == 0)[:100]), "160 x 100 'mono8'"),
        (mask_of(label == 0, data=array.array("B", [1])), "1 bytes, step 160, are too few"),
    ):
        with refused(RequestError, match=culprit, code="BAD_REQUEST"):
            asked(T, settings, cloud=cloud, target_mask=bad).load()


def test_a_mask_shows_where_contacts_may_be(scene):
    grid, label, T = scene
    cloud = message(grid, OPTICAL, True)
    region = some(some(asked(T, cloud=cloud, region_mask=mask_of(label == 1)).steering)().region)
    seen, other = (grid[label == number].reshape(-1, 3) for number in (1, 0))
    assert (region.distance(seen[np.isfinite(seen).all(1)]) < 0).all()
    assert region.distance(np.nanmean(other, axis=0)[None])[0] > 0.05
    steering = asked(T, cloud=cloud, region_mask=mask_of(label == 1, encoding="rgb8")).steering
    with refused(RequestError, "region_mask: 160 x 120 'rgb8'; valid: mono8"):
        some(steering)()


def test_a_cloud_of_the_object_alone_is_taken_whole(scene):
    grid, label, T = scene
    bottle = np.where((label == 0)[..., None], grid, np.nan)
    loaded = asked(T, cloud=message(bottle, OPTICAL, False), alone=True).load()
    assert loaded.support is None
    assert not loaded.obstacles
    assert np.linalg.norm(loaded.object.mesh.vertices.mean(0) - np.nanmean(bottle, axis=(0, 1))) < 0.06


@pytest.mark.parametrize(("moved", "turned"), [(0.004, 0.5), (0.006, 0.0), (0.0, 0.7)])
def test_views_of_a_camera_that_moved_need_a_fixed_frame(moved: float, turned: float):
    poses = [np.eye(4), np.eye(4), np.eye(4)]
    poses[2][:3, :3] = Rotation.from_euler("y", turned, degrees=True).as_matrix()
    poses[2][0, 3] = moved

    def add(views: Views, pose: np.ndarray, eye: float = 0.0) -> Views:
        frame = cloud_frame(PointCloud2(header=Header(frame_id="camera")), 1)
        return views.add(frame, PointCloud(np.eye(3), np.array([0.0, 0.0, eye])), Settings(), lambda *_: pose)

    rested = add(add(Views(), poses[0]), poses[1])
    with nullcontext() if moved == 0.004 else pytest.raises(TransformError, match=r"moved by .* fixed_frame"):
        assert len(add(rested, poses[2]).clouds) == 3
    # In the frame of a turntable, the camera is not at the origin.
    assert len(add(add(Views(), poses[0], 0.5), poses[2], 0.5).clouds) == 2
