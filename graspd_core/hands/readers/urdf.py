"""Read a `HandModel` from a URDF. Common mistakes are repaired with a warning, or are errors that name the element.

Boxes, spheres, cylinders and capsules do not change. Meshes become convex hulls. The viewer draws the visual shapes.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from graspd_core.errors import HandError
from graspd_core.hands.model import HandModel, JointKind, Primitive, PrimitiveKind
from graspd_core.hands.readers.build_model import JointSpec, LinkSpec, assemble, read_couplings, refuse_crowds
from graspd_core.hands.readers.link_meshes import LARGEST_SIZE, corners_each, mesh_hull, missing_packages, whole_mesh
from graspd_core.hands.readers.xml_io import read_numbers, read_origin, read_xml, wrong
from graspd_core.mesh.convex_parts import limited_hull
from graspd_core.mesh.mesh_files import simplify
from graspd_core.types import TriangleMesh

_ROUND: dict[str, PrimitiveKind] = {"cylinder": "cylinder", "capsule": "capsule"}
# Lengths that differ by less than this count as equal [m].
_SAME = 1e-6
_SHAPES = ("box", "sphere", "cylinder", "capsule", "mesh")
# For the viewer: number of triangles of all meshes of a hand together, and least number of each mesh.
_MOST_TRIANGLES, _FEWEST_TRIANGLES = 4000, 60
# Simplifying may fail on torn surfaces or lose a thin part. The hull is drawn instead if a mesh keeps more than this
# multiple of the wanted triangles, or less than this share of its extent.
_STUCK, _SHRUNK = 1.5, 0.95


def _colliding(link: ET.Element) -> list[ET.Element]:
    return link.findall("collision") or link.findall("visual")


def _shapes(
    path: Path, elements: Sequence[ET.Element], read_mesh: Callable[..., TriangleMesh]
) -> tuple[Primitive, ...]:
    """Read shapes. A cylinder with a sphere at each end becomes a capsule. URDF files often build one this way."""
    shapes = [_read_shape(path, element, read_mesh) for element in elements]
    found, taken = list(shapes), set[int]()
    for i, shape in enumerate(shapes):
        if shape.kind != "cylinder":
            continue
        half = shape.size[1] * shape.rotation[:, 2]
        ends = [(shape.translation + sign * half, shape.size[0]) for sign in (-1.0, 1.0)]
        balls = [next((j for j, b in enumerate(shapes) if j not in taken and _is_ball(b, *end)), -1) for end in ends]
        if min(balls) >= 0:
            found[i] = replace(shape, kind="capsule")
            taken.update(balls)
    return tuple(shape for i, shape in enumerate(found) if i not in taken)


def _is_ball(shape: Primitive, center: Float[np.ndarray, "3"], radius: float) -> bool:
    same = shape.kind == "sphere" and abs(shape.size[0] - radius) < _SAME
    return same and float(np.abs(shape.translation - center).max()) < _SAME


def _read_shape(path: Path, element: ET.Element, read_mesh: Callable[..., TriangleMesh]) -> Primitive:
    """Read a `<collision>` or `<visual>` as a primitive of link zero. `read_mesh` reads a mesh file [m]."""
    rotation, translation = read_origin(path, element)
    geometry = element.find("geometry")
    shapes = [] if geometry is None else list(geometry)
    if not shapes:
        raise wrong(path, element, f"a <{element.tag}> has no <geometry> with a shape; valid: {', '.join(_SHAPES)}")
    shape = shapes[0]
    if shape.tag == "box":
        half = 0.5 * _positive(path, shape, "size", 3)
        return Primitive(0, "box", rotation, translation, tuple(half.tolist()))
    if shape.tag == "sphere":
        return Primitive(0, "sphere", rotation, translation, (float(_positive(path, shape, "radius", 1)[0]),))
    if shape.tag in _ROUND:
        radius, length = (float(_positive(path, shape, key, 1)[0]) for key in ("radius", "length"))
        return Primitive(0, _ROUND[shape.tag], rotation, translation, (radius, 0.5 * length))
    if shape.tag == "mesh":
        mesh = read_mesh(path, shape, shape.get("filename") or "", _scale(path, shape))
        return Primitive(0, "hull", rotation, translation, (), mesh.vertices, mesh.faces)
    raise wrong(path, shape, f"unknown {element.tag} shape <{shape.tag}>; known: {', '.join(_SHAPES)}")


def _scale(path: Path, shape: ET.Element) -> Float[np.ndarray, "3"]:
    one = len((shape.get("scale") or "").split()) == 1
    scale = np.resize(read_numbers(path, shape, "scale", 1 if one else 3, "1 1 1"), 3)
    if (scale == 0).any():
        raise wrong(path, shape, f"<mesh scale={shape.get('scale')!r}>: a factor cannot be zero")
    return scale


def _positive(path: Path, shape: ET.Element, key: str, count: int) -> Float[np.ndarray, "n"]:
    values = read_numbers(path, shape, key, count, "")
    if (values <= 0).any():
        raise wrong(path, shape, f"<{shape.tag} {key}={shape.get(key)!r}>: sizes must be positive")
    if (values > LARGEST_SIZE).any():
        text = f"<{shape.tag} {key}={shape.get(key)!r}>"
        raise wrong(path, shape, f"{text}: larger than {LARGEST_SIZE:g} m; lengths are in metres")
    return values


_KINDS: dict[str, JointKind] = {
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
    "fixed": "fixed",
}
# Advice in errors about xacro files.
EXPAND = "expand it to a URDF first: xacro FILE > hand.urdf"
# Types of joints that place a whole robot in the world.
_FREE = ("floating", "planar")
_MOMENTS = ("xx", "xy", "xz", "yy", "yz", "zz")
# Greatest valid mass [kg] and moment of inertia [kg·m²].
_HEAVIEST = 1e3


def read_urdf(path: Path, root: ET.Element | None = None, *, keep_world: bool = False) -> HandModel:
    """Read a hand from a URDF. Contact candidates are not set.

    The open and the closed posture are mid-range. The palm is at the base's origin. Limits of effort and velocity
    become infinite if they are missing or zero. These changes add a warning: a `continuous` joint is limited to ±π, a
    link without collision shapes gets its visual shapes, a `world` link or a floating joint above the base is dropped.

    Args:
        path: path of the file.
        root: root element, if it has been read already.
        keep_world: whether to keep a `world` link above a fixed joint. An arm needs this link: poses refer to it.

    Raises:
        HandError: the file is missing, malformed or not a tree, has no moving joint, or has an unknown joint type.
    """
    root = read_xml(path) if root is None else root
    if root.tag != "robot":
        raise wrong(path, root, f"the root element is <{root.tag}>; a URDF has <robot>")
    links, joints = root.findall("link"), root.findall("joint")
    shapes = sum(len(link.findall(tag)) for link in links for tag in ("collision", "visual"))
    refuse_crowds(path, len(links), len(joints), shapes)
    for element in (*links, *joints):
        if not element.get("name"):
            raise wrong(path, element, f"a <{element.tag}> has no name; give it a unique one")
    _refuse_xacro(path, root)
    links, joints, dropped = _below_world(path, links, joints, keep_world)
    specs = [_read_joint(path, joint) for joint in joints]
    corners = corners_each(sum(shape.find("geometry/mesh") is not None for link in links for shape in _colliding(link)))
    hull = partial(mesh_hull, corners=corners)
    bodies, shown = [], []
    for link in links:
        name, elements = str(link.get("name")), _colliding(link)
        if elements and elements[0].tag == "visual":
            shown.append(name)
        bodies.append(LinkSpec(name, *_inertial(path, link), _shapes(path, elements, hull)))
    if shown:
        dropped.append(f"no <collision>, so the <visual> is used: {', '.join(shown)}")
    dropped += missing_packages(
        path, (mesh for link in links for shape in _colliding(link) for mesh in shape.iter("mesh"))
    )
    name = str(root.get("name") or path.stem)
    return assemble(path, name, bodies, specs, read_couplings(path, joints), tuple(dropped))


def visual_solids(hand: HandModel, prefix: str = "") -> tuple[Primitive, ...]:
    """Return the shapes for a viewer, in link frames.

    In the result, a shape of kind `hull` may be non-convex. All meshes together are simplified to about 4000 triangles.
    Links without visual shapes, and hands without a URDF, get their collision shapes.

    Args:
        hand: any loaded hand.
        prefix: the `prefix` with which `load_hand` loaded the hand.

    Raises:
        HandError: a file cannot be read.
    """
    path = Path(hand.urdf)
    if path.suffix == ".pkl" or (root := read_xml(path)).tag != "robot":
        return hand.primitives
    found: list[Primitive] = []
    for link in root.findall("link"):
        index = hand.link_index.get(f"{prefix}{link.get('name')}")
        if index is not None:
            found += [replace(shape, link=index) for shape in _shapes(path, link.findall("visual"), whole_mesh)]
    shown = {shape.link for shape in found}
    share = _MOST_TRIANGLES / max(sum(len(shape.faces) for shape in found), 1)
    return (*(_simpler(shape, share) for shape in found), *(s for s in hand.primitives if s.link not in shown))


def _simpler(shape: Primitive, share: float) -> Primitive:
    """Return a mesh simplified to `share` of its triangles. Other shapes do not change."""
    count = max(int(len(shape.faces) * share), _FEWEST_TRIANGLES)
    if shape.kind != "hull" or len(shape.faces) <= count:
        return shape
    mesh = simplify(TriangleMesh(shape.vertices, shape.faces), count)
    extents = [np.ptp(vertices, axis=0) for vertices in (mesh.vertices[np.unique(mesh.faces)], shape.vertices)]
    if len(mesh.faces) > count * _STUCK or (extents[0] < _SHRUNK * extents[1]).any():
        mesh = limited_hull(shape.vertices, count // 2)
    return replace(shape, vertices=mesh.vertices, faces=mesh.faces)


def below_link(path: Path, root: ET.Element, link: str) -> None:
    """Keep only `link` and the links and joints below it. Raises HandError: the file has no such link."""
    links = [str(element.get("name")) for element in root.findall("link")]
    if link not in links:
        raise HandError(f"{path}: root: no link {link!r}; links: {', '.join(links) or 'none, the file is not a URDF'}")
    ends = [(joint_end(joint, "parent"), joint_end(joint, "child")) for joint in root.findall("joint")]
    kept, waiting = {link}, [link]
    while waiting:
        parent = waiting.pop()
        below = {child for above, child in ends if above == parent} - kept
        kept |= below
        waiting += below
    keep_links(root, kept)


def keep_links(root: ET.Element, kept: set[str]) -> None:
    """Keep only the links in `kept` of a URDF, and the joints between two of them."""
    for link in root.findall("link"):
        if link.get("name") not in kept:
            root.remove(link)
    for joint in root.findall("joint"):
        if not {joint_end(joint, "parent"), joint_end(joint, "child")} <= kept:
            root.remove(joint)


def joint_end(joint: ET.Element, end: str) -> str:
    """Return the link at an end of a joint, `parent` or `child`. Empty if the file does not name it."""
    element = joint.find(end)
    return "" if element is None else element.get("link") or ""


def _refuse_xacro(path: Path, root: ET.Element) -> None:
    for top in root:
        if top.tag.startswith("xacro:"):
            raise wrong(path, top, f"is a xacro file (<{top.tag}>); {EXPAND}")
        if top.tag not in ("link", "joint"):
            continue
        for element in top.iter():
            unexpanded = [text for text in element.attrib.values() if "${" in text or "$(" in text]
            if unexpanded or element.tag.startswith("xacro:"):
                what = unexpanded[0] if unexpanded else f"<{element.tag}>"
                raise wrong(path, element, f"xacro left over in <{element.tag}>: {what}; {EXPAND}")


def _below_world(
    path: Path, links: list[ET.Element], joints: list[ET.Element], keep_world: bool
) -> tuple[list[ET.Element], list[ET.Element], list[str]]:
    """Drop links and joints that only place the hand in the world. Return the other links and joints, and warnings."""
    dropped: list[str] = []
    while True:
        children = {joint_end(joint, "child") for joint in joints}
        roots = [link for link in links if link.get("name") not in children]
        below = [joint for joint in joints if len(roots) == 1 and joint_end(joint, "parent") == roots[0].get("name")]
        if len(below) != 1 or any(roots[0].find(tag) is not None for tag in ("visual", "collision", "inertial")):
            break
        is_world = not keep_world and roots[0].get("name") == "world" and below[0].get("type") == "fixed"
        if not is_world and below[0].get("type") not in _FREE:
            break
        links = [link for link in links if link is not roots[0]]
        joints = [joint for joint in joints if joint is not below[0]]
        dropped.append(
            f"link {roots[0].get('name')!r} and {below[0].get('type')} joint {below[0].get('name')!r} above the base "
            f"{joint_end(below[0], 'child')!r} were dropped"
        )
    for joint in joints:
        if joint.get("type") not in _KINDS:
            raise wrong(path, joint, f"is of type {joint.get('type')!r}; known: {', '.join(_KINDS)}")
    return links, joints, dropped


def _read_joint(path: Path, joint: ET.Element) -> JointSpec:
    parent, child = (joint_end(joint, end) for end in ("parent", "child"))
    if not (parent and child):
        raise wrong(path, joint, f"has no <{'child' if parent else 'parent'} link=...>")
    kind = _KINDS[str(joint.get("type"))]
    rotation, translation = read_origin(path, joint)
    name = str(joint.get("name"))
    if kind == "fixed":
        return JointSpec(name, parent, child, kind, rotation, translation)
    return JointSpec(name, parent, child, kind, rotation, translation, _axis(path, joint), *_limits(path, joint))


def _axis(path: Path, joint: ET.Element) -> Float[np.ndarray, "3"]:
    element = joint.find("axis")
    axis = np.array([1.0, 0.0, 0.0]) if element is None else read_numbers(path, element, "xyz", 3, "1 0 0")
    largest = float(np.abs(axis).max())
    if largest == 0:
        raise wrong(path, joint, "has a zero axis")
    axis = axis / largest
    return axis / np.linalg.norm(axis)


def _limits(path: Path, joint: ET.Element) -> tuple[float, float, float, float]:
    """Return lower and upper limit [rad] or [m], effort [N·m] or [N], and velocity. The last two may be infinite."""
    limit = joint.find("limit")
    continuous = joint.get("type") == "continuous"
    if limit is None:
        if not continuous:
            raise wrong(path, joint, "has no <limit>; give its lower and upper, or make the joint continuous")
        limit = ET.Element("limit")
    lower, upper = (float(read_numbers(path, limit, key, 1, "0")[0]) for key in ("lower", "upper"))
    if continuous:
        lower, upper = -np.inf, np.inf
    if lower > upper:
        raise wrong(path, joint, f"has lower {lower:g} above upper {upper:g}")
    return lower, upper, _unset_if_zero(path, limit, "effort"), _unset_if_zero(path, limit, "velocity")


def _unset_if_zero(path: Path, limit: ET.Element, key: str) -> float:
    if (limit.get(key) or "").strip().lower().lstrip("+") in ("inf", "infinity"):
        return np.inf
    value = float(read_numbers(path, limit, key, 1, "0")[0])
    return value if value > 0 else np.inf


def _inertial(path: Path, link: ET.Element) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Return mass [kg], centre of mass [m] and inertia about this centre [kg·m²]. Zero without `<inertial>`."""
    inertial = link.find("inertial")
    if inertial is None:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    rotation, com = read_origin(path, inertial)
    element, inertia = inertial.find("mass"), inertial.find("inertia")
    mass = 0.0 if element is None else float(read_numbers(path, element, "value", 1, "0")[0])
    if mass < 0:
        raise wrong(path, inertial, f"has a negative mass, {mass:g}")
    moments = np.zeros(6)
    if inertia is not None:
        moments = np.array([read_numbers(path, inertia, f"i{key}", 1, "0")[0] for key in _MOMENTS])
    if max(mass, *np.abs(moments)) > _HEAVIEST:
        heavy = f"mass {mass:g} kg, inertia up to {np.abs(moments).max():g} kg·m²; valid: each at most {_HEAVIEST:g}"
        raise wrong(path, inertial, heavy)
    xx, xy, xz, yy, yz, zz = moments
    return mass, com, rotation @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ rotation.T
