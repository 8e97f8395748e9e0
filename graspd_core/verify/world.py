"""The judge's world: a hand of primitives on a position-controlled base, and a free object of convex parts.

With a support there are gravity and a table, with neighbours there are these; without, neither costs anything. They are
mocap bodies after the hand's own, so that a trial can lower them all away from the hand.

Contact and solver settings follow the floating protocol of DexGraspBench (Chen et al., BODex, ICRA 2025), from its
published parameters. Nothing here is differentiable and nothing is shared with the optimiser.
"""

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.geometry.mesh import surface_samples
from graspd_core.geometry.scene import Neighbour, ObjectModel
from graspd_core.geometry.sdf import sample_sdf
from graspd_core.hands.model import HandModel
from graspd_core.se3 import quaternion_from_rotation
from graspd_core.types import Plane, TriangleMesh

_OBJECT = "graspd_object"
# What the hand meets of the support, and what the object rests on.
_TABLE, _REST = "the support", "graspd_rest"
_GRAVITY = 9.81
_GEOM_OF_KIND = {kind: f"mjGEOM_{kind.upper()}" for kind in ("box", "sphere", "capsule", "cylinder")}


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
        slide_stiffness: of every prismatic joint [N/m]: what `stiffness` comes to at the end of a 10 cm link.
        slide_damping: of every prismatic joint, likewise [N·s/m].
        armature: rotor inertia of every joint [kg·m²] or [kg].
        stage_time: duration of pregrasp → grasp and of grasp → squeeze [s].
        hold_time: duration of each of the six pulls [s].
        pull: force per object mass [N/kg].
        max_displacement: allowed travel of the object's centre of mass [m].
        max_rotation: allowed turn of the object [rad].
        max_start_penetration: deeper starts are refused [m].
    """

    friction: tuple[float, float, float] = (0.6, 0.02, 1e-4)
    noslip_iterations: int = 2
    impratio: float = 10.0
    timestep: float = 0.004
    stiffness: float = 5.0
    damping: float = 0.1
    slide_stiffness: float = 500.0
    slide_damping: float = 10.0
    armature: float = 1e-4
    stage_time: float = 0.4
    hold_time: float = 2.0
    pull: float = 10.0
    max_displacement: float = 0.05
    max_rotation: float = float(np.deg2rad(15.0))
    max_start_penetration: float = 0.01


PROTOCOLS: dict[str, Protocol] = {
    "standard": Protocol(),
    "hard": Protocol(friction=(0.3, 0.002, 1e-4), noslip_iterations=0, impratio=1.0),
}


@dataclass(frozen=True)
class World:
    """A compiled model and where things are in it. The model is never written to after compilation.

    Attributes:
        model: the `mujoco.MjModel`.
        joint_addresses: index into `qpos` of each hand joint, in the hand's order.
        object_address: index into `qpos` of the object's free joint (position, then wxyz).
        object_velocity: index into `qvel` of its free joint.
        object_body: body id of the object.
        center_of_mass: of the object, in its own frame [m].
        hand_geoms: ids of the hand's geoms.
        obstacles: id and name of the geom of every obstacle to the hand.
        up: unit direction against gravity; None where there is none.
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


def build_world(
    hand: HandModel,
    target: ObjectModel,
    parts: Sequence[TriangleMesh],
    protocol: Protocol,
    support: Plane | None = None,
    neighbours: Sequence[Neighbour] = (),
) -> World:
    """Compile the world of one hand and one object.

    Args:
        hand: any loaded hand.
        target: gives mass, centre of mass and inertia.
        parts: convex collision parts of the object, object frame [m].
        protocol: physics settings.
        support: a table, with gravity onto it. The hand meets it where it is; the object rests on a plane of its own
            through its lowest point, because a reconstructed bottom hovers or sinks by millimetres.
        neighbours: fixed, as their convex hulls. Those that the object touches already let it pass.
    """
    import mujoco

    # Or MuJoCo writes a log file into the working directory; the trial reads the counts of warnings itself.
    mujoco.set_mju_user_warning(_ignore)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    option = spec.option
    option.timestep = protocol.timestep
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = protocol.impratio
    option.noslip_iterations = protocol.noslip_iterations
    option.gravity = [0.0, 0.0, 0.0]
    # Several contact points between flat faces: on one point each, a box between two plates rolls out. Later versions
    # of MuJoCo have no such switch, because it is always on.
    option.enableflags |= int(getattr(mujoco.mjtEnableBit, "mjENBL_MULTICCD", 0))
    _add_hand(spec, hand, protocol)
    _add_object(spec, target, parts, protocol)
    obstacles = [_TABLE] if support is not None else []
    if support is not None:
        _add_support(spec, hand, parts, protocol, support)
    for index, neighbour in enumerate(neighbours):
        obstacles.append(f"neighbour {index + 1}")
        _add_neighbour(spec, obstacles[-1], neighbour, target, protocol)
    model = spec.compile()
    addresses = [model.joint(f"joint:{name}").qposadr[0] for name in hand.joint_names]
    return World(
        model=model,
        joint_addresses=np.array(addresses),
        object_address=int(model.joint(_OBJECT).qposadr[0]),
        object_velocity=int(model.joint(_OBJECT).dofadr[0]),
        object_body=int(model.body(_OBJECT).id),
        center_of_mass=target.center_of_mass,
        hand_geoms=tuple(i for i in range(model.ngeom) if model.body(model.geom_bodyid[i]).name.startswith("link:")),
        obstacles=tuple((int(model.geom(name).id), name) for name in obstacles),
        up=None if support is None else support.normal,
    )


def _ignore(message: str) -> None:
    del message


def _add_hand(spec: Any, hand: HandModel, protocol: Protocol) -> None:
    import mujoco

    quaternions = quaternion_from_rotation(torch.as_tensor(hand.link_offset_rotation, dtype=torch.float64)).numpy()
    bodies: list[Any] = []
    for link, name in enumerate(hand.link_names):
        parent = hand.link_parent[link]
        if parent < 0:
            body = spec.worldbody.add_body(name=f"link:{name}", mocap=True)
        else:
            body = bodies[parent].add_body(
                name=f"link:{name}", pos=hand.link_offset_translation[link], quat=quaternions[link]
            )
        bodies.append(body)
        joint = int(hand.link_joint[link])
        if joint >= 0:
            _add_joint(spec, body, hand, link, joint, protocol)
        body.explicitinertial = True
        body.mass = max(float(hand.link_mass[link]), 1e-3)
        body.ipos = hand.link_com[link]
        body.fullinertia = _full_inertia(hand.link_inertia[link], floor=1e-7)
    for index, primitive in enumerate(hand.primitives):
        geom = bodies[primitive.link].add_geom(
            pos=primitive.translation,
            quat=quaternion_from_rotation(torch.as_tensor(primitive.rotation, dtype=torch.float64)).numpy(),
            condim=4,
            friction=protocol.friction,
            # The hand's contact softness rules in every contact it takes part in.
            priority=1,
            solref=[0.005, 1.0],
            solimp=[0.5, 0.99, 1e-4, 0.5, 2.0],
        )
        if primitive.kind == "hull":
            geom.type = mujoco.mjtGeom.mjGEOM_MESH
            geom.meshname = f"hand:{index}"
            _add_mesh(spec, geom.meshname, primitive.vertices, primitive.faces)
        else:
            geom.type = getattr(mujoco.mjtGeom, _GEOM_OF_KIND[primitive.kind])
            geom.size = np.resize(np.append(primitive.size, [0.0, 0.0]), 3)
    first, second = np.nonzero(np.triu(hand.adjacent, 1))
    for a, b in zip(first, second, strict=True):
        spec.add_exclude(bodyname1=f"link:{hand.link_names[a]}", bodyname2=f"link:{hand.link_names[b]}")


def _add_joint(spec: Any, body: Any, hand: HandModel, link: int, joint: int, protocol: Protocol) -> None:
    import mujoco

    name = f"joint:{hand.joint_names[joint]}"
    slides = hand.joint_kind[link] == "prismatic"
    body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE,
        axis=hand.joint_axis[link],
        range=[hand.lower[joint], hand.upper[joint]],
        limited=True,
        damping=protocol.slide_damping if slides else protocol.damping,
        armature=protocol.armature,
        # A joint's stop is as hard as the time step allows (two steps), not MuJoCo's soft default of five.
        solref_limit=[2 * protocol.timestep, 1.0],
    )
    effort = float(hand.effort[joint])
    actuator = spec.add_actuator(name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)
    actuator.set_to_position(kp=protocol.slide_stiffness if slides else protocol.stiffness)
    actuator.forcelimited = True
    actuator.forcerange = [-effort, effort]


def _add_object(spec: Any, target: ObjectModel, parts: Sequence[TriangleMesh], protocol: Protocol) -> None:
    import mujoco

    body = spec.worldbody.add_body(name=_OBJECT)
    body.add_freejoint(name=_OBJECT)
    body.explicitinertial = True
    body.mass = target.mass
    body.ipos = target.center_of_mass
    body.fullinertia = _full_inertia(target.inertia, floor=1e-9)
    for index, part in enumerate(parts):
        name = f"part:{index}"
        _add_mesh(spec, name, part.vertices, part.faces)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=name,
            condim=4,
            friction=protocol.friction,
            contype=1,
            conaffinity=1,
        )


def _add_support(spec: Any, hand: HandModel, parts: Sequence[TriangleMesh], protocol: Protocol, support: Plane) -> None:
    import mujoco

    spec.option.gravity = -_GRAVITY * support.normal
    lowest = min(float((part.vertices @ support.normal).min()) for part in parts)
    for name, height in ((_TABLE, support.offset), (_REST, lowest)):
        body = spec.worldbody.add_body(name=name, mocap=True)
        body.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[0.0, 0.0, 1.0],
            pos=height * support.normal,
            quat=_turn_z_to(support.normal),
            condim=4,
            friction=protocol.friction,
        )
    spec.add_exclude(bodyname1=_TABLE, bodyname2=_OBJECT)
    for link in hand.link_names:
        # Real hands carry their own weight.
        spec.body(f"link:{link}").gravcomp = 1.0
        spec.add_exclude(bodyname1=_REST, bodyname2=f"link:{link}")


def _turn_z_to(normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4"]:
    """The shortest rotation of z onto a unit vector, wxyz."""
    quaternion = np.array([1.0 + normal[2], -normal[1], normal[0], 0.0])
    length = np.linalg.norm(quaternion)
    return quaternion / length if length > 1e-6 else np.array([0.0, 1.0, 0.0, 0.0])


def _add_neighbour(spec: Any, name: str, neighbour: Neighbour, target: ObjectModel, protocol: Protocol) -> None:
    import mujoco

    body = spec.worldbody.add_body(name=name, mocap=True)
    _add_mesh(spec, name, neighbour.mesh.vertices, neighbour.mesh.faces)
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, condim=4, friction=protocol.friction)
    surface = torch.as_tensor(surface_samples(target.mesh, 1000, 0)[0]).to(neighbour.sdf.field)
    if bool((sample_sdf(neighbour.sdf, surface)[0] < 0).any()):
        # A grown hull that overlaps the object would throw it away.
        spec.add_exclude(bodyname1=name, bodyname2=_OBJECT)


def _add_mesh(spec: Any, name: str, vertices: np.ndarray, faces: np.ndarray) -> None:
    import mujoco

    mesh = spec.add_mesh(name=name)
    mesh.uservert = np.asarray(vertices, dtype=float).ravel()
    mesh.userface = np.asarray(faces, dtype=np.int32).ravel()
    # Masses are given explicitly, so a part may be as thin as it likes.
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL


def _full_inertia(inertia: Float[np.ndarray, "3 3"], floor: float) -> list[float]:
    """MuJoCo's order xx yy zz xy xz yz, with principal moments raised to `floor` and the triangle inequality kept."""
    moments, axes = np.linalg.eigh(0.5 * (inertia + inertia.T))
    moments = np.maximum(moments, floor)
    moments[2] = min(moments[2], 0.999 * (moments[0] + moments[1]))
    m = axes @ np.diag(moments) @ axes.T
    return [m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2]]
