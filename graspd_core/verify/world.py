"""The world of a trial in MuJoCo: a hand of primitives on a position-controlled base, a free object of convex parts.

A support adds gravity and a table, neighbours add obstacles. They are mocap bodies after the hand's own, so that a
trial can lower them all away from the hand.

Contact and solver settings follow the floating protocol of DexGraspBench (Chen et al., BODex, ICRA 2025), from its
published parameters. Nothing here is differentiable and nothing is shared with the optimiser.
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
# What the hand meets of the support, and what the object rests on.
TABLE, _REST = "the support", "graspd_rest"
_GRAVITY = 9.81

# Sliding, torsional and rolling coefficients.
Friction = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class FreeBody:
    """A body of the scene that is free to move.

    Attributes:
        model: the object, in its own frame.
        parts: its convex parts, likewise [m].
        pose: of its frame in the world [m].
    """

    model: ObjectModel
    parts: tuple[TriangleMesh, ...]
    pose: Float[np.ndarray, "4 4"]


def add_primitive(spec: Any, body: Any, primitive: Primitive, name: str, friction: Friction) -> None:
    """Add a collision solid of the hand. `name` is that of its mesh, if it needs one."""
    import mujoco

    geom = body.add_geom(
        pos=primitive.translation,
        quat=quaternion_from_rotation(torch.as_tensor(primitive.rotation, dtype=torch.float64)).numpy(),
        condim=4,
        friction=friction,
        # The hand's contact softness rules in every contact it takes part in.
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
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=mesh,
            condim=4,
            friction=friction,
            contype=1,
            conaffinity=1,
        )


def add_others(spec: Any, others: Sequence[FreeBody], friction: Friction) -> tuple[str, ...]:
    """Add free bodies about the object. Return the names of their bodies."""
    names = tuple(f"other {index + 1}" for index in range(len(others)))
    for name, other in zip(names, others, strict=True):
        add_object(spec, other.model, other.parts, friction, name=name, pose=other.pose)
    return names


def add_support(spec: Any, hand: HandModel, parts: Sequence[TriangleMesh], friction: Friction, support: Plane) -> None:
    """Add the plane that the hand meets, and one below `parts` on which they rest. Without parts there is one plane."""
    spec.option.gravity = -_GRAVITY * support.normal
    add_plane(spec, TABLE, support, friction)
    for link in hand.link_names:
        # Real hands carry their own weight.
        spec.body(f"link:{link}").gravcomp = 1.0
    if not parts:
        return
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
        # A grown hull that overlaps the object would throw it away.
        spec.add_exclude(bodyname1=name, bodyname2=OBJECT)


def add_mesh(spec: Any, name: str, vertices: np.ndarray, faces: np.ndarray) -> None:
    import mujoco

    mesh = spec.add_mesh(name=name)
    mesh.uservert = np.asarray(vertices, dtype=float).ravel()
    mesh.userface = np.asarray(faces, dtype=np.int32).ravel()
    # Masses are given explicitly, so a part may be as thin as it likes.
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL


def full_inertia(inertia: Float[np.ndarray, "3 3"], floor: float) -> list[float]:
    """Return xx yy zz xy xz yz, with principal moments raised to `floor` and the triangle inequality kept."""
    moments, axes = np.linalg.eigh(0.5 * (inertia + inertia.T))
    moments = np.maximum(moments, floor)
    moments[2] = min(moments[2], 0.999 * (moments[0] + moments[1]))
    m = axes @ np.diag(moments) @ axes.T
    return [m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2]]


# A hand of more solids than this has thousands of contacts with itself and the object, more than MuJoCo's 14 MB hold.
_CROWD, _MEMORY = 100, 2**28


@dataclass(frozen=True)
class Protocol:
    """Physics of a trial. Defaults are the `standard` hold trial.

    Attributes:
        friction: sliding, torsional and rolling coefficients.
        noslip_iterations: iterations of MuJoCo's slip suppression.
        impratio: frictional-to-normal impedance.
        timestep: [s].
        stiffness: position gain of every revolute joint [N·m/rad].
        damping: of every revolute joint [N·m·s/rad].
        slide_stiffness: of every prismatic joint [N/m]: what `stiffness` comes to at the end of a 5 cm link.
        slide_damping: of every prismatic joint, likewise [N·s/m].
        armature: rotor inertia of every joint [kg·m²] or [kg].
        stage_time: duration of pregrasp → grasp and of grasp → squeeze [s].
        hold_time: duration of each pull [s].
        pulls: directions of the pulls, one after another, each from the squeeze on: rows of `hold_trial.DIRECTIONS`.
        pull: force per object mass [N/kg].
        max_displacement: allowed travel of the object's centre of mass [m].
        max_rotation: allowed turn of the object [rad].
        max_start_penetration: deeper starts are refused [m].
        max_grasp_penetration: a grasp posture deeper in the object is refused [m].
        max_self_penetration: a hand deeper in itself is refused, at pregrasp and grasp, and as it was squeezed [m].
        full_length: whether every hold lasts to its end, not only until the answer is known (`early_stop`).
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
    """Return the trial of an object more slippery than the 0.6 of the protocols, with coefficients in proportion.

    A rougher object is tried as the protocol says, so that no grasp passes by friction that nobody measured.
    """
    share = min(friction / Protocol.friction[0], 1.0)
    sliding, torsional, rolling = protocol.friction
    return replace(protocol, friction=(sliding * share, torsional * share, rolling * share))


# Squeeze and protocol of a grasp that held, and MuJoCo's state with the hand closed. So many are kept.
ClosedState = tuple[Posture, Protocol, Float[np.ndarray, "state"]]
_MOST_CLOSED = 32


@dataclass(frozen=True)
class World:
    """A compiled model and where things are in it. The model is never written to after compilation.

    Attributes:
        model: the `mujoco.MjModel`.
        joint_addresses: index into `qpos` of each actuated hand joint, in the hand's order.
        object_address: index into `qpos` of the object's free joint (position, then wxyz).
        object_velocity: index into `qvel` of its free joint.
        object_body: body id of the object.
        center_of_mass: of the object [m].
        hand_geoms: ids of the hand's geoms.
        obstacles: id and name of the geom of every obstacle to the hand.
        up: unit direction against gravity, None without gravity.
        coupled_addresses: index into `qpos` of each coupled joint, in the order of `mimics`.
        mimics: the coupled joints.
        fingers: number of the hand's fingertips.
        others: body ids of the free things about the object.
        spare: the `mujoco.MjData` of trials that ended, for `trial_data`.
        closed: of the last grasps that held: squeeze, protocol and MuJoCo's state with the hand closed, for `payload`.
        watch: called with the `mujoco.MjData` after every step of a trial. None, as in planning, costs nothing.
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
    others: tuple[int, ...] = ()
    spare: deque[Any] = field(default_factory=deque, repr=False, compare=False)
    closed: deque[ClosedState] = field(default_factory=lambda: deque(maxlen=_MOST_CLOSED), repr=False, compare=False)
    watch: Callable[[Any], None] | None = field(default=None, repr=False, compare=False)


def altered(world: World, *, mass: float | None = None, friction: Friction | None = None) -> World:
    """Return the world with an object of another mass [kg], or with another friction of everything."""
    import mujoco

    model, body = copy(world.model), world.object_body
    if friction is not None:
        model.geom_friction[:] = friction
    if mass is not None:
        model.body_inertia[body] *= mass / model.body_mass[body]
        model.body_mass[body] = mass
        # What MuJoCo derives of the masses softens its contacts.
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return replace(world, model=model, spare=deque(), closed=deque(maxlen=_MOST_CLOSED))


@contextmanager
def trial_data(world: World) -> Iterator[Any]:
    """Give the `mujoco.MjData` of one trial, at the model's initial state.

    Safe from any thread: each trial has its own. Data of an ended trial is used again, since it takes about a
    millisecond to make. Data that MuJoCo broke off in is not: its memory may be half in use.
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
    """Simulate `steps` steps, and call the watch hook after each."""
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
    *,
    others: Sequence[FreeBody] | None = None,
) -> World:
    """Compile the world of one hand and one object.

    Args:
        hand: any loaded hand.
        target: gives mass, centre of mass and inertia. It lies near the origin (`near_scene`).
        parts: convex collision parts of the object, object frame [m].
        protocol: physics settings.
        support: a table, with gravity onto it. The hand meets it where it is. The object rests on a plane of its own
            through its lowest point, because a reconstructed bottom hovers or sinks by millimetres.
        obstacles: fixed, as their convex hulls. Those that the object touches already let it pass.
        others: free bodies. If given, even none, the object rests on the support itself.
    """
    import mujoco

    # Otherwise MuJoCo writes a log file into the working directory. The trial reads the counts of warnings itself.
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
        add_support(spec, hand, parts if others is None else (), protocol.friction, support)
    for index, obstacle in enumerate(obstacles):
        fixed.append(f"neighbour {index + 1}")
        add_obstacle(spec, fixed[-1], obstacle, target, protocol.friction)
    free = add_others(spec, others or (), protocol.friction)
    world = _world_of(spec.compile(), hand, target, fixed, None if support is None else support.normal)
    return replace(world, others=tuple(int(world.model.body(name).id) for name in free))


def _world_of(
    model: Any,
    hand: HandModel,
    target: ObjectModel,
    fixed: Sequence[str],
    up: Float[np.ndarray, "3"] | None,
) -> World:
    """Return a compiled model with the addresses that trials need. `fixed` names the geoms of the obstacles."""
    return World(
        model=model,
        joint_addresses=_joint_addresses(model, hand.joint_names),
        object_address=int(model.joint(OBJECT).qposadr[0]),
        object_velocity=int(model.joint(OBJECT).dofadr[0]),
        object_body=int(model.body(OBJECT).id),
        center_of_mass=target.center_of_mass,
        hand_geoms=tuple(i for i in range(model.ngeom) if model.body(model.geom_bodyid[i]).name.startswith("link:")),
        obstacles=tuple((int(model.geom(name).id), name) for name in fixed),
        up=up,
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
    """Add a hand's links, joints, motors and solids. Its base is a mocap body."""
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
        # A joint's stop is as hard as the time step allows (two steps), not MuJoCo's soft default of five.
        solref_limit=[2 * protocol.timestep, 1.0],
    )
    effort = float(hand.effort[joint])
    actuator = spec.add_actuator(name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)
    actuator.set_to_position(kp=protocol.slide_stiffness if hand.slides[joint] else protocol.stiffness)
    actuator.forcelimited = True
    actuator.forcerange = [-effort, effort]


def _add_coupled_joint(spec: Any, body: Any, hand: HandModel, mimic: Mimic, protocol: Protocol) -> None:
    """Add a joint without motor or stops, held to its leader by an equality: loads on it reach the motor."""
    import mujoco

    name = f"joint:{mimic.name}"
    body.add_joint(name=name, limited=False, **_joint_physics(hand, mimic.link, protocol))
    equality = spec.add_equality(
        type=mujoco.mjtEq.mjEQ_JOINT,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        name1=name,
        name2=f"joint:{hand.joint_names[mimic.joint]}",
        # As stiff as gears: two time steps and hardly any softness, or a loaded finger would lag behind its leader.
        solref=[2 * protocol.timestep, 1.0],
        solimp=[0.9999, 0.9999, 1e-3, 0.5, 2.0],
    )
    equality.data[:5] = mimic.offset, mimic.multiplier, 0.0, 0.0, 0.0


def _joint_physics(hand: HandModel, link: int, protocol: Protocol) -> dict[str, Any]:
    """Return what joints with and without a motor share."""
    import mujoco

    slides = hand.joint_kind[link] == "prismatic"
    return {
        "type": mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE,
        "axis": hand.joint_axis[link],
        "damping": protocol.slide_damping if slides else protocol.damping,
        "armature": protocol.armature,
    }
