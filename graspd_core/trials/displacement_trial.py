"""The displacement trial's numbers in MuJoCo: does the figure come from the grasp, or from the engine?

The same frozen hand, 1 kg, 35 steps of 1/240 s under 9.8 m/s². What MuJoCo knows in another way: friction is per pair
here and is what Bullet makes of two 3s, and nothing bounces, as in Bullet, where a hand of restitution 0 stops that.
"""

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.hands.kinematics import forward, make_kinematics
from graspd_core.hands.model import HandModel
from graspd_core.scene.scene import ObjectModel
from graspd_core.se3 import SE3, quaternion_from_rotation, rotation_from_quaternion
from graspd_core.trials.bodies import OBJECT, add_object, add_primitive
from graspd_core.trials.hold_trial import DIRECTIONS
from graspd_core.types import Posture, TriangleMesh

TIMESTEP, STEPS = 1 / 240, 35
GRAVITY, MASS, FRICTION = 9.8, 1.0, 3.0
# Bullet multiplies the coefficients of the two bodies.
_PAIR_FRICTION = (FRICTION**2, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class FrozenWorld:
    """A hand without joints and a free object of 1 kg, compiled.

    Attributes:
        model: the `mujoco.MjModel`; every link of the hand is a body that is put where a posture says.
        hand: the hand.
        object_body: body id of the object.
        center_of_mass: of the object, in its own frame [m].
    """

    model: Any
    hand: HandModel
    object_body: int
    center_of_mass: Float[np.ndarray, "3"]


def build_frozen_world(hand: HandModel, target: ObjectModel, parts: Sequence[TriangleMesh]) -> FrozenWorld:
    """Compile the world of one hand and one object; `parts` are the object's convex parts, object frame [m]."""
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
    """Displacement of the object's centre of mass [m] after 35 steps of 1/240 s, mean over gravity's directions."""
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
    place, quaternion, joints = (
        torch.as_tensor(part, dtype=torch.float64)
        for part in (posture.position, posture.quaternion_wxyz, posture.joint_positions)
    )
    links = forward(make_kinematics(world.hand, "cpu", torch.float64), joints[None])[0]
    base = SE3(rotation_from_quaternion(quaternion), place)
    data.mocap_pos[:] = base.apply(links.translation).numpy()
    data.mocap_quat[:] = quaternion_from_rotation(base.rotation @ links.rotation).numpy()
