"""What the node publishes on a grasp, over DDS; and its markers."""

import array
import dataclasses

import numpy as np
import pytest
import yaml
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion
from graspd_msgs.msg import Grasp as GraspMessage
from graspd_msgs.msg import GraspArray, GraspRequest
from graspd_msgs.srv import ListHands
from hypothesis import given
from hypothesis import strategies as st
from rclpy.qos import qos_profile_sensor_data
from rclpy.serialization import serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from trimesh.transformations import translation_matrix
from visualization_msgs.msg import Marker, MarkerArray

from graspd_bench.rendering.render import render_depth
from graspd_core import Grasp, GraspResult, Outcome, Posture, TrialResult, Verdict, hand_mesh, load_hand, make_shape
from graspd_core.hands.model import Primitive
from graspd_core.paths import config_dir
from graspd_core.perception.cloud.camera import PinholeCamera
from graspd_core.types import ROBUSTNESS, Contact, GraspMetrics, Timing
from graspd_ros.convert import array_of, matrix_of_pose, moved_result
from graspd_ros.outputs.messages import COLOURS, IDS_OF_A_GRASP, PARTS, array_message, ending_of, result_markers
from graspd_ros.outputs.responses import presentable
from graspd_ros.parameters import Settings
from graspd_ros.request_planner import Planned

FEW = {"num_grasps": 2, "preset": "fast", "time_budget": 100.0}
LONG = {"num_grasps": 64, "preset": "accurate", "time_budget": 600.0}
SPHERE = {"source": GraspRequest.MESH, "mesh_uri": "sphere.obj"}
BALL, RADIUS = np.array([0.0, 0.0, 0.5]), 0.035  # metres, camera frame
CAMERA = PinholeCamera(200, 150, 400.0, 400.0, 99.5, 74.5)
HAND_LENGTH = 0.25

pytestmark = pytest.mark.timeout(300)
HAND = load_hand("allegro_right")


def test_a_request_keeps_its_id_tells_progress_and_gets_one_full_answer(client, node):
    markers = client.late(MarkerArray, "/graspd/markers")
    turned = Quaternion(z=np.sqrt(0.5), w=np.sqrt(0.5))
    header = Header(frame_id="table", stamp=client.now())
    client.send_request(
        id="mine-1", header=header, object_pose=Pose(position=Point(x=1.0), orientation=turned), **SPHERE, **FEW
    )
    answer = client.answer("mine-1")
    assert (answer.status, answer.error_code, answer.outcome) == (GraspArray.SUCCEEDED, "", "succeeded")
    assert answer.header == header
    assert 0 < answer.elapsed < FEW["time_budget"]
    verified = [grasp for grasp in answer.grasps if grasp.verdict == GraspMessage.VERIFIED]
    assert len(verified) == 2
    best = answer.grasps[0]
    assert (best.id, best.rank, best.hand, best.base_link) == ("mine-1/0", 0, "allegro_right", "base_link")
    assert np.linalg.norm(array_of(best.grasp_pose.position) - [1.0, 0.0, 0.0]) < HAND_LENGTH
    assert np.linalg.norm([best.contacts[0].position.x - 1.0, best.contacts[0].position.y]) < RADIUS + 0.01
    for joints in (best.pregrasp_joints, best.grasp_joints, best.squeeze_joints):
        assert len(joints.name) == len(joints.position) == 16
    assert list(best.trajectory.joint_names) == list(best.grasp_joints.name)
    assert len(best.trajectory.points) == len(best.trajectory_base_poses) == 3
    metrics = {metric.name: metric.value for metric in best.metrics}
    assert metrics["epsilon"] > 0
    assert "robustness" not in metrics, "what was not measured is left out"
    assert (best.probability, answer.next_view.header.frame_id) == (-1.0, ""), "nothing was guessed of a mesh"
    (hold,) = best.trials
    assert (hold.name, hold.passed, hold.reason) == ("hold", True, "")
    assert 0 <= hold.displacement < 0.02
    assert {p.request_id for p in client.progress} == {"mine-1"}
    # Ten reports a second at most, and a stage may take less than that: the first is told always.
    assert "load" in {p.stage for p in client.progress}
    assert all(0 <= p.fraction <= 1 and p.message for p in client.progress)
    elapsed = [p.elapsed for p in client.progress]
    assert elapsed == sorted(elapsed)
    client.spin_until(lambda: markers, "markers")
    assert {marker.header.frame_id for marker in markers[-1].markers} == {"table"}
    client.spin_for(0.3)
    assert len(client.answers) == 1


def test_a_live_id_is_not_taken_twice_and_a_queued_request_can_be_cancelled(client, node):
    client.send_request(id="a", **SPHERE, **LONG)
    client.event(event="progress", request="a")
    client.send_request(id="a", **SPHERE, **LONG)
    again = client.answer("a")
    assert (again.status, again.error_code) == (GraspArray.REFUSED, "DUPLICATE_ID")
    client.forget()
    client.send_request(id="b", **SPHERE, **LONG)
    queued = client.spin_until(lambda: [p for p in client.progress if p.request_id == "b"], "queued")
    assert (queued[0].stage, queued[0].message) == ("queued", "queued: 1 ahead")
    client.send_cancel("b")
    assert client.answer("b").status == GraspArray.CANCELLED
    client.send_cancel("a")
    assert client.answer("a").status == GraspArray.CANCELLED


def test_a_deadline_that_passes_in_the_queue_is_answered_then(client, node):
    client.send_request(id="long", **SPHERE, **LONG)
    client.event(event="progress", request="long")
    client.send_request(id="brief", **SPHERE, time_budget=0.5)
    answer = client.answer("brief")
    assert (answer.status, answer.error_code) == (GraspArray.FAILED, "DEADLINE")
    assert answer.elapsed >= 0.5
    # The other is still at work.
    assert [a.request_id for a in client.answers] == ["brief"]
    client.send_cancel("long")
    assert client.answer("long").status == GraspArray.CANCELLED


def depth_of_ball(client) -> tuple[Image, CameraInfo]:
    """The ball and nothing else, in millimetres."""
    depth = render_depth(make_shape("sphere"), CAMERA, translation_matrix(-BALL))
    header, sizes = Header(frame_id="optical", stamp=client.now()), {"width": CAMERA.width, "height": CAMERA.height}
    image = Image(header=header, encoding="16UC1", step=2 * CAMERA.width, **sizes)
    image.data = array.array("B", (depth * 1000).round().astype("<u2").tobytes())
    k = [CAMERA.fx, 0.0, CAMERA.cx, 0.0, CAMERA.fy, CAMERA.cy, 0.0, 0.0, 1.0]
    return image, CameraInfo(header=header, k=k, distortion_model="plumb_bob", **sizes)


def test_depth_images_become_views_and_views_a_grasp(client, node):
    client.set_parameters(cloud_policy="off")
    images = client.node.create_publisher(Image, "/depth/image_rect", qos_profile_sensor_data)
    infos = client.node.create_publisher(CameraInfo, "/depth/camera_info", qos_profile_sensor_data)
    client.spin_until(lambda: images.get_subscription_count() and infos.get_subscription_count(), "match")
    refused = client.call(Trigger, "add_view")
    assert not refused.success
    assert "no cloud or depth image" in refused.message
    client.set_parameters(cloud_max_age=100.0)
    for views in (1, 2):
        image, info = depth_of_ball(client)
        client.show(lambda: (images.publish(image), infos.publish(info)), image.header)  # noqa: B023
        added = client.call(Trigger, "add_view")
        assert (added.success, added.message) == (True, f"{views} views in 'optical'")
    client.send_request(id="views", source=GraspRequest.VIEWS, **FEW)
    answer = client.answer("views")
    assert answer.status in (GraspArray.SUCCEEDED, GraspArray.PARTIAL), answer.message
    assert answer.header == image.header
    assert np.linalg.norm(array_of(answer.grasps[0].grasp_pose.position) - BALL) < HAND_LENGTH
    assert client.call(Trigger, "reset_views").message == "dropped 2 views"
    client.send_request(id="none", source=GraspRequest.VIEWS)
    assert client.answer("none").error_code == "NO_CLOUD"


def test_hands_are_listed_and_a_reset_leaves_late_joiners_nothing_but_the_last_answer(client, node):
    hands = client.call(ListHands, "list_hands")
    assert hands.current in hands.names
    assert (hands.current, len(hands.joint_names), hands.base_link) == ("allegro_right", 16, "base_link")

    client.send_request(id="refused", source=9)
    client.answer("refused")
    late = client.late(GraspArray, "/graspd/grasps")
    client.spin_until(lambda: late, "the last answer for a late joiner")
    assert late[0].request_id == "refused"
    client.forget()
    client.send_request(id="running", **SPHERE, **LONG)
    client.event(event="progress", request="running")
    assert client.call(Trigger, "reset").message == "cancelled 1 requests, dropped 0 views"
    assert client.answer("running").status == GraspArray.CANCELLED
    answers, markers = client.late(GraspArray, "/graspd/grasps"), client.late(MarkerArray, "/graspd/markers")
    client.spin_until(lambda: answers, "the last answer for a late joiner")
    client.spin_for(1.0)
    assert [answer.request_id for answer in answers] == ["running"]
    assert markers == []


def test_a_grasp_that_is_less_sure_is_told_with_the_next_view_and_not_presented():
    hand = load_hand("parallel_gripper")
    posture = Posture(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(len(hand.joint_names)))
    trials = (TrialResult("hold", True, 0.0, 0.0), TrialResult(ROBUSTNESS, False, 0.0, 0.0, "fails with 3"))
    grasp = Grasp(posture, posture, posture, trials=trials, probability=0.51)
    view, T_table_camera = translation_matrix([0.0, 0.0, 0.5]), translation_matrix([1.0, 0.0, 0.0])
    result = GraspResult(Outcome.TOO_FEW, (grasp,), Timing(), 0, "closed_form", next_view=view)
    assert presentable(result) is None
    ending = ending_of(Planned(moved_result(result, T_table_camera)))
    message = array_message(ending, "mine", Header(frame_id="table"), 1.0, hand, Settings())
    assert message.status == GraspArray.PARTIAL
    (told,) = message.grasps
    assert (told.verdict, told.probability, told.reason) == (GraspMessage.UNVERIFIED, 0.51, "fails with 3")
    assert message.next_view.header.frame_id == "table"
    assert array_of(message.next_view.pose.position) == pytest.approx([1.0, 0.0, 0.5])


def grasp(verdict: Verdict = Verdict.VERIFIED, seed: int = 0) -> Grasp:
    random = np.random.default_rng(seed)
    joints = HAND.lower + random.random(HAND.num_joints) * (HAND.upper - HAND.lower)
    posture = Posture(random.normal(size=3), np.roll(Rotation.random(rng=random).as_quat(), 1), joints)
    contact = Contact("link_3.0", (0.1, 0.2, 0.3), (0.0, 0.0, 1.0))
    metrics = GraspMetrics({"epsilon": 0.1234, "payload": 1.234})
    reason = "the object turned 40°" if verdict is Verdict.FAILED else ""
    trials = () if verdict is Verdict.UNVERIFIED else (TrialResult("hold", not reason, 0.0, 0.7, reason),)
    return Grasp(posture, posture, posture, (contact,), 1.0, metrics, trials)


def markers(*grasps: Grasp, shown: int = 1) -> list[Marker]:
    message = result_markers(grasps, HAND, "camera", Time(sec=7), most=shown)
    serialize_message(message)  # every field is of its type
    return list(message.markers)


def of(found: list[Marker], namespace: str) -> list[Marker]:
    return [marker for marker in found if marker.ns == namespace]


def support(marker: Marker, direction: np.ndarray) -> float:
    """How far a solid reaches along a direction, as RViz draws it [m]."""
    T, half = matrix_of_pose(marker.pose), array_of(marker.scale) / 2
    local = T[:3, :3].T @ direction
    if marker.type == Marker.CUBE:
        reach = np.abs(local) @ half
    elif marker.type == Marker.SPHERE:
        reach = half[0]
    elif marker.type == Marker.CYLINDER:
        reach = half[0] * np.hypot(local[0], local[1]) + half[2] * abs(local[2])
    else:
        corners = np.array([[p.x, p.y, p.z] for p in marker.points])
        reach = (corners @ local).max()
    return float(direction @ T[:3, 3] + reach)


@given(st.integers(0, 1000), st.integers(0, 1000))
def test_the_markers_are_as_large_as_the_hand_and_where_it_is(seed: int, way: int):
    """The hand's own mesh, made elsewhere, reaches as far in any direction, but for its inscribed round faces."""
    found = grasp(seed=seed)
    direction = np.random.default_rng(way).normal(size=3)
    direction /= np.linalg.norm(direction)
    mesh = hand_mesh(HAND, found.grasp.joint_positions)
    turn = Rotation.from_quat(np.roll(found.grasp.quaternion_wxyz, -1))
    vertices = turn.apply(mesh.vertices) + found.grasp.position
    drawn = max(support(marker, direction) for marker in of(markers(found), "hand"))
    assert drawn - 1e-3 < (vertices @ direction).max() <= drawn + 1e-9


def test_every_kind_of_solid_is_drawn():
    solid = HAND.primitives[0]
    corners = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    kinds = (
        dataclasses.replace(solid, kind="box", size=(0.1, 0.2, 0.3)),
        dataclasses.replace(solid, kind="sphere", size=(0.1,)),
        dataclasses.replace(solid, kind="cylinder", size=(0.1, 0.2)),
        dataclasses.replace(solid, kind="capsule", size=(0.1, 0.2)),
        dataclasses.replace(solid, kind="hull", size=(), vertices=corners, faces=faces),
    )
    hand = dataclasses.replace(HAND, primitives=kinds)
    found = of(list(result_markers([grasp()], hand, "camera", Time()).markers), "hand")
    kinds = [m.type for m in found]
    assert kinds == [
        Marker.CUBE, Marker.SPHERE, Marker.CYLINDER, Marker.CYLINDER, Marker.SPHERE, Marker.SPHERE, Marker.TRIANGLE_LIST
    ]  # fmt: skip
    assert (found[0].scale.x, found[0].scale.y, found[0].scale.z) == (0.2, 0.4, 0.6)
    assert (found[2].scale.x, found[2].scale.z) == (0.2, 0.4)
    # The capsule's balls sit at the ends of its cylinder.
    ends = [matrix_of_pose(m.pose)[:3, 3] for m in found[4:6]]
    middle = matrix_of_pose(found[3].pose)
    np.testing.assert_allclose(ends[1] - ends[0], 0.4 * middle[:3, 2], atol=1e-9)
    np.testing.assert_allclose((ends[0] + ends[1]) / 2, middle[:3, 3], atol=1e-9)
    assert len(found[6].points) == 12


def test_an_arrow_ends_where_the_link_touches_and_goes_against_the_normal():
    (arrow,) = of(markers(grasp()), "contacts")
    tail, tip = ([getattr(point, axis) for axis in "xyz"] for point in arrow.points)
    assert arrow.type == Marker.ARROW
    assert tip == [0.1, 0.2, 0.3]
    assert tail == pytest.approx([0.1, 0.2, 0.33])


def test_the_axes_are_those_of_the_base_link_in_red_green_and_blue():
    found = grasp(seed=3)
    turn = Rotation.from_quat(np.roll(found.grasp.quaternion_wxyz, -1)).as_matrix()
    for axis, arrow in enumerate(of(markers(found), "axes")):
        tail, tip = (np.array([getattr(point, name) for name in "xyz"]) for point in arrow.points)
        np.testing.assert_allclose(tail, found.grasp.position)
        np.testing.assert_allclose((tip - tail) / np.linalg.norm(tip - tail), turn[:, axis], atol=1e-9)
        assert [arrow.color.r, arrow.color.g, arrow.color.b] == [float(i == axis) for i in range(3)]


@pytest.mark.parametrize("verdict", list(Verdict))
def test_colour_and_text_tell_the_verdict(verdict: Verdict):
    found = markers(grasp(verdict))
    colours = {(m.color.r, m.color.g, m.color.b) for m in of(found, "hand")}
    assert colours == {COLOURS[verdict]}
    (text,) = of(found, "text")
    assert text.text.startswith(f"#0 {verdict}")
    assert "holds 1.2 kg" in text.text
    assert ("turned 40°" in text.text) == (verdict is Verdict.FAILED)
    assert text.scale.z > 0


def test_what_was_shown_before_goes_first():
    for grasps in ((), (grasp(),)):
        found = markers(*grasps)
        assert found[0].action == Marker.DELETEALL
        assert all(marker.action == Marker.ADD for marker in found[1:])
        assert bool(found[1:]) == bool(grasps)


def test_every_marker_stays_has_a_frame_and_an_id_of_its_own():
    found = markers(grasp(), grasp(seed=1), grasp(seed=2), shown=2)
    names = [(marker.ns, marker.id) for marker in found[1:]]
    assert len(set(names)) == len(names)
    assert {number // IDS_OF_A_GRASP for _, number in names} == {0, 1}
    assert {(m.header.frame_id, m.header.stamp.sec) for m in found} == {("camera", 7)}
    assert all((m.lifetime.sec, m.lifetime.nanosec) == (0, 0) for m in found)
    # Stable: the same grasp is told by the same names again.
    assert names == [(marker.ns, marker.id) for marker in markers(grasp(), grasp(seed=1), shown=2)[1:]]
    # RViz complains of rotations that are none, and of sizes of zero.
    for marker in found[1:]:
        assert matrix_of_pose(marker.pose)[3, 3] == 1
        assert marker.type == Marker.TEXT_VIEW_FACING or min(marker.scale.x, marker.scale.y, marker.scale.z) > 0


def test_the_hand_is_drawn_at_each_stage_with_the_solids_that_are_given():
    whole = hand_mesh(HAND, HAND.open_posture)
    drawn = [Primitive(0, "hull", np.eye(3), np.zeros(3), (), whole.vertices, whole.faces)]
    found = list(result_markers((grasp(),), HAND, "camera", Time(), parts=PARTS, solids=drawn).markers)
    for part in ("hand", "pregrasp", "squeeze"):
        (marker,) = of(found, part)
        assert (marker.type, len(marker.points)) == (Marker.TRIANGLE_LIST, 3 * len(whole.faces))


def test_every_part_can_be_asked_for_and_left_out():
    good, bad = grasp(), grasp(Verdict.FAILED, seed=1)
    every = list(result_markers((good, bad), HAND, "camera", Time(), parts=PARTS).markers)
    assert {marker.ns for marker in every} - {""} == set(PARTS)
    for part in PARTS:
        only = list(result_markers((good, bad), HAND, "camera", Time(), parts=(part,)).markers)
        assert {marker.ns for marker in only} - {""} == {part}
    # Before and after the grasp the hand is faint; who was rejected has a reason and a way.
    assert all(marker.color.a < 0.5 for marker in [*of(every, "pregrasp"), *of(every, "squeeze")])
    arrow, text = of(every, "rejected")
    assert (arrow.type, text.type) == (Marker.ARROW, Marker.TEXT_VIEW_FACING)
    assert "turned 40°" in text.text
    assert len({(marker.ns, marker.id) for marker in every[1:]}) == len(every) - 1


def test_the_ready_display_listens_to_the_markers_and_has_a_switch_for_each_part():
    display = yaml.safe_load((config_dir() / "graspd.rviz").read_text())["Visualization Manager"]["Displays"][-1]
    assert display["Topic"]["Value"] == "/graspd/markers"
    assert set(display["Namespaces"]) == set(PARTS)
