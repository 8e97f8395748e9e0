"""The cell in MuJoCo: an arm with the masses of its links, a hand on it, table, bins, and things that lie in a bin.

Contacts, friction, solver and the hand's motors are those of the trials (graspd_core/verify/world.py), so that what
differs from a trial is the arm and what lies about. The arm's motors hold a stiff position within their effort limits.
They carry the weight of arm and hand, as real controllers do, and do not know of the thing in the hand.
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
from graspd_core.verify.world import PROTOCOLS, Friction, add_hand, add_object, set_physics

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

_GRAVITY = 9.81
# What falls off the table falls this deep [m].
FLOOR = -0.5
# An arm's motor gives its full effort at this error [rad]. Its damping is this time times its stiffness [s]. Gears and
# rotors weigh this much [kg·m²].
_FULL_EFFORT_AT, DAMPING_TIME, _ARMATURE = 0.02, 0.04, 0.1
_HAND = "hand/"
# What is dropped into a bin keeps so far from its walls [m].
_GAP = 0.005
# Whose a geom is. Things have the numbers from THING on.
NOTHING, ARM, HAND, TABLE, PICK_BIN, PLACE_BIN, THING = range(7)
PARTS = {ARM: "arm", HAND: "hand", TABLE: "table", PICK_BIN: "pick bin", PLACE_BIN: "place bin"}
Pose = Float[np.ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class CellWorld:
    """A compiled cell, and where things are in it.

    Attributes:
        model: the `mujoco.MjModel`.
        arm, hand: the robot.
        layout: what stands about it.
        things: what lies there.
        joint_names: those of the arm, then the actuated ones of the hand.
        joint_qpos, joint_dof, actuators: of these joints, indices into `qpos`, `qvel` and `ctrl`.
        coupled_qpos: index into `qpos` of each of `hand.mimics`.
        thing_qpos, thing_dof: of each thing's free joint.
        thing_bodies: body ids of the things.
        arm_bodies, hand_bodies: body ids of their links, in their order.
        owner: whose each geom is, by its id: `ARM`, …, `THING` + number of the thing.
        effort: greatest of each joint [N·m] or [N].
        velocity: greatest of each joint [rad/s] or [m/s].
        lower, upper: limits of each joint [rad] or [m].
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
    thing_dof: Int[np.ndarray, "things"]
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
        """Joint values at the start: the arm aside, the hand open."""
        return np.concatenate([self.layout.start, self.hand.open_posture])


def build_cell(
    arm: Arm,
    hand: HandModel,
    layout: CellLayout,
    things: Sequence[Thing] = (),
    poses: Sequence[Pose] = (),
    *,
    friction: float | None = None,
) -> CellWorld:
    """Compile a cell with things at some poses.

    Args:
        arm, hand: the arm carries the hand where its description says.
        layout: what stands about the arm.
        things: what lies there.
        poses: of the things' frames in the base frame [m].
        friction: sliding coefficient of everything, None: that of the trials.

    Raises:
        ConfigError: nobody says how the hand is mounted, or arm and hand have joints of one name.
    """
    import mujoco

    if twice := set(arm.joint_names) & set(hand.joint_names):
        raise ConfigError(f"arm {arm.name} and hand {hand.name} both have a joint {sorted(twice)[0]!r}")
    # Or MuJoCo writes a log file into the working directory.
    mujoco.set_mju_user_warning(lambda message: None)
    protocol = PROTOCOLS["standard"]
    slide, *rest = protocol.friction
    rub: Friction = (slide if friction is None else friction, rest[0], rest[1])
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    set_physics(spec.option, replace(protocol, friction=rub))
    spec.option.gravity = [0.0, 0.0, -_GRAVITY]
    spec.memory = 2**28
    floor = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], pos=[0.0, 0.0, FLOOR])
    floor.condim, floor.friction = 4, rub
    _add_robot(spec, arm, hand, rub)
    _add_solids(spec, layout, rub)
    for index, (thing, pose) in enumerate(zip(things, poses, strict=True)):
        add_object(spec, thing.model, thing.parts, rub, name=f"thing {index}", pose=pose)
    world = _world_of(spec.compile(), arm, hand, layout, tuple(things))
    for one, other in _touching(world):
        spec.add_exclude(bodyname1=one, bodyname2=other)
    return replace(world, model=spec.compile())


def _add_robot(spec: Any, arm: Arm, hand: HandModel, friction: Friction) -> None:
    import mujoco

    protocol = replace(PROTOCOLS["standard"], friction=friction)
    add_hand(spec, arm.chain, protocol)
    spec.body(f"link:{arm.chain.base_link}").mocap = False
    for name, effort in zip(arm.joint_names, arm.chain.effort, strict=True):
        joint, stiffness = spec.joint(f"joint:{name}"), float(effort) / _FULL_EFFORT_AT
        joint.armature = _ARMATURE
        # The motor carries the links too, within its limit.
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
        thing_dof=rows("dofadr", free),
        thing_bodies=thing_bodies,
        arm_bodies=arm_bodies,
        hand_bodies=hand_bodies,
        owner=owner,
        effort=np.concatenate([arm.chain.effort, hand.effort]),
        velocity=np.concatenate([arm.chain.velocity, hand.velocity]),
        lower=np.concatenate([arm.lower, hand.lower]),
        upper=np.concatenate([arm.upper, hand.upper]),
    )  # fmt: skip


def pile_cell(
    arm: Arm, hand: HandModel, sources: Sequence[ThingSource], seed: int, *, friction: float | None = None
) -> CellWorld:
    """Compile a cell with things that were dropped into the first bin. The same seed drops them the same way."""
    layout, things = layout_of(arm), [load_thing(source) for source in sources]
    poses = []
    # Without the fence they would roll to where the bin's walls are.
    for body in dropped([thing.model for thing in things], seed, layout.pick.half - _GAP, stays=True):
        pose = body.pose.copy()
        pose[:2, 3] += layout.pick.center
        poses.append(pose)
    return build_cell(arm, hand, layout, things, poses, friction=friction)


def put_robot(world: CellWorld, data: Any, values: Float[np.ndarray, "joints"]) -> None:
    """Put joints and targets at some values, coupled joints where they belong."""
    data.qpos[world.joint_qpos] = values
    data.ctrl[world.actuators] = values
    hand = values[len(world.arm.joint_names) :]
    for address, mimic in zip(world.coupled_qpos, world.hand.mimics, strict=True):
        data.qpos[address] = mimic.multiplier * hand[mimic.joint] + mimic.offset


def _touching(world: CellWorld) -> set[tuple[str, str]]:
    """Pairs of links that are in each other at the start, one of them the arm's: their solids are too wide."""
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
