"""The second simulator: the same hand as in the model, and the hold trial's verdicts on grasps made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from graspd_bench.bullet.bullet_hold import bullet_hold_trial
from graspd_bench.bullet.bullet_world import BulletWorld, build_bullet_world, load_hand_urdf, roll_pitch_yaw, simulation
from graspd_core.errors import SimulatorError
from graspd_core.hands.kinematics import forward, make_kinematics
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import Mimic
from graspd_core.hands.readers.xml_io import rotation_from_rpy
from graspd_core.se3 import random_rotations, rotation_from_quaternion
from graspd_core.verify.hold_trial import hold_trial
from graspd_core.verify.world import PROTOCOLS, build_world

pybullet = pytest.importorskip("pybullet")

# Pulls of half a second tell as much about a cube between two plates as two.
STANDARD = replace(PROTOCOLS["standard"], hold_time=0.5)


@pytest.fixture(scope="module")
def world(gripper, cube) -> BulletWorld:
    return build_bullet_world(gripper, cube, (cube.mesh,))


def test_links_are_where_the_model_has_them():
    hand = load_hand("allegro_right")
    q = np.random.default_rng(0).uniform(hand.lower, hand.upper)
    links = forward(make_kinematics(hand, "cpu", torch.float64), torch.as_tensor(q)[None])[0]
    with simulation(timestep=0.001, solver_iterations=10) as client:
        body, joints = load_hand_urdf(client, hand, armature=0.0)
        for joint, value in zip(joints, q, strict=True):
            pybullet.resetJointState(body, joint, value, physicsClientId=client)
        for index in range(pybullet.getNumJoints(body, physicsClientId=client)):
            link = int(pybullet.getJointInfo(body, index, physicsClientId=client)[12].decode().removeprefix("link"))
            state = pybullet.getLinkState(body, index, computeForwardKinematics=True, physicsClientId=client)
            # Bullet's floats pass through angles and text.
            assert np.array(state[4]) == pytest.approx(links.translation[link].numpy(), abs=1e-6)
            there = rotation_from_quaternion(torch.tensor(np.roll(state[5], 1))).numpy()
            assert there == pytest.approx(links.rotation[link].numpy(), abs=1e-5)


@given(seed=st.integers(0, 2**31))
def test_angles_of_a_rotation_make_it_again(seed):
    rotation = random_rotations(1, torch.Generator().manual_seed(seed), torch.float64)[0].numpy()
    assert rotation_from_rpy(roll_pitch_yaw(rotation)) == pytest.approx(rotation, abs=1e-9)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_angles_of_a_rotation_in_gimbal_lock(pitch):
    rotation = rotation_from_rpy(np.array([0.3, pitch, -0.8]))
    assert rotation_from_rpy(roll_pitch_yaw(rotation)) == pytest.approx(rotation, abs=1e-7)


def test_coupled_joints_are_refused(gripper):
    coupled = replace(gripper, mimics=(Mimic("right_slide", 2, 0, 1.0, 0.0),))
    with (
        simulation(timestep=0.001, solver_iterations=10) as client,
        pytest.raises(SimulatorError, match=r"no coupled joints.*right_slide"),
    ):
        load_hand_urdf(client, coupled, armature=0.0)


def test_a_firm_squeeze_holds_and_the_same_trial_gives_the_same_figures(world, closing):
    grasp = closing(0.015, 0.0249, (0.03, 0.03))
    hold = bullet_hold_trial(world, grasp, STANDARD)
    assert (hold.passed, hold.reason) == (True, "")
    assert hold.displacement < 0.003
    assert hold.rotation < np.deg2rad(2)
    assert bullet_hold_trial(world, grasp, STANDARD) == hold


def test_failures_fail_for_the_same_reasons(world, closing):
    deep = bullet_hold_trial(world, closing(0.04, 0.04, (0.04, 0.04)), STANDARD)
    assert deep.reason == "the pregrasp penetrates the object by 15.0 mm"
    far = bullet_hold_trial(world, closing(0.015, 0.025, (0.03, 0.03), height=-0.145), STANDARD)
    assert far.reason.startswith("the object moved")
    assert far.reason.endswith("under a pull along +x")


@pytest.mark.parametrize(("share", "held"), [(1.3, True), (0.75, False)])
@pytest.mark.parametrize("friction", [0.3, 0.6])
def test_both_simulators_keep_coulombs_limit(friction, share, held, world, gripper, cube, closing):
    # As in test_trial: a pull of F along x against two faces, 2 μ N ≥ F.
    protocol = replace(STANDARD, friction=(friction, 0.02, 1e-4))
    normal = share * protocol.pull * cube.mass / (2 * friction)
    squeeze = 0.025 + normal / protocol.slide_stiffness
    grasp = closing(0.015, 0.0249, (squeeze, squeeze))
    second = bullet_hold_trial(world, grasp, protocol)
    first = hold_trial(build_world(gripper, cube, (cube.mesh,), protocol), grasp, protocol)
    assert first.passed == second.passed == held, (first, second)
