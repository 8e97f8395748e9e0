"""The hold trial in PyBullet, with the stages, gains, effort limits, pulls and limits of `hold_trial` in MuJoCo.

docs/metrics.md describes what Bullet does differently, and how this trial compensates for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from graspd_bench.bullet.bullet_world import BulletWorld, add_object, load_hand_urdf, simulation
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import Grasp, Posture, TrialResult
from graspd_core.verify.hold_trial import DIRECTIONS, axis_name, broken_limit, straight_path
from graspd_core.verify.world import Protocol

# pybullet is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false


# Time step [s]. With MuJoCo's 4 ms, Bullet's solver lets an object turn by 10° in 2 s if the fingers are light.
TIMESTEP = 0.001
SOLVER_ITERATIONS = 50
_NAME = "bullet_hold"
# Steps between two checks of the limits: every 0.1 s, as in MuJoCo's trial.
_CHECK_EVERY = 100


@dataclass(frozen=True, eq=False)
class _Run:
    """One running simulation. `client`, `body` (the object), `hand` and `joints` are ids of PyBullet.

    `worst` has the greatest displacement [m] and rotation [rad] of the object so far. It is updated in place.
    """

    client: int
    world: BulletWorld
    protocol: Protocol
    body: int
    hand: int
    joints: tuple[int, ...]
    worst: Float[np.ndarray, "2"]


def bullet_hold_trial(world: BulletWorld, grasp: Grasp, protocol: Protocol) -> TrialResult:
    """Run one hold trial in PyBullet. The trial ends when the object exceeds a limit of displacement or rotation.

    Returns:
        Verdict and reason, greatest displacement of the object's centre of mass [m], greatest rotation [rad].

    Raises:
        SimulatorError: the hand has coupled joints.
    """
    import pybullet

    with simulation(timestep=TIMESTEP, solver_iterations=SOLVER_ITERATIONS) as client:
        pybullet.setPhysicsEngineParameter(enableConeFriction=1, physicsClientId=client)
        run = _start(client, world, grasp.pregrasp, protocol)
        depth = _start_penetration(run)
        if depth > protocol.max_start_penetration:
            return TrialResult(_NAME, False, 0.0, 0.0, f"the pregrasp penetrates the object by {depth * 1e3:.1f} mm")
        for stage, start, end in (("closing", grasp.pregrasp, grasp.grasp), ("squeezing", grasp.grasp, grasp.squeeze)):
            reason = _move(run, start, end)
            if reason:
                return _result(run, f"{reason} while {stage}")
        held = pybullet.saveState(physicsClientId=client)
        for direction in DIRECTIONS:
            pybullet.restoreState(held, physicsClientId=client)
            reason = _pull(run, grasp.squeeze, direction)
            if reason:
                return _result(run, f"{reason} under a pull along {axis_name(direction)}")
        return _result(run, "")


def _result(run: _Run, reason: str) -> TrialResult:
    return TrialResult(_NAME, not reason, float(run.worst[0]), float(run.worst[1]), reason)


def _start(client: int, world: BulletWorld, posture: Posture, protocol: Protocol) -> _Run:
    """Set up the simulation, with the hand in `posture` and the object at rest at the origin of the object frame."""
    import pybullet

    sliding, torsional, _ = protocol.friction
    body = add_object(client, world, world.mass)
    hand, joints = load_hand_urdf(client, world.hand, protocol.armature)
    # Bullet multiplies the sliding coefficients of a pair. It multiplies a body's spinning coefficient with the sliding
    # coefficient of the other body. With the values below, the hand's coefficients apply.
    grip = {"lateralFriction": sliding, "spinningFriction": torsional, "jointDamping": 0.0}
    free = {"linearDamping": 0.0, "angularDamping": 0.0, "restitution": 0.0, "rollingFriction": 0.0}
    pybullet.changeDynamics(
        body, -1, lateralFriction=1.0, spinningFriction=0.0, collisionMargin=0.0, **free, physicsClientId=client
    )
    for link in range(-1, pybullet.getNumJoints(hand, physicsClientId=client)):
        pybullet.changeDynamics(hand, link, **grip, **free, physicsClientId=client)
    for joint, value in zip(joints, posture.joint_positions.tolist(), strict=True):
        pybullet.resetJointState(hand, joint, value, physicsClientId=client)
    run = _Run(client, world, protocol, body, hand, joints, np.zeros(2))
    _put_base(run, posture)
    return run


def _put_base(run: _Run, posture: Posture) -> None:
    import pybullet

    xyzw = np.roll(posture.quaternion_wxyz, -1).tolist()
    pybullet.resetBasePositionAndOrientation(run.hand, posture.position.tolist(), xyzw, physicsClientId=run.client)


def _start_penetration(run: _Run) -> float:
    import pybullet

    pybullet.performCollisionDetection(physicsClientId=run.client)
    contacts = pybullet.getContactPoints(run.hand, run.body, physicsClientId=run.client)
    return max(0.0, -min((contact[8] for contact in contacts), default=0.0))


def _move(run: _Run, start: Posture, end: Posture) -> str:
    """Move base and joint targets linearly from `start` to `end`. Return why the trial failed, otherwise ""."""
    steps = round(run.protocol.stage_time / TIMESTEP)
    for step, posture in enumerate(straight_path(start, end, np.arange(1, steps + 1) / steps), 1):
        _put_base(run, posture)
        _drive(run, posture.joint_positions)
        if reason := _step(run, step):
            return reason
    return ""


def _pull(run: _Run, posture: Posture, direction: Float[np.ndarray, "3"]) -> str:
    """Pull at the object's centre of mass for the hold time. Return why the trial failed, or "" if it did not fail."""
    import pybullet

    force = (run.protocol.pull * run.world.mass * direction).tolist()
    for step in range(1, round(run.protocol.hold_time / TIMESTEP) + 1):
        _drive(run, posture.joint_positions)
        position, _ = pybullet.getBasePositionAndOrientation(run.body, physicsClientId=run.client)
        pybullet.applyExternalForce(run.body, -1, force, position, pybullet.WORLD_FRAME, physicsClientId=run.client)
        if reason := _step(run, step):
            return reason
    return ""


def _step(run: _Run, step: int) -> str:
    import pybullet

    pybullet.stepSimulation(physicsClientId=run.client)
    return "" if step % _CHECK_EVERY else _breach(run)


def _drive(run: _Run, target: Float[np.ndarray, "joints"]) -> None:
    """Drive the joints towards `target` [rad] or [m] for one step, by springs with dampers.

    Bullet has a motor that reaches a target velocity with at most a given force. Here the target is the velocity at
    which the damper balances the spring. The maximum force is the current force of spring and damper. So the motor acts
    as spring and damper, and cannot overshoot. Explicit torques on light fingers would need time steps of microseconds.
    """
    import pybullet

    hand, protocol = run.world.hand, run.protocol
    states = pybullet.getJointStates(run.hand, run.joints, physicsClientId=run.client)
    position, velocity = np.array([state[:2] for state in states]).T
    stiffness = np.where(hand.slides, protocol.slide_stiffness, protocol.stiffness)
    damping = np.where(hand.slides, protocol.slide_damping, protocol.damping)
    torque = np.clip(stiffness * (target - position), -hand.effort, hand.effort)
    pybullet.setJointMotorControlArray(
        run.hand,
        run.joints,
        pybullet.VELOCITY_CONTROL,
        targetVelocities=(torque / damping).tolist(),
        forces=np.abs(torque - damping * velocity).tolist(),
        physicsClientId=run.client,
    )


def _breach(run: _Run) -> str:
    """Update the greatest displacement and rotation of the object. Return which limit is broken, or "" if none is."""
    import pybullet

    position, quaternion = pybullet.getBasePositionAndOrientation(run.body, physicsClientId=run.client)
    if not np.isfinite([*position, *quaternion]).all():
        run.worst[:] = np.inf
        return "the simulation diverged"
    rotation = rotation_from_quaternion(torch.tensor(np.roll(quaternion, 1))).numpy() @ run.world.axes.T
    travel = float(np.linalg.norm(np.array(position) - run.world.center_of_mass))
    turn = float(np.arccos(np.clip(0.5 * (np.trace(rotation) - 1), -1.0, 1.0)))
    run.worst[:] = np.maximum(run.worst, [travel, turn])
    return broken_limit(run.protocol, travel, turn)
