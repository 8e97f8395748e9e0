"""What RViz is shown: the hand where it is, arrows where it touches, colours that tell the verdict."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import yaml
from builtin_interfaces.msg import Time
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import serialize_message
from scipy.spatial.transform import Rotation
from visualization_msgs.msg import Marker

from graspd_core.hands.kinematics import hand_mesh
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import Primitive
from graspd_core.paths import config_dir
from graspd_core.types import Contact, Grasp, GraspMetrics, Posture, TrialResult, Verdict
from graspd_ros.convert import matrix_of_pose
from graspd_ros.outputs.markers import COLOURS, IDS_OF_A_GRASP, PARTS, result_markers

HAND = load_hand("allegro_right")


def grasp(verdict: Verdict = Verdict.VERIFIED, seed: int = 0) -> Grasp:
    random = np.random.default_rng(seed)
    joints = HAND.lower + random.random(HAND.num_joints) * (HAND.upper - HAND.lower)
    posture = Posture(random.normal(size=3), np.roll(Rotation.random(rng=random).as_quat(), 1), joints)
    contact = Contact("link_3.0", (0.1, 0.2, 0.3), (0.0, 0.0, 1.0))
    metrics = GraspMetrics({"epsilon": 0.1234})
    reason = "the object turned 40°" if verdict is Verdict.FAILED else ""
    trials = () if verdict is Verdict.UNVERIFIED else (TrialResult("hold", not reason, 0.0, 0.7, reason),)
    return Grasp(posture, posture, posture, (contact,), 1.0, metrics, trials)


def markers(*grasps: Grasp, shown: int = 1) -> list[Marker]:
    message = result_markers(grasps, HAND, "camera", Time(sec=7), shown=shown)
    serialize_message(message)  # every field is of its type
    return list(message.markers)


def of(found: list[Marker], namespace: str) -> list[Marker]:
    return [marker for marker in found if marker.ns == namespace]


def support(marker: Marker, direction: np.ndarray) -> float:
    """How far a solid reaches along a direction, as RViz draws it [m]."""
    T, half = matrix_of_pose(marker.pose), np.array([marker.scale.x, marker.scale.y, marker.scale.z]) / 2
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
    assert "0.123" in text.text
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
