"""URDF of arm and hand as one robot, and its frames for /tf.

Frames of the arm keep their names. Frame names of the hand begin with `hand_`, because both have a base link.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from graspd_bench.bullet.bullet_world import roll_pitch_yaw
from graspd_cell.world import CellWorld, Pose
from graspd_core.arms.arm import Arm, tip_hand
from graspd_core.hands.model import HandModel
from graspd_core.hands.readers.urdf import below_link
from graspd_core.hands.readers.xml_io import read_xml

CAMERA_FRAME, HAND_PREFIX = "camera_depth_optical_frame", "hand_"


def robot_description(arm: Arm, hand: HandModel) -> str:
    """Return the URDF of the arm with the hand mounted. A hand without a URDF is omitted.

    Names of the hand's links begin with `hand_`. Joints keep their names.
    """
    root = _with_addresses(Path(arm.chain.urdf))
    root.set("name", f"{arm.name}_{hand.name}")
    path = Path(hand.urdf)
    if path.suffix == ".pkl" or (own := _with_addresses(path)).tag != "robot":
        return ET.tostring(root, encoding="unicode")
    # Links above the hand's base have no place below the arm's tip.
    below_link(path, own, hand.base_link)
    for link in own.iter("link"):
        if link.get("name"):
            link.set("name", HAND_PREFIX + str(link.get("name")))
    for joint in own.findall("joint"):
        for end in joint.findall("parent") + joint.findall("child"):
            end.set("link", HAND_PREFIX + str(end.get("link")))
    for element in own:
        if element.tag in ("link", "joint", "material"):
            root.append(element)
    mount, turn = ET.SubElement(root, "joint", name=f"{HAND_PREFIX}mount", type="fixed"), tip_hand(arm, hand)
    (x, y, z), (roll, pitch, yaw) = turn.translation.tolist(), roll_pitch_yaw(turn.rotation.numpy())
    ET.SubElement(mount, "parent", link=arm.chain.link_names[arm.tip])
    ET.SubElement(mount, "child", link=HAND_PREFIX + hand.base_link)
    ET.SubElement(mount, "origin", xyz=f"{x:.9g} {y:.9g} {z:.9g}", rpy=f"{roll:.9g} {pitch:.9g} {yaw:.9g}")
    return ET.tostring(root, encoding="unicode")


def _with_addresses(path: Path) -> ET.Element:
    """Return a file's XML, in which relative paths of mesh files are replaced by absolute file:// addresses."""
    root = read_xml(path)
    for mesh in root.iter("mesh"):
        name = mesh.get("filename")
        if name and "://" not in name:
            mesh.set("filename", (path.parent / name).resolve().as_uri())
    return root


def frames_of(world: CellWorld, poses: Mapping[str, Pose]) -> list[tuple[str, str, Pose]]:
    """Return parent, child and `T_parent_child` [m] for each link except the arm's base.

    Args:
        world: the cell.
        poses: link poses in the base frame, from `SimulatedRobot.link_poses`.
    """
    arm, hand, found = world.arm, world.hand, []
    for prefix, key, robot in (("", "", arm.chain), (HAND_PREFIX, "hand/", hand)):
        for link, name in enumerate(robot.link_names):
            parent = robot.link_parent[link]
            if parent >= 0:
                above, pose = f"{prefix}{robot.link_names[parent]}", poses[f"{key}{robot.link_names[parent]}"]
            elif key:
                above = arm.chain.link_names[arm.tip]
                pose = poses[above]
            else:
                continue
            found.append((above, f"{prefix}{name}", np.linalg.inv(pose) @ poses[f"{key}{name}"]))
    return found
