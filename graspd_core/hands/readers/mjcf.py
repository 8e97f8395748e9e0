"""Read a `HandModel` from an MJCF file. MuJoCo parses and compiles the file.

MuJoCo gets the XML of `read_xml`, reduced to the sections that describe how the hand moves. MuJoCo opens no file.
graspd itself reads the meshes and makes convex hulls. Unsupported elements that affect motion are an error.
"""

from __future__ import annotations

import importlib
import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.errors import HandError, short_repr
from graspd_core.hands.model import HandModel, JointKind, Primitive, PrimitiveKind
from graspd_core.hands.readers.build_model import (
    Coupling,
    JointSpec,
    LinkSpec,
    assemble,
    refuse_crowds,
    resolved_couplings,
)
from graspd_core.hands.readers.link_meshes import LARGEST_SIZE, SMALLEST_MESH, corners_each, mesh_hull
from graspd_core.hands.readers.xml_io import DEEPEST, FARTHEST, Element, as_text, read_xml, wrong
from graspd_core.mesh.convex_parts import limited_hull
from graspd_core.se3 import axis_rotation, rotation_from_quaternion
from graspd_core.types import TriangleMesh

# Number of used `size` values for each geom type.
_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "ellipsoid": 3}
_PLAIN: dict[str, PrimitiveKind] = {"sphere": "sphere", "capsule": "capsule", "cylinder": "cylinder", "box": "box"}
_CORNERS_OF_ELLIPSOID = 200


@dataclass(frozen=True, eq=False)
class _MeshAsset:
    """A mesh asset at `place` in the MJCF file. `vertices` [m] are not scaled yet, and empty if there is a `file`."""

    place: Element
    file: str
    scale: Float[np.ndarray, "3"]
    vertices: Float[np.ndarray, "_ 3"]


def _read_assets(path: Path, spec: Any) -> dict[str, _MeshAsset]:
    """Return the mesh assets by name. Raises HandError: a mesh has `refpos` or `refquat`, or a scale of zero."""
    assets = {}
    for mesh in spec.meshes:
        if np.any(mesh.refpos) or not np.array_equal(mesh.refquat, (1, 0, 0, 0)):
            raise fault(path, mesh, "<mesh refpos=...> and <mesh refquat=...> are not read; move the vertices instead")
        if not np.all(mesh.scale):
            raise fault(path, mesh, f"<mesh scale={short_repr(list(mesh.scale))}>: a factor cannot be zero")
        # As MuJoCo does, `strippath` takes only the name of a file.
        file = str(Path(spec.meshdir) / (Path(mesh.file).name if spec.strippath else mesh.file)) if mesh.file else ""
        vertices = np.array(mesh.uservert, dtype=float).reshape(-1, 3)
        assets[mesh.name or Path(mesh.file).stem] = _MeshAsset(_place(mesh), file, np.array(mesh.scale), vertices)
    return assets


def fault(path: Path, element: Any, message: str) -> HandError:
    """Return an error about an element of an `MjSpec`. The message names file and line, and element or parent."""
    return wrong(path, _place(element), message)


def _place(element: Any) -> Element:
    named = element if element.name or not hasattr(element, "parent") else element.parent
    place = Element(type(named).__name__.removeprefix("Mjs").lower())
    place.line = int(element.info.removeprefix("line ") or 0)
    place.owner = f"{place.tag} {named.name!r}" if named.name else ""
    return place


def _type_name(element: Any) -> str:
    return element.type.name.partition("_")[2].lower()


def pose(position: Float[np.ndarray, "3"], quaternion: Float[np.ndarray, "4"]) -> tuple[np.ndarray, np.ndarray]:
    """Return a pose of a MuJoCo model as rotation matrix and translation [m]. `quaternion` is wxyz."""
    return rotation_from_quaternion(torch.as_tensor(np.array(quaternion))).numpy(), np.array(position)


def check_type(path: Path, geom: Any, assets: Mapping[str, _MeshAsset]) -> None:
    """Raise HandError if a geom has an unsupported type or an unknown mesh."""
    kind, known = _type_name(geom), (*_SIZES, "mesh")
    if kind not in known:
        raise fault(path, geom, f"<geom type={kind!r}> is not read; known: {', '.join(known)}")
    if geom.meshname and kind != "mesh":
        fitted = f"<geom type={kind!r} mesh={geom.meshname!r}>: no {kind} is fitted to a mesh"
        raise fault(path, geom, f"{fitted}; give type='mesh', or a size without a mesh")
    if kind == "mesh" and geom.meshname not in assets:
        raise fault(path, geom, f"unknown mesh {geom.meshname!r}; valid: {', '.join(assets) or 'none'}")


def _read_geom(path: Path, model: Any, geom: Any, hull: TriangleMesh | None) -> Primitive:
    """Return a geom as a primitive of link zero. `hull` is None except for a mesh. An ellipsoid becomes a hull.

    Raises HandError: the geom is larger than `LARGEST_SIZE`.
    """
    rotation, translation = pose(model.geom_pos[geom.id], model.geom_quat[geom.id])
    if hull is not None:
        return Primitive(0, "hull", rotation, translation, (), hull.vertices, hull.faces)
    kind = _type_name(geom)
    size = model.geom_size[geom.id, : _SIZES[kind]].copy()
    if not (size <= LARGEST_SIZE).all():
        raise fault(path, geom, f"<geom size='{size}'>: larger than {LARGEST_SIZE:g} m; lengths are in metres")
    if kind in _PLAIN:
        return Primitive(0, _PLAIN[kind], rotation, translation, tuple(size.tolist()))
    import trimesh

    ball = limited_hull(np.asarray(trimesh.creation.icosphere(subdivisions=2).vertices) * size, _CORNERS_OF_ELLIPSOID)
    return Primitive(0, "hull", rotation, translation, (), ball.vertices, ball.faces)


def _asset_hull(path: Path, mesh: _MeshAsset, corners: int) -> TriangleMesh:
    """Return a hull [m] with at most `corners` corners. Raises HandError: the mesh is missing, broken or too large."""
    if mesh.file:
        return mesh_hull(path, mesh.place, mesh.file, mesh.scale, corners)
    points = mesh.vertices * mesh.scale
    if len(points) < 4 or np.abs(points).max() > LARGEST_SIZE or np.ptp(points, axis=0).max() < SMALLEST_MESH:
        valid = f"four or more, {SMALLEST_MESH:g} m across or more, within {LARGEST_SIZE:g} m"
        raise wrong(path, mesh.place, f"<mesh vertex=...>: {len(points)} points; expected {valid}")
    return limited_hull(points, corners)


_KINDS: dict[str, JointKind] = {"hinge": "revolute", "slide": "prismatic"}
_REFUSED = ("replicate", "attach", "composite", "flexcomp", "plugin")
# Sections that MuJoCo gets. Other sections may name files or allocate memory, or do not matter here.
_SECTIONS = ("compiler", "default", "asset", "worldbody", "tendon", "equality", "actuator")
# Attributes whose values are names. They are not searched for nan and inf, because a name may contain these letters.
_NAMES = {"name", "class", "childclass", "model", "mesh", "file"}
_HEAVIEST, _MOST_CLASSES = 1e3, 300
# MuJoCo's number for `inertiafromgeom="true"`. The geoms then give all masses, and <inertial> is ignored.
_FROM_GEOMS = 1
# Greatest number of files, the main file included.
_MOST_FILES = 30


@dataclass(eq=False)
class _Parts:
    """A file parsed (`spec`) and compiled (`model`) by MuJoCo, and the links and joints read so far.

    `meshes` and `labels` (names of joints) have MuJoCo's ids as keys. `shown` names bodies without colliding geoms.
    """

    path: Path
    spec: Any
    model: Any
    meshes: dict[int, _MeshAsset]
    links: list[LinkSpec] = field(default_factory=list)
    joints: list[JointSpec] = field(default_factory=list)
    labels: dict[int, str] = field(default_factory=dict)
    shown: list[str] = field(default_factory=list)


def read_mjcf(path: Path, root: ET.Element) -> HandModel:
    """Read the hand of an MJCF file with this root element. Palm and postures are set as by `read_urdf`.

    The base is the only body directly in `<worldbody>`. If hinges or slides move this body, a new link `world` is the
    base. Raises HandError: MuJoCo refuses the file, `<worldbody>` has several bodies, or an element is unsupported.
    """
    _include(path, path, root, {path.resolve()})
    _refuse(path, root)
    parts = _compiled(path, root)
    world = parts.spec.worldbody
    if len(world.bodies) != 1:
        names = ", ".join(body.name for body in world.bodies)
        raise wrong(path, root, f"the world has {len(world.bodies)} bodies: {names or 'none'}; valid: one body")
    base, warnings = world.bodies[0], []
    if world.geoms:
        warnings.append("geoms of the world itself were dropped")
    free = any(_type_name(joint) == "free" for joint in base.joints)
    if free:
        warnings.append(f"the free joint of the base {base.name!r} was dropped")
    hangs = bool(base.joints) and not free
    if hangs:
        parts.links.append(LinkSpec("world"))
    _read_body(parts, base, "world" if hangs else None)
    if parts.spec.tendons:
        warnings.append("tendons are not read: joints that they couple move independently")
    if parts.shown:
        warnings.append(f"no colliding geom, so visual geoms are used: {', '.join(parts.shown)}")
    efforts, couplings = _efforts(parts), resolved_couplings(path, _couplings(parts))
    joints = [replace(j, effort=min(j.effort, efforts.get(j.name, np.inf))) for j in parts.joints]
    hand = assemble(path, root.get("model") or path.stem, parts.links, joints, couplings, tuple(warnings))
    number = parts.spec.worldbody.id if hangs else base.id
    x, y, z, *turn = (*parts.model.body_pos[number].tolist(), *parts.model.body_quat[number].tolist())
    w, i, j, k = turn
    return replace(hand, base_place=((x, y, z), (w, i, j, k)))


def included_files(path: Path) -> tuple[Path, ...]:
    """Return the files that an MJCF file includes, sorted by path. Raises HandError: see `read_mjcf`."""
    root, seen = read_xml(path), {path.resolve()}
    if root.tag == "mujoco":
        _include(path, path, root, seen)
    return tuple(sorted(seen - {path.resolve()}))


def _include(path: Path, holder: Path, parent: ET.Element, seen: set[Path], depth: int = 0) -> None:
    """Replace each `<include>` below `parent` by the included elements, as in MuJoCo. `holder`: the file of `parent`.

    Raises HandError: an included file does not exist, is not an MJCF file, or is included twice.
    """
    children: list[ET.Element] = []
    for child in parent:
        if depth > DEEPEST:
            raise wrong(path, child, f"<{child.tag}> is nested more than {DEEPEST} deep")
        if child.tag == "include":
            file, included = _read_included(path, holder, child, seen)
            _include(path, file, included, seen, depth + 1)
            children += included
        else:
            _include(path, holder, child, seen, depth + 1)
            children.append(child)
    parent[:] = children


def _read_included(path: Path, holder: Path, place: ET.Element, seen: set[Path]) -> tuple[Path, ET.Element]:
    """Read an included file, which lies beside the main file or beside `holder`. Return its path and root."""
    name = place.get("file") or ""
    told = f"<include file={short_repr(name)}>"
    found = next((folder / name for folder in (path.parent, holder.parent) if os.path.isfile(folder / name)), None)
    if found is None:
        raise wrong(path, place, f"{told}: no such file beside {path.name}")
    if found.resolve() in seen:
        raise wrong(path, place, f"{told}: included twice; valid: once")
    if len(seen) >= _MOST_FILES:
        raise wrong(path, place, f"{told}: too many included files; valid: at most {_MOST_FILES}")
    seen.add(found.resolve())
    root = read_xml(found)
    if root.tag not in ("mujoco", "mujocoinclude"):
        raise wrong(path, place, f"{told}: the root element is <{root.tag}>; valid: <mujoco>, <mujocoinclude>")
    for element in root.iter():
        # Error messages would name these lines as lines of the main file.
        if isinstance(element, Element):
            element.line = 0
    return found, root


def _refuse(path: Path, root: ET.Element) -> None:
    """Raise HandError for unsupported elements, and for content that is dangerous for MuJoCo."""
    for element in root.iter():
        if element.tag in _REFUSED:
            raise wrong(path, element, f"<{element.tag}> is not read; save the compiled model as one plain MJCF file")
        for key, text in element.attrib.items():
            # MuJoCo accepts nan and inf, but writes a note to the terminal and to a log file.
            if key not in _NAMES and re.search(r"(?i)(^|\s)[+-]?(nan|inf(inity)?)(?!\w)", text):
                raise wrong(path, element, f"<{element.tag} {key}={short_repr(text)}>: expected finite numbers")
    classes = len(root.findall(".//default"))
    if classes > _MOST_CLASSES:
        raise wrong(path, root, f"{classes} default classes; a hand has at most {_MOST_CLASSES}")
    refuse_crowds(path, *(len(root.findall(f"worldbody//{tag}")) for tag in ("body", "joint", "geom")))


def _compiled(path: Path, root: ET.Element) -> _Parts:
    """Compile the file with MuJoCo. A small sphere replaces each mesh, so that MuJoCo opens no mesh file."""
    mujoco: Any = importlib.import_module("mujoco")  # MuJoCo ships no type information.
    root[:] = [section for section in root if section.tag in _SECTIONS]
    for assets in root.findall("asset"):
        assets[:] = assets.findall("mesh")
    for element in root.iter():
        element.attrib.pop("material", None)
    try:
        spec = mujoco.MjSpec.from_string(as_text(root))
        assets, meshes = _read_assets(path, spec), []
        for geom in spec.geoms:
            in_world, name = geom.parent.name == "world", geom.meshname
            if not in_world:
                check_type(path, geom, assets)
            if in_world or name:
                geom.type, geom.meshname, geom.size = mujoco.mjtGeom.mjGEOM_SPHERE, "", (0.01, 0.0, 0.0)
                meshes.append((geom, assets.get(name)))
        for mesh in list(spec.meshes):
            spec.delete(mesh)
        # The compiler warns that its own `settotalmass` is deprecated.
        total, spec.compiler.settotalmass = spec.compiler.settotalmass, -1
        model = spec.compile()
        if total > 0:
            mujoco.mj_setTotalmass(model, total)
        return _Parts(path, spec, model, {geom.id: mesh for geom, mesh in meshes if mesh})
    except (ValueError, mujoco.FatalError) as error:
        raise _refusal(path, root, " ".join(str(error).split())) from error


def _refusal(path: Path, root: ET.Element, text: str) -> HandError:
    """Convert MuJoCo's error message to an error about the element that the message names."""
    line, tag = re.search(r",? line (\d+)", text), re.search(r"Element '(\w+)'", text)
    place = Element(tag.group(1) if tag else "mujoco")
    if line:
        place.line, text = int(line.group(1)), text.replace(line.group(), "")
    named = [e.owner for e in root.iter(place.tag) if isinstance(e, Element) and e.line == place.line]
    place.owner = named[0] if named else ""
    return wrong(path, place, f"MuJoCo refuses it: {text[:400]}")


def _read_body(parts: _Parts, body: Any, parent: str | None) -> None:
    """Append a body's link and joints to `parts`, then the links and joints of its child bodies."""
    model, name = parts.model, body.name or f"body_{len(parts.links)}"
    link = LinkSpec(name, *_inertial(parts, body), _primitives(parts, body, name))
    rotation, translation = pose(model.body_pos[body.id], model.body_quat[body.id])
    if parent is not None:
        _refuse_far(parts, body, translation)
        above: str = parent
        for number, joint in enumerate(body.joints):
            label = parts.labels[joint.id] = joint.name or f"{name}_joint{number}"
            offset = np.array(model.jnt_pos[joint.id])
            _refuse_far(parts, joint, offset)
            last = number == len(body.joints) - 1 and not offset.any()
            # A joint not at the body's origin, or not the last joint of the body, gets an extra link without mass.
            child = name if last else f"{name}:{label}"
            at_joint = JointSpec(label, above, child, "fixed", rotation, translation + rotation @ offset)
            parts.joints.append(_moving(parts, joint, at_joint))
            above, rotation, translation = child, np.eye(3), -offset
            if not last:
                parts.links.append(LinkSpec(child))
        if above != name:
            parts.joints.append(JointSpec(f"{name}:weld", above, name, "fixed", rotation, translation))
    parts.links.append(link)
    for child in body.bodies:
        _read_body(parts, child, name)


def _moving(parts: _Parts, joint: Any, placed: JointSpec) -> JointSpec:
    """Return a MuJoCo joint as a `JointSpec`. `placed` is a fixed joint with the same pose, name and links."""
    model, number = parts.model, joint.id
    kind = _KINDS.get(_type_name(joint))
    if kind is None:
        raise fault(parts.path, joint, f"is of type {_type_name(joint)!r}; known: {', '.join(_KINDS)}")
    axis, rotation, translation = np.array(model.jnt_axis[number]), placed.rotation, placed.translation
    # The pose in the file belongs to the joint value `ref`. So the pose at zero is moved back by `ref`.
    if kind == "revolute":
        rotation = rotation @ axis_rotation(axis, -_reference(parts, number))
    else:
        translation = translation - rotation @ axis * _reference(parts, number)
    if joint.range[0] > joint.range[1]:
        raise fault(parts.path, joint, f"has lower {joint.range[0]:g} above upper {joint.range[1]:g}")
    lower, upper = model.jnt_range[number].tolist() if model.jnt_limited[number] else (-np.inf, np.inf)
    effort = float(np.abs(model.jnt_actfrcrange[number]).max()) if model.jnt_actfrclimited[number] else np.inf
    moves = {"kind": kind, "rotation": rotation, "translation": translation, "axis": axis}
    return replace(placed, **moves, lower=lower, upper=upper, effort=effort)


def _reference(parts: _Parts, joint: int) -> float:
    return float(parts.model.qpos0[parts.model.jnt_qposadr[joint]])


def _refuse_far(parts: _Parts, element: Any, position: Float[np.ndarray, "3"]) -> None:
    if not np.abs(position).max() <= FARTHEST:
        text = f"pos={short_repr(position.tolist())}: exceeds {FARTHEST:g} m; lengths are in metres"
        raise fault(parts.path, element, text)


def _primitives(parts: _Parts, body: Any, name: str) -> tuple[Primitive, ...]:
    """Return the colliding geoms of a body, or all geoms if none collides."""
    colliding = [geom for geom in body.geoms if geom.contype or geom.conaffinity]
    if body.geoms and not colliding:
        parts.shown.append(name)
    corners, found = corners_each(len(parts.meshes)), []
    for geom in colliding or body.geoms:
        mesh = parts.meshes.get(geom.id)
        hull = None if mesh is None else _asset_hull(parts.path, mesh, corners)
        found.append(_read_geom(parts.path, parts.model, geom, hull))
        _refuse_far(parts, geom, found[-1].translation)
    return tuple(found)


def _inertial(parts: _Parts, body: Any) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Return mass [kg], centre of mass [m] and inertia about this centre [kg·m²]. Zero if there is no <inertial>.

    Return zero too if the file says `inertiafromgeom="true"`. MuJoCo would weigh the spheres that replace the meshes.
    """
    if not body.explicitinertial or parts.spec.compiler.inertiafromgeom == _FROM_GEOMS:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    model, number = parts.model, body.id
    rotation, com = pose(model.body_ipos[number], model.body_iquat[number])
    mass, moments = float(model.body_mass[number]), np.array(model.body_inertia[number])
    if body.mass < 0 or not max(mass, *moments) <= _HEAVIEST:
        heavy = f"mass {min(mass, body.mass):g} kg, inertia {moments.max():g} kg·m²; valid: each 0 to {_HEAVIEST:g}"
        raise fault(parts.path, body, heavy)
    _refuse_far(parts, body, com)
    return mass, com, (rotation * moments) @ rotation.T


def _couplings(parts: _Parts) -> dict[str, Coupling]:
    """Return the couplings of joints by linear equalities: q₁ − ref₁ = c₀ + c₁ (q₂ − ref₂)."""
    direct: dict[str, Coupling] = {}
    for tie in parts.spec.equalities:
        if not tie.active:
            continue
        kind = tie.type.name.removeprefix("mjEQ_").lower()
        if kind != "joint" or not tie.name2:
            told = f"equality <{kind}> is not supported; valid: <joint> with joint1 and joint2"
            if kind in ("connect", "weld"):
                told += "; to couple the joints of a loop, write <joint joint1 joint2 polycoef> instead"
            raise fault(parts.path, tie, told)
        constant, slope, *bends = tie.data[:5].tolist()
        if any(bends):
            given = short_repr(tie.data[:5].tolist())
            raise fault(parts.path, tie, f"<joint polycoef={given}>: not linear; valid: zeros after the second number")
        one, two = (parts.model.joint(name).id for name in (tie.name1, tie.name2))
        offset = _reference(parts, one) + constant - slope * _reference(parts, two)
        direct[parts.labels[one]] = Coupling(parts.labels[two], slope, offset)
    return direct


def _efforts(parts: _Parts) -> dict[str, float]:
    """Return the greatest torque [N·m] or force [N] by joint name, for joints whose actuator is limited."""
    mujoco: Any = importlib.import_module("mujoco")
    model, efforts = parts.model, {}
    for i in range(model.nu):
        gain = float(model.actuator_gainprm[i, 0])
        motor = model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
        motor = motor and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE
        force = 0.0
        if model.actuator_forcelimited[i]:
            force = float(np.abs(model.actuator_forcerange[i]).max())
        elif motor and model.actuator_ctrllimited[i]:
            force = float(np.abs(gain * model.actuator_ctrlrange[i]).max())
        force *= abs(float(model.actuator_gear[i, 0]))
        if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT and 0 < force < np.inf:
            label = parts.labels.get(int(model.actuator_trnid[i, 0]), "")
            # Forces of several actuators of a joint add up.
            efforts[label] = efforts.get(label, 0.0) + force
    return efforts
