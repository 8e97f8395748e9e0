"""Matrices of messages, results in another frame, /tf over DDS, and where the arm stands that carries the hand."""

import math
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion, Transform, TransformStamped, Vector3
from hypothesis import given
from hypothesis import strategies as st
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from scipy.spatial.transform import Rotation
from tf2_msgs.msg import TFMessage

from graspd_core import load_hand, load_scene
from graspd_core.arms.arm import arm_links, tip_hand
from graspd_core.errors import TransformError
from graspd_core.transforms import SECOND, TransformBuffer
from graspd_core.types import Contact, Grasp, GraspResult, Outcome, Plane, Posture, Timing
from graspd_ros import convert
from graspd_ros.convert import matrix_of_posture
from graspd_ros.inputs import tf_listener
from graspd_ros.inputs.tf_listener import reach_of
from graspd_ros.parameters import Settings
from graspd_ros.request import Request
from graspd_ros.request_planner import Planner

SETTINGS = Settings(num_grasps=1, preset="fast", deadline=100.0, verify="none", arm="panda_like")


def pose(xyz: tuple[float, float, float], rotation: Rotation) -> Pose:
    x, y, z, w = rotation.as_quat()
    return Pose(position=Point(x=xyz[0], y=xyz[1], z=xyz[2]), orientation=Quaternion(x=x, y=y, z=z, w=w))


def matrix(xyz: tuple[float, float, float], rotation: Rotation) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), xyz
    return T


PLACES = st.tuples(*[st.floats(-5.0, 5.0)] * 3)
# Seeds alone are drawn: while SciPy makes the first rotation, other threads may use `random`, which Hypothesis refuses.
TURNS = st.integers(0, 2**32 - 1)


def turned(seed: int) -> Rotation:
    return Rotation.random(rng=np.random.default_rng(seed))


@given(PLACES, TURNS)
def test_poses_and_matrices_are_inverse_to_each_other(xyz, seed):
    rotation = turned(seed)
    T = convert.matrix_of_pose(pose(xyz, rotation))
    np.testing.assert_allclose(T, matrix(xyz, rotation), atol=1e-12)
    np.testing.assert_allclose(convert.matrix_of_pose(convert.pose_of_matrix(T)), T, atol=1e-12)
    q = pose(xyz, rotation).orientation
    transform = Transform(translation=Vector3(x=xyz[0], y=xyz[1], z=xyz[2]), rotation=q)
    np.testing.assert_array_equal(convert.matrix_of_transform(transform), T)


def test_a_rounded_quaternion_is_made_unit_and_a_wrong_one_refused():
    rounded = convert.matrix_of_pose(Pose(orientation=Quaternion(z=0.7, w=0.7)))
    np.testing.assert_allclose(rounded[:3, :3] @ rounded[:3, :3].T, np.eye(3), atol=1e-12)
    for wrong in (Quaternion(w=0.0), Quaternion(w=2.0), Quaternion(w=math.nan), Quaternion(w=math.inf)):
        with pytest.raises(TransformError, match="length"):
            convert.matrix_of_pose(Pose(orientation=wrong))
    with pytest.raises(TransformError, match="position"):
        convert.matrix_of_pose(Pose(position=Point(x=math.nan)))


@given(PLACES, TURNS, PLACES, TURNS)
def test_a_moved_result_is_the_same_grasp_seen_from_elsewhere(where, how, base, turn):
    how, turn = turned(how), turned(turn)
    T = matrix(where, how)
    wxyz = np.roll(turn.as_quat(), 1)
    posture = Posture(np.array(base), wxyz, np.array([0.1, 0.2]))
    normal = np.array([0.0, 0.0, 1.0])
    grasp = Grasp(posture, posture, posture, (Contact("tip", base, (1.0, 0.0, 0.0)),), score=2.0)
    result = GraspResult(Outcome.SUCCEEDED, (grasp,), Timing(), 0, "closed_form", support=Plane(normal, 0.3))
    moved = convert.moved_result(result, T)
    found = moved.grasps[0]
    for new in (found.pregrasp, found.grasp, found.squeeze):
        seen = matrix(tuple(new.position), Rotation.from_quat(np.roll(new.quaternion_wxyz, -1)))
        np.testing.assert_allclose(seen, T @ matrix(base, turn), atol=1e-9)
        np.testing.assert_array_equal(new.joint_positions, posture.joint_positions)
    contact = found.contacts[0]
    np.testing.assert_allclose(contact.position, T[:3, :3] @ base + T[:3, 3], atol=1e-9)
    np.testing.assert_allclose(contact.normal, T[:3, 0], atol=1e-9)
    # A point that was on the support still is.
    assert moved.support is not None
    on_it = T[:3, :3] @ np.array([1.0, -2.0, 0.3]) + T[:3, 3]
    assert moved.support.normal @ on_it == pytest.approx(moved.support.offset, abs=1e-9)
    assert (found.score, moved.outcome) == (2.0, Outcome.SUCCEEDED)


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch, domain: int, make_node) -> Node:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    return make_node(domain=domain)


def test_without_tf2_msgs_the_node_says_so_once_and_goes_on(node, monkeypatch, capfd):
    monkeypatch.setitem(sys.modules, "tf2_msgs.msg", None)
    before = len(list(node.subscriptions))
    listener = tf_listener.TransformListener(node, TransformBuffer())
    assert not listener.available
    assert len(list(node.subscriptions)) == before
    assert "".join(capfd.readouterr()).count("tf2_msgs is not installed") == 1


def test_a_transform_that_comes_late_is_waited_for(node: Node, monkeypatch: pytest.MonkeyPatch):
    buffer, asked, stamp = TransformBuffer(), [], Time(nanosec=5)
    listener = tf_listener.TransformListener(node, buffer)
    buffer.add("world", "base", np.eye(4), 5, static=True)
    with pytest.raises(TransformError, match=r"'camera'.*base, world"):
        listener.lookup_in_time("world", "camera", Time(), lambda: True)

    def stop() -> bool:
        asked.append(1)
        if len(asked) == 3:  # as the executor's thread would, between two looks
            buffer.add("world", "camera", matrix((1.0, 0.0, 0.0), Rotation.identity()), 5, static=True)
        return False

    assert listener.lookup_in_time("world", "camera", stamp, stop)[0, 3] == 1.0
    assert len(asked) == 3
    begun = time.monotonic()
    monkeypatch.setattr(tf_listener, "TRANSFORM_PATIENCE", 0.1)
    with pytest.raises(TransformError, match="'hand'"):
        listener.lookup_in_time("world", "hand", stamp, lambda: False)
    assert time.monotonic() - begun >= 0.1


def spin_until(node: Node, condition: Callable[[], bool]) -> None:
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    while not condition():
        executor.spin_once(timeout_sec=0.05)
    executor.shutdown()


def test_a_transform_that_is_wrong_is_left_out_of_its_message(node: Node, capfd):
    """Transforms of another process: test_scenarios.py (played from a bag) and test_planning_scene.py (static)."""
    buffer, wrong, right = TransformBuffer(), TransformStamped(child_frame_id="broken"), TransformStamped()
    listener, publisher = tf_listener.TransformListener(node, buffer), node.create_publisher(TFMessage, "/tf", 10)
    wrong.transform.rotation.w, right.child_frame_id = 3.0, "right"
    wrong.header.frame_id = right.header.frame_id = "world"

    def heard() -> bool:
        publisher.publish(TFMessage(transforms=[wrong, right]))
        return "right" in buffer.frames()

    assert listener.available
    spin_until(node, heard)
    assert "broken" not in buffer.frames()
    assert "quaternion x y z w [0.0, 0.0, 0.0, 3.0]: its length is 3; valid: 1" in "".join(capfd.readouterr())


def test_when_time_jumps_back_everything_is_forgotten(node: Node):
    from rosgraph_msgs.msg import Clock

    node.set_parameters([Parameter("use_sim_time", value=True)])
    buffer = TransformBuffer()
    listener = tf_listener.TransformListener(node, buffer)
    clock = node.create_publisher(Clock, "/clock", 10)
    spin_until(node, lambda: clock.get_subscription_count() > 0)

    def set_time(second: int) -> None:
        message = Clock()
        message.clock.sec = second
        clock.publish(message)
        spin_until(node, lambda: node.get_clock().now().nanoseconds == second * SECOND)

    set_time(100)
    set_time(101)
    buffer.add("world", "camera", np.eye(4), 101 * SECOND)
    set_time(102)
    assert buffer.frames() == ("camera", "world")
    set_time(50)
    assert listener.available
    assert buffer.frames() == ()


def request(settings: Settings, pose: np.ndarray | None = None) -> Request:
    return Request("r", "mesh", "map", Time(), settings, lambda: load_scene("shape:box"), T_frame_object=pose)


def at(x: float, y: float, z: float) -> np.ndarray:
    """A pose turned by a quarter about z."""
    return matrix((x, y, z), Rotation.from_euler("z", 90, degrees=True))


def test_the_base_is_placed_in_the_frame_of_the_object():
    asked: list[tuple[str, str]] = []

    def lookup(target: str, source: str) -> np.ndarray:
        asked.append((target, source))
        return at(-0.5, 0.0, 0.1)

    seen = reach_of(request(SETTINGS), lookup)
    assert asked == [("map", "base_link")]
    assert seen.position == pytest.approx((-0.5, 0.0, 0.1))
    assert seen.quaternion_wxyz == pytest.approx((np.sqrt(0.5), 0, 0, np.sqrt(0.5)))
    placed = reach_of(request(replace(SETTINGS, arm_base_frame="robot"), at(1.0, 2.0, 0.0)), lookup)
    assert asked[-1] == ("map", "robot")
    assert placed.position == pytest.approx((-2.0, 1.5, 0.1))
    assert abs(placed.quaternion_wxyz[0]) == pytest.approx(1.0)
    assert placed.arm is seen.arm, "what is known of an arm is kept"
    own = reach_of(request(replace(SETTINGS, arm_base_frame="map")), lookup)
    assert (len(asked), own.position) == (2, (0.0, 0.0, 0.0))


def test_a_planned_grasp_has_the_arm_s_joints_in_every_frame():
    """The object stands in `map`, the result is told in `out`: the arm's tip is where the grasp's pose says."""
    base, object_pose, T_out_map = at(0.5, 2.0, -0.1), at(1.0, 2.0, 0.0), at(3.0, 0.0, 0.0)

    def lookup(target: str, source: str, stamp: Time, stop: object) -> np.ndarray:
        return {("map", "base_link"): base, ("out", "map"): T_out_map}[target, source]

    hand = load_hand("barrett_like")
    settings = replace(SETTINGS, hand="barrett_like", output_frame="out")
    planned = Planner(hand, lookup).plan(request(settings, object_pose), lambda: False, lambda _: None)
    reach = reach_of(request(settings, object_pose), lambda target, source: base)
    for grasp in planned.result.grasps:
        assert grasp.arm is not None
        links = arm_links(reach.arm, torch.as_tensor(grasp.arm.at("grasp"))[None])
        carried = links[0, reach.arm.tip].compose(tip_hand(reach.arm, hand))
        world = T_out_map @ base
        told = matrix_of_posture(grasp.grasp)
        assert np.allclose(world[:3, :3] @ carried.translation.numpy() + world[:3, 3], told[:3, 3], atol=5e-4)
        assert np.allclose(world[:3, :3] @ carried.rotation.numpy(), told[:3, :3], atol=5e-3)


def test_a_base_that_tf_does_not_know_is_named_before_any_work():
    def lookup(target: str, source: str, stamp: Time, stop: object) -> np.ndarray:
        raise TransformError(f"{source} -> {target}: not connected")

    asked = replace(request(SETTINGS), load=lambda: pytest.fail("the object was read"))
    with pytest.raises(TransformError, match="base_link -> map"):
        Planner(load_hand("barrett_like"), lookup).plan(asked, lambda: False, lambda _: None)
