"""The trial's world against closed forms: free flight, joint limits, hollows; joints that follow a leader."""

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from graspd_core import Grasp, Posture, load_hand
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.model import HandModel, all_joint_positions
from graspd_core.mesh.convex_parts import convex_parts
from graspd_core.mesh.sdf import build_sdf
from graspd_core.mesh.shapes import MUG_HALF, MUG_WALL, make_shape
from graspd_core.verify.hold_trial import DIRECTIONS, hold_trial, set_hand_pose, set_joints, start_penetration
from graspd_core.verify.world import PROTOCOLS, World, at_friction, build_world

# On softer springs than the trials' own, so that a millimetre of squeeze is half a newton.
STANDARD = replace(PROTOCOLS["standard"], slide_stiffness=500.0, slide_damping=10.0)


def start(world: World, height: float, joints: float) -> mujoco.MjData:
    """The gripper at a height [m] with both fingers at a joint value [m]."""
    data = mujoco.MjData(world.model)
    data.mocap_pos[0] = [0, 0, height]
    data.qpos[world.joint_addresses] = joints
    data.ctrl[:] = joints
    mujoco.mj_forward(world.model, data)
    return data


@pytest.mark.parametrize("direction", range(6))
def test_a_free_object_flies_as_newton_says(direction, world):
    data = start(world, -1.0, 0.0)
    data.xfrc_applied[world.object_body, :3] = STANDARD.pull * 0.1 * DIRECTIONS[direction]
    steps = 50
    mujoco.mj_step(world.model, data, steps)
    t = steps * STANDARD.timestep
    travelled = data.qpos[world.object_address : world.object_address + 3]
    # Half of 10 m/s² · t²; stepping speeds before places adds one part in `steps`.
    assert travelled == pytest.approx(0.5 * 10 * t**2 * (1 + 1 / steps) * DIRECTIONS[direction], abs=1e-9)


def test_the_object_weighs_what_it_should(world, cube):
    assert world.model.body_mass[world.object_body] == pytest.approx(cube.mass)
    # A cube of side a: m a² / 6 about any axis.
    assert world.model.body_inertia[world.object_body] == pytest.approx([0.1 * 0.04**2 / 6] * 3, rel=1e-6)
    assert np.array_equal(world.model.opt.gravity, np.zeros(3))


@pytest.mark.parametrize(("radius", "length"), [(0.0015, 0.2), (0.0002, 0.1), (0.01, 0.1)])
def test_mujoco_accepts_rods_however_thin(radius, length, gripper, cube):
    # A cylinder about its axis z: m r² / 2, and across: m (3 r² + l²) / 12.
    across = cube.mass * (3 * radius**2 + length**2) / 12
    rod = replace(cube, inertia=np.diag([across, across, cube.mass * radius**2 / 2]))
    world = build_world(gripper, rod, (cube.mesh,), STANDARD)
    # A thousandth of the inertia is traded for a valid one.
    assert world.model.body_inertia[world.object_body][:2] == pytest.approx(across, rel=2e-3)


def test_joints_stay_within_their_limits_however_far_the_target(world, gripper):
    data = start(world, -1.0, 0.02)
    worst = 0.0
    for step in range(300):
        # As fast as a trial moves its targets, and 20 mm past either limit.
        data.ctrl[:] = 0.02 + min(1.0, step / 100) * np.array([0.04, -0.04])
        mujoco.mj_step(world.model, data)
        joints = data.qpos[world.joint_addresses]
        worst = max(worst, float(np.max([joints - gripper.upper, gripper.lower - joints])))
    # Limits are soft constraints: 10 N of the actuator press a finger of 50 g in by less than a millimetre.
    assert worst < 1e-3
    assert data.qpos[world.joint_addresses] == pytest.approx([0.04, 0.0], abs=1e-3)


def test_effort_is_limited(gripper, cube):
    world = build_world(replace(gripper, effort=np.array([1.5, 1.5])), cube, (cube.mesh,), STANDARD)
    data = start(world, -0.045, 0.025)
    data.ctrl[:] = 0.04
    mujoco.mj_step(world.model, data, 200)
    # 500 N/m times 15 mm would be 7.5 N.
    assert data.actuator_force == pytest.approx([1.5, 1.5])


def test_a_squeeze_presses_with_the_actuators_force(world):
    data = start(world, -0.045, 0.0249)
    data.ctrl[:] = 0.027
    mujoco.mj_step(world.model, data, 300)
    force = np.zeros(6)
    pressed = 0.0
    for index in range(data.ncon):
        mujoco.mj_contactForce(world.model, data, index, force)
        pressed += force[0]
    # Statics: the sum over both fingers of what the actuators give.
    assert pressed == pytest.approx(data.actuator_force.sum(), rel=0.01)
    # On flat faces there is more than one point, or the cube could turn about it.
    assert data.ncon >= 6


def test_a_finger_fits_into_the_hollow_of_a_mug(gripper, cube):
    mug = replace(cube, mesh=make_shape("mug"))
    parts = convex_parts(mug.mesh, build_sdf(mug.mesh))
    assert len(parts) > 1
    world = build_world(gripper, mug, parts, STANDARD)
    # Fingers side by side within the cup (30 mm wide, both 20 mm thick together, inner radius 36 mm), upside down, so
    # that their ends come down 30 mm from the rim, and the palm stays above it.
    data = mujoco.MjData(world.model)
    data.mocap_pos[0] = [0, 0, MUG_HALF + 0.04]
    data.mocap_quat[0] = [0, 1, 0, 0]
    data.qpos[world.joint_addresses] = 0.04
    mujoco.mj_forward(world.model, data)
    assert start_penetration(world, data) < 0.001
    # Down to the bottom and 5 mm through: that is noticed.
    bottom = MUG_WALL - MUG_HALF
    data.mocap_pos[0] = [0, 0, bottom - 0.005 + 0.07]
    mujoco.mj_forward(world.model, data)
    assert start_penetration(world, data) > 0.003


@pytest.mark.parametrize(
    ("given", "standard", "hard"), [(0.15, (0.15, 0.005), (0.075, 0.0005)), (1.5, (0.6, 0.02), (0.3, 0.002))]
)
def test_a_slippery_object_is_tried_as_slippery_as_it_is(given, standard, hard):
    found = [at_friction(PROTOCOLS[name], given).friction[:2] for name in ("standard", "hard")]
    np.testing.assert_allclose(found, [standard, hard])


USUAL = PROTOCOLS["standard"]
AWAY = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module", params=["barrett_like", "parallel_gripper"])
def coupled(request: pytest.FixtureRequest) -> HandModel:
    return load_hand(request.param, candidates=8)


@pytest.fixture(scope="module")
def coupled_world(coupled, cube) -> World:
    return build_world(coupled, cube, (cube.mesh,), USUAL)


def posture(joints: np.ndarray) -> Posture:
    return Posture(AWAY, np.array([1.0, 0, 0, 0]), joints)


def errors(coupled: HandModel, coupled_world: World, data: mujoco.MjData) -> np.ndarray:
    """How far each coupled joint is from where its leader's value puts it."""
    actuated = data.qpos[coupled_world.joint_addresses]
    return np.array([
        data.qpos[address] - m.multiplier * actuated[m.joint] - m.offset
        for address, m in zip(coupled_world.coupled_addresses, coupled.mimics, strict=True)
    ])  # fmt: skip


def test_every_link_is_placed_as_kinematics_say(coupled, coupled_world):
    data = mujoco.MjData(coupled_world.model)
    q = 0.3 * coupled.lower + 0.7 * coupled.upper
    set_hand_pose(coupled_world, data, posture(q))
    mujoco.mj_forward(coupled_world.model, data)
    for name, rotation, translation in zip(coupled.link_names, *link_poses(coupled, q), strict=True):
        body = data.body(f"link:{name}")
        np.testing.assert_allclose(body.xpos, AWAY + translation, atol=1e-9)
        np.testing.assert_allclose(body.xmat.reshape(3, 3), rotation, atol=1e-9)
    assert abs(errors(coupled, coupled_world, data)).max() == 0.0


def test_only_leaders_have_motors_and_setting_joints_sets_those_that_follow(coupled, coupled_world):
    assert coupled_world.model.nu == coupled.num_joints
    assert coupled_world.model.neq == len(coupled.mimics)
    data = mujoco.MjData(coupled_world.model)
    q = 0.5 * (coupled.lower + coupled.upper)
    set_joints(coupled_world, data, q)
    movable = [data.qpos[a] for a in sorted({*coupled_world.joint_addresses, *coupled_world.coupled_addresses})]
    np.testing.assert_allclose(movable, all_joint_positions(coupled, q))


def test_followers_keep_up_while_the_hand_moves(coupled, coupled_world):
    data = mujoco.MjData(coupled_world.model)
    set_hand_pose(coupled_world, data, posture(coupled.open_posture))
    worst = np.zeros(len(coupled.mimics))
    for step in range(200):
        # As fast as a trial closes.
        data.ctrl[:] = coupled.open_posture + min(1.0, step / 100) * (coupled.closed_posture - coupled.open_posture)
        mujoco.mj_step(coupled_world.model, data)
        worst = np.maximum(worst, abs(errors(coupled, coupled_world, data)))
    assert data.qpos[coupled_world.joint_addresses] == pytest.approx(coupled.closed_posture, abs=2e-3)
    assert worst.max() < 1e-3  # rad, or m


def test_a_load_on_a_follower_is_carried_by_its_leaders_motor(coupled, coupled_world):
    """Statics: a torque τ on a coupled joint turns up as multiplier · τ at the joint that it follows."""
    data = mujoco.MjData(coupled_world.model)
    set_hand_pose(coupled_world, data, posture(coupled.closed_posture))
    mimic = coupled.mimics[0]
    load = 5.0 if coupled.slides[mimic.joint] else 0.3
    data.qfrc_applied[coupled_world.model.joint(f"joint:{mimic.name}").dofadr[0]] = load
    mujoco.mj_step(coupled_world.model, data, 400)
    assert -data.actuator_force[mimic.joint] == pytest.approx(mimic.multiplier * load, rel=1e-3)
    assert abs(errors(coupled, coupled_world, data)).max() < 1e-3


def test_a_jaw_that_follows_presses_as_hard(cube):
    coupled = load_hand("parallel_gripper", candidates=8)
    coupled_world = build_world(coupled, cube, (cube.mesh,), USUAL)
    data = mujoco.MjData(coupled_world.model)
    # The cube of 40 mm between the jaws' ends, 110 mm before the mount.
    between = Posture(np.array([0.0, 0.0, -0.13]), np.array([1.0, 0, 0, 0]), np.array([0.0202]))
    set_hand_pose(coupled_world, data, between)
    data.ctrl[:] = 0.01
    mujoco.mj_step(coupled_world.model, data, 300)
    pressed = {"left": 0.0, "right": 0.0}
    force = np.zeros(6)
    for index in range(data.ncon):
        mujoco.mj_contactForce(coupled_world.model, data, index, force)
        bodies = [coupled_world.model.body(coupled_world.model.geom_bodyid[g]).name for g in data.contact[index].geom]
        side = next(key for key in pressed if any(key in name for name in bodies))
        pressed[side] += force[0]
    # 10 mm short of the target, 2000 N/m: 20 N on the joint, half of them from either jaw.
    assert pressed["left"] == pytest.approx(10.0, rel=0.03)
    assert pressed["right"] == pytest.approx(10.0, rel=0.03)


def test_a_trial_closes_coupled_jaws_on_a_cube(cube):
    coupled = load_hand("parallel_gripper", candidates=8)
    coupled_world = build_world(coupled, cube, (cube.mesh,), USUAL)

    def at(joint: float) -> Posture:
        return Posture(np.array([0.0, 0.0, -0.13]), np.array([1.0, 0, 0, 0]), np.array([joint]))

    grasp = Grasp(at(0.03), at(0.02), at(0.015), (), 0.0)
    assert hold_trial(coupled_world, grasp, USUAL).passed
    limp = replace(grasp, squeeze=at(0.0199))
    assert not hold_trial(coupled_world, limp, USUAL).passed
