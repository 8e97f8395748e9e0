"""MuJoCo model of the cell: an arm with link masses, a hand, table, bins, and objects in a bin.

Contacts, friction, solver and the hand's motors are the same as in the trials (graspd_core/verify/world.py). Only the
arm and the surrounding solids differ. The arm's motors are stiff position servos with effort limits. Like real
controllers, the motors compensate the weight of arm and hand, but not the weight of the held object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from graspd_bench.trials import dropped
from graspd_cell.layout import CellLayout, layout_of
from graspd_cell.things import Thing, ThingSource, load_thing
from graspd_core.arms.arm import Arm, tip_hand
from graspd_core.errors import ConfigError
from graspd_core.hands.model import HandModel
from graspd_core.se3 import quaternion_from_rotation
from graspd_core.verify.world import PROTOCOLS, Friction, Protocol, add_hand, add_object, set_physics

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

_GRAVITY = 9.81
# Height of the ground, where objects that fall off the table land [m].
FLOOR = -0.5
# Position error at which an arm's motor gives its full effort [rad]. Ratio of its damping to its stiffness [s]. Inertia
# of gears and rotors [kg·m²].
_FULL_EFFORT_AT, DAMPING_TIME, _ARMATURE = 0.02, 0.04, 0.1
_HAND = "hand/"
# Gap between dropped objects and the bin's walls [m].
_GAP = 0.005
# Owners of geoms. Object k has the number THING + k.
NOTHING, ARM, HAND, TABLE, PICK_BIN, PLACE_BIN, THING = range(7)
PARTS = {ARM: "arm", HAND: "hand", TABLE: "table", PICK_BIN: "pick bin", PLACE_BIN: "place bin"}
Pose = Float[np.ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class CellWorld:
    """Compiled cell with indices into MuJoCo's arrays.

    Attributes:
        model: the `mujoco.MjModel`.
        arm, hand: models of the robot.
        layout: solids and camera around the arm.
        things: objects in the cell.
        joint_names: names of the arm's joints, then of the hand's actuated joints.
        joint_qpos, joint_dof, actuators: indices of these joints into `qpos`, `qvel` and `ctrl`.
        coupled_qpos: index into `qpos` of each joint in `hand.mimics`.
        thing_qpos: first index of each object's free joint in `qpos`.
        thing_bodies: body ids of the objects.
        arm_bodies, hand_bodies: body ids of the links, in the order of the models.
        owner: owner of each geom by geom id: `NOTHING`, `ARM`, …, or `THING` + index of the object.
        effort: effort limit of each joint [N·m] or [N].
        velocity: speed limit of each joint [rad/s] or [m/s].
        lower, upper: position limits of each joint [rad] or [m].
    """

    model: Any
    arm: Arm
    hand: HandModel
    layout: CellLayout
    things: tuple[Thing, ...]
    joint_names: tuple[str, ...]
    joint_qpos: Int[np.ndarray, "joints"]
    joint_dof: Int[np.ndarray, "joints"]
    actuators: Int[np.ndarray, "joints"]
    coupled_qpos: Int[np.ndarray, "coupled"]
    thing_qpos: Int[np.ndarray, "things"]
    thing_bodies: Int[np.ndarray, "things"]
    arm_bodies: Int[np.ndarray, "arm_links"]
    hand_bodies: Int[np.ndarray, "hand_links"]
    owner: Int[np.ndarray, "geoms"]
    effort: Float[np.ndarray, "joints"]
    velocity: Float[np.ndarray, "joints"]
    lower: Float[np.ndarray, "joints"]
    upper: Float[np.ndarray, "joints"]

    @property
    def start(self) -> Float[np.ndarray, "joints"]:
        """Joint values of the start posture [rad] or [m]: the arm out of the camera's view, the hand open."""
        return np.concatenate([self.layout.start, self.hand.open_posture])


def build_cell(
    arm: Arm,
    hand: HandModel,
    layout: CellLayout,
    things: Sequence[Thing] = (),
    poses: Sequence[Pose] = (),
) -> CellWorld:
    """Compile a cell with objects at given poses.

    Args:
        arm, hand: models of the robot. Their descriptions say where the hand is mounted on the arm.
        layout: solids and camera around the arm.
        things: objects to add.
        poses: one pose per object in the base frame [m].

    Raises:
        ConfigError: no mount of the hand is described, or arm and hand share a joint name.
    """
    import mujoco

    if twice := set(arm.joint_names) & set(hand.joint_names):
        raise ConfigError(f"arm {arm.name} and hand {hand.name} both have a joint {sorted(twice)[0]!r}; rename one")
    # Without this MuJoCo writes a log file into the working directory.
    mujoco.set_mju_user_warning(lambda message: None)
    protocol = PROTOCOLS["standard"]
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    set_physics(spec.option, protocol)
    spec.option.gravity = [0.0, 0.0, -_GRAVITY]
    spec.memory = 2**28
    floor = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], pos=[0.0, 0.0, FLOOR])
    floor.condim, floor.friction = 4, protocol.friction
    _add_robot(spec, arm, hand, protocol)
    _add_solids(spec, layout, protocol.friction)
    for index, (thing, pose) in enumerate(zip(things, poses, strict=True)):
        add_object(spec, thing.model, thing.parts, protocol.friction, name=f"thing {index}", pose=pose)
    world = _world_of(spec.compile(), arm, hand, layout, tuple(things))
    for one, other in _touching(world):
        spec.add_exclude(bodyname1=one, bodyname2=other)
    return replace(world, model=spec.compile())


def _add_robot(spec: Any, arm: Arm, hand: HandModel, protocol: Protocol) -> None:
    import mujoco

    add_hand(spec, arm.chain, protocol)
    spec.body(f"link:{arm.chain.base_link}").mocap = False
    for name, effort in zip(arm.joint_names, arm.chain.effort, strict=True):
        joint, stiffness = spec.joint(f"joint:{name}"), float(effort) / _FULL_EFFORT_AT
        joint.armature = _ARMATURE
        # The effort that compensates gravity counts against the motor's limit.
        joint.actgravcomp, joint.actfrclimited, joint.actfrcrange = True, True, [-effort, effort]
        spec.actuator(f"joint:{name}").set_to_position(kp=stiffness, kv=DAMPING_TIME * stiffness)
    own = mujoco.MjSpec()
    own.compiler.degree = False
    add_hand(own, hand, protocol)
    base = own.body(f"link:{hand.base_link}")
    base.mocap = False
    mount = tip_hand(arm, hand)
    tip = spec.body(f"link:{arm.chain.link_names[arm.tip]}")
    frame = tip.add_frame(pos=mount.translation.numpy(), quat=quaternion_from_rotation(mount.rotation).numpy())
    frame.attach_body(base, _HAND, "")
    for prefix, model in (("", arm.chain), (_HAND, hand)):
        for link in model.link_names:
            spec.body(f"{prefix}link:{link}").gravcomp = 1.0


def _add_solids(spec: Any, layout: CellLayout, friction: Friction) -> None:
    import mujoco

    for index, solid in enumerate(layout.solids):
        name, box = f"{solid.name} {index}", mujoco.mjtGeom.mjGEOM_BOX
        spec.worldbody.add_geom(
            name=name, type=box, size=list(solid.half), pos=list(solid.center), condim=4, friction=friction
        )


def _world_of(model: Any, arm: Arm, hand: HandModel, layout: CellLayout, things: tuple[Thing, ...]) -> CellWorld:
    names = (*arm.joint_names, *hand.joint_names)
    inner = [f"joint:{name}" for name in arm.joint_names] + [f"{_HAND}joint:{name}" for name in hand.joint_names]
    free = [f"thing {index}" for index in range(len(things))]

    def bodies(prefix: str, robot: HandModel) -> np.ndarray:
        return np.array([model.body(f"{prefix}link:{link}").id for link in robot.link_names], dtype=np.int64)

    def rows(attribute: str, joints: Sequence[str]) -> np.ndarray:
        return np.array([getattr(model.joint(name), attribute)[0] for name in joints], dtype=np.int64)

    arm_bodies, hand_bodies = bodies("", arm.chain), bodies(_HAND, hand)
    thing_bodies = np.array([model.body(name).id for name in free], dtype=np.int64)
    owner = np.full(model.ngeom, NOTHING, dtype=np.int64)
    solids = {solid: number for number, solid in PARTS.items()}
    for index, solid in enumerate(layout.solids):
        owner[model.geom(f"{solid.name} {index}").id] = solids[solid.name]
    owner[np.isin(model.geom_bodyid, arm_bodies)] = ARM
    owner[np.isin(model.geom_bodyid, hand_bodies)] = HAND
    for index, body in enumerate(thing_bodies):
        owner[model.geom_bodyid == body] = THING + index
    return CellWorld(
        model, arm, hand, layout, things, names,
        joint_qpos=rows("qposadr", inner),
        joint_dof=rows("dofadr", inner),
        actuators=np.array([model.actuator(name).id for name in inner], dtype=np.int64),
        coupled_qpos=rows("qposadr", [f"{_HAND}joint:{mimic.name}" for mimic in hand.mimics]),
        thing_qpos=rows("qposadr", free),
        thing_bodies=thing_bodies,
        arm_bodies=arm_bodies,
        hand_bodies=hand_bodies,
        owner=owner,
        effort=np.concatenate([arm.chain.effort, hand.effort]),
        velocity=np.concatenate([arm.chain.velocity, hand.velocity]),
        lower=np.concatenate([arm.lower, hand.lower]),
        upper=np.concatenate([arm.upper, hand.upper]),
    )  # fmt: skip


def pile_cell(arm: Arm, hand: HandModel, sources: Sequence[ThingSource], seed: int) -> CellWorld:
    """Compile a cell with objects dropped into the pick bin. The same seed gives the same poses."""
    layout, things, poses = layout_of(arm), list[Thing](), []
    for source in sources:
        # Reports name objects, so each object gets a name of its own.
        thing, same = load_thing(source), sum(source.name == other.name for other in sources[: len(things)])
        things.append(replace(thing, name=f"{thing.name} #{same + 1}") if same else thing)
    # The fence stays until the objects rest, so that no object rolls into the bin's walls.
    for body in dropped([thing.model for thing in things], seed, layout.pick.half - _GAP, stays=True):
        pose = body.pose.copy()
        pose[:2, 3] += layout.pick.center
        poses.append(pose)
    return build_cell(arm, hand, layout, things, poses)


def put_robot(world: CellWorld, data: Any, values: Float[np.ndarray, "joints"]) -> None:
    """Set joint positions and targets to `values` [rad] or [m], and coupled joints accordingly."""
    data.qpos[world.joint_qpos] = values
    data.ctrl[world.actuators] = values
    hand = values[len(world.arm.joint_names) :]
    for address, mimic in zip(world.coupled_qpos, world.hand.mimics, strict=True):
        data.qpos[address] = mimic.multiplier * hand[mimic.joint] + mimic.offset


def _touching(world: CellWorld) -> set[tuple[str, str]]:
    """Return pairs of an arm link and a robot link whose collision shapes overlap in the start posture."""
    import mujoco

    data = mujoco.MjData(world.model)
    put_robot(world, data, world.start)
    mujoco.mj_forward(world.model, data)
    found = set()
    for geoms in data.contact.geom:
        owners = set(world.owner[geoms].tolist())
        if owners in ({ARM}, {ARM, HAND}):
            one, other = (world.model.body(int(world.model.geom_bodyid[geom])).name for geom in geoms)
            found.add((one, other))
    return found
