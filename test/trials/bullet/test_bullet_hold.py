"""The second simulator: the model's hand, the hold trial's verdicts, displacements against falls on paper."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from graspd_bench.bullet import bullet_world as bullet
from graspd_bench.bullet.bullet_hold import bullet_hold_trial
from graspd_bench.bullet.bullet_world import (
    OBMAN,
    BulletWorld,
    build_bullet_world,
    bullet_displacement,
    displacements,
    load_hand_urdf,
    roll_pitch_yaw,
    simulation,
)
from graspd_bench.trials import FrozenWorld, build_frozen_world, displacement_trial
from graspd_core import Posture, TriangleMesh, load_hand
from graspd_core.errors import SimulatorError
from graspd_core.hands.kinematics import forward, make_kinematics
from graspd_core.hands.model import Mimic
from graspd_core.hands.readers.xml_io import rotation_from_rpy
from graspd_core.perception.scene import build_scene
from graspd_core.se3 import quaternion_from_rotation, random_rotations, rotation_from_quaternion
from graspd_core.verify.hold_trial import DIRECTIONS, hold_trial
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
        pytest.raises(SimulatorError, match=r"coupled joints .*right_slide"),
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


STEP, STEPS, GRAVITY = 1 / 240, 35, 9.8
UP = np.array([1.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def frozen(gripper, cube) -> FrozenWorld:
    return build_frozen_world(gripper, cube, (cube.mesh,))


def hand_at(height: float, finger: float) -> Posture:
    return Posture(np.array([0.0, 0.0, height]), UP, np.array([finger, finger]))


def fall(drag: float = 0.0) -> float:
    """Semi-implicit Euler from rest against a drag of `drag (1 + v) v`; 10.42 cm without it, in small steps."""
    height = speed = 0.0
    for _ in range(STEPS):
        speed += (GRAVITY - drag * (1 + speed) * speed) * STEP
        height += speed * STEP
    return height


def test_free_fall(world, frozen):
    far = hand_at(-1.0, 0.0)
    # Bullet's damping of 0.04, linear and quadratic in the velocity; it computes in float32.
    assert displacements(world, far, DIRECTIONS) == pytest.approx(np.full(6, fall(0.04)), abs=2e-6)
    assert bullet_displacement(world, far) == pytest.approx(0.1068, abs=1e-4)
    assert displacement_trial(frozen, far) == pytest.approx(fall(), rel=1e-6)


def test_a_frozen_grip_holds_in_every_direction(world, frozen):
    # Either finger 0.2 mm deep: else nothing presses, and MuJoCo's cube slides out. Bullet has a margin of 1 mm.
    grip = hand_at(-0.045, 0.0252)
    assert displacements(world, grip, DIRECTIONS).max() < 0.0005
    assert displacement_trial(frozen, grip) < 0.0005


def test_an_object_falls_onto_the_palm_and_no_farther(world, frozen):
    # Fingers wide open, the palm 10 mm below the cube's face: it is there after 45 ms. Bullet's margin takes 1 mm.
    down, up = np.array([[0.0, 0, -1]]), np.array([[0.0, 0, 1]])
    open_hand = hand_at(-0.03, 0.0)
    assert bullet_displacement(world, open_hand, directions=down) == pytest.approx(0.0095, abs=0.0015)
    assert displacement_trial(frozen, open_hand, directions=down) == pytest.approx(0.01, abs=0.001)
    assert bullet_displacement(world, open_hand, directions=up) > 0.1


def test_the_figure_is_the_mean_of_six_directions_and_obmans_one_of_them(world):
    open_hand = hand_at(-0.03, 0.0)
    six = displacements(world, open_hand, DIRECTIONS)
    assert bullet_displacement(world, open_hand) == pytest.approx(six.mean())
    assert bullet_displacement(world, open_hand, directions=OBMAN) == pytest.approx(six[1], abs=1e-6)
    assert len({round(d, 3) for d in six}) > 1


def test_the_same_figure_whatever_ran_before_and_in_another_process(world):
    grip = hand_at(-0.045, 0.0252)
    first = bullet_displacement(world, grip)
    bullet_displacement(world, hand_at(-0.03, 0.0))
    assert bullet_displacement(pickle.loads(pickle.dumps(world)), grip) == first


@pytest.mark.parametrize("seed", range(3))
def test_turning_and_moving_everything_changes_nothing(seed, world, gripper, cube):
    rotation = random_rotations(1, torch.Generator().manual_seed(seed), torch.float64)[0].numpy()
    shift = np.random.default_rng(seed).uniform(-0.5, 0.5, 3)
    mesh = TriangleMesh(cube.mesh.vertices @ rotation.T + shift, cube.mesh.faces)
    turned = build_scene(mesh, mass=0.1, resolution=8).object
    here = hand_at(-0.03, 0.0)
    there = Posture(
        rotation @ here.position + shift, quaternion_from_rotation(torch.as_tensor(rotation)).numpy(), np.zeros(2)
    )
    moved = displacements(build_bullet_world(gripper, turned, (mesh,)), there, DIRECTIONS @ rotation.T)
    # Half a millimetre of how a cube in contact settles in float32 far from the origin.
    assert moved == pytest.approx(displacements(world, here, DIRECTIONS), abs=0.0005)


def test_without_the_simulator_one_clear_error(gripper, cube, monkeypatch):
    monkeypatch.setattr(bullet.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SimulatorError, match=r"pybullet is not installed.*bench"):
        build_bullet_world(gripper, cube, (cube.mesh,))
