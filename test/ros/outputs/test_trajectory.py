"""A grasp as a trajectory: in limits, in step, never too fast, and good enough to hold an object when played."""

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

import dataclasses
import math

import mujoco
import numpy as np
import pytest
from builtin_interfaces.msg import Time
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory

from graspd_core import ArmPath, Grasp, Posture, load_hand, load_scene, plan_grasps
from graspd_core.arms.arm_paths import STAGE_ROWS
from graspd_core.hands.model import HandModel, Mount
from graspd_core.perception.scene import object_parts
from graspd_core.verify.world import PROTOCOLS, build_world
from graspd_ros.convert import matrix_of, matrix_of_pose
from graspd_ros.outputs.messages import arm_trajectory, base_poses, grasp_message, posture_times, trajectory_of
from graspd_ros.parameters import Settings

HAND = load_hand("allegro_right")
SHARES = st.lists(st.floats(0.0, 1.0), min_size=HAND.num_joints, max_size=HAND.num_joints)


def posture(share: list[float], position: tuple[float, ...] = (0.0, 0.0, 0.0), turn: float = 0.0) -> Posture:
    """Joints at a share of their range, the base turned about z."""
    joints = HAND.lower + np.array(share) * (HAND.upper - HAND.lower)
    return Posture(np.array(position), np.array([math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)]), joints)


def grasp(*postures: Posture) -> Grasp:
    return Grasp(*postures, contacts=(), score=0.0)


def seconds(trajectory: JointTrajectory) -> list[float]:
    return [p.time_from_start.sec + p.time_from_start.nanosec * 1e-9 for p in trajectory.points]


def positions(trajectory: JointTrajectory) -> np.ndarray:
    return np.array([p.positions for p in trajectory.points])


def spline(trajectory: JointTrajectory) -> CubicHermiteSpline:
    """What ros2_control makes of points with positions and velocities."""
    return CubicHermiteSpline(seconds(trajectory), positions(trajectory), [p.velocities for p in trajectory.points])


@given(SHARES, SHARES, SHARES, st.floats(0.0, 0.3), st.floats(0.0, math.pi), st.floats(0.2, 20.0), st.floats(0.01, 5.0))
def test_no_speed_is_exceeded_whatever_the_postures(first, second, third, travel, turn, joint_speed, shortest):
    pace = Settings(joint_speed=joint_speed, shortest_stage=shortest)
    found = grasp(posture(first), posture(second, (travel, 0.0, 0.0), turn), posture(third, (travel, 0.0, 0.0), turn))
    trajectory = trajectory_of(found, HAND, pace)
    times = seconds(trajectory)
    assert times[0] >= shortest
    assert np.diff(times).min() >= shortest - 2e-9
    path = spline(trajectory)
    moments = np.linspace(times[0], times[-1], 400)
    assert (np.abs(path(moments, 1)) <= np.minimum(joint_speed, HAND.velocity) * (1 + 1e-6)).all()
    # The base goes the same way in the same rhythm.
    assert 1.5 * travel / (times[1] - times[0]) <= pace.base_speed * (1 + 1e-6)
    assert 1.5 * turn / (times[1] - times[0]) <= pace.base_turn * (1 + 1e-6)


@given(SHARES, SHARES, SHARES)
def test_joints_stay_within_their_limits_and_in_step(first, second, third):
    trajectory = trajectory_of(grasp(posture(first), posture(second), posture(third)), HAND, Settings())
    times, path = seconds(trajectory), spline(trajectory)
    for start, end, a, b in zip(times, times[1:], positions(trajectory), positions(trajectory)[1:], strict=False):
        way = path(np.linspace(start, end, 50))
        assert (way >= HAND.lower - 1e-9).all()
        assert (way <= HAND.upper + 1e-9).all()
        # In step: every joint has done the same share of its way at the same time.
        share = np.linspace(0, 1, 50) ** 2 * (3 - 2 * np.linspace(0, 1, 50))
        np.testing.assert_allclose(way, a + share[:, None] * (b - a), atol=1e-6)


def test_the_first_point_leaves_time_to_come_from_anywhere():
    still = posture([0.5] * HAND.num_joints)
    first = posture_times(grasp(still, still, still), HAND, Settings(joint_speed=0.5))[0]
    assert first == pytest.approx(1.5 * (HAND.upper - HAND.lower).max() / 0.5)


def test_a_negated_quaternion_is_no_turn():
    here = posture([0.5] * HAND.num_joints)
    negated = dataclasses.replace(here, quaternion_wxyz=-here.quaternion_wxyz)
    times = posture_times(grasp(here, negated, here), HAND, Settings())
    np.testing.assert_allclose(np.diff(times), Settings().shortest_stage)


def test_a_sliding_joint_keeps_the_speed_of_the_base():
    sliding = dataclasses.replace(
        HAND, joint_kind=tuple("prismatic" if kind == "revolute" else kind for kind in HAND.joint_kind)
    )
    here, there = posture([0.0] * HAND.num_joints), posture([1.0] * HAND.num_joints)
    slow = np.diff(posture_times(grasp(here, there, there), sliding, Settings()))[0]
    assert slow == pytest.approx(1.5 * (HAND.upper - HAND.lower).max() / Settings().base_speed)


def test_rounding_beyond_a_limit_is_cut_off():
    above = dataclasses.replace(posture([1.0] * HAND.num_joints), joint_positions=HAND.upper + 1e-12)
    assert (positions(trajectory_of(grasp(above, above, above), HAND, Settings())) <= HAND.upper).all()


def test_the_message_names_joints_and_starts_on_receipt():
    here = posture([0.5] * HAND.num_joints, (0.1, 0.2, 0.3), 1.0)
    trajectory = trajectory_of(grasp(here, here, here), HAND, Settings())
    assert tuple(trajectory.joint_names) == HAND.joint_names
    assert trajectory.header.frame_id == HAND.base_link
    assert (trajectory.header.stamp.sec, trajectory.header.stamp.nanosec) == (0, 0)
    assert all(list(p.velocities) == [0.0] * HAND.num_joints for p in trajectory.points)
    poses = base_poses(grasp(here, here, here), "camera", Time(sec=7))
    assert len(poses) == len(trajectory.points) == 3
    assert {(p.header.frame_id, p.header.stamp.sec) for p in poses} == {("camera", 7)}
    assert poses[1].pose.position.z == 0.3
    assert poses[1].pose.orientation.z == pytest.approx(math.sin(0.5))


# The flange's z is the hand's, 3 cm before the mount; an eighth of a turn about it.
MOUNT = Mount("tool0", (0.0, 0.0, 0.03), (float(np.cos(np.pi / 8)), 0.0, 0.0, float(np.sin(np.pi / 8))))


@pytest.fixture(scope="module")
def mounted() -> HandModel:
    return dataclasses.replace(load_hand("barrett_like", candidates=8), mount=MOUNT)


def spread(mounted: HandModel, share: float, height: float) -> Posture:
    joints = mounted.lower + share * (mounted.upper - mounted.lower)
    return Posture(np.array([0.1, -0.2, height]), np.array([0.5, 0.5, -0.5, 0.5]), joints)


@pytest.fixture(scope="module")
def carried(mounted: HandModel) -> Grasp:
    return Grasp(spread(mounted, 0.2, 0.3), spread(mounted, 0.4, 0.25), spread(mounted, 0.5, 0.25), (), 1.0)


def test_the_arms_link_is_where_the_mount_puts_it(mounted: HandModel, carried: Grasp) -> None:
    message = grasp_message(carried, 0, "r", Header(frame_id="camera"), mounted, Settings())
    assert message.mount_link == "tool0"
    for base, parent in (
        (message.pregrasp_pose, message.mount_pregrasp_pose),
        (message.grasp_pose, message.mount_grasp_pose),
    ):
        # T_frame_parent · T_parent_base is the base link's pose again.
        again = matrix_of_pose(parent) @ matrix_of(MOUNT.position, MOUNT.quaternion_wxyz)
        np.testing.assert_allclose(again, matrix_of_pose(base), atol=1e-12)
    # By mounted: the base's z is turned by the quaternion (0.5, 0.5, -0.5, 0.5) onto -y; 3 cm back along it.
    z = matrix_of_pose(message.grasp_pose)[:3, 2]
    at = message.mount_grasp_pose.position
    np.testing.assert_allclose([at.x, at.y, at.z], np.array([0.1, -0.2, 0.25]) - 0.03 * z, atol=1e-12)
    floating = dataclasses.replace(mounted, mount=None)
    assert grasp_message(carried, 0, "r", Header(frame_id="camera"), floating, Settings()).mount_link == ""


def test_all_movable_joints_are_in_every_message(mounted: HandModel, carried: Grasp) -> None:
    message = grasp_message(carried, 0, "r", Header(frame_id="camera", stamp=Time()), mounted, Settings())
    names = [f"f{finger}_{joint}" for finger in (1, 2, 3) for joint in ("spread", "proximal", "distal")]
    names.remove("f3_spread")
    for joints in (message.pregrasp_joints, message.grasp_joints, message.squeeze_joints):
        assert (list(joints.name), joints.header.frame_id) == (names, mounted.base_link)
        assert (len(joints.position), list(joints.velocity), list(joints.effort)) == (len(names), [], [])
    # Controllers refuse joints that have no command of their own.
    assert list(message.trajectory.joint_names) == list(mounted.joint_names)
    assert set(mounted.joint_names) < set(names)
    value = dict(zip(names, message.squeeze_joints.position, strict=True))
    assert value["f2_spread"] == pytest.approx(-value["f1_spread"])
    assert value["f3_distal"] == pytest.approx(value["f3_proximal"] / 3)
    for point, at in zip(message.trajectory.points, (carried.pregrasp, carried.grasp, carried.squeeze), strict=True):
        np.testing.assert_allclose(point.positions, at.joint_positions)
        assert len(point.velocities) == mounted.num_joints


def test_a_follower_is_no_faster_than_its_kind_may_be(mounted: HandModel, carried: Grasp) -> None:
    """A joint that follows three times as fast makes its leader three times as slow."""
    quick = dataclasses.replace(
        mounted,
        mimics=tuple(dataclasses.replace(m, multiplier=3.0) for m in mounted.mimics),
        velocity=np.full(4, np.inf),
    )
    pace = Settings(joint_speed=0.1, shortest_stage=0.01)
    travel = carried.grasp.joint_positions - carried.pregrasp.joint_positions
    first, closed, _ = posture_times(carried, quick, pace)
    assert closed - first == pytest.approx(1.5 * 3 * np.abs(travel).max() / 0.1)


NAMES = ("shoulder", "elbow")


def grasp_with(step: float) -> Grasp:
    """A grasp 4 cm from its pregrasp, whose arm moves one joint by `step` [rad] between waypoints."""
    hand = load_hand("barrett_like", candidates=50)
    turn = np.array([1.0, 0.0, 0.0, 0.0])
    before, there = (Posture(np.array([0.0, 0.0, z]), turn, hand.open_posture) for z in (0.24, 0.2))
    positions = np.column_stack([step * np.arange(STAGE_ROWS[-1] + 1), np.zeros(STAGE_ROWS[-1] + 1)])
    return Grasp(before, there, there, arm=ArmPath(NAMES, positions, STAGE_ROWS))


@pytest.mark.parametrize("step", [0.0, 0.02, 0.2])
def test_no_joint_and_no_hand_is_faster_than_asked(step: float):
    grasp, pace = grasp_with(step), Settings(joint_speed=0.5, base_speed=0.1, shortest_stage=0.2)
    assert grasp.arm is not None
    trajectory = arm_trajectory(grasp, grasp.arm, pace)
    assert list(trajectory.joint_names) == list(NAMES)
    assert np.allclose([point.positions for point in trajectory.points], grasp.arm.positions)
    times = np.array(seconds(trajectory))
    assert times[0] == pytest.approx(pace.shortest_stage)
    assert step / np.diff(times).min() <= 0.5
    stages = np.diff(times[list(STAGE_ROWS)])
    assert (stages >= np.maximum(0.2, np.array([0.1, 0.04, 0.1]) / 0.1) - 1e-6).all()


LIMITS = np.array([0.3, np.inf])


@pytest.mark.parametrize(
    ("about", "base_speed"), [({"velocity": LIMITS}, 9.0), ({"slides": np.array([True, False])}, LIMITS[0])]
)
def test_no_joint_of_the_arm_is_faster_than_the_arm_allows_or_slides_faster_than_the_base(about, base_speed):
    found, limits, hand = grasp_with(0.2), LIMITS, load_hand("barrett_like", candidates=50)
    assert found.arm is not None
    found = dataclasses.replace(found, arm=dataclasses.replace(found.arm, **about))
    pace = Settings(joint_speed=50.0, base_speed=base_speed, shortest_stage=0.01)
    told = grasp_message(found, 0, "id", Header(), hand, pace)
    for sent in (told.arm_trajectory, told.execution.arm):
        speeds = np.diff(positions(sent), axis=0) / np.diff(seconds(sent))[:, None]
        assert (np.abs(speeds) <= limits * (1 + 1e-6)).all()
    # The execution looks at its speeds in 200 moments of a stage.
    assert (np.abs([point.velocities for point in told.execution.arm.points]) <= 1.01 * limits).all()


def test_the_message_of_a_grasp_has_it_only_where_there_is_an_arm():
    hand, grasp = load_hand("barrett_like", candidates=50), grasp_with(0.02)
    told = grasp_message(grasp, 0, "id", Header(frame_id="world"), hand, Settings())
    assert list(told.arm_stages) == list(STAGE_ROWS)
    assert len(told.arm_trajectory.points) == STAGE_ROWS[-1] + 1
    made = told.execution
    assert list(made.gates) == ["pregrasp", "closed", "squeezed", "lifted"]
    assert made.gate_points[-1] == len(made.arm.points) - 1 == len(made.hand.points) - 1
    assert list(made.hand.joint_names) == list(hand.joint_names)
    assert seconds(made.arm) == seconds(made.hand)
    assert made.mass == -1.0
    assert grasp_message(grasp, 0, "id", Header(), hand, Settings(), mass=0.3).execution.mass == 0.3
    bare = grasp_message(Grasp(grasp.pregrasp, grasp.grasp, grasp.squeeze), 0, "id", Header(), hand, Settings())
    assert list(bare.arm_stages) == []
    assert bare.arm_trajectory.points == []
    assert bare.execution.gates == []


def play(found: Grasp, hand: HandModel, scene) -> float:
    """Execute the messages in MuJoCo as a controller would, then hang the object on the hand; its travel in 2 s [m]."""
    protocol = PROTOCOLS["standard"]
    world = build_world(hand, scene.object, object_parts(scene.object), protocol)
    data = mujoco.MjData(world.model)
    trajectory, poses = trajectory_of(found, hand, Settings()), base_poses(found, "object", Time())
    times, path = seconds(trajectory), spline(trajectory)
    places = np.array([[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in poses])
    turns = Rotation.from_quat([[getattr(p.pose.orientation, axis) for axis in "xyzw"] for p in poses])
    slerp = Slerp(range(3), turns)
    # The base keeps the rhythm of the joints: 0 at the first point, 1 at the second, 2 at the third.
    phase = CubicHermiteSpline(times, range(3), np.zeros(3))

    def command(at: float) -> None:
        done = min(float(phase(at)), 2.0)
        data.ctrl[:] = path(at)
        data.mocap_pos[0] = [np.interp(done, range(3), column) for column in places.T]
        data.mocap_quat[0] = np.roll(slerp(done).as_quat(), 1)

    command(times[0])
    data.qpos[world.joint_addresses] = path(times[0])
    for at in np.linspace(times[0], times[-1], round((times[-1] - times[0]) / protocol.timestep)):
        command(at)
        mujoco.mj_step(world.model, data)
    weight = 9.81 * world.model.body_mass[world.object_body]
    data.xfrc_applied[world.object_body, :3] = [0.0, 0.0, -weight]
    mujoco.mj_step(world.model, data, round(2.0 / protocol.timestep))
    return float(np.linalg.norm(data.xipos[world.object_body] - world.center_of_mass))


def test_the_messages_alone_make_a_hand_hold_an_object():
    scene = load_scene("shape:cylinder")
    result = plan_grasps(scene, HAND, count=1, preset="fast", seed=0)
    assert result.grasps[0].verdict == "verified"
    travel = play(result.grasps[0], HAND, scene)
    assert travel < PROTOCOLS["standard"].max_displacement
    # And the test can fail: a hand that closes half a metre above the object holds nothing.
    above = {
        name: dataclasses.replace(posture, position=posture.position + np.array([0.0, 0.0, 0.5]))
        for name, posture in vars(result.grasps[0]).items()
        if name in ("pregrasp", "grasp", "squeeze")
    }
    assert play(dataclasses.replace(result.grasps[0], **above), HAND, scene) > 1.0
