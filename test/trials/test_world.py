"""The trial's world against closed forms: free flight, joint limits, hollows."""

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from graspd_core.mesh.convex_parts import convex_parts
from graspd_core.mesh.sdf import build_sdf
from graspd_core.mesh.shapes import MUG_HALF, MUG_WALL, make_shape
from graspd_core.verify.hold_trial import DIRECTIONS, start_penetration
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
