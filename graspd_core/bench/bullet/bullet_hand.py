"""A hand as PyBullet takes it: a URDF of its links, joints and collision solids, written out and loaded.

Written from the hand's model instead of loading the hand's own file, so that both simulators see the same solids,
the same masses and the same joint frames.
"""

# pybullet is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false

from __future__ import annotations

import tempfile
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from jaxtyping import Float

from graspd_core.bench.bullet.bullet_world import wavefront
from graspd_core.errors import SimulatorError
from graspd_core.hands.model import HandModel, Primitive
from graspd_core.types import TriangleMesh

# As in the MuJoCo world: links without a mass get one [kg], and no moment is smaller than this [kg·m²].
_LEAST_MASS, _LEAST_MOMENT = 1e-3, 1e-7


def load_hand_urdf(client: int, hand: HandModel, armature: float) -> tuple[int, tuple[int, ...]]:
    """Put a hand with its base fixed into a simulation; returns its body and the number of each actuated joint.

    Args:
        client: PyBullet's client.
        hand: without coupled joints.
        armature: rotor inertia of every joint [kg·m²]; Bullet has none, so that the moved link carries it.

    Raises:
        SimulatorError: the hand has coupled joints.
    """
    import pybullet

    if hand.mimics:
        names = ", ".join(mimic.name for mimic in hand.mimics)
        raise SimulatorError(
            f"{hand.name}: the second simulator knows no coupled joints ({names}); valid: hands without"
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
    """The URDF text; links and joints are numbered, hulls are files named hull<number of the primitive>.obj."""
    robot = ET.Element("robot", name=hand.name)
    for link in range(hand.num_links):
        element = ET.SubElement(robot, "link", name=f"link{link}")
        _add_inertia(element, hand, link, armature if hand.link_joint[link] >= 0 else 0.0)
        for index, primitive in enumerate(hand.primitives):
            if primitive.link == link:
                _add_collision(element, index, primitive)
        if hand.link_parent[link] >= 0:
            _add_joint(robot, hand, link)
    # Bullet breaks lines that are longer than some kilobytes.
    ET.indent(robot)
    return ET.tostring(robot, encoding="unicode")


def _add_inertia(element: ET.Element, hand: HandModel, link: int, armature: float) -> None:
    inertial = ET.SubElement(element, "inertial")
    # The base is fixed, and Bullet counts poses from its centre of mass: put that where the base frame is.
    ET.SubElement(inertial, "origin", xyz=_text(hand.link_com[link] if link else np.zeros(3)))
    ET.SubElement(inertial, "mass", value=str(max(float(hand.link_mass[link]), _LEAST_MASS)))
    moments, axes = np.linalg.eigh(0.5 * (hand.link_inertia[link] + hand.link_inertia[link].T))
    tensor = axes @ np.diag(np.maximum(moments, _LEAST_MOMENT) + armature) @ axes.T
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
        # Efforts are the trial's affair; Bullet refuses an infinite one.
        limits = {"lower": hand.lower[joint], "upper": hand.upper[joint], "effort": 1e3, "velocity": 1e3}
        ET.SubElement(element, "limit", {key: repr(float(value)) for key, value in limits.items()})


def roll_pitch_yaw(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """URDF's angles [rad] of a rotation: R = Rz(yaw) Ry(pitch) Rx(roll); where pitch is ±90°, roll is zero."""
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    if np.hypot(rotation[0, 0], rotation[1, 0]) < 1e-9:
        return np.array([0.0, pitch, np.arctan2(-rotation[0, 1], rotation[1, 1])])
    return np.array([np.arctan2(rotation[2, 1], rotation[2, 2]), pitch, np.arctan2(rotation[1, 0], rotation[0, 0])])


def _text(values: Float[np.ndarray, "n"]) -> str:
    return " ".join(repr(float(value)) for value in values)
