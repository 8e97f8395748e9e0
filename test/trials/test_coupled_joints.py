"""Coupled joints in the trial's world: they move with their leader, free or loaded, and load its motor."""

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import HandModel, all_joint_positions
from graspd_core.types import Grasp, Posture
from graspd_core.verify.hold_trial import hold_trial, set_hand_pose, set_joints
from graspd_core.verify.world import PROTOCOLS, World, build_world

STANDARD = PROTOCOLS["standard"]
AWAY = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module", params=["barrett_like", "parallel_gripper"])
def hand(request: pytest.FixtureRequest) -> HandModel:
    return load_hand(request.param, candidates=8)


@pytest.fixture(scope="module")
def world(hand, cube) -> World:
    return build_world(hand, cube, (cube.mesh,), STANDARD)


def posture(joints: np.ndarray) -> Posture:
    return Posture(AWAY, np.array([1.0, 0, 0, 0]), joints)


def errors(hand: HandModel, world: World, data: mujoco.MjData) -> np.ndarray:
    """How far each coupled joint is from where its leader's value puts it."""
    actuated = data.qpos[world.joint_addresses]
    return np.array([
        data.qpos[address] - m.multiplier * actuated[m.joint] - m.offset
        for address, m in zip(world.coupled_addresses, hand.mimics, strict=True)
    ])  # fmt: skip


def test_every_link_is_placed_as_kinematics_say(hand, world):
    data = mujoco.MjData(world.model)
    q = 0.3 * hand.lower + 0.7 * hand.upper
    set_hand_pose(world, data, posture(q))
    mujoco.mj_forward(world.model, data)
    for name, rotation, translation in zip(hand.link_names, *link_poses(hand, q), strict=True):
        body = data.body(f"link:{name}")
        np.testing.assert_allclose(body.xpos, AWAY + translation, atol=1e-9)
        np.testing.assert_allclose(body.xmat.reshape(3, 3), rotation, atol=1e-9)
    assert abs(errors(hand, world, data)).max() == 0.0


def test_only_leaders_have_motors(hand, world):
    assert world.model.nu == hand.num_joints
    assert world.model.neq == len(hand.mimics)


def test_followers_keep_up_while_the_hand_moves(hand, world):
    data = mujoco.MjData(world.model)
    set_hand_pose(world, data, posture(hand.open_posture))
    worst = np.zeros(len(hand.mimics))
    for step in range(200):
        # As fast as a trial closes.
        data.ctrl[:] = hand.open_posture + min(1.0, step / 100) * (hand.closed_posture - hand.open_posture)
        mujoco.mj_step(world.model, data)
        worst = np.maximum(worst, abs(errors(hand, world, data)))
    assert data.qpos[world.joint_addresses] == pytest.approx(hand.closed_posture, abs=2e-3)
    assert worst.max() < 1e-3  # rad, or m


def test_a_load_on_a_follower_is_carried_by_its_leaders_motor(hand, world):
    """Statics: a torque τ on a coupled joint turns up as multiplier · τ at the joint that it follows."""
    data = mujoco.MjData(world.model)
    set_hand_pose(world, data, posture(hand.closed_posture))
    mimic = hand.mimics[0]
    load = 5.0 if hand.slides[mimic.joint] else 0.3
    data.qfrc_applied[world.model.joint(f"joint:{mimic.name}").dofadr[0]] = load
    mujoco.mj_step(world.model, data, 400)
    assert -data.actuator_force[mimic.joint] == pytest.approx(mimic.multiplier * load, rel=1e-3)
    assert abs(errors(hand, world, data)).max() < 1e-3


def test_a_jaw_that_follows_presses_as_hard(cube):
    hand = load_hand("parallel_gripper", candidates=8)
    world = build_world(hand, cube, (cube.mesh,), STANDARD)
    data = mujoco.MjData(world.model)
    # The cube of 40 mm between the jaws' ends, 110 mm before the mount.
    set_hand_pose(world, data, Posture(np.array([0.0, 0.0, -0.13]), np.array([1.0, 0, 0, 0]), np.array([0.0202])))
    data.ctrl[:] = 0.01
    mujoco.mj_step(world.model, data, 300)
    pressed = {"left": 0.0, "right": 0.0}
    force = np.zeros(6)
    for index in range(data.ncon):
        mujoco.mj_contactForce(world.model, data, index, force)
        bodies = [world.model.body(world.model.geom_bodyid[g]).name for g in data.contact[index].geom]
        side = next(key for key in pressed if any(key in name for name in bodies))
        pressed[side] += force[0]
    # 10 mm short of the target, 2000 N/m: 20 N on the joint, half of them from either jaw.
    assert pressed["left"] == pytest.approx(10.0, rel=0.03)
    assert pressed["right"] == pytest.approx(10.0, rel=0.03)


def test_a_trial_closes_coupled_jaws_on_a_cube(cube):
    hand = load_hand("parallel_gripper", candidates=8)
    world = build_world(hand, cube, (cube.mesh,), STANDARD)

    def at(joint: float) -> Posture:
        return Posture(np.array([0.0, 0.0, -0.13]), np.array([1.0, 0, 0, 0]), np.array([joint]))

    grasp = Grasp(at(0.03), at(0.02), at(0.015), (), 0.0)
    assert hold_trial(world, grasp, STANDARD).passed
    limp = replace(grasp, squeeze=at(0.0199))
    assert not hold_trial(world, limp, STANDARD).passed


def test_setting_joints_sets_those_that_follow(hand, world):
    data = mujoco.MjData(world.model)
    q = 0.5 * (hand.lower + hand.upper)
    set_joints(world, data, q)
    movable = [data.qpos[a] for a in sorted({*world.joint_addresses, *world.coupled_addresses})]
    np.testing.assert_allclose(movable, all_joint_positions(hand, q))
