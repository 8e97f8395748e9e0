"""A grasp as MoveIt's message: every field as MoveIt reads it, and what is refused."""

import math
import sys
from copy import deepcopy
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion
from moveit_msgs.msg import AttachedCollisionObject, CollisionObject
from moveit_msgs.msg import Grasp as MoveItGrasp
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from trimesh.transformations import translation_matrix

from graspd_core import load_hand, make_shape
from graspd_core.errors import ConfigError
from graspd_core.perception.obstacles import held_hull
from graspd_core.types import Grasp, GraspMetrics, Posture, TrialResult, Verdict
from graspd_ros.convert import matrix_of_pose, pose_of_matrix
from graspd_ros.inputs.solids import updated_objects
from graspd_ros.outputs.messages import grasp_message
from graspd_ros.outputs.moveit import MoveItMissing, attached_object, moveit_grasp
from graspd_ros.parameters import Settings

HAND = load_hand("allegro_right")


def made(verdict: Verdict = Verdict.VERIFIED) -> Grasp:
    turned = np.array([math.cos(0.3), 0.0, math.sin(0.3), 0.0])
    far = Posture(np.array([0.0, 0.0, 0.30]), turned, HAND.open_posture)
    near = Posture(np.array([0.0, 0.0, 0.22]), turned, (HAND.open_posture + HAND.closed_posture) / 2)
    tight = Posture(np.array([0.0, 0.0, 0.22]), turned, HAND.closed_posture)
    metrics = GraspMetrics({"penetration": 1e-3, "epsilon": 0.25})
    trial = TrialResult("hold", verdict is Verdict.VERIFIED, 0.0, 0.0, "lost the object")
    return Grasp(far, near, tight, (), 1.0, metrics, (trial,))


def message(verdict: Verdict = Verdict.VERIFIED) -> Any:
    return grasp_message(made(verdict), 0, "mesh-1", Header(frame_id="camera", stamp=Time(sec=3)), HAND, Settings())


UP = {"retreat": (0.0, 0.0, 2.0), "retreat_frame": "world"}


def test_every_field_is_filled_as_moveit_reads_it():
    ours = message()
    theirs = moveit_grasp(ours, **UP, retreat_distance=0.2)
    assert isinstance(theirs, MoveItGrasp)
    assert theirs.id == ours.id == "mesh-1/0"
    assert theirs.grasp_quality == 0.25
    assert theirs.grasp_pose.header.frame_id == "camera"
    assert theirs.grasp_pose.pose.position.z == pytest.approx(0.22)
    assert theirs.grasp_pose.pose.orientation.y == pytest.approx(math.sin(0.3))
    # Open first; then the closing, its clock starting where the opening ended.
    opening: Any = theirs.pre_grasp_posture
    closing: Any = theirs.grasp_posture
    assert list(opening.points[0].positions) == list(ours.trajectory.points[0].positions)
    assert [list(p.positions) for p in closing.points] == [list(p.positions) for p in ours.trajectory.points[1:]]
    assert list(opening.joint_names) == list(closing.joint_names) == list(ours.trajectory.joint_names)
    starts = [p.time_from_start.sec + p.time_from_start.nanosec * 1e-9 for p in ours.trajectory.points]
    times = [p.time_from_start.sec + p.time_from_start.nanosec * 1e-9 for p in closing.points]
    np.testing.assert_allclose(times, np.array(starts[1:]) - starts[0], atol=1e-8)
    approach = theirs.pre_grasp_approach
    assert approach.direction.header.frame_id == "camera"
    assert approach.direction.vector.z == pytest.approx(-1.0)
    assert approach.desired_distance == pytest.approx(0.08)
    assert 0 < approach.min_distance < approach.desired_distance
    retreat = theirs.post_grasp_retreat
    assert (retreat.direction.header.frame_id, retreat.direction.vector.z) == ("world", 1.0)
    assert retreat.desired_distance == pytest.approx(0.2)
    assert ours == message(), "what it is made from stays as it is"


def test_what_is_held_hangs_on_the_base_link_with_its_weight(monkeypatch: pytest.MonkeyPatch):
    # A box whose corner is 1 cm from the origin, and a hand that looks at it along a turned axis.
    box = make_shape("box")
    grasp, ours = made(), message()
    theirs = attached_object(ours, held_hull(box, grasp.grasp), HAND, 0.25)
    assert isinstance(theirs, AttachedCollisionObject)
    assert (theirs.link_name, theirs.object.header.frame_id, theirs.object.id) == (
        HAND.base_link,
        HAND.base_link,
        "mesh-1",
    )
    assert (theirs.weight, theirs.object.operation) == (0.25, CollisionObject.ADD)
    assert list(theirs.touch_links) == list(HAND.link_names)
    assert list(next(iter(theirs.detach_posture.points)).positions) == list(
        next(iter(ours.trajectory.points)).positions
    )
    # With the hand at the grasp it is where the box is. A planning scene reads it back.
    T = matrix_of_pose(ours.grasp_pose)
    (held,) = updated_objects({}, theirs.object).values()
    placed = held.shapes[0].vertices @ held.T_frame_object[:3, :3].T + held.T_frame_object[:3, 3]
    corners = placed @ T[:3, :3].T + T[:3, 3]
    for end in (np.min, np.max):
        np.testing.assert_allclose(end(corners, 0), end(box.vertices, 0), atol=1e-9)
    monkeypatch.setitem(sys.modules, "moveit_msgs.msg", ModuleType("old"))
    with pytest.raises(MoveItMissing, match="AttachedCollisionObject is not installed"):
        attached_object(ours, held_hull(box, grasp.grasp), HAND)


def test_the_pose_is_that_of_the_arms_last_link():
    # The hand is mounted 5 cm along the wrist's z, turned a quarter about it.
    wrist_base = matrix_of_pose(
        Pose(position=Point(z=0.05), orientation=Quaternion(z=math.sqrt(0.5), w=math.sqrt(0.5)))
    )
    theirs = moveit_grasp(message(), **UP, T_parent_base=wrist_base)
    back = pose_of_matrix(matrix_of_pose(theirs.grasp_pose.pose) @ wrist_base)
    np.testing.assert_allclose(matrix_of_pose(back), matrix_of_pose(message().grasp_pose), atol=1e-12)


def test_a_hand_that_closes_late_waits_where_the_grasp_says():
    ours = message()
    joints = np.linspace(HAND.lower, HAND.upper, 3)[1]
    ours.arrival_pose, ours.mount_link = deepcopy(ours.grasp_pose), "tool0"
    ours.arrival_pose.position.z = 0.221
    ours.mount_grasp_pose = pose_of_matrix(matrix_of_pose(ours.grasp_pose) @ translation_matrix([0.0, 0.0, -0.1]))
    # All movable joints, in whatever order: those of the trajectory are picked by name.
    ours.arrival_joints = JointState(name=list(HAND.joint_names)[::-1], position=joints[::-1].tolist())
    theirs: Any = moveit_grasp(ours, **UP, touch=("can",))
    np.testing.assert_allclose(theirs.pre_grasp_posture.points[0].positions, joints)
    assert list(theirs.grasp_posture.points[-1].positions) == list(ours.trajectory.points[-1].positions)
    waits = matrix_of_pose(ours.arrival_pose) @ translation_matrix([0.0, 0.0, -0.1])
    np.testing.assert_allclose(matrix_of_pose(theirs.grasp_pose.pose), waits, atol=1e-12)
    assert theirs.pre_grasp_approach.desired_distance == pytest.approx(0.079)
    assert list(theirs.allowed_touch_objects) == ["can"]


def test_the_pose_of_a_mounted_hand_is_that_of_the_link_that_carries_it():
    ours = message()
    ours.mount_link, ours.mount_grasp_pose = "tool0", Pose(position=Point(z=0.4))
    pose = moveit_grasp(ours, **UP).grasp_pose.pose
    np.testing.assert_allclose(matrix_of_pose(pose), matrix_of_pose(ours.mount_grasp_pose), atol=1e-12)
    # What is said here counts for more.
    theirs = moveit_grasp(ours, **UP, T_parent_base=np.eye(4))
    np.testing.assert_allclose(matrix_of_pose(theirs.grasp_pose.pose), matrix_of_pose(ours.grasp_pose), atol=1e-12)


def test_a_failed_grasp_is_not_handed_on():
    with pytest.raises(ConfigError, match=r"mesh-1/0.*lost the object"):
        moveit_grasp(message(Verdict.FAILED), **UP)


def test_a_retreat_needs_a_direction():
    with pytest.raises(ConfigError, match="retreat"):
        moveit_grasp(message(), retreat=(0.0, 0.0, 0.0), retreat_frame="world")


def test_without_moveit_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "moveit_msgs.msg", None)
    with pytest.raises(MoveItMissing, match="ros-jazzy-moveit-msgs"):
        moveit_grasp(message(), **UP)
