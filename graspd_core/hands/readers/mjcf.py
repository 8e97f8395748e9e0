"""MJCF to `HandModel`: the part of MuJoCo's format that hands are written in, read without MuJoCo.

Read are bodies, hinges and slides (several to a body, with `pos` and `ref`), boxes, spheres, ellipsoids, capsules,
cylinders and meshes, default classes, and joints coupled by a straight line. What would change how the hand moves and
is not read is refused by name. Reference: MuJoCo's XML reference, 3.x.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from graspd_core.hands.model import HandModel, JointKind, Primitive
from graspd_core.hands.readers.build_model import JointSpec, LinkSpec, assemble, refuse_crowds
from graspd_core.hands.readers.link_meshes import corners_each
from graspd_core.hands.readers.mimic import Coupling, resolved_couplings
from graspd_core.hands.readers.mjcf_geoms import read_geom
from graspd_core.hands.readers.mjcf_values import (
    MjcfSettings,
    read_axis,
    read_pose,
    read_range,
    read_settings,
    with_defaults,
)
from graspd_core.hands.readers.xml_io import read_xml, wrong
from graspd_core.hands.readers.xml_values import read_numbers, read_position
from graspd_core.se3 import axis_rotation

_KINDS: dict[str, JointKind] = {"hinge": "revolute", "slide": "prismatic"}
_REFUSED = ("include", "frame", "replicate", "attach", "composite", "flexcomp", "plugin")


@dataclass(eq=False)
class _Parts:
    """What has been read so far."""

    settings: MjcfSettings
    meshes: dict[str, ET.Element]
    links: list[LinkSpec] = field(default_factory=list)
    joints: list[JointSpec] = field(default_factory=list)
    references: dict[str, float] = field(default_factory=dict)
    shown: list[str] = field(default_factory=list)


def read_mjcf(path: Path, root: ET.Element | None = None) -> HandModel:
    """The hand that an MJCF file describes, as `read_urdf` gives one; the base is the one body of the world.

    Raises:
        HandError: the file is malformed, has several bodies in the world, or uses what is not read.
    """
    root = read_xml(path) if root is None else root
    for element in root.iter():
        if element.tag in _REFUSED:
            raise wrong(path, element, f"<{element.tag}> is not read; save the compiled model as one plain MJCF file")
    refuse_crowds(path, *(len(root.findall(f"worldbody//{tag}")) for tag in ("body", "joint", "geom")))
    meshes = sum("mesh" in geom.attrib for geom in root.findall("worldbody//geom"))
    settings = replace(read_settings(path, root), corners=corners_each(meshes))
    parts = _Parts(settings, _mesh_assets(settings, root))
    bodies = root.findall("worldbody/body")
    if len(bodies) != 1:
        names = ", ".join(str(body.get("name")) for body in bodies)
        raise wrong(path, root, f"the world has {len(bodies)} bodies, a hand has one: {names or 'none'}")
    warnings: list[str] = []
    if root.find("worldbody/geom") is not None:
        warnings.append("geoms of the world itself were dropped")
    if _is_free(settings, bodies[0]):
        warnings.append(f"the free joint of the base {bodies[0].get('name')!r} was dropped")
    fixed = _is_free(settings, bodies[0]) or not bodies[0].findall("joint")
    if not fixed:
        parts.links.append(LinkSpec("world"))
    _read_body(parts, bodies[0], None if fixed else "world", "main")
    if root.find("tendon") is not None:
        warnings.append("tendons are not read: joints that they couple move by themselves")
    if parts.shown:
        warnings.append(f"no colliding geom, so the visual ones are taken: {', '.join(parts.shown)}")
    direct = _couplings(parts, root)
    efforts = _efforts(settings, root)
    joints = [replace(j, effort=min(j.effort, efforts.get(j.name, np.inf))) for j in parts.joints]
    name = str(root.get("model") or path.stem)
    return assemble(path, name, parts.links, joints, resolved_couplings(path, direct), tuple(warnings))


def _is_free(settings: MjcfSettings, body: ET.Element) -> bool:
    free = [with_defaults(settings, joint, "main").get("type") == "free" for joint in body.findall("joint")]
    return body.find("freejoint") is not None or any(free)


def _mesh_assets(settings: MjcfSettings, root: ET.Element) -> dict[str, ET.Element]:
    meshes: dict[str, ET.Element] = {}
    for element in root.findall("asset/mesh"):
        whole = with_defaults(settings, element, "main")
        meshes[whole.get("name") or Path(whole.get("file") or "").stem] = whole
    return meshes


def _read_body(parts: _Parts, body: ET.Element, parent: str | None, above: str) -> None:
    """Append a body's link and joints, then those of the bodies in it; `above` is the class that it inherits."""
    settings = parts.settings
    child_class = body.get("childclass", above)
    name = body.get("name") or f"body_{len(parts.links)}"
    primitives = _primitives(parts, body, child_class, name)
    link = LinkSpec(name, *_inertial(settings, body), tuple(primitives))
    if parent is not None:
        rotation, translation = read_pose(settings, body)
        joints = [with_defaults(settings, joint, child_class) for joint in body.findall("joint")]
        for number, joint in enumerate(joints):
            label = joint.get("name") or f"{name}_joint{number}"
            offset = read_position(settings.path, joint, "pos")
            last = number == len(joints) - 1 and not offset.any()
            # A joint beside the body's origin, or one of several, moves a link of its own that the body is welded to.
            child = name if last else f"{name}:{label}"
            spec = _joint(parts, joint, label, parent, child, rotation, translation + rotation @ offset)
            parts.joints.append(spec)
            if last:
                rotation = None
                break
            parts.links.append(LinkSpec(child))
            parent, rotation, translation = child, np.eye(3), -offset
        if rotation is not None:
            parts.joints.append(JointSpec(f"{name}:weld", parent, name, "fixed", rotation, translation))
    parts.links.append(link)
    for child in body.findall("body"):
        if child.find("freejoint") is not None:
            raise wrong(settings.path, child, "has a free joint inside the hand")
        _read_body(parts, child, name, child_class)


def _joint(
    parts: _Parts,
    joint: ET.Element,
    label: str,
    parent: str,
    child: str,
    rotation: Float[np.ndarray, "3 3"],
    translation: Float[np.ndarray, "3"],
) -> JointSpec:
    settings, path = parts.settings, parts.settings.path
    kind = _KINDS.get(joint.get("type", "hinge"))
    if kind is None:
        raise wrong(path, joint, f"is of type {joint.get('type')!r}; known: {', '.join(_KINDS)}")
    unit = settings.angle if kind == "revolute" else 1.0
    axis = read_axis(settings, joint)
    # At `ref` the joint is as drawn; a joint value of zero lies that far back.
    reference = float(read_numbers(path, joint, "ref", 1, "0")[0]) * unit
    parts.references[label] = reference
    if kind == "revolute":
        rotation = rotation @ axis_rotation(axis, -reference)
    else:
        translation = translation - rotation @ axis * reference
    lower, upper = -np.inf, np.inf
    ends = read_range(settings, joint, "range", "limited")
    if ends is not None:
        lower, upper = (ends * unit).tolist()
        if lower > upper:
            raise wrong(path, joint, f"has lower {lower:g} above upper {upper:g}")
    forces = read_range(settings, joint, "actuatorfrcrange", "actuatorfrclimited")
    effort = np.inf if forces is None else float(np.abs(forces).max())
    return JointSpec(label, parent, child, kind, rotation, translation, axis, lower, upper, effort)


def _primitives(parts: _Parts, body: ET.Element, child_class: str, name: str) -> list[Primitive]:
    """The colliding geoms of a body, or all where none collides."""
    geoms = [with_defaults(parts.settings, geom, child_class) for geom in body.findall("geom")]
    colliding = [g for g in geoms if (g.get("contype", "1"), g.get("conaffinity", "1")) != ("0", "0")]
    if geoms and not colliding:
        parts.shown.append(name)
    return [read_geom(parts.settings, geom, parts.meshes) for geom in colliding or geoms]


def _inertial(
    settings: MjcfSettings, body: ET.Element
) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Mass [kg], centre [m] and inertia about it [kg·m²]; zero where the body gives none."""
    inertial = body.find("inertial")
    if inertial is None:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    rotation, com = read_pose(settings, inertial)
    mass = float(read_numbers(settings.path, inertial, "mass", 1, "0")[0])
    if "fullinertia" in inertial.attrib:
        xx, yy, zz, xy, xz, yz = read_numbers(settings.path, inertial, "fullinertia", 6, "")
    else:
        (xx, yy, zz), xy, xz, yz = read_numbers(settings.path, inertial, "diaginertia", 3, "0 0 0"), 0.0, 0.0, 0.0
    moments = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if mass < 0 or max(mass, float(np.abs(moments).max())) > 1e3:
        raise wrong(settings.path, inertial, f"weighs {mass:g} kg: no hand")
    return mass, com, rotation @ moments @ rotation.T


def _couplings(parts: _Parts, root: ET.Element) -> dict[str, Coupling]:
    """Joints that an equality ties to another by a straight line: q₁ − ref₁ = c₀ + c₁ (q₂ − ref₂)."""
    path, joints = parts.settings.path, parts.references
    direct: dict[str, Coupling] = {}
    for section in root.findall("equality"):
        for given in section:
            element = with_defaults(parts.settings, given, "main")
            if element.get("active", "true") == "false":
                continue
            if element.tag != "joint" or "joint2" not in element.attrib:
                raise wrong(path, element, f"equality <{element.tag}> is not read: only a joint tied to another is")
            one, two = str(element.get("joint1")), str(element.get("joint2"))
            for name in (one, two):
                if name not in joints:
                    raise wrong(path, element, f"names the joint {name!r}; known: {', '.join(joints)}")
            count = len((element.get("polycoef") or "0 1 0 0 0").split())
            constant, slope, *bends = np.resize(read_numbers(path, element, "polycoef", count, "0 1 0 0 0"), 5)
            if count != 5 or any(bends):
                raise wrong(
                    path, element, f"<joint polycoef={element.get('polycoef')!r}>: only a straight line is read"
                )
            direct[one] = Coupling(two, float(slope), float(joints[one] + constant - slope * joints[two]))
    return direct


def _efforts(settings: MjcfSettings, root: ET.Element) -> dict[str, float]:
    """The greatest torque or force that a joint's actuator gives, where it is limited."""
    efforts: dict[str, float] = {}
    for section in root.findall("actuator"):
        for given in section:
            element = with_defaults(settings, given, "main")
            what = "force" if "forcerange" in element.attrib or element.tag != "motor" else "ctrl"
            forces = read_range(settings, element, f"{what}range", f"{what}limited")
            force = 0.0 if forces is None else float(np.abs(forces).max())
            count = len(element.get("gear", "").split()) or 1
            gear = float(np.abs(read_numbers(settings.path, element, "gear", count, "1"))[0])
            if "joint" in element.attrib and force > 0 and gear > 0:
                efforts[str(element.get("joint"))] = force * gear
    return efforts
