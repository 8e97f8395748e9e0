"""The simulated cell in MuJoCo: motions, effort limits, the referee, and the camera against the known scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from graspd_bench.rendering.depth_noise import DEFAULT, NONE
from graspd_cell.referee import HARD
from graspd_cell.robot import JointMotion, MotionAborted
from graspd_cell.simulated_robot import ARM_TOLERANCES, SETTLING, SimulatedRobot
from graspd_cell.things import family_sources, find_sources
from graspd_cell.world import PICK_BIN, pile_cell
from graspd_core.arms.arm import load_arm
from graspd_core.errors import ConfigError
from graspd_core.hands.library import load_hand

RobotOf = Callable[..., SimulatedRobot]


def test_a_motion_reaches_its_end_within_tolerance(pair: tuple[str, str], robot_of: RobotOf, smooth_motion: Any):
    robot = robot_of(*pair)
    arm = robot.world.arm
    goal = robot.world.layout.start + np.linspace(-0.6, 0.4, len(arm.joint_names))
    behind: list[float] = []
    robot.watchers.append(
        lambda r: behind.append(np.abs(r.joints().of(arm.joint_names).positions - r.arm.targets).max())
    )
    reading = robot.follow(smooth_motion(robot, goal, 2.0), 4.0)
    assert np.abs(reading.of(arm.joint_names).positions - goal).max() < ARM_TOLERANCES.goal
    assert 2.0 <= reading.time < 2.1
    # As a real arm's controller tracks, not only at the end.
    assert max(behind) < 0.01
    assert (np.abs(reading.efforts) <= robot.world.effort + 1e-6).all()


def test_a_hand_closes_and_says_how_hard_its_motors_work(pair: tuple[str, str], robot_of: RobotOf):
    robot = robot_of(*pair)
    hand = robot.world.hand
    reading = robot.follow(JointMotion(hand.joint_names, np.array([1.0]), hand.closed_posture[None]), 3.0)
    off = np.abs(reading.of(hand.joint_names).positions - hand.closed_posture) / hand.joint_scale
    assert off.max() < 0.06
    assert np.isfinite(reading.efforts).all()
    # The arm has not moved meanwhile.
    assert np.abs(reading.of(robot.world.arm.joint_names).positions - robot.world.layout.start).max() < 2e-3


def test_arm_and_hand_move_together(robot_of: RobotOf):
    robot = robot_of("ur5e_like", "allegro_right")
    world = robot.world
    goal = np.concatenate([world.layout.start + 0.1, world.hand.closed_posture])
    reading = robot.follow(JointMotion(world.joint_names, np.array([1.5]), goal[None], 0 * goal[None]), 3.0)
    off = np.abs(reading.positions - goal)
    assert off[:6].max() < ARM_TOLERANCES.goal
    assert off[6:].max() < 0.06
    # One controller's abort stops both.
    tight = JointMotion(
        world.joint_names, np.array([1.5]), world.start[None], path_tolerance=np.array([1e-6] + [9.0] * 21)
    )
    with pytest.raises(MotionAborted, match="joint 'shoulder_pan' left its path"):
        robot.follow(tight, 3.0)
    robot.wait(1.0)
    assert np.abs(robot.joints().positions - goal).max() < 0.1


def test_a_dropped_thing_settles_in_the_bin(robot_of: RobotOf):
    robot = robot_of("ur5e_like", "allegro_right", "family:pear:0", "shape:box")
    before = robot.thing_poses()
    robot.wait(2.0)
    fallen = robot.thing_poses()
    robot.wait(0.5)
    for high, low, still in zip(before, fallen, robot.thing_poses(), strict=True):
        assert 0.01 < low[2, 3] < high[2, 3] - 0.02
        assert np.linalg.norm(still[:3, 3] - low[:3, 3]) < 0.005
    report = robot.referee()
    assert dict(report.places) == {"pear 0": "pick bin", "box": "pick bin"}
    assert (report.in_hand, dict(report.hardest)) == ("", {})


def test_a_thing_beside_the_table_is_lost(robot_of: RobotOf):
    robot = robot_of("ur5e_like", "parallel_gripper", "shape:sphere")
    address = robot.world.thing_qpos[0]
    robot._data.qpos[address : address + 2] = [3.0, 0.0]
    robot.wait(1.0)
    assert robot.referee().places["sphere"] == "lost"


def test_a_motion_into_the_table_is_reported_with_its_force_and_keeps_to_the_efforts(
    robot_of: RobotOf, smooth_motion: Any, arm_at: Any
):
    robot = robot_of("ur5e_like", "parallel_gripper")
    world = robot.world
    place = np.array([*world.layout.place.center, 0.2])
    above = arm_at(robot, place, world.layout.start)
    robot.follow(smooth_motion(robot, above, 3.0), 5.0)
    assert robot.referee().hard() == {}
    efforts: list[np.ndarray] = []
    robot.watchers.append(lambda r: efforts.append(np.abs(r.joints().efforts)))
    # The fingers are 17 cm long: 7 cm into the table.
    below = arm_at(robot, place - [0.0, 0.0, 0.1], above)
    with pytest.raises(MotionAborted, match=r"joint '\w+' (left its path|missed its goal) by 0\.\d+; its tolerance is"):
        robot.follow(smooth_motion(robot, below, 1.0), 3.0)
    hard = robot.referee().hard()
    assert set(hard) == {"hand on table"}
    assert hard["hand on table"] > HARD
    # Motors work to their limits and no further, friction of the joints aside.
    assert (np.max(efforts, axis=0) <= world.effort * 1.001 + 1e-6).all()
    assert np.max(efforts, axis=0)[:3].max() > 30.0
    # And the arm stands still.
    first = robot.joints().positions
    robot.wait(0.2)
    assert np.abs(robot.joints().positions - first).max() < 1e-3
    robot.clear_forces()
    assert robot.referee().hardest == {}


def test_a_gripper_lifts_a_thing_and_the_referee_sees_it(robot_of: RobotOf, smooth_motion: Any, arm_at: Any):
    robot = robot_of("ur5e_like", "parallel_gripper", "shape:box", height=0.05)
    robot.wait(1.0)
    world, x = robot.world, robot.thing_poses()[0][:2, 3]
    above = arm_at(robot, np.array([*x, 0.3]), world.layout.start)
    robot.follow(smooth_motion(robot, above, 3.0), 5.0)
    robot.follow(smooth_motion(robot, arm_at(robot, np.array([*x, 0.19]), above), 1.0), 5.0)
    closed = JointMotion(world.hand.joint_names, np.array([1.0]), np.zeros((1, 1)))
    reading = robot.follow(closed, 3.0)
    # The jaws stop at the thing, and press as hard as the motor can.
    assert reading.of(("left_jaw",)).positions[0] > 0.01
    assert reading.of(("left_jaw",)).efforts[0] < -15.0
    robot.follow(smooth_motion(robot, above, 1.0), 3.0)
    report = robot.referee()
    assert report.in_hand == "box"
    assert robot.thing_poses()[0][2, 3] > 0.1
    assert report.hard("box") == {}
    robot.follow(JointMotion(world.hand.joint_names, np.array([0.5]), np.array([[0.07]])), 3.0)
    robot.wait(0.5)
    assert robot.referee().in_hand == ""


def test_a_stopped_motion_leaves_the_arm_still(robot_of: RobotOf, smooth_motion: Any):
    robot = robot_of("panda_like", "leap_right")
    motion = smooth_motion(robot, robot.world.layout.start + 0.4, 2.0)
    with pytest.raises(MotionAborted, match="the motion was stopped"):
        robot.follow(motion, 5.0, stop=lambda: robot.time > 1.0)
    assert robot.time < 1.5
    first = robot.joints().positions
    robot.wait(0.5)
    assert np.abs(robot.joints().positions - first).max() < 1e-3
    with pytest.raises(MotionAborted, match=r"took longer than its timeout of 0\.5 s"):
        robot.follow(smooth_motion(robot, robot.world.layout.start, 2.0), 0.5)


def test_a_motion_that_no_robot_could_follow_is_refused(robot_of: RobotOf, smooth_motion: Any):
    robot = robot_of("ur5e_like", "allegro_right")
    start, names = robot.world.layout.start, robot.world.arm.joint_names
    with pytest.raises(ConfigError, match=r"'shoulder_pan' would move at 10\.00 rad/s or m/s; valid: at most 3\.14"):
        robot.follow(JointMotion(names, np.array([0.1]), start[None] + np.eye(6)[:1]), 1.0)
    with pytest.raises(ConfigError, match=r"joint 'elbow' would go .* beyond its limits; valid: \[-3.14"):
        robot.follow(smooth_motion(robot, np.full(6, 6.0), 9.0), 20.0)
    with pytest.raises(ConfigError, match=r"the motion has joints elbow; valid: all of shoulder_pan"):
        robot.follow(JointMotion(("elbow",), np.array([1.0]), np.zeros((1, 1))), 2.0)


def test_the_depth_image_agrees_with_the_known_scene(robot_of: RobotOf):
    robot = robot_of("ur5e_like", "allegro_right", "shape:box", height=0.05)
    robot.wait(1.0)
    view = robot.look()
    rows, columns = np.nonzero(view.depth)
    ahead = view.depth[rows, columns].astype(float)
    (fx, _, cx), (_, fy, cy), _ = view.intrinsics
    points = np.stack([(columns - cx) / fx * ahead, (rows - cy) / fy * ahead, ahead], 1)
    points = points @ view.T_base_camera[:3, :3].T + view.T_base_camera[:3, 3]
    # The box's top, a square of which the middle is above its pose; then table; then walls.
    mesh, pose = robot.world.things[0].model.mesh, robot.thing_poses()[0]
    corners = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
    near = np.abs(points[:, :2] - pose[:2, 3]).max(1) < 0.01
    assert near.sum() > 50
    np.testing.assert_allclose(points[near, 2], corners[:, 2].max(), atol=5e-4)
    assert np.abs(points[:, 2]).min() < 1e-4
    flat = np.abs(points[:, 2]) < 5e-4
    assert 0.3 < flat.mean() < 0.99
    assert points[:, 2].min() > -0.06
    noisy = SimulatedRobot(robot.world, noise=DEFAULT)
    again = SimulatedRobot(robot.world, noise=DEFAULT)
    first, second = noisy.look().depth, noisy.look().depth
    np.testing.assert_array_equal(first, again.look().depth)
    assert (first != second).any()
    seen = first > 0
    assert np.abs(first[seen] - SimulatedRobot(robot.world, noise=NONE).look().depth[seen]).mean() < 0.005


def test_no_thing_is_in_a_wall_and_a_pile_lies_still():
    arm, hand = load_arm("ur5e_like"), load_hand("parallel_gripper")
    world = pile_cell(arm, hand, family_sources((11,), ("jar", "tool", "drill", "pump", "animal", "pan")), 11)
    robot = SimulatedRobot(world)
    contact = robot._data.contact
    deepest = min([0.0, *contact.dist[(np.sort(world.owner[contact.geom], 1)[:, 0] == PICK_BIN)]])
    # Once things rolled out of the fence that they fell into, and hung in the walls.
    assert deepest > -0.003
    robot.wait(SETTLING)
    before = robot.thing_poses()
    robot.wait(0.5)
    for first, then in zip(before, robot.thing_poses(), strict=True):
        assert np.linalg.norm(first[:3, 3] - then[:3, 3]) < 0.01


def test_equal_things_have_names_of_their_own():
    sources = find_sources(["shape:sphere", "shape:box", "shape:sphere", "shape:sphere"])
    world = pile_cell(load_arm("ur5e_like"), load_hand("parallel_gripper"), sources, 1)
    places = SimulatedRobot(world).referee().places
    assert list(places) == ["sphere", "box", "sphere #2", "sphere #3"]
