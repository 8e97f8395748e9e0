"""What a request must hold, and what becomes of it; no node."""

from __future__ import annotations

import array
import math

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from graspd_msgs.msg import GraspRequest
from hypothesis import given
from hypothesis import strategies as st
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from graspd_core.errors import CloudError, GraspdError, NoObjectError, ResourceError, TransformError
from graspd_core.optimize.plan_config import preset_names
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_ros.convert import pose_matrix
from graspd_ros.error_codes import ErrorCode, RequestError, code_of, sentence_of
from graspd_ros.inputs.request_builder import RequestBuilder, check_request, settings_of
from graspd_ros.inputs.sensor_frames import MOST_CLOUD_BYTES, MOST_VIEWS, SensorFrame, Views, cloud_frame, trimmed
from graspd_ros.parameters import MOST_GRASPS, Settings

NOW = Time(sec=1000)
HAND = "allegro_right"
FAR = Pose(position=Point(x=math.inf))


def intake(lookup=lambda target, source, stamp: np.eye(4)) -> RequestBuilder:
    return RequestBuilder(HAND, lambda: NOW, lookup)


def sensor_frame(points: np.ndarray, frame: str = "camera", stamp: Time = NOW) -> SensorFrame:
    return SensorFrame("cloud", frame, stamp, 1000 * 10**9, lambda: PointCloud(points, np.zeros(3)))


@pytest.mark.parametrize(("given", "told", "timeless"), [(Time(), NOW, True), (Time(sec=7), Time(sec=7), False)])
def test_a_mesh_without_a_time_stands_where_it_does_now(tmp_path, given, told, timeless):
    (tmp_path / "can.obj").touch()
    settings = Settings(mesh_roots=[str(tmp_path)])
    uri = str(tmp_path / "can.obj")
    message = GraspRequest(source=GraspRequest.MESH, mesh_uri=uri, header=Header(stamp=given))
    request = intake().from_message("r", settings, message)
    assert (request.stamp, request.timeless) == (told, timeless)
    by_path = intake().from_mesh("r", settings, uri)
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
        ({"mesh_scale": -1.0}, "mesh_scale: -1.0"),
        ({"mesh_scale": math.nan}, "mesh_scale: nan"),
        ({"use_target_point": True, "target_point": Point(x=math.nan)}, "target_point: [nan"),
        ({"use_target_point": True, "target_point": Point(z=1e9)}, "within 1000 m"),
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
    given = Settings(num_grasps=3, preset="fast", seed=7, deadline=5.0, mesh_scale=0.5)
    left_open = settings_of(GraspRequest(), given)
    assert (left_open.num_grasps, left_open.preset, left_open.seed, left_open.deadline) == (3, "fast", 7, 5.0)
    asked = settings_of(GraspRequest(num_grasps=9, preset="accurate", seed=0, time_budget=2.5, mesh_scale=0.1), given)
    assert (asked.num_grasps, asked.preset, asked.seed, asked.deadline, asked.mesh_scale) == (
        9,
        "accurate",
        0,
        2.5,
        0.1,
    )


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
    expected = np.eye(4)
    expected[:3, 3] = [1.0, 2.0, 3.0]
    np.testing.assert_array_equal(pose_matrix(none), expected)
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
    with pytest.raises(RequestError, match="no cloud or depth image has come yet") as refused:
        taker.from_message("a", Settings(), latest)
    assert refused.value.code is ErrorCode.NO_CLOUD
    taker.newest = sensor_frame(np.zeros((3, 3)), stamp=Time(sec=990))
    with pytest.raises(RequestError, match=r"10\.0 s old, more than cloud_max_age=5 s") as refused:
        taker.from_message("a", Settings(), latest)
    assert refused.value.code is ErrorCode.STALE_CLOUD
    request = taker.from_message("a", Settings(cloud_max_age=0.0), latest)
    assert (request.frame, request.stamp.sec, request.source) == ("camera", 990, "latest_cloud")
    taker.newest = sensor_frame(np.zeros((3, 3)), stamp=Time())  # without a stamp, arrival counts
    assert taker.from_message("b", Settings(), latest).stamp == NOW


def test_views_are_gathered_in_one_frame():
    def lookup(target: str, source: str, stamp: Time) -> np.ndarray:
        if source == "lost":
            raise TransformError("unknown frame 'lost'; known: map")
        pose = np.eye(4)
        pose[0, 3] = 1.0
        return pose

    taker, settings = intake(lookup), Settings(fixed_frame="map")
    with pytest.raises(RequestError, match="call ~/add_view") as refused:
        taker.from_message("a", settings, GraspRequest(source=GraspRequest.VIEWS))
    assert refused.value.code is ErrorCode.NO_CLOUD
    taker.newest = sensor_frame(np.array([[0.0, 0.0, 1.0], [0.0, 0.5, 1.0]]))
    taker.add_view(settings)
    taker.newest = sensor_frame(np.array([[2.0, 0.0, 0.0]]), frame="map")
    taker.add_view(settings)
    first, second = taker.views.clouds
    np.testing.assert_array_equal(first.points, [[1.0, 0.0, 1.0], [1.0, 0.5, 1.0]])
    np.testing.assert_array_equal(first.viewpoint, [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(second.points, [[2.0, 0.0, 0.0]])
    assert taker.from_message("a", settings, GraspRequest(source=GraspRequest.VIEWS)).frame == "map"
    taker.newest = sensor_frame(np.zeros((3, 3)), frame="lost")
    with pytest.raises(GraspdError, match="lost"):
        taker.add_view(settings)
    assert len(taker.views.clouds) == 2
    taker.forget()
    assert taker.views == Views()


def test_the_number_of_views_and_their_size_are_bounded():
    views, settings, crowd = Views(), Settings(), sensor_frame(np.random.default_rng(0).normal(size=(500_000, 3)))
    views = views.add(crowd, crowd.read(), settings, lambda *_: np.eye(4))
    assert len(views.clouds[0].points) <= 200_000
    few = sensor_frame(np.zeros((3, 3)))
    for _ in range(MOST_VIEWS - 1):
        views = views.add(few, few.read(), settings, lambda *_: np.eye(4))
    with pytest.raises(RequestError, match="64 views are kept already"):
        views.add(few, few.read(), settings, lambda *_: np.eye(4))


@given(
    st.lists(st.tuples(*[st.floats(-2, 2)] * 3), min_size=1, max_size=50),
    st.sampled_from([0.0, 1e-8, 0.1, 0.5]),
)
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
    with pytest.raises(RequestError, match=f"{MOST_CLOUD_BYTES + 1} bytes; at most"):
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
    (tmp_path / "can.obj").touch()
    mesh = {"source": GraspRequest.MESH, "mesh_uri": str(tmp_path / "can.obj")}
    settings = Settings(mesh_roots=[str(tmp_path)])
    lost = PoseStamped(header=Header(frame_id="base"), pose=Pose(position=Point(x=1.0)))
    asked = GraspRequest(**mesh, exclude=["can-1/0"], exclude_poses=[lost])
    request = intake().from_message("r", settings, asked)
    assert request.exclude == ("can-1/0",)
    ((frame, pose),) = request.exclude_poses
    assert (frame, pose[0, 3]) == ("base", 1.0)
    again = intake().from_message("s", settings, GraspRequest(**mesh, object_pose=Pose(position=Point(z=2.0))))
    assert again.object_key == request.object_key != ""
    larger = intake().from_message("t", settings, GraspRequest(**mesh, mesh_scale=2.0))
    assert larger.object_key != request.object_key
    assert "exclude: 257 ids, 0 poses; valid: 256" in str(refusal(exclude=["a/0"] * 257))
    with pytest.raises(RequestError, match="exclude_poses: position"):
        intake().from_message("u", settings, GraspRequest(**mesh, exclude_poses=[PoseStamped(pose=FAR)]))
