"""Hand and object in PyBullet, the second simulator, and the displacement trial.

The URDF of the hand is written from the HandModel and not read from the hand's own file. So MuJoCo and PyBullet use the
same collision shapes, masses and joint frames. The object consists of convex parts.

A BulletWorld is plain data, from which every trial builds its own simulation. Bullet keeps contacts and solver state
between trials. In a shared simulation, a result would depend on earlier trials.
"""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import torch
from jaxtyping import Float

from graspd_bench.trials import FRICTION, GRAVITY, MASS, STEPS, TIMESTEP
from graspd_core.errors import SimulatorError
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.model import HandModel, Primitive
from graspd_core.perception.scene import ObjectModel
from graspd_core.se3 import quaternion_from_rotation, rotation_from_quaternion
from graspd_core.types import Posture, TriangleMesh
from graspd_core.verify.hold_trial import DIRECTIONS

# pybullet is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false


# Least mass [kg] and least moment of inertia [kg·m²] of a link, equal to those of the MuJoCo world.
_LEAST_MASS, _LEAST_LINK_MOMENT = 1e-3, 1e-7


def load_hand_urdf(client: int, hand: HandModel, armature: float) -> tuple[int, tuple[int, ...]]:
    """Load a hand with a fixed base. Return its body id and the joint ids of the actuated joints.

    Args:
        client: id of the PyBullet client.
        hand: a hand without coupled joints.
        armature: rotor inertia of every joint [kg·m²]. Bullet has no rotors, so the moved link gets this inertia.

    Raises:
        SimulatorError: the hand has coupled joints.
    """
    import pybullet

    if hand.mimics:
        names = ", ".join(mimic.name for mimic in hand.mimics)
        raise SimulatorError(
            f"{hand.name}: PyBullet does not support its coupled joints ({names}); valid: hands without coupled joints"
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "hand.urdf")
        path.write_text(hand_urdf(hand, armature))
        for index, primitive in enumerate(hand.primitives):
            if primitive.kind == "hull":
                Path(folder, f"hull{index}.obj").write_text(
                    wavefront([TriangleMesh(primitive.vertices, primitive.faces)])
                )
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE | pybullet.URDF_USE_SELF_COLLISION
        flags |= pybullet.URDF_USE_IMPLICIT_CYLINDER
        body = pybullet.loadURDF(str(path), useFixedBase=True, flags=flags, physicsClientId=client)
    numbers = {"base": -1}
    joints = {}
    for index in range(pybullet.getNumJoints(body, physicsClientId=client)):
        info = pybullet.getJointInfo(body, index, physicsClientId=client)
        joints[info[1].decode()], numbers[info[12].decode()] = index, index
    for first, second in zip(*np.nonzero(np.triu(hand.adjacent, 1)), strict=True):
        a, b = (-1 if link == 0 else numbers[f"link{link}"] for link in (first, second))
        pybullet.setCollisionFilterPair(body, body, a, b, 0, physicsClientId=client)
    moved_by = {int(joint): link for link, joint in enumerate(hand.link_joint) if joint >= 0}
    return body, tuple(joints[f"joint{moved_by[joint]}"] for joint in range(hand.num_joints))


def hand_urdf(hand: HandModel, armature: float) -> str:
    """Return the hand's URDF with names link<i>, joint<i>, hull<i>.obj. Moved links get inertia `armature` [kg·m²]."""
    robot = ET.Element("robot", name=hand.name)
    for link in range(hand.num_links):
        element = ET.SubElement(robot, "link", name=f"link{link}")
        _add_inertia(element, hand, link, armature if hand.link_joint[link] >= 0 else 0.0)
        for index, primitive in enumerate(hand.primitives):
            if primitive.link == link:
                _add_collision(element, index, primitive)
        if hand.link_parent[link] >= 0:
            _add_joint(robot, hand, link)
    # Indentation keeps lines short, because Bullet breaks lines longer than a few kilobytes.
    ET.indent(robot)
    return ET.tostring(robot, encoding="unicode")


def _add_inertia(element: ET.Element, hand: HandModel, link: int, armature: float) -> None:
    inertial = ET.SubElement(element, "inertial")
    # Bullet measures a body's pose at its centre of mass, so the base link's centre of mass is put at the base frame.
    ET.SubElement(inertial, "origin", xyz=_text(hand.link_com[link] if link else np.zeros(3)))
    ET.SubElement(inertial, "mass", value=str(max(float(hand.link_mass[link]), _LEAST_MASS)))
    moments, axes = np.linalg.eigh(0.5 * (hand.link_inertia[link] + hand.link_inertia[link].T))
    tensor = axes @ np.diag(np.maximum(moments, _LEAST_LINK_MOMENT) + armature) @ axes.T
    keys = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    ET.SubElement(inertial, "inertia", {key: repr(float(tensor[at])) for key, at in keys.items()})


def _add_collision(element: ET.Element, index: int, primitive: Primitive) -> None:
    collision = ET.SubElement(element, "collision")
    ET.SubElement(collision, "origin", xyz=_text(primitive.translation), rpy=_text(roll_pitch_yaw(primitive.rotation)))
    geometry, size = ET.SubElement(collision, "geometry"), primitive.size
    if primitive.kind == "box":
        ET.SubElement(geometry, "box", size=_text(2 * np.array(size)))
    elif primitive.kind == "sphere":
        ET.SubElement(geometry, "sphere", radius=str(size[0]))
    elif primitive.kind == "hull":
        ET.SubElement(geometry, "mesh", filename=f"hull{index}.obj")
    else:
        ET.SubElement(geometry, primitive.kind, radius=str(size[0]), length=str(2 * size[1]))


def _add_joint(robot: ET.Element, hand: HandModel, link: int) -> None:
    joint = int(hand.link_joint[link])
    element = ET.SubElement(robot, "joint", name=f"joint{link}", type=hand.joint_kind[link])
    ET.SubElement(element, "parent", link=f"link{hand.link_parent[link]}")
    ET.SubElement(element, "child", link=f"link{link}")
    rpy = roll_pitch_yaw(hand.link_offset_rotation[link])
    ET.SubElement(element, "origin", xyz=_text(hand.link_offset_translation[link]), rpy=_text(rpy))
    if joint >= 0:
        ET.SubElement(element, "axis", xyz=_text(hand.joint_axis[link]))
        # The trial itself limits the efforts. Bullet does not accept infinite values.
        limits = {"lower": hand.lower[joint], "upper": hand.upper[joint], "effort": 1e3, "velocity": 1e3}
        ET.SubElement(element, "limit", {key: repr(float(value)) for key, value in limits.items()})


def roll_pitch_yaw(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Return URDF's roll, pitch and yaw [rad] of R = Rz(yaw) Ry(pitch) Rx(roll). If pitch is ±90°, roll is zero."""
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    if np.hypot(rotation[0, 0], rotation[1, 0]) < 1e-9:
        return np.array([0.0, pitch, np.arctan2(-rotation[0, 1], rotation[1, 1])])
    return np.array([np.arctan2(rotation[2, 1], rotation[2, 2]), pitch, np.arctan2(rotation[1, 0], rotation[0, 0])])


def _text(values: Float[np.ndarray, "n"]) -> str:
    return " ".join(repr(float(value)) for value in values)


# Least principal moment of an object per kilogram [m²]: the moment of a ball of 0.5 mm radius.
_LEAST_MOMENT = 1e-7
# Settings of the displacement trial.
SOLVER_ITERATIONS = 150
HAND_RESTITUTION, OBJECT_RESTITUTION = 0.0, 0.5
# The only gravity direction of the papers, object frame. It is arbitrary, because a mesh's orientation is arbitrary.
OBMAN = np.array([[0.0, 1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class BulletWorld:
    """One hand and one object, ready for trials in PyBullet. It is plain data, so that processes can share it.

    Attributes:
        hand: the hand.
        parts: text of an OBJ file with the convex parts [m], relative to centre of mass and principal axes.
        mass: mass of the object [kg].
        center_of_mass: centre of mass in the object frame [m].
        axes: principal axes of inertia, the rotation `R_object_principal`.
        moments: principal moments of inertia per kilogram [m²].
    """

    hand: HandModel
    parts: str
    mass: float
    center_of_mass: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    moments: Float[np.ndarray, "3"]


def bullet_available() -> bool:
    """Return whether PyBullet is installed. It has no wheel for Python 3.12."""
    return importlib.util.find_spec("pybullet") is not None


def build_bullet_world(hand: HandModel, target: ObjectModel, parts: Sequence[TriangleMesh]) -> BulletWorld:
    """Prepare trials of one hand and one object.

    Args:
        hand: the hand.
        target: the object, which gives mass, centre of mass and inertia.
        parts: convex collision parts of the object, object frame [m].

    Raises:
        SimulatorError: PyBullet is not installed.
    """
    if not bullet_available():
        raise SimulatorError(
            "pybullet is not installed: the displacement trial and the second simulator need it; "
            "valid: Python 3.11 with pip install -e '.[bench]' (there is no wheel for 3.12)"
        )
    inertia = 0.5 * (target.inertia + target.inertia.T) / target.mass
    moments, axes = np.diag(inertia), np.eye(3)
    # If the tensor is diagonal, keep the axes of the object frame. For equal moments `eigh` could return any axes.
    if np.any(inertia != np.diag(moments)):
        moments, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return BulletWorld(
        hand=hand,
        parts=wavefront([TriangleMesh((part.vertices - target.center_of_mass) @ axes, part.faces) for part in parts]),
        mass=target.mass,
        center_of_mass=target.center_of_mass,
        axes=axes,
        moments=np.maximum(moments, _LEAST_MOMENT),
    )


@contextmanager
def simulation(*, timestep: float, solver_iterations: int) -> Iterator[int]:
    """Open an empty simulation without gravity. Yield the id of its PyBullet client.

    Args:
        timestep: time step [s].
        solver_iterations: limit of solver iterations per step.
    """
    import pybullet

    client = pybullet.connect(pybullet.DIRECT)
    try:
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=timestep,
            numSolverIterations=solver_iterations,
            enableFileCaching=0,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        yield client
    finally:
        pybullet.disconnect(client)


def add_object(client: int, world: BulletWorld, mass: float) -> int:
    """Add the object with a given mass [kg] so that the object frame is the world frame. Return its body id.

    Bullet puts the origin of a body at its centre of mass. Collision margin and damping are PyBullet's defaults: 1 mm
    around convex parts, and 4 % per second.
    """
    import pybullet

    # Bullet reads the file a second time for the visual shape.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "parts.obj")
        path.write_text(world.parts)
        body = pybullet.createMultiBody(
            baseMass=mass,
            baseCollisionShapeIndex=pybullet.createCollisionShape(
                pybullet.GEOM_MESH, fileName=str(path), physicsClientId=client
            ),
            basePosition=world.center_of_mass.tolist(),
            baseOrientation=xyzw(world.axes),
            physicsClientId=client,
        )
    pybullet.changeDynamics(body, -1, localInertiaDiagonal=(mass * world.moments).tolist(), physicsClientId=client)
    return body


def add_frozen_hand(client: int, hand: HandModel, posture: Posture) -> tuple[int, ...]:
    """Add each collision primitive of the hand in `posture` as a fixed body of its own. Return the body ids."""
    import pybullet

    rotations, translations = link_poses(hand, posture.joint_positions)
    base = rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz, dtype=torch.float64)).numpy()
    bodies = []
    for primitive in hand.primitives:
        link = base @ rotations[primitive.link]
        origin = base @ translations[primitive.link] + posture.position
        bodies.append(
            pybullet.createMultiBody(
                baseMass=0.0,
                baseCollisionShapeIndex=_collision_shape(client, primitive),
                basePosition=(link @ primitive.translation + origin).tolist(),
                baseOrientation=xyzw(link @ primitive.rotation),
                physicsClientId=client,
            )
        )
    return tuple(bodies)


def _collision_shape(client: int, primitive: Primitive) -> int:
    import pybullet

    size = primitive.size
    if primitive.kind == "box":
        shape = {"shapeType": pybullet.GEOM_BOX, "halfExtents": list(size)}
    elif primitive.kind == "sphere":
        shape = {"shapeType": pybullet.GEOM_SPHERE, "radius": size[0]}
    elif primitive.kind == "hull":
        shape = {"shapeType": pybullet.GEOM_MESH, "vertices": primitive.vertices.tolist()}
    else:
        kind = pybullet.GEOM_CAPSULE if primitive.kind == "capsule" else pybullet.GEOM_CYLINDER
        shape = {"shapeType": kind, "radius": size[0], "height": 2 * size[1]}
    return pybullet.createCollisionShape(**shape, physicsClientId=client)


def wavefront(parts: Sequence[TriangleMesh]) -> str:
    """Return the text of an OBJ file with one object per mesh. PyBullet makes a convex hull of each."""
    lines, first = [], 1
    for index, part in enumerate(parts):
        lines.append(f"o part{index}")
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in part.vertices.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (part.faces + first).tolist()]
        first += len(part.vertices)
    return "\n".join(lines) + "\n"


def xyzw(rotation: Float[np.ndarray, "3 3"]) -> list[float]:
    """Convert a rotation matrix to a quaternion in PyBullet's order: x, y, z, w."""
    w, x, y, z = quaternion_from_rotation(torch.as_tensor(np.ascontiguousarray(rotation))).tolist()
    return [x, y, z, w]


def bullet_displacement(
    world: BulletWorld, posture: Posture, *, directions: Float[np.ndarray, "directions 3"] = DIRECTIONS
) -> float:
    """Return how far gravity moves the object's centre of mass in 35 steps of 1/240 s [m], mean over directions.

    The hand is frozen in its grasp. The trial is ObMan's (Hasson et al., CVPR 2019), which many papers report. It is
    written anew from the published parameters. docs/metrics.md lists the deviations. An object in free fall moves 10.7
    cm, so a result near 10.7 cm only says that the hand does not hold.
    """
    return float(displacements(world, posture, directions).mean())


def displacements(
    world: BulletWorld, posture: Posture, directions: Float[np.ndarray, "directions 3"]
) -> Float[np.ndarray, "directions"]:
    """Return how far gravity along each direction moves the object [m]. Directions are unit vectors, object frame."""
    import pybullet

    moved = np.empty(len(directions))
    with simulation(timestep=TIMESTEP, solver_iterations=SOLVER_ITERATIONS) as client:
        body = add_object(client, world, MASS)
        pybullet.changeDynamics(
            body, -1, lateralFriction=FRICTION, restitution=OBJECT_RESTITUTION, physicsClientId=client
        )
        for fixed in add_frozen_hand(client, world.hand, posture):
            pybullet.changeDynamics(
                fixed, -1, lateralFriction=FRICTION, restitution=HAND_RESTITUTION, physicsClientId=client
            )
        start = pybullet.saveState(physicsClientId=client)
        for index, direction in enumerate(directions):
            pybullet.restoreState(start, physicsClientId=client)
            pybullet.setGravity(*(GRAVITY * direction).tolist(), physicsClientId=client)
            for _ in range(STEPS):
                pybullet.stepSimulation(physicsClientId=client)
            position, _ = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
            moved[index] = np.linalg.norm(np.array(position) - world.center_of_mass)
    return moved
