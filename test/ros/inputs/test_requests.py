"""From messages to requests: what is checked, where meshes may lie, the sources, and wishes for place and direction."""

import array
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from expected import refused
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Vector3
from graspd_msgs.msg import GraspRequest
from hypothesis import given
from hypothesis import strategies as st
from sensor_msgs.msg import Image, PointCloud2
from shape_msgs.msg import SolidPrimitive
from std_msgs.msg import Header
from trimesh.transformations import translation_matrix

from graspd_core import Box, PointCloud, Sphere, load_scene, preset_names
from graspd_core.errors import CloudError, GraspdError, MeshError, NoObjectError, ResourceError, TransformError
from graspd_ros.convert import pose_matrix
from graspd_ros.error_codes import ErrorCode, RequestError, code_of, sentence_of
from graspd_ros.inputs import request_builder, sensor_frames
from graspd_ros.inputs.request_builder import SOURCES, RequestBuilder, check_request, resolve_mesh, settings_of
from graspd_ros.inputs.sensor_frames import MOST_CLOUD_BYTES, MOST_VIEWS, SensorFrame, Views, cloud_frame, trimmed
from graspd_ros.parameters import MOST_GRASPS, Settings
from graspd_ros.request import Request

NOW = Time(sec=1000)
HAND = "allegro_right"
FAR = Pose(position=Point(x=math.inf))
# A quarter turn about x: the object's z is the header's −y.
LYING = Pose(position=Point(x=0.5), orientation=Quaternion(x=np.sqrt(0.5), w=np.sqrt(0.5)))
BOX, BALL = SolidPrimitive.BOX, SolidPrimitive.SPHERE
DOWN = Vector3(z=-1.0)
SEEN = Time(sec=999)
SCANNER = 9


def intake(lookup=lambda target, source, stamp: np.eye(4)) -> RequestBuilder:
    return RequestBuilder(HAND, lambda: NOW, lookup)


def request(tmp_path: Path, **fields) -> Request:
    """A request for grasps on a mesh."""
    if not (can := tmp_path / "can.obj").exists():
        can.touch()
    message = GraspRequest(source=GraspRequest.MESH, mesh_uri=str(can), **fields)
    return intake().from_message("r", Settings(mesh_roots=[str(tmp_path)]), message)


def sensor_frame(points: np.ndarray, frame: str = "camera", stamp: Time = NOW) -> SensorFrame:
    return SensorFrame("cloud", frame, stamp, 1000 * 10**9, lambda *_: PointCloud(points, np.zeros(3)))


@pytest.mark.parametrize(("given", "told", "timeless"), [(Time(), NOW, True), (Time(sec=7), Time(sec=7), False)])
def test_a_mesh_without_a_time_stands_where_it_does_now(tmp_path, given, told, timeless):
    asked = request(tmp_path, header=Header(stamp=given))
    assert (asked.stamp, asked.timeless) == (told, timeless)
    by_path = intake().from_mesh("r", asked.settings, str(tmp_path / "can.obj"))
    assert (by_path.stamp, by_path.timeless) == (NOW, True)


def refusal(**fields) -> RequestError:
    with pytest.raises(RequestError) as refused:
        check_request(GraspRequest(**fields), HAND)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 400
    return refused.value


@pytest.mark.parametrize(
    ("fields", "culprit"),
    [
        ({"id": "../../etc/passwd"}, "id: '../../etc/passwd'"),
        ({"id": "a\nb"}, "id: "),
        ({"id": "x" * 10**6}, "at most 128"),
        ({"num_grasps": MOST_GRASPS + 1}, "num_grasps: 257; valid: 1 to 256"),
        ({"preset": "/etc/passwd.yaml"}, f"preset: '/etc/passwd.yaml'; valid: {', '.join(preset_names())}"),
        ({"seed": -2}, "seed: -2"),
        ({"time_budget": -1.0}, "time_budget: -1.0"),
        ({"time_budget": math.inf}, "time_budget: inf"),
        ({"time_budget": math.nan}, "time_budget: nan"),
        ({"mass": math.nan}, "mass: nan; valid: 0.001 to 100 kg, 0 for the parameter"),
        ({"mesh_scale": -1.0}, "mesh_scale: -1.0"),
        ({"mesh_scale": math.nan}, "mesh_scale: nan"),
        ({"use_target_point": True, "target_point": Point(x=math.nan)}, "target_point: [nan"),
        ({"use_target_point": True, "target_point": Point(z=1e9)}, "within 1000 m"),
        ({"use_view_point": True, "view_point": Point(x=math.nan)}, "view_point: [nan"),
        ({"target_mask": Image(height=1), "alone": True}, "target_mask: cannot be combined with alone"),
        (
            {"target_mask": Image(height=1), "use_target_point": True},
            "target_mask: cannot be combined with target_point",
        ),
        ({"target_mask": Image(height=1), "source": GraspRequest.MESH}, "target_mask: source is 1"),
        ({"any_object": True, "alone": True}, "any_object: alone is given too"),
        ({"any_object": True, "target_mask": Image(height=1)}, "any_object: target_mask is given too"),
        ({"any_object": True, "source": GraspRequest.MESH}, "any_object: source is 1; valid sources: CLOUD=0"),
        ({"any_object": True, "source": GraspRequest.KNOWN}, "any_object: source is 4; valid sources: CLOUD=0"),
    ],
)
def test_a_field_out_of_range_is_named(fields, culprit):
    error = refusal(**fields)
    assert culprit in str(error)
    assert error.code is ErrorCode.BAD_REQUEST


def test_another_hand_is_refused_and_ones_own_is_not():
    error = refusal(hand="shadow")
    assert error.code is ErrorCode.WRONG_HAND
    assert "'shadow' is not loaded; this node plans for allegro_right" in str(error)
    check_request(GraspRequest(hand=HAND), HAND)


def test_what_a_request_leaves_open_is_the_parameters():
    given = Settings(num_grasps=3, preset="fast", seed=7, deadline=5.0, mass=0.09, mesh_scale=0.5)
    assert settings_of(GraspRequest(), given) == replace(given, mesh_scale=1.0)  # a message's own default is 1
    fields = {"num_grasps": 9, "preset": "accurate", "seed": 0, "mass": 0.07, "mesh_scale": 0.1}
    asked = settings_of(GraspRequest(**fields, time_budget=2.5), given)
    assert asked == replace(given, **fields, deadline=2.5)


@given(
    st.text(max_size=200),
    st.integers(0, 255),
    st.integers(0, 2**32 - 1),
    st.sampled_from(["", "nonsense", "../fast", *preset_names()]),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(),
    st.floats(),
)
def test_whatever_passes_gives_settings_within_the_parameters_ranges(id, source, count, preset, seed, budget, scale):
    message = GraspRequest(
        id=id, source=source, num_grasps=count, preset=preset, seed=seed, time_budget=budget, mesh_scale=scale
    )
    try:
        check_request(message, HAND)
    except RequestError:
        return
    settings = settings_of(message, Settings())
    assert 1 <= settings.num_grasps <= MOST_GRASPS
    assert settings.seed >= 0
    assert 0.1 <= settings.deadline <= 3600
    assert settings.preset in preset_names()
    assert 0 < settings.mesh_scale < math.inf
    assert "/" not in message.id


def test_a_pose_without_turn_is_a_place_and_a_wrong_one_is_refused():
    none = Pose(position=Point(x=1.0, y=2.0, z=3.0), orientation=Quaternion(w=0.0))
    np.testing.assert_array_equal(pose_matrix(none), translation_matrix([1.0, 2.0, 3.0]))
    quarter = pose_matrix(Pose(orientation=Quaternion(z=math.sqrt(0.5), w=math.sqrt(0.5))))
    np.testing.assert_allclose(quarter[:3, 0], [0, 1, 0], atol=1e-15)
    for pose, culprit in [
        (Pose(orientation=Quaternion(w=2.0)), "length 2"),
        (Pose(orientation=Quaternion(w=math.nan)), "length nan"),
        (Pose(position=Point(y=math.inf)), "position"),
        (Pose(position=Point(y=1e7)), "position"),
    ]:
        with pytest.raises(RequestError, match=culprit):
            pose_matrix(pose)


def test_a_cloud_is_refused_when_none_came_or_it_is_old():
    taker, latest = intake(), GraspRequest(source=GraspRequest.LATEST_CLOUD)
    with refused(RequestError, match="no cloud or depth image has arrived yet", code="NO_CLOUD"):
        taker.from_message("a", Settings(), latest)
    taker.newest = sensor_frame(np.zeros((3, 3)), stamp=Time(sec=990))
    with refused(RequestError, match=r"10\.0 s old, more than cloud_max_age=5 s", code="STALE_CLOUD"):
        taker.from_message("a", Settings(), latest)
    request = taker.from_message("a", Settings(cloud_max_age=0.0), latest)
    assert (request.frame, request.stamp.sec, request.source) == ("camera", 990, "latest_cloud")
    taker.newest = cloud_frame(PointCloud2(header=Header(frame_id="camera")), 1000 * 10**9)
    # Without a stamp, arrival counts, also for transforms.
    request = taker.from_message("b", Settings(), latest)
    assert (request.stamp, request.timeless) == (NOW, False)


def test_views_are_gathered_in_one_frame():
    def lookup(target: str, source: str, stamp: Time) -> np.ndarray:
        if source == "lost":
            raise TransformError("unknown frame 'lost'; known: map")
        return translation_matrix([1.0, 0.0, 0.0])

    taker, settings = intake(lookup), Settings(fixed_frame="map")
    with refused(RequestError, match="call ~/add_view", code="NO_CLOUD"):
        taker.from_message("a", settings, GraspRequest(source=GraspRequest.VIEWS))
    taker.newest = sensor_frame(np.array([[0.0, 0.0, 1.0], [0.0, 0.5, 1.0]]))
    taker.add_view(settings)
    taker.newest = sensor_frame(np.array([[2.0, 0.0, 0.0]]), frame="map")
    taker.add_view(settings)
    first, second = taker.views.clouds
    np.testing.assert_array_equal(first.points, [[1.0, 0.0, 1.0], [1.0, 0.5, 1.0]])
    np.testing.assert_array_equal(first.viewpoint, [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(second.points, [[2.0, 0.0, 0.0]])
    assert taker.from_message("a", settings, GraspRequest(source=GraspRequest.VIEWS)).frame == "map"
    every = GraspRequest(source=GraspRequest.VIEWS, any_object=True)
    asked = taker.from_message("a", settings, every)
    assert asked.views is not None
    assert asked.views() == (taker.views.clouds, ())
    with pytest.raises(RequestError, match="any_object: the parameter segment is false"):
        taker.from_message("a", replace(settings, segment=False), every)
    taker.newest = sensor_frame(np.zeros((3, 3)), frame="lost")
    with pytest.raises(GraspdError, match="lost"):
        taker.add_view(settings)
    assert len(taker.views.clouds) == 2
    assert taker.drop_views() == 2
    assert taker.views == Views()


def test_the_number_of_views_and_their_size_are_bounded():
    views, settings, crowd = Views(), Settings(), sensor_frame(np.random.default_rng(0).normal(size=(500_000, 3)))
    views = views.add(crowd, crowd.read(), settings, lambda *_: np.eye(4))
    assert len(views.clouds[0].points) <= 200_000
    few = sensor_frame(np.zeros((3, 3)))
    for _ in range(MOST_VIEWS - 1):
        views = views.add(few, few.read(), settings, lambda *_: np.eye(4))
    with pytest.raises(RequestError, match="64 views are stored, which is the limit"):
        views.add(few, few.read(), settings, lambda *_: np.eye(4))


@given(st.lists(st.tuples(*[st.floats(-2, 2)] * 3), min_size=1, max_size=50), st.sampled_from([0.0, 1e-8, 0.1, 0.5]))
def test_trimming_keeps_points_of_the_workspace_at_most_one_a_voxel(rows, voxel):
    points = np.array(rows)
    settings = Settings(roi_min=[-1.0] * 3, roi_max=[1.0] * 3, voxel_size=voxel)
    inside = points[(np.abs(points) <= 1).all(1)]
    if not len(inside):
        with pytest.raises(RequestError, match="roi_min"):
            trimmed(PointCloud(points, np.zeros(3)), settings)
        return
    kept = trimmed(PointCloud(points, np.zeros(3)), settings).points
    assert {tuple(p) for p in kept} <= {tuple(p) for p in inside}
    if voxel:
        cells = {tuple(np.floor(p / voxel)) for p in inside}
        assert len(kept) == len(cells)
        assert {tuple(np.floor(p / voxel)) for p in kept} == cells
    else:
        assert len(kept) == len(inside)


def test_a_cloud_too_large_to_keep_is_refused_wherever_it_comes_from():
    huge = PointCloud2(data=array.array("B", bytes(MOST_CLOUD_BYTES + 1)))
    with pytest.raises(RequestError, match=f"{MOST_CLOUD_BYTES + 1} bytes; valid: at most"):
        cloud_frame(huge, 0)


def test_names_that_the_node_makes_up_differ_from_those_before_a_restart(monkeypatch):
    names = []
    for second in (1, 2):
        monkeypatch.setattr("time.strftime", lambda _, second=second: f"then{second}")
        taker = intake()
        names += [taker.new_id("mesh"), taker.new_id("mesh")]
    assert len(set(names)) == 4


def test_a_target_point_comes_into_the_frame_of_the_cloud():
    asked = []

    def lookup(target: str, source: str, stamp: Time) -> np.ndarray:
        asked.append((target, source))
        raise TransformError("not connected")

    taker = intake(lookup)
    taker.newest = sensor_frame(np.zeros((3, 3)))
    point = {"use_target_point": True, "target_point": Point(z=0.5), "source": GraspRequest.LATEST_CLOUD}
    for frame in ("", "camera"):
        taker.from_message("a", Settings(), GraspRequest(header=Header(frame_id=frame), **point))
    assert not asked
    with pytest.raises(TransformError):
        taker.from_message("a", Settings(), GraspRequest(header=Header(frame_id="map"), **point))
    assert asked == [("camera", "map")]


def test_every_trouble_has_its_code():
    cases = {
        NoObjectError("x"): ErrorCode.NO_OBJECT,
        CloudError("x"): ErrorCode.BAD_CLOUD,
        MeshError("x"): ErrorCode.BAD_MESH,
        TransformError("x"): ErrorCode.NO_TRANSFORM,
        ResourceError("x"): ErrorCode.OUT_OF_MEMORY,
        MemoryError(): ErrorCode.OUT_OF_MEMORY,
        RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried 8 bytes"): (
            ErrorCode.OUT_OF_MEMORY
        ),
        RuntimeError("sizes differ"): ErrorCode.INTERNAL,
        SystemExit(3): ErrorCode.INTERNAL,
    }
    assert [code_of(error) for error in cases] == list(cases.values())
    assert sentence_of(ValueError("two\nlines")) == "internal error: ValueError: two lines"


def test_what_was_lost_and_which_object_it_was_of_reach_the_worker(tmp_path):
    lost = PoseStamped(header=Header(frame_id="base"), pose=Pose(position=Point(x=1.0)))
    asked = request(tmp_path, exclude=["can-1/0"], exclude_poses=[lost])
    assert asked.exclude == ("can-1/0",)
    ((frame, pose),) = asked.exclude_poses
    assert (frame, pose[0, 3]) == ("base", 1.0)
    again = request(tmp_path, object_pose=Pose(position=Point(z=2.0)))
    assert again.object_key == asked.object_key != ""
    assert request(tmp_path, mesh_scale=2.0).object_key != asked.object_key
    (tmp_path / "can.obj").write_text("# another object, whose file is as old")
    os.utime(tmp_path / "can.obj", ns=(0, 0))
    (tmp_path / "left").mkdir()
    (tmp_path / "left" / "can.obj").touch()
    os.utime(tmp_path / "left" / "can.obj", ns=(0, 0))
    roots = [Settings(mesh_roots=[str(root)]) for root in (tmp_path, tmp_path / "left")]
    message = GraspRequest(source=GraspRequest.MESH, mesh_uri="can.obj")
    assert len({intake().from_message("r", settings, message).object_key for settings in roots}) == 2
    assert "exclude: 257 ids, 0 poses; valid: at most 256 together" in str(refusal(exclude=["a/0"] * 257))
    with pytest.raises(RequestError, match="exclude_poses: position"):
        request(tmp_path, exclude_poses=[PoseStamped(pose=FAR)])


def test_clouds_of_one_image_are_one_object_only_where_they_show_the_same(make_cloud):
    def key(points: np.ndarray, **settings: object) -> str:
        cloud = make_cloud(points)
        cloud.header.stamp = NOW
        message = GraspRequest(cloud=cloud, alone=True)
        return intake().from_message("r", replace(Settings(), **settings), message).object_key

    ball = np.random.default_rng(0).normal(size=(100, 3))
    assert key(ball) == key(ball) != ""
    # A segmenter gives each object of an image as its own cloud, all with the image's stamp.
    assert key(ball + np.array([0.2, 0.0, 0.0])) != key(ball)
    assert key(ball, roi_min=[0.0, 0.0, 0.0]) != key(ball)
    assert key(ball, voxel_size=0.01) != key(ball)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("meshes") / "root"
    (root / "sub dir").mkdir(parents=True)
    (root / "mug.obj").write_text("")
    (root / "sub dir" / "cup.obj").write_text("")
    (root.parent / "secret.obj").write_text("")
    (root / "link.obj").symlink_to(root.parent / "secret.obj")
    (root / "inner.obj").symlink_to(root / "mug.obj")
    return root


def test_every_form_finds_the_file(root: Path, monkeypatch: pytest.MonkeyPatch):
    prefix = root / "prefix"
    share = prefix / "share" / "things"
    share.mkdir(parents=True)
    (share / "pan.obj").write_text("")
    (prefix / "share" / "ament_index" / "resource_index" / "packages").mkdir(parents=True)
    (prefix / "share" / "ament_index" / "resource_index" / "packages" / "things").write_text("")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(prefix))
    mug, cup = root / "mug.obj", root / "sub dir" / "cup.obj"
    found = {
        "mug.obj": mug,
        "./sub dir/../mug.obj": mug,
        " mug.obj\n": mug,
        str(mug): mug,
        f"file://{mug}": mug,
        f"file://localhost{root}/sub%20dir/cup.obj": cup,
        "inner.obj": mug,
        "package://things/pan.obj": share / "pan.obj",
    }
    assert {uri: resolve_mesh(uri, [str(root)]) for uri in found} == found
    assert resolve_mesh("package://things/pan.obj", ["package://things"]) == share / "pan.obj"


@pytest.mark.parametrize(
    ("uri", "culprit"),
    [
        ("", "empty"),
        ("../secret.obj", "outside mesh_roots"),
        ("link.obj", "outside mesh_roots"),
        ("file:///etc/hostname", "outside mesh_roots"),
        ("/etc/hostname", "outside mesh_roots"),
        ("file://elsewhere/mug.obj", "unknown form"),
        ("https://elsewhere/mug.obj", "unknown form"),
        ("package://nothing/mug.obj", "'nothing' is not installed"),
        ("missing.obj", "no such file"),
        ("sub dir", "a directory"),
        ("mug\0.obj", "not a usable path"),
        ("m" * 300, "not a usable path"),
        ("m" * 5000, "5000 characters long"),
    ],
)
def test_what_may_not_be_read_is_refused_by_name(root: Path, uri: str, culprit: str):
    with refused(MeshError, culprit):
        resolve_mesh(uri, [str(root)])


def test_without_a_usable_root_nothing_may_be_read(root: Path):
    with pytest.raises(MeshError, match="names no existing directory"):
        resolve_mesh("mug.obj", [str(root / "nowhere"), "package://nothing"])


PARTS = st.sampled_from(["..", ".", "root", "sub dir", "mug.obj", "secret.obj", "link.obj", "", "/", "~", "%2e%2e"])


@given(st.sampled_from(["", "file://", "file:///", "package://"]), st.lists(PARTS, max_size=8))
def test_no_spelling_leads_out(root: Path, scheme: str, parts: list[str]):
    try:
        found = resolve_mesh(scheme + "/".join(parts), [str(root)])
    except MeshError:
        return
    assert found == root / "mug.obj"


def test_a_mesh_too_large_to_read_is_refused_before_it_is_read(root: Path):
    with (root / "huge.obj").open("wb") as file:
        file.truncate(request_builder.MOST_MESH_BYTES + 1)
    with pytest.raises(MeshError, match="at most 100 MB"):
        resolve_mesh("huge.obj", [str(root)])


def solid(kind: int, *sizes: float) -> SolidPrimitive:
    return SolidPrimitive(type=kind, dimensions=list(sizes))


def test_a_request_that_asks_for_nothing_has_no_wishes(tmp_path):
    assert request(tmp_path).steering is None
    assert request(tmp_path, object_pose=LYING, region=SolidPrimitive(), region_pose=LYING).steering is None


def test_wishes_come_to_the_frame_of_the_object(tmp_path):
    asked = request(
        tmp_path,
        object_pose=LYING,
        approach_direction=DOWN,
        approach_angle=0.3,
        use_roll=True,
        roll=1.0,
        region=solid(BALL, 0.1),
        region_pose=Pose(position=Point(x=0.5, z=0.2)),
        avoid=[solid(BOX, 0.1, 0.2, 0.3)],
        avoid_poses=[Pose(position=Point(x=0.6))],
    ).steering
    assert asked is not None
    found = asked()
    # Header's −z is the object's −y; the header's x, from which a vertical approach's roll is measured, stays.
    assert np.allclose(np.asarray(found.approach_direction), [0, -1, 0])
    assert found.roll_zero is not None
    assert np.allclose(np.asarray(found.roll_zero), [1, 0, 0])
    assert (found.approach_angle, found.roll, found.roll_tolerance) == (0.3, 1.0, np.pi / 12)
    assert isinstance(found.region, Sphere)
    assert np.allclose(np.asarray(found.region.center), [0, 0.2, 0])
    (box,) = found.avoid
    assert np.allclose(np.asarray(box.center), [0.1, 0, 0])
    # The box's edges lie along the header's axes.
    assert np.allclose(box.rotation @ [0, 0, 1], [0, 1, 0])
    assert box.size == (0.1, 0.2, 0.3)


def test_wishes_in_another_frame_than_the_cloud_go_by_tf():
    T = np.eye(4)
    T[:3, :3] = [[0, 1, 0], [0, 0, 1], [1, 0, 0]]
    cloud = PointCloud2(header=Header(frame_id="camera", stamp=NOW))
    for frame, direction in (("map", [0, -1, 0]), ("camera", [0, 0, -1]), ("", [0, 0, -1])):
        message = GraspRequest(header=Header(frame_id=frame), cloud=cloud, approach_direction=DOWN)
        steering = intake(lambda *_: T).from_message("r", Settings(), message).steering
        assert steering is not None
        assert np.allclose(np.asarray(steering().approach_direction), direction)


def test_point_and_wishes_are_placed_where_the_camera_stood_when_it_saw(make_cloud, monkeypatch):
    def lookup(target: str, source: str, stamp: Time) -> np.ndarray:
        return translation_matrix([0.0, 0.0, 5.0 if stamp == SEEN else -1.0])  # the camera has moved since

    cloud, targets = make_cloud(np.ones((100, 3))), []
    cloud.header.stamp = SEEN
    monkeypatch.setattr(sensor_frames, "scene_of_views", lambda views, settings, target, told: targets.append(target))
    fields = {"cloud": cloud, "use_target_point": True, "target_point": Point(x=0.5), "region": solid(BALL, 0.1)}
    asked = intake(lookup).from_message("r", Settings(), GraspRequest(header=Header(frame_id="map"), **fields))
    asked.load()
    assert np.allclose(targets[0].point, [0.5, 0, 5])
    assert asked.steering is not None
    region = asked.steering().region
    assert isinstance(region, Sphere)
    assert np.allclose(np.asarray(region.center), [0, 0, 5])


@pytest.mark.parametrize("source", [GraspRequest.CLOUD, GraspRequest.LATEST_CLOUD, GraspRequest.VIEWS])
def test_a_request_may_have_the_present_time_though_tf_is_a_little_behind(make_cloud, monkeypatch, source):
    def lookup(target: str, frame: str, stamp: Time) -> np.ndarray:
        assert stamp != NOW, "the newest transform is older"
        return np.eye(4)

    def lookup_in_time(target: str, frame: str, stamp: Time) -> np.ndarray:
        times.append(stamp)  # transforms at the present time have arrived meanwhile
        return np.eye(4)

    targets, times = [], list[Time]()
    monkeypatch.setattr(sensor_frames, "scene_of_views", lambda views, settings, target, *_: targets.append(target))
    builder = RequestBuilder(HAND, lambda: NOW, lookup, lookup_in_time)
    cloud = make_cloud(np.ones((100, 3)))
    cloud.header.stamp = SEEN
    builder.newest = cloud_frame(cloud, 999 * 10**9)
    builder.views = Views("camera", SEEN, (PointCloud(np.ones((100, 3)), np.zeros(3)),))
    fields = {"use_target_point": True, "target_point": Point(x=0.5), "approach_direction": DOWN}
    message = GraspRequest(header=Header(frame_id="map", stamp=NOW), source=source, cloud=cloud, **fields)
    asked = builder.from_message("r", Settings(), message)
    asked.load()
    assert asked.steering is not None
    asked.steering()
    assert np.allclose(targets[0].point, [0.5, 0, 0])
    # A cloud is seen at its own time. Views are in a fixed frame, so the header's time counts.
    assert times == [NOW if source == GraspRequest.VIEWS else SEEN] * 2


def test_a_box_may_be_the_region(tmp_path):
    steering = request(tmp_path, region=solid(BOX, 0.1, 0.1, 0.1)).steering
    assert steering is not None
    assert isinstance(steering().region, Box)


@pytest.mark.parametrize(
    ("fields", "culprit"),
    [
        ({"approach_direction": Vector3(x=float("nan"))}, "approach_direction: .*3 finite numbers"),
        ({"approach_angle": 0.5}, "approach_angle: needs approach_direction"),
        ({"approach_direction": DOWN, "approach_angle": -0.5}, "approach_angle: -0.5 rad; valid: above 0"),
        ({"approach_direction": DOWN, "roll": 0.5}, "roll: use_roll is false"),
        ({"use_roll": True}, "roll: no approach_direction is given"),
        ({"region": solid(BOX, 0.1)}, "region: type 1 of 1 dimensions; valid: BOX=1 or SPHERE=2"),
        ({"region": solid(BALL, 0.1, 0.1)}, "region: 2 dimensions; valid for a SPHERE: 1, the radius"),
        ({"region": solid(BALL, -0.1)}, "sphere radius: -0.1 m; valid: above 0"),
        ({"region": solid(SolidPrimitive.CONE, 0.1, 0.1)}, "region: type 4 of 2 dimensions"),
        ({"region": solid(BALL, 0.1), "region_pose": Pose(position=Point(x=float("inf")))}, "region_pose: position"),
        ({"region_mask": Image(height=1)}, "region_mask: source is 1; valid sources: CLOUD=0"),
        ({"region_mask": Image(height=1), "region": solid(BALL, 0.1)}, "region_mask: region is given too"),
        ({"avoid": [solid(BOX, 1, 1, 1)]}, "avoid: 1 boxes, 0 poses; valid: one pose for each box, at most 64"),
        ({"avoid_poses": [Pose()]}, "avoid: 0 boxes, 1 poses; valid: one pose for each box"),
        ({"avoid": [solid(BALL, 1)], "avoid_poses": [Pose()]}, "avoid: type 2 of 1 dimensions; valid: BOX=1"),
        ({"avoid": [solid(BOX, 1, 0, 1)], "avoid_poses": [Pose()]}, "box size: .*three lengths above 0"),
    ],
)
def test_wishes_that_make_no_sense_are_refused_by_name(tmp_path, fields, culprit):
    with refused(GraspdError, match=culprit, code="BAD_REQUEST"):
        request(tmp_path, **fields)


def test_every_constant_of_the_message_has_its_row():
    names = {name for name in dir(GraspRequest) if name.isupper() and not name.endswith("__DEFAULT")} - {"SLOT_TYPES"}
    assert {source.name.upper(): number for number, source in SOURCES.items()} == {
        name: getattr(GraspRequest, name) for name in names
    }


def test_a_source_without_a_row_is_refused_and_the_rows_are_named(monkeypatch):
    request = GraspRequest(source=SCANNER)
    with refused(
        RequestError, match=r"source: 9; valid: CLOUD=0, MESH=1, LATEST_CLOUD=2, VIEWS=3, KNOWN=4$", code="BAD_REQUEST"
    ):
        intake().from_message("r", Settings(), request)
    monkeypatch.setitem(SOURCES, 7, replace(SOURCES[GraspRequest.CLOUD], name="lidar"))
    with pytest.raises(RequestError, match=r"LIDAR=7$"):
        intake().from_message("r", Settings(), request)


def test_a_source_is_one_row(monkeypatch):
    scene, given = load_scene("shape:box", resolution=16), []

    def from_scanner(asked: request_builder.SourceInput) -> Request:
        given.append((asked.message, asked.settings.num_grasps))
        return asked.request("scanner", SEEN, lambda: scene)

    monkeypatch.setitem(SOURCES, SCANNER, request_builder.Source("scanner", from_scanner))
    message = GraspRequest(source=SCANNER, num_grasps=3, header=Header(frame_id="map"))
    request = intake().from_message("r", Settings(), message)
    assert given == [(message, 3)]
    assert (request.source, request.frame, request.stamp, request.timeless) == ("scanner", "scanner", SEEN, False)
    assert request.T_frame_object is None
    assert request.settings.num_grasps == 3
    assert request.load() is scene
