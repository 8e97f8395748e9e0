"""Build the MuJoCo world of a trial: a hand of primitives on a mocap base, and a free object of convex parts.

A support adds gravity and a table. Neighbours add obstacles. Table and obstacles are mocap bodies, so that a trial can
lower them away from the hand. Their mocap indices come after the index of the hand.

Contact and solver settings use the published parameters of DexGraspBench's floating protocol (Chen et al., BODex, ICRA
2025). Nothing in this module is differentiable, and the optimiser does not use this module.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.hands.model import HandModel, Mimic, Primitive
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.perception.scene import ObjectModel, Obstacle
from graspd_core.se3 import quaternion_between, quaternion_from_rotation
from graspd_core.types import Plane, Posture, TriangleMesh

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false


OBJECT = "graspd_object"
# Name of the plane with which the hand collides, and name of the plane on which the object rests.
TABLE, _REST = "the support", "graspd_rest"
_GRAVITY = 9.81

# Sliding, torsional and rolling friction coefficients.
Friction = tuple[float, float, float]


def add_primitive(spec: Any, body: Any, primitive: Primitive, name: str, friction: Friction) -> None:
    """Add a collision primitive of the hand to `body`. If the primitive is a hull, its mesh is called `name`."""
    import mujoco

    geom = body.add_geom(
        pos=primitive.translation,
        quat=quaternion_from_rotation(torch.as_tensor(primitive.rotation, dtype=torch.float64)).numpy(),
        condim=4,
        friction=friction,
        # With this priority, MuJoCo uses the hand's contact settings in each contact of the hand.
        priority=1,
        solref=[0.005, 1.0],
        solimp=[0.5, 0.99, 1e-4, 0.5, 2.0],
    )
    if primitive.kind == "hull":
        geom.type = mujoco.mjtGeom.mjGEOM_MESH
        geom.meshname = name
        add_mesh(spec, name, primitive.vertices, primitive.faces)
    else:
        geom.type = getattr(mujoco.mjtGeom, f"mjGEOM_{primitive.kind.upper()}")
        geom.size = np.resize(np.append(primitive.size, [0.0, 0.0]), 3)


def add_object(
    spec: Any,
    target: ObjectModel,
    parts: Sequence[TriangleMesh],
    friction: Friction,
    *,
    name: str = OBJECT,
    pose: Float[np.ndarray, "4 4"] | None = None,
) -> None:
    import mujoco

    body = spec.worldbody.add_body(name=name)
    if pose is not None:
        body.pos = pose[:3, 3]
        body.quat = quaternion_from_rotation(torch.as_tensor(pose[:3, :3], dtype=torch.float64)).numpy()
    body.add_freejoint(name=name)
    body.explicitinertial = True
    body.mass = target.mass
    body.ipos = target.center_of_mass
    body.fullinertia = full_inertia(target.inertia, floor=1e-9)
    for index, part in enumerate(parts):
        mesh = f"part:{index}" if name == OBJECT else f"{name} part:{index}"
        add_mesh(spec, mesh, part.vertices, part.faces)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, condim=4, friction=friction)


def add_support(spec: Any, hand: HandModel, parts: Sequence[TriangleMesh], friction: Friction, support: Plane) -> None:
    """Add gravity, a plane for the hand, and a plane for the object at the bottom of its `parts`."""
    spec.option.gravity = -_GRAVITY * support.normal
    add_plane(spec, TABLE, replace(support, offset=support.offset + support.margin), friction)
    for link in hand.link_names:
        # Compensate gravity for the hand's links, because a real hand carries its own weight.
        spec.body(f"link:{link}").gravcomp = 1.0
    lowest = min(float((part.vertices @ support.normal).min()) for part in parts)
    add_plane(spec, _REST, Plane(support.normal, lowest), friction)
    spec.add_exclude(bodyname1=TABLE, bodyname2=OBJECT)
    for link in hand.link_names:
        spec.add_exclude(bodyname1=_REST, bodyname2=f"link:{link}")


def add_plane(spec: Any, name: str, plane: Plane, friction: Friction) -> None:
    import mujoco

    body = spec.worldbody.add_body(name=name, mocap=True)
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0.0, 0.0, 1.0],
        pos=plane.offset * plane.normal,
        quat=quaternion_between(np.eye(3)[2], plane.normal, around=np.eye(3)[0]),
        condim=4,
        friction=friction,
    )


def add_obstacle(spec: Any, name: str, neighbour: Obstacle, target: ObjectModel, friction: Friction) -> None:
    import mujoco

    body = spec.worldbody.add_body(name=name, mocap=True)
    add_mesh(spec, name, neighbour.mesh.vertices, neighbour.mesh.faces)
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, condim=4, friction=friction)
    surface = torch.as_tensor(surface_samples(target.mesh, 1000, 0)[0]).to(neighbour.sdf.field)
    if bool((sample_sdf(neighbour.sdf, surface)[0] < 0).any()):
        # An obstacle is a padded convex hull. If it overlaps the object, it would push the object away.
        spec.add_exclude(bodyname1=name, bodyname2=OBJECT)


def add_mesh(spec: Any, name: str, vertices: np.ndarray, faces: np.ndarray) -> None:
    import mujoco

    mesh = spec.add_mesh(name=name)
    mesh.uservert = np.asarray(vertices, dtype=float).ravel()
    mesh.userface = np.asarray(faces, dtype=np.int32).ravel()
    # Shell inertia accepts parts without volume. MuJoCo does not use it, because all masses are given explicitly.
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL


def full_inertia(inertia: Float[np.ndarray, "3 3"], floor: float) -> list[float]:
    """Return a valid inertia as xx, yy, zz, xy, xz, yz [kg·m²]. Each principal moment is at least `floor`."""
    moments, axes = np.linalg.eigh(0.5 * (inertia + inertia.T))
    moments = np.maximum(moments, floor)
    moments[2] = min(moments[2], 0.999 * (moments[0] + moments[1]))
    # For a thin rod, the second moment may now exceed the sum of the others. MuJoCo would refuse such moments.
    moments[0] = max(moments[0], 1.001 * (moments[1] - moments[2]))
    m = axes @ np.diag(moments) @ axes.T
    return [m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2]]


# Simulation memory [bytes] of hands with more than `_CROWD` primitives. Their contacts exceed MuJoCo's usual 14 MB.
_CROWD, _MEMORY = 100, 2**28


@dataclass(frozen=True)
class Protocol:
    """Physics settings of a trial. The defaults are those of the `standard` hold trial.

    Attributes:
        friction: sliding, torsional and rolling friction coefficients.
        noslip_iterations: iterations of MuJoCo's noslip solver.
        impratio: ratio of frictional to normal impedance.
        timestep: simulation time step [s].
        stiffness: position gain of every revolute joint [N·m/rad].
        damping: damping of every revolute joint [N·m·s/rad].
        slide_stiffness: position gain of every prismatic joint [N/m]. It equals `stiffness` at a lever arm of 5 cm.
        slide_damping: damping of every prismatic joint [N·s/m]. It equals `damping` at a lever arm of 5 cm.
        armature: rotor inertia of every joint [kg·m²] or [kg].
        stage_time: duration of pregrasp → grasp and of grasp → squeeze [s].
        hold_time: duration of each pull [s].
        pulls: row indices of `hold_trial.DIRECTIONS`, one per pull. Every pull starts from the squeezed state.
        pull: pull force per kilogram of object mass [N/kg].
        max_displacement: greatest allowed travel of the object's centre of mass [m].
        max_rotation: greatest allowed rotation of the object [rad].
        max_start_penetration: greatest allowed penetration of the object at the pregrasp [m].
        max_grasp_penetration: greatest allowed penetration of the object at the grasp [m].
        max_self_penetration: greatest allowed self-penetration of the hand at pregrasp, grasp and after squeezing [m].
        full_length: whether every pull runs to its end instead of stopping early (`early_stop`).
    """

    friction: tuple[float, float, float] = (0.6, 0.02, 1e-4)
    noslip_iterations: int = 2
    impratio: float = 10.0
    timestep: float = 0.004
    stiffness: float = 5.0
    damping: float = 0.1
    slide_stiffness: float = 2000.0
    slide_damping: float = 40.0
    armature: float = 1e-4
    stage_time: float = 0.4
    hold_time: float = 2.0
    pulls: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    pull: float = 10.0
    max_displacement: float = 0.05
    max_rotation: float = float(np.deg2rad(15.0))
    max_start_penetration: float = 0.01
    max_grasp_penetration: float = 0.005
    max_self_penetration: float = 0.002
    full_length: bool = False


_HARD = Protocol(friction=(0.3, 0.002, 1e-4), noslip_iterations=0, impratio=1.0)
PROTOCOLS: dict[str, Protocol] = {
    "standard": Protocol(),
    "hard": _HARD,
    "full": Protocol(full_length=True),
    "hard_full": replace(_HARD, full_length=True),
}


def at_friction(protocol: Protocol, friction: float) -> Protocol:
    """Return the protocol with all three friction coefficients multiplied by the object's friction / 0.6.

    The factor is at most 1, so that no grasp passes only because a high friction is assumed.
    """
    share = min(friction / Protocol.friction[0], 1.0)
    sliding, torsional, rolling = protocol.friction
    return replace(protocol, friction=(sliding * share, torsional * share, rolling * share))


# Squeeze posture and protocol of a grasp that held, and MuJoCo's state after squeezing. A world keeps the last 32.
ClosedState = tuple[Posture, Protocol, Float[np.ndarray, "state"]]
_MOST_CLOSED = 32


@dataclass(frozen=True)
class World:
    """A compiled MuJoCo model and the indices that trials need. Trials never write to the model.

    Attributes:
        model: the `mujoco.MjModel`.
        joint_addresses: index into `qpos` of each actuated hand joint, in the order of the hand's joint names.
        object_address: index into `qpos` of the object's free joint (position, then wxyz).
        object_velocity: index into `qvel` of the object's free joint.
        object_body: body id of the object.
        center_of_mass: the object's centre of mass [m].
        hand_geoms: ids of the hand's geoms.
        obstacles: geom id and name of every obstacle, the support included.
        up: unit direction against gravity, None without gravity.
        coupled_addresses: index into `qpos` of each coupled joint, in the order of `mimics`.
        mimics: the coupled joints.
        fingers: number of the hand's fingertips.
        spare: `mujoco.MjData` objects of ended trials, which `trial_data` reuses.
        closed: squeeze posture, protocol and closed-hand state of the last grasps that held. `payload` reuses them.
        watch: hook that gets the `mujoco.MjData` after every step of a trial. None in planning.
    """

    model: Any
    joint_addresses: np.ndarray
    object_address: int
    object_velocity: int
    object_body: int
    center_of_mass: Float[np.ndarray, "3"]
    hand_geoms: tuple[int, ...] = ()
    obstacles: tuple[tuple[int, str], ...] = ()
    up: Float[np.ndarray, "3"] | None = None
    coupled_addresses: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    mimics: tuple[Mimic, ...] = ()
    fingers: int = 3
    spare: deque[Any] = field(default_factory=deque, repr=False, compare=False)
    closed: deque[ClosedState] = field(default_factory=lambda: deque(maxlen=_MOST_CLOSED), repr=False, compare=False)
    watch: Callable[[Any], None] | None = field(default=None, repr=False, compare=False)


def altered(world: World, *, mass: float | None = None, friction: Friction | None = None) -> World:
    """Return a copy of the world with another object mass [kg], or with another friction of all geoms."""
    import mujoco

    model, body = copy(world.model), world.object_body
    if friction is not None:
        model.geom_friction[:] = friction
    if mass is not None:
        model.body_inertia[body] *= mass / model.body_mass[body]
        model.body_mass[body] = mass
        # MuJoCo's contact softness depends on constants that it derives from the masses.
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return replace(world, model=model, spare=deque(), closed=deque(maxlen=_MOST_CLOSED))


@contextmanager
def trial_data(world: World) -> Iterator[Any]:
    """Provide the `mujoco.MjData` of one trial, reset to the model's initial state.

    Several threads may call this function, because each trial has its own data. Data of an ended trial is reused,
    because making new data takes about a millisecond. After a MuJoCo error, data is not reused, because the error may
    leave the data's memory in use.
    """
    import mujoco

    try:
        data = world.spare.pop()
        mujoco.mj_resetData(world.model, data)
    except IndexError:
        data = mujoco.MjData(world.model)
    yield data
    world.spare.append(data)


def advance(world: World, data: Any, steps: int = 1) -> None:
    """Simulate `steps` steps and call the watch hook after each step."""
    import mujoco

    if world.watch is None:
        mujoco.mj_step(world.model, data, steps)
        return
    for _ in range(steps):
        mujoco.mj_step(world.model, data)
        world.watch(data)


def build_world(
    hand: HandModel,
    target: ObjectModel,
    parts: Sequence[TriangleMesh],
    protocol: Protocol,
    support: Plane | None = None,
    obstacles: Sequence[Obstacle] = (),
) -> World:
    """Compile the world of one hand and one object.

    Args:
        target: the object, near the origin (`near_scene`), with its mass, centre of mass and inertia.
        parts: convex collision parts of the object, object frame [m].
        protocol: physics settings.
        support: a table, with gravity along its negative normal. The hand collides with this plane. The object rests on
            another plane, through its lowest point, because a reconstructed bottom may be millimetres off.
        obstacles: fixed bodies, as convex hulls. An obstacle that overlaps the object does not collide with the object.
    """
    import mujoco

    # Without this handler, MuJoCo writes warnings to a file in the working directory. Trials read warning counters.
    mujoco.set_mju_user_warning(lambda message: None)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    set_physics(spec.option, protocol)
    if len(hand.primitives) > _CROWD:
        spec.memory = _MEMORY
    add_hand(spec, hand, protocol)
    add_object(spec, target, parts, protocol.friction)
    fixed = [TABLE] if support is not None else []
    if support is not None:
        add_support(spec, hand, parts, protocol.friction, support)
    for index, obstacle in enumerate(obstacles):
        fixed.append(f"neighbour {index + 1}")
        add_obstacle(spec, fixed[-1], obstacle, target, protocol.friction)
    model = spec.compile()
    return World(
        model=model,
        joint_addresses=_joint_addresses(model, hand.joint_names),
        object_address=int(model.joint(OBJECT).qposadr[0]),
        object_velocity=int(model.joint(OBJECT).dofadr[0]),
        object_body=int(model.body(OBJECT).id),
        center_of_mass=target.center_of_mass,
        hand_geoms=tuple(i for i in range(model.ngeom) if model.body(model.geom_bodyid[i]).name.startswith("link:")),
        obstacles=tuple((int(model.geom(name).id), name) for name in fixed),
        up=None if support is None else support.normal,
        coupled_addresses=_joint_addresses(model, [mimic.name for mimic in hand.mimics]),
        mimics=hand.mimics,
        fingers=len(hand.fingertip_groups),
    )


def set_physics(option: Any, protocol: Protocol) -> None:
    import mujoco

    option.timestep = protocol.timestep
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = protocol.impratio
    option.noslip_iterations = protocol.noslip_iterations
    option.gravity = [0.0, 0.0, 0.0]


def _joint_addresses(model: Any, names: Sequence[str]) -> np.ndarray:
    return np.array([model.joint(f"joint:{name}").qposadr[0] for name in names], dtype=np.int64)


def add_hand(spec: Any, hand: HandModel, protocol: Protocol) -> None:
    """Add the hand's links, joints, actuators and collision primitives. The hand's base is a mocap body."""
    quaternions = quaternion_from_rotation(torch.as_tensor(hand.link_offset_rotation, dtype=torch.float64)).numpy()
    bodies: list[Any] = []
    coupled = {mimic.link: mimic for mimic in hand.mimics}
    for link, name in enumerate(hand.link_names):
        parent = hand.link_parent[link]
        if parent < 0:
            body = spec.worldbody.add_body(name=f"link:{name}", mocap=True)
        else:
            body = bodies[parent].add_body(
                name=f"link:{name}", pos=hand.link_offset_translation[link], quat=quaternions[link]
            )
        bodies.append(body)
        if link in coupled:
            _add_coupled_joint(spec, body, hand, coupled[link], protocol)
        elif hand.link_joint[link] >= 0:
            _add_joint(spec, body, hand, link, protocol)
        body.explicitinertial = True
        body.mass = max(float(hand.link_mass[link]), 1e-3)
        body.ipos = hand.link_com[link]
        body.fullinertia = full_inertia(hand.link_inertia[link], floor=1e-7)
    for index, primitive in enumerate(hand.primitives):
        add_primitive(spec, bodies[primitive.link], primitive, f"hand:{index}", protocol.friction)
    first, second = np.nonzero(np.triu(hand.adjacent, 1))
    for a, b in zip(first, second, strict=True):
        spec.add_exclude(bodyname1=f"link:{hand.link_names[a]}", bodyname2=f"link:{hand.link_names[b]}")


def _add_joint(spec: Any, body: Any, hand: HandModel, link: int, protocol: Protocol) -> None:
    import mujoco

    joint = int(hand.link_joint[link])
    name = f"joint:{hand.joint_names[joint]}"
    body.add_joint(
        name=name,
        **_joint_physics(hand, link, protocol),
        range=[hand.lower[joint], hand.upper[joint]],
        limited=True,
        # Joint limits are as stiff as the time step allows: time constant two steps. MuJoCo's default is five steps.
        solref_limit=[2 * protocol.timestep, 1.0],
    )
    effort = float(hand.effort[joint])
    actuator = spec.add_actuator(name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)
    actuator.set_to_position(kp=protocol.slide_stiffness if hand.slides[joint] else protocol.stiffness)
    actuator.forcelimited = True
    actuator.forcerange = [-effort, effort]


def _add_coupled_joint(spec: Any, body: Any, hand: HandModel, mimic: Mimic, protocol: Protocol) -> None:
    """Add a coupled joint, without actuator or limits. An equality constraint ties the joint to its leader joint."""
    import mujoco

    name = f"joint:{mimic.name}"
    body.add_joint(name=name, limited=False, **_joint_physics(hand, mimic.link, protocol))
    equality = spec.add_equality(
        type=mujoco.mjtEq.mjEQ_JOINT,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        name1=name,
        name2=f"joint:{hand.joint_names[mimic.joint]}",
        # The constraint is as stiff as gears. With a softer constraint, a loaded joint would lag behind its leader.
        solref=[2 * protocol.timestep, 1.0],
        solimp=[0.9999, 0.9999, 1e-3, 0.5, 2.0],
    )
    equality.data[:5] = mimic.offset, mimic.multiplier, 0.0, 0.0, 0.0


def _joint_physics(hand: HandModel, link: int, protocol: Protocol) -> dict[str, Any]:
    """Return the MuJoCo joint settings that actuated and coupled joints share."""
    import mujoco

    slides = hand.joint_kind[link] == "prismatic"
    return {
        "type": mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE,
        "axis": hand.joint_axis[link],
        "damping": protocol.slide_damping if slides else protocol.damping,
        "armature": protocol.armature,
    }
