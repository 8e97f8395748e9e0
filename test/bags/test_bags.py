"""Recordings written and read back, both storages; and one line for whatever is wrong with one."""

import argparse
import contextlib
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from bag_writer import (
    Record,
    camera_info_message,
    cloud_message,
    depth_message,
    packed_message,
    transforms_message,
    write_bag,
)
from expected import refused

from graspd_bench.rendering.render import look_at, render_depth
from graspd_core.cli.options import bag_views
from graspd_core.errors import BagError, CloudError, TransformError
from graspd_core.io.bags import bag_topics, is_bag, read_frames, read_raw, read_transforms
from graspd_core.io.messages import camera_from_message
from graspd_core.mesh.shapes import SPHERE_RADIUS, make_shape
from graspd_core.perception.cloud.camera import PinholeCamera
from graspd_core.transforms import SECOND

CAMERA = PinholeCamera(160, 120, 150.0, 150.0, 79.5, 59.5, (0.1, -0.2, 0.001, -0.001, 0.05))
OPTICAL = "camera_optical_frame"
START = 1_700_000_000 * SECOND
STORAGES = ["sqlite3", "mcap"]


def flown_records(eyes, *, encoding="16UC1") -> list[Record]:
    """A camera that flies round the sphere, one second from eye to eye, with its pose half a second earlier and later.

    The frames are world -> mount (moving) -> camera_optical_frame (fixed).
    """
    T_mount_camera = look_at((0.1, 0.0, 0.0), (0.0, 0.1, 0.0))
    fixed = transforms_message([("mount", OPTICAL, T_mount_camera)], START)
    records = [Record("/tf_static", START, fixed)]
    for index, eye in enumerate(eyes):
        stamp = START + (index + 1) * SECOND
        T_world_camera = look_at(eye, (0, 0, 0))
        depth = render_depth(make_shape("sphere"), CAMERA, T_world_camera)
        T_world_mount = T_world_camera @ np.linalg.inv(T_mount_camera)
        for side in (-1, 1):
            moved = T_world_mount.copy()
            moved[:3, 3] += (0, 0, side * 0.02)
            near = stamp + side * SECOND // 4
            records.append(Record("/tf", near, transforms_message([("world", "mount", moved)], near)))
        records += [
            Record("/depth/camera_info", stamp, camera_info_message(CAMERA, OPTICAL, stamp)),
            Record("/depth/image_raw", stamp, depth_message(depth, OPTICAL, stamp, encoding=encoding)),
        ]
    return sorted(records, key=lambda record: record.stamp)


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_a_rendered_scene_comes_back_through_depth_camera_and_transforms(tmp_path, storage, encoding):
    eyes = [(0.4, 0.0, 0.2), (0.0, -0.4, 0.2), (-0.3, 0.3, 0.1)]
    write_bag(tmp_path / "bag", flown_records(eyes, encoding=encoding), storage=storage)
    transforms = read_transforms(tmp_path / "bag")
    frames = list(read_frames(tmp_path / "bag"))
    assert [frame.stamp for frame in frames] == [START + (i + 1) * SECOND for i in range(3)]
    for frame, eye in zip(frames, eyes, strict=True):
        cloud = frame.view(transforms, "world")
        # Half a millimetre of rounding in 16UC1, and a tenth of the mesh's facets.
        bound = 7e-4 if encoding == "16UC1" else 2e-4
        assert np.linalg.norm(cloud.points, axis=1) == pytest.approx(
            np.full(len(cloud.points), SPHERE_RADIUS), abs=bound
        )
        assert len(cloud.points) > 300
        assert cloud.viewpoint == pytest.approx(eye, abs=1e-6)
        assert cloud.forward == pytest.approx(-np.array(eye) / np.linalg.norm(eye), abs=1e-6)
        assert frame.view().viewpoint.tolist() == [0, 0, 0]


@pytest.mark.parametrize("storage", STORAGES)
def test_clouds_come_back_in_order_some_or_all(tmp_path, storage):
    points = np.random.default_rng(0).normal(size=(7, 30, 3)).astype("f4").astype(float)
    points[:, 3] = np.nan
    records = [Record("/points", START + i, cloud_message(cloud, "lidar", START + i)) for i, cloud in enumerate(points)]
    write_bag(tmp_path / "bag", records, storage=storage)
    (topic,) = bag_topics(tmp_path / "bag")
    assert (topic.name, topic.type, topic.count) == ("/points", "sensor_msgs/msg/PointCloud2", 7)
    for options, expected in [
        ({}, range(7)),
        ({"every": 3}, (0, 3, 6)),
        ({"limit": 2}, (0, 1)),
        ({"every": 2, "limit": 3}, (0, 2, 4)),
    ]:
        frames = list(read_frames(tmp_path / "bag", **options))
        assert [frame.index for frame in frames] == list(expected)
        for frame in frames:
            assert frame.frame == "lidar"
            np.testing.assert_array_equal(frame.view().points, np.delete(points[frame.index], 3, axis=0))
            assert frame.view().forward is None


@pytest.mark.parametrize("storage", STORAGES)
def test_a_storage_file_alone_is_a_bag(tmp_path, storage):
    write_bag(tmp_path / "bag", flown_records([(0.4, 0, 0.2)]), storage=storage)
    file = next(path for path in (tmp_path / "bag").iterdir() if path.suffix != ".yaml")
    assert is_bag(file)
    (tmp_path / "bag" / "metadata.yaml").unlink()  # as a recorder leaves it that was killed
    assert is_bag(tmp_path / "bag")
    for path in (file, tmp_path / "bag"):
        (frame,) = read_frames(path)
        assert len(frame.view(read_transforms(path), "world").points) > 300


def test_a_rectified_image_is_not_undistorted_again(tmp_path):
    info = camera_info_message(CAMERA, OPTICAL, START)
    image = depth_message(np.full((120, 160), 0.5), OPTICAL, START)
    seen = {}
    # A name with "rect" in it need not be of a rectified image.
    for name in ("image_raw", "image_rect", "image_rect_raw", "depth_direct"):
        records = [Record("/d/camera_info", START, info), Record(f"/d/{name}", START, image)]
        write_bag(tmp_path / name, records)
        (frame,) = read_frames(tmp_path / name)
        seen[name] = frame.view().points
    ideal = np.array([-79.5, -59.5]) / 150 * 0.5
    assert seen["image_rect"][0, :2] == pytest.approx(ideal)
    assert seen["image_rect_raw"][0, :2] == pytest.approx(ideal)
    assert np.abs(seen["image_raw"][0, :2] - ideal).max() > 1e-3
    np.testing.assert_array_equal(seen["depth_direct"], seen["image_raw"])


def test_a_rectified_image_of_a_fisheye_camera_has_no_distortion_left():
    info = camera_info_message(CAMERA, OPTICAL, START)
    info.distortion_model = "equidistant"
    assert camera_from_message(info, rectified=True).distortion == ()


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_packed_depth_is_read_like_the_image_that_it_was(tmp_path, encoding):
    depth = render_depth(make_shape("sphere"), CAMERA, look_at((0.4, 0.0, 0.2), (0, 0, 0)))
    plain = depth_message(depth, OPTICAL, START, encoding=encoding)
    info = Record("/d/camera_info", START, camera_info_message(CAMERA, OPTICAL, START))
    packed = Record("/d/image_rect/compressedDepth", START, packed_message(depth, OPTICAL, START, encoding))
    write_bag(tmp_path / "plain", [info, Record("/d/image_rect", START, plain)])
    write_bag(tmp_path / "packed", [info, packed])
    write_bag(tmp_path / "both", [info, packed, Record("/d/image_rect", START, plain)])
    (expected,), (found,), (chosen,) = (list(read_frames(tmp_path / name)) for name in ("plain", "packed", "both"))
    assert (found.topic, chosen.topic) == ("/d/image_rect/compressedDepth", "/d/image_rect")
    # Rectified by its name, as the plain one is. Half a step of the inverse depth is 0.01 mm at 0.45 m.
    np.testing.assert_allclose(found.view().points, expected.view().points, atol=2e-5)


def test_a_calibration_of_another_frame_is_refused_in_a_recording_as_in_the_node(tmp_path):
    records = [
        Record("/d/camera_info", START, camera_info_message(CAMERA, "colour_optical_frame", START)),
        Record("/d/image", START, depth_message(np.full((120, 160), 0.5), OPTICAL, START)),
    ]
    write_bag(tmp_path / "bag", records)
    (frame,) = read_frames(tmp_path / "bag")
    with pytest.raises(CloudError, match="'camera_optical_frame', but its camera_info has 'colour_optical_frame'"):
        frame.view()


def test_depth_in_a_frame_whose_name_says_another_direction_is_told(tmp_path, capsys):
    for frame in (OPTICAL, "camera_link"):
        records = [
            Record("/points", START + i, cloud_message(np.ones((60, 3)) * [0, 0, 1], frame, START)) for i in (0, 1)
        ]
        write_bag(tmp_path / frame, records)
        options = argparse.Namespace(
            topic=None, camera_info=None, every=1, limit=None, frame=None, view_point=None, sensor_frame=""
        )
        assert len(list(bag_views(tmp_path / frame, options))) == 2
        told = capsys.readouterr().err
        assert told.count("frame 'camera_link': by its name the camera looks along x") == (frame == "camera_link")


@pytest.mark.parametrize("lost", ["depth", "camera_info"])
def test_messages_that_only_the_metadata_counts_are_named(tmp_path, lost):
    path = bag_of(tmp_path / "bag", "/a/depth", "/a/camera_info")
    with contextlib.closing(sqlite3.connect(next(path.glob("*.db3")))) as storage:
        storage.execute("delete from messages where topic_id = (select id from topics where name = ?)", (f"/a/{lost}",))
        storage.commit()
    with pytest.raises(BagError, match=f"counts messages on /a/{lost}, but its storage has none"):
        list(read_frames(path))


def test_binned_and_cropped_images_have_their_own_camera():
    info = camera_info_message(CAMERA, OPTICAL, START)
    info.binning_x = info.binning_y = 2
    info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height = 40, 20, 80, 60
    camera = camera_from_message(info)
    assert (camera.width, camera.height) == (40, 30)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (75, 75, 39.5 / 2, 39.5 / 2)
    assert camera.distortion == CAMERA.distortion
    assert camera_from_message(info, rectified=True).distortion == ()


def test_raw_messages_come_back_in_order_of_recording(tmp_path):
    write_bag(tmp_path / "bag", flown_records([(0.4, 0, 0.2), (0, 0.4, 0.2)]), storage="mcap")
    times = [time for _, time, _ in read_raw(tmp_path / "bag")]
    assert len(times) == 9
    assert times == sorted(times)
    assert {topic.name for topic, _, _ in read_raw(tmp_path / "bag", ("/tf",))} == {"/tf"}
    with pytest.raises(BagError, match="no topic '/gone'; the bag has: /depth/camera_info, /depth/image_raw, /tf"):
        list(read_raw(tmp_path / "bag", ("/gone",)))


def test_a_cloud_without_a_stamp_was_seen_when_it_was_recorded(tmp_path):
    records = flown_records([(0.4, 0, 0.2), (0, -0.4, 0.2)])
    at = START + SECOND
    write_bag(tmp_path / "bag", [*records, Record("/bare", at, cloud_message(np.ones((60, 3)), OPTICAL, 0))])
    (frame,) = read_frames(tmp_path / "bag", topic="/bare")
    assert (frame.stamp, frame.received) == (0, at)
    assert frame.view(read_transforms(tmp_path / "bag"), "world").viewpoint == pytest.approx([0.4, 0, 0.2], abs=1e-6)


def test_clouds_of_a_moving_camera_are_fused_in_a_fixed_frame_only(tmp_path, refusal_of):
    write_bag(tmp_path / "bag", flown_records([(0.4, 0, 0.2), (0, -0.4, 0.2)]))
    told = refusal_of("replay", tmp_path / "bag", "--fuse")
    assert f"frame {OPTICAL} moved by 566 mm and 90.0° between views" in told
    assert "--frame" in told


def test_times_and_frames_that_the_bag_does_not_know_are_named(tmp_path):
    records = flown_records([(0.4, 0, 0.2)])
    late = START + 60 * SECOND
    write_bag(tmp_path / "bag", [*records, Record("/late", late, cloud_message(np.ones((60, 3)), OPTICAL, late))])
    transforms = read_transforms(tmp_path / "bag")
    (frame,) = read_frames(tmp_path / "bag", topic="/late")
    with pytest.raises(TransformError, match=r"mount in world is known from 1700000000\.75"):
        frame.view(transforms, "world")
    with pytest.raises(TransformError, match="unknown frame 'wolrd'; known: camera_optical_frame, mount, world"):
        frame.view(transforms, "wolrd")
    with pytest.raises(TransformError, match="camera_optical_frame -> world: no transforms are given"):
        frame.view(None, "world")
    # Of its own frame it needs to know nothing.
    assert len(frame.view(transforms, "/" + OPTICAL).points) == 60


def bag_of(path: Path, *topics: str) -> Path:
    """Clouds on topics called points*, images on others, camera info where the name says so."""
    records = []
    for topic in topics:
        if "camera_info" in topic:
            message = camera_info_message(CAMERA, OPTICAL, START)
        elif "points" in topic:
            message = cloud_message(np.ones((60, 3)), OPTICAL, START)
        else:
            message = depth_message(np.full((120, 160), 0.5), OPTICAL, START)
            if "color" in topic:
                message.encoding = "rgb8"
        records.append(Record(topic, START, message))
    write_bag(path, records)
    return path


@pytest.mark.parametrize(
    ("topics", "options", "chosen"),
    [
        (("/points",), {}, "/points"),
        (("/points", "/a/depth", "/a/camera_info"), {}, "/points"),
        (("/points", "/a/depth", "/a/camera_info"), {"topic": "/a/depth"}, "/a/depth"),
        (("/color/image", "/a/depth", "/b/camera_info"), {}, "/a/depth"),
        (("/a/depth", "/b/camera_info", "/c/camera_info"), {"info_topic": "/c/camera_info"}, "/a/depth"),
        (("/points_1", "/points_2"), {"topic": "/points_2"}, "/points_2"),
    ],
)
def test_the_topic_is_the_one_that_is_meant(tmp_path, topics, options, chosen):
    (frame,) = read_frames(bag_of(tmp_path / "bag", *topics), **options)
    assert frame.topic == chosen
    assert len(frame.view().points) >= 60


@pytest.mark.parametrize(
    ("topics", "options", "culprit"),
    [
        (("/points_1", "/points_2"), {}, "several topics fit; name one of: /points_1, /points_2"),
        (("/a/depth", "/b/depth", "/a/camera_info"), {}, "several topics fit; name one of: /a/depth, /b/depth"),
        (("/points",), {"topic": "/cloud"}, "no clouds or depth images on '/cloud'; valid topics: /points"),
        (("/color/image",), {}, "no topic with clouds or depth images; the bag has: /color/image (Image)"),
        (("/a/depth",), {}, "no camera info on '/a/camera_info' for /a/depth; valid topics: none"),
        (
            ("/a/depth", "/b/camera_info", "/c/camera_info"),
            {},
            "no camera info on '/a/camera_info' for /a/depth; valid topics: /b/camera_info, /c/camera_info",
        ),
    ],
)
def test_a_topic_that_is_missing_or_ambiguous_is_named(tmp_path, topics, options, culprit):
    path = bag_of(tmp_path / "bag", *topics)
    with refused(BagError, culprit):
        list(read_frames(path, **options))


def test_a_frame_that_only_a_refused_transform_names_is_told_with_the_fault(tmp_path, refusal_of):
    """Some drivers send a quaternion of four zeros."""
    tree = transforms_message([("base", OPTICAL, np.eye(4)), ("elbow", "wrist", np.eye(4))], START)
    tree.transforms[0].transform.rotation.w = 0.0
    cloud = cloud_message(np.random.default_rng(0).random((60, 3)), OPTICAL, START)
    write_bag(tmp_path / "bag", [Record("/tf_static", START, tree), Record("/points", START, cloud)])
    said = f"refused: transform base -> {OPTICAL}: not rigid; valid: a rotation and a finite position"
    (frame,) = read_frames(tmp_path / "bag")
    with pytest.raises(TransformError, match=f"unknown frame 'base'; known: elbow, wrist; {said}"):
        frame.view(read_transforms(tmp_path / "bag"), "base")
    line = refusal_of("reconstruct", tmp_path / "bag", "--frame", "base", "--out", tmp_path / "m.ply")
    assert f"no frame 'base'; frames of its transforms: elbow, wrist; {said}" in line


def test_a_bag_without_transforms_says_so(tmp_path):
    with pytest.raises(BagError, match="has no transforms"):
        read_transforms(bag_of(tmp_path / "bag", "/points"))


def cut(path: Path, share: float) -> None:
    """Lose the end of a storage file, as a full disk or a pulled plug does."""
    file = next(p for p in path.iterdir() if p.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9])
def test_a_bag_that_was_cut_short_is_named(tmp_path, storage, share):
    write_bag(tmp_path / "bag", flown_records([(0.4, 0, 0.2), (0, 0.4, 0.2)]), storage=storage)
    cut(tmp_path / "bag", share)
    with refused(BagError, str(tmp_path / "bag")):
        list(read_frames(tmp_path / "bag"))


@pytest.mark.parametrize(
    ("make", "culprit"),
    [
        (lambda path: None, "no such bag"),
        (lambda path: path.mkdir(), "not a bag; a bag is a directory of rosbag2, or a file ending in .mcap or .db3"),
        (lambda path: path.write_text("hello"), "not a bag"),
        (lambda path: (path.mkdir(), (path / "metadata.yaml").write_text("a: [1\n")), "not a readable bag"),
        (lambda path: (path.mkdir(), (path / "metadata.yaml").write_text("")), "not a readable bag"),
        (lambda path: (path.mkdir(), (path / "a.mcap").touch(), (path / "b.mcap").touch()), "2 storage files"),
        (lambda path: (path.mkdir(), (path / "a.db3").write_text("not sqlite")), "not a readable bag"),
    ],
)
def test_what_is_no_bag_is_named(tmp_path, make, culprit):
    make(tmp_path / "bag")
    with refused(BagError, culprit):
        bag_topics(tmp_path / "bag")


def test_a_bag_of_ros_1_is_named_by_every_command_with_what_converts_it(tmp_path, refusal_of):
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n")
    told = "old.bag: is a bag of ROS 1; convert it first: rosbags-convert --src old.bag --dst old"
    for words in (["replay"], ["synthesize"], ["reconstruct", "--out", tmp_path / "m.ply"]):
        assert told in refusal_of(words[0], tmp_path / "old.bag", *words[1:])
