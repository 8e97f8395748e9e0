"""More trials in MuJoCo: displacement under gravity with a frozen and with a driven hand, and falling objects.

`displacement_trial` repeats PyBullet's displacement trial in MuJoCo. The two results show how much depends on the
simulator. Both trials have a frozen hand, an object of 1 kg, 35 steps of 1/240 s, and 9.8 m/s². Friction is the product
of Bullet's two coefficients, 3 times 3. Nothing bounces, as the hand's restitution in Bullet is 0.

`gravity_trial` measures how far gravity moves an object within 2 s while the hand squeezes the object. Hand, object and
physics are those of the hold trial. The displacement trial of the papers differs: its hand is frozen, without motors
and effort limits, and it ends after 0.15 s, too soon to show a slow slip.

`dropped` lets objects fall on a table and come to rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.model import HandModel
from graspd_core.perception.scene import ObjectModel, object_parts
from graspd_core.se3 import quaternion_from_rotation, random_rotations, rotation_from_quaternion
from graspd_core.types import Grasp, Plane, Posture, TriangleMesh
from graspd_core.verify.early_stop import CHECK_EVERY, CREEPING, ObjectState
from graspd_core.verify.hold_trial import DIRECTIONS, close_hand, diverged, moved, object_state
from graspd_core.verify.world import (
    OBJECT,
    PROTOCOLS,
    Protocol,
    World,
    add_object,
    add_plane,
    add_primitive,
    set_physics,
    trial_data,
)

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false


TIMESTEP, STEPS = 1 / 240, 35
GRAVITY, MASS, FRICTION = 9.8, 1.0, 3.0
# Bullet multiplies the friction coefficients of the two bodies.
_PAIR_FRICTION = (FRICTION**2, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class FrozenWorld:
    """Compiled MuJoCo model of a hand without joints and a free object of 1 kg.

    Attributes:
        model: the `mujoco.MjModel`. Every link of the hand is a mocap body.
        hand: the hand.
        object_body: body id of the object.
        center_of_mass: centre of mass of the object, in the object frame [m].
    """

    model: Any
    hand: HandModel
    object_body: int
    center_of_mass: Float[np.ndarray, "3"]


def build_frozen_world(hand: HandModel, target: ObjectModel, parts: Sequence[TriangleMesh]) -> FrozenWorld:
    """Compile the MuJoCo model of one hand and object. `parts` are the object's convex parts, object frame [m]."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.option.gravity = [0.0, 0.0, 0.0]
    links = [spec.worldbody.add_body(name=f"link:{name}", mocap=True) for name in hand.link_names]
    for index, primitive in enumerate(hand.primitives):
        add_primitive(spec, links[primitive.link], primitive, f"hand:{index}", _PAIR_FRICTION)
    heavy = replace(target, mass=MASS, inertia=target.inertia * (MASS / target.mass))
    add_object(spec, heavy, parts, _PAIR_FRICTION)
    model = spec.compile()
    return FrozenWorld(model, hand, int(model.body(OBJECT).id), target.center_of_mass)


def displacement_trial(
    world: FrozenWorld, posture: Posture, *, directions: Float[np.ndarray, "directions 3"] = DIRECTIONS
) -> float:
    """Return how far gravity moves the object's centre of mass in 35 steps of 1/240 s [m], mean over `directions`."""
    import mujoco

    moved = []
    for direction in directions:
        data = mujoco.MjData(world.model)
        _place_links(world, data, posture)
        data.xfrc_applied[world.object_body, :3] = GRAVITY * MASS * direction
        mujoco.mj_step(world.model, data, STEPS)
        mujoco.mj_kinematics(world.model, data)
        moved.append(np.linalg.norm(data.xipos[world.object_body] - world.center_of_mass))
    return float(np.mean(moved))


def _place_links(world: FrozenWorld, data: Any, posture: Posture) -> None:
    rotations, translations = link_poses(world.hand, posture.joint_positions)
    base = rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz).double()).numpy()
    data.mocap_pos[:] = translations @ base.T + posture.position
    data.mocap_quat[:] = quaternion_from_rotation(torch.as_tensor(base @ rotations)).numpy()


DROP_GRAVITY, DURATION = 9.8, 2.0
# Gravity along one direction ends at this displacement [m]. It is also the result if the hand fails to close.
LOST = 0.1
# Gravity along one direction ends early when its final displacement is known with this tolerance [m].
TOLERANCE = 1e-4
# `_WINDOW` checks give one speed. `_SAFETY` times the change of the prediction must be below `TOLERANCE`.
_WINDOW, _SAFETY = 2, 4


def gravity_trial(world: World, grasp: Grasp, protocol: Protocol, *, stop: Callable[[], bool] = lambda: False) -> float:
    """Return the displacement of the object's centre of mass [m], mean over six gravity directions.

    The hand closes and squeezes as in the hold trial. Then gravity acts on the object along ±x, ±y, ±z in turn for 2 s.
    An object that moves 10 cm is lost and counts as 10 cm. If the hand fails to close, the result is also 10 cm.
    A direction ends early if predictions of the displacement at 2 s agree within 0.1 mm. Then the prediction counts.
    With `protocol.full_length` no direction ends early. If `stop` returns true, the displacement so far counts.
    """
    import mujoco

    with trial_data(world) as data:
        if close_hand(world, data, grasp, protocol, np.zeros(2)):
            return LOST
        held = np.empty(mujoco.mj_stateSize(world.model, mujoco.mjtState.mjSTATE_INTEGRATION))
        mujoco.mj_getState(world.model, data, held, mujoco.mjtState.mjSTATE_INTEGRATION)
        weight = DROP_GRAVITY * float(world.model.body_mass[world.object_body])
        displaced = np.empty(len(DIRECTIONS))
        for index, direction in enumerate(DIRECTIONS):
            mujoco.mj_setState(world.model, data, held, mujoco.mjtState.mjSTATE_INTEGRATION)
            data.xfrc_applied[world.object_body, :3] = weight * direction
            displaced[index] = _fall(world, data, protocol, stop)
        return float(displaced.mean())


def _fall(world: World, data: Any, protocol: Protocol, stop: Callable[[], bool]) -> float:
    """Return the object's displacement after 2 s of gravity [m]. Stop early if the object is lost or creeps evenly."""
    import mujoco

    checks, states = round(DURATION / protocol.timestep / CHECK_EVERY), list[ObjectState]()
    travel = 0.0
    for _ in range(checks):
        if stop():
            break
        mujoco.mj_step(world.model, data, CHECK_EVERY)
        states.append(object_state(world, data))
        travel = moved(world, states[-1])[0]
        if diverged(data) or not travel < LOST:
            return LOST
        if not protocol.full_length and (end := _end(states, checks)) is not None:
            return min(math.dist(end, world.center_of_mass), LOST)
    return travel


def _end(states: list[ObjectState], checks: int) -> Float[np.ndarray, "3"] | None:
    """Predict the centre of mass after check number `checks` [m]. None if the object does not creep evenly."""
    recent = states[-2 * _WINDOW - 1 :]
    if len(recent) <= 2 * _WINDOW or not all(s.speed < CREEPING.speed and s.spin < CREEPING.spin for s in recent):
        return None
    first, middle, last = (np.asarray(state.center) for state in (recent[0], recent[_WINDOW], recent[-1]))
    left = (checks - len(states)) / _WINDOW
    end, before = last + left * (last - middle), middle + (left + 1) * (middle - first)
    return end if _SAFETY * np.linalg.norm(end - before) < TOLERANCE else None


_FLOOR, _WALL = "floor", "wall"
_GRAVITY = 9.81
# Damping of translation and rotation per mass and inertia [1/s]. Strong damping limits the fall to 0.6 m/s, so that
# objects neither bounce nor pass through thin walls. Objects on the table are damped less. There damping stops balls.
_FALLING, _RESTING = (16.0, 16.0), (1.0, 4.0)
# Objects are at rest after `_STILL` steps in a row in which all are slower than `_SPEED` [m/s] and `_SPIN` [rad/s].
_SPEED, _SPIN, _STILL = 0.002, 0.05, 50
Pose = Float[np.ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class FreeBody:
    """An object that can move freely.

    Attributes:
        model: the object model, in the object's own frame.
        parts: convex parts of the object, in its own frame [m].
        pose: `T_world_body` [m].
    """

    model: ObjectModel
    parts: tuple[TriangleMesh, ...]
    pose: Float[np.ndarray, "4 4"]


def settle(bodies: Sequence[FreeBody], *, wall: float | None = None, seconds: float = 4.0) -> tuple[Pose, ...]:
    """Let objects come to rest on the table z = 0.

    Args:
        bodies: objects at their start poses. They must not overlap.
        wall: half the side of a square fence around the origin [m]. Inside it, strong damping slows the objects' fall.
            If None, there is no fence, and the objects already lie on the table.
        seconds: limit of the simulated time [s].

    Returns:
        The final poses `T_world_body`. Equal bodies give equal poses.
    """
    import mujoco

    if not bodies:
        return ()
    spec, protocol = mujoco.MjSpec(), PROTOCOLS["standard"]
    spec.compiler.degree = False
    set_physics(spec.option, protocol)
    spec.option.gravity = [0.0, 0.0, -_GRAVITY]
    spec.memory = 2**27
    add_plane(spec, _FLOOR, Plane(np.eye(3)[2], 0.0), protocol.friction)
    for index, normal in enumerate(np.vstack([np.eye(3)[:2], -np.eye(3)[:2]]) if wall is not None else ()):
        add_plane(spec, f"{_WALL} {index}", Plane(normal, -float(wall or 0.0)), protocol.friction)
    names = [f"body {index}" for index in range(len(bodies))]
    for name, body in zip(names, bodies, strict=True):
        add_object(spec, body.model, body.parts, protocol.friction, name=name, pose=body.pose)
    model = spec.compile()
    data = mujoco.MjData(model)
    _damp(model, names, *(_RESTING if wall is None else _FALLING))
    still = 0
    for _ in range(round(seconds / protocol.timestep)):
        mujoco.mj_step(model, data)
        speed = np.abs(data.qvel.reshape(-1, 6))
        still = still + 1 if speed[:, :3].max() < _SPEED and speed[:, 3:].max() < _SPIN else 0
        if still == _STILL:
            break
    return tuple(_pose(data, int(model.body(name).id)) for name in names)


def _damp(model: Any, names: Sequence[str], slow: float, turn: float) -> None:
    for name in names:
        body = int(model.body(name).id)
        first = int(model.joint(name).dofadr[0])
        model.dof_damping[first : first + 3] = slow * model.body_mass[body]
        model.dof_damping[first + 3 : first + 6] = turn * model.body_inertia[body].max()


def dropped(models: Sequence[ObjectModel], seed: int, wall: float, *, stays: bool = False) -> tuple[FreeBody, ...]:
    """Drop objects into a square fence on the table z = 0, then remove the fence. Return the objects when at rest.

    Args:
        models: the objects. They start above each other, with the first object lowest.
        seed: random seed of their orientations and places.
        wall: half the side of the fence around the origin [m].
        stays: whether to keep the fence.
    """
    generator = torch.Generator().manual_seed(seed)
    turns = random_rotations(len(models), generator, torch.float64).numpy()
    places = 0.3 * wall * (2 * torch.rand(len(models), 2, generator=generator, dtype=torch.float64).numpy() - 1)
    bodies, height = [], 0.0
    for model, turn, place in zip(models, turns, places, strict=True):
        pose, reach = np.eye(4), model.radius + 0.01
        pose[:3, :3] = turn
        pose[:3, 3] = np.array([*place, height + reach]) - turn @ model.center_of_mass
        height += 2 * reach
        bodies.append(FreeBody(model, object_parts(model), pose))
    fallen = posed(bodies, settle(bodies, wall=wall, seconds=4.0 + height))
    return fallen if stays else posed(fallen, settle(fallen))


def posed(bodies: Sequence[FreeBody], poses: Sequence[Pose]) -> tuple[FreeBody, ...]:
    return tuple(replace(body, pose=pose) for body, pose in zip(bodies, poses, strict=True))


def _pose(data: Any, body: int) -> Pose:
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_quaternion(torch.as_tensor(data.xquat[body])).numpy()
    pose[:3, 3] = data.xpos[body]
    return pose
