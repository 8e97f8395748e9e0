"""Things that lie free on a table: dropped until they rest, and one of them lifted out by a hand.

The lift is the lift trial in a world where nothing is simplified: the object rests on the support and on the others,
which are as free as it is. Where all of them are afterwards is kept, so that the next lift goes on from there.
"""

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.hands.model import HandModel
from graspd_core.scene.scene import ObjectModel
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.trials.bodies import OBJECT, FreeBody, add_others, add_plane
from graspd_core.trials.lift_trial import LiftSettings, lift_trial
from graspd_core.trials.world import PROTOCOLS, Protocol, World, build_world, set_physics
from graspd_core.types import Grasp, Plane, Posture, TrialResult, TriangleMesh

_FLOOR, _WALL = "floor", "wall"
_GRAVITY = 9.81
# What falls slowly neither bounces nor passes through thin walls: as in honey, it falls at 0.6 m/s [1/s], and turns as
# slowly [1/s]; what has fallen is left in thinner honey, or balls would roll for minutes.
_FALLING, _RESTING = (16.0, 16.0), (1.0, 4.0)
# At rest for so many steps in a row, all of them slower than this [m/s], [rad/s].
_SPEED, _SPIN, _STILL = 0.002, 0.05, 50
Pose = Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class Lifted:
    """What came of a lift.

    Attributes:
        result: of the lift trial.
        poses: of all things afterwards, in their order, seen from the table [m].
        hand: where the hand ended, likewise; None where it never moved.
    """

    result: TrialResult
    poses: tuple[Pose, ...]
    hand: Posture | None


def settle(
    bodies: Sequence[FreeBody], *, wall: float | None = None, seconds: float = 4.0, protocol: Protocol | None = None
) -> tuple[Pose, ...]:
    """Let things come to rest on the table z = 0.

    Args:
        bodies: where they begin, not in each other.
        wall: half the side of a square fence about the origin, within which they fall slowly; without it they lie
            where they are and come to rest [m].
        seconds: the most of simulated time.
        protocol: physics.

    Returns:
        The poses at the end, the same for the same bodies.
    """
    import mujoco

    if not bodies:
        return ()
    protocol = protocol or PROTOCOLS["standard"]
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    set_physics(spec.option, protocol)
    spec.option.gravity = [0.0, 0.0, -_GRAVITY]
    spec.memory = 2**27
    add_plane(spec, _FLOOR, Plane(np.eye(3)[2], 0.0), protocol.friction)
    for index, normal in enumerate(np.vstack([np.eye(3)[:2], -np.eye(3)[:2]]) if wall is not None else ()):
        add_plane(spec, f"{_WALL} {index}", Plane(normal, -float(wall or 0.0)), protocol.friction)
    names = add_others(spec, bodies, protocol.friction, np.zeros(3))
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
    """Let everything be slowed as in a liquid, whatever its mass and size."""
    for name in names:
        body = int(model.body(name).id)
        first = int(model.joint(name).dofadr[0])
        model.dof_damping[first : first + 3] = slow * model.body_mass[body]
        model.dof_damping[first + 3 : first + 6] = turn * model.body_inertia[body].max()


def lift_out(
    hand: HandModel, bodies: Sequence[FreeBody], index: int, grasp: Grasp, protocol: Protocol, settings: LiftSettings
) -> Lifted:
    """Close the hand on one of the things, all of them as they lie on the table z = 0, and lift it.

    Args:
        grasp: in the frame of the table.
        protocol: physics, and how far the thing may slip in the hand.
    """
    target, others = bodies[index], [body for k, body in enumerate(bodies) if k != index]
    model, parts = placed(target)
    world = build_world(hand, model, parts, protocol, Plane(np.eye(3)[2], 0.0), others=others)
    watch = _Watch(world)
    result = lift_trial(replace(world, watch=watch, spare=deque()), hand, grasp, protocol, settings=settings)
    if watch.end is None:
        return Lifted(result, tuple(body.pose for body in bodies), None)
    moved, rest, posture = watch.end
    poses = [*rest[:index], moved @ target.pose, *rest[index:]]
    return Lifted(result, tuple(poses), posture)


class _Watch:
    """Remembers where all was at the last step, seen from the table, which sinks in a lift (lift_trial.py)."""

    def __init__(self, world: World) -> None:
        self._world = world
        self.end: tuple[Pose, list[Pose], Posture] | None = None

    def __call__(self, data: Any) -> None:
        world, up = self._world, self._world.origin - data.mocap_pos[1]
        body = int(world.model.body(OBJECT).id)
        object_pose, rest = _pose(data, body), [_pose(data, other) for other in world.others]
        for pose in (object_pose, *rest):
            pose[:3, 3] += up
        # The object's parts are where it lay, in a frame about the world's origin.
        object_pose[:3, 3] -= object_pose[:3, :3] @ world.origin
        posture = Posture(data.mocap_pos[0] + up, data.mocap_quat[0].copy(), data.qpos[world.joint_addresses])
        self.end = object_pose, rest, posture


def placed(body: FreeBody) -> tuple[ObjectModel, tuple[TriangleMesh, ...]]:
    """A thing with its parts as it lies, in the world frame."""
    turn, place = body.pose[:3, :3], body.pose[:3, 3]

    def there(mesh: TriangleMesh) -> TriangleMesh:
        return TriangleMesh(mesh.vertices @ turn.T + place, mesh.faces)

    model = replace(
        body.model,
        mesh=there(body.model.mesh),
        center_of_mass=turn @ body.model.center_of_mass + place,
        inertia=turn @ body.model.inertia @ turn.T,
    )
    return model, tuple(there(part) for part in body.parts)


def _pose(data: Any, body: int) -> Pose:
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_quaternion(torch.as_tensor(data.xquat[body])).numpy()
    pose[:3, 3] = data.xpos[body]
    return pose
