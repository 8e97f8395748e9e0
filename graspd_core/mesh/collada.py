"""Read the surfaces of COLLADA (.dae) files, without a COLLADA library.

The reader takes the triangles, strips, fans, polylists and polygons of the visual scene that `<scene>` names, or of the
only visual scene, or of all geometries if there is no scene. It applies the node transforms, and converts lengths to
metres by `<unit>`. Polygons become triangle fans, which is exact if they are convex. The up axis is ignored, as in ROS
viewers. Format: COLLADA 1.4.1, Khronos Group, 2008.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from graspd_core.se3 import axis_rotation
from graspd_core.types import TriangleMesh, joined

# Greatest numbers of nodes and of faces. A few nodes can instance the same geometry very many times.
_MOST_NODES = 4000
_MOST_FACES = 20_000_000
_FACES = ("triangles", "tristrips", "polylist", "polygons", "trifans")


def read_dae(path: Path) -> TriangleMesh:
    """Read all surfaces of a COLLADA file and join them into one mesh [m], with the axes of the file.

    Raises:
        ValueError: the file is not COLLADA, declares a document type, holds no faces, or refers to a missing element.
        OSError: the file cannot be read.
    """
    data = path.read_bytes()
    try:
        root = ET.fromstring(data, parser=ET.XMLParser(target=_Builder()))
        # Numbers too large for a float or an integer are found below, where values and indices are checked.
        with np.errstate(over="ignore", invalid="ignore"):
            return _joined(root)
    except (ET.ParseError, LookupError) as error:
        raise ValueError(f"not well-formed XML: {error}") from error
    except OverflowError as error:
        raise ValueError(f"a number is too large: {error}") from error


class _Builder(ET.TreeBuilder):
    """An XML tree builder that refuses document type declarations in any encoding."""

    def doctype(self, *_: object) -> None:
        raise ValueError("a document type declaration is not allowed; remove it")


def _joined(root: ET.Element) -> TriangleMesh:
    for element in root.iter():
        element.tag = str(element.tag).rpartition("}")[2]
    if root.tag != "COLLADA":
        raise ValueError(f"the root element is <{root.tag}>, not <COLLADA>")
    named = {f"#{element.get('id')}": element for element in root.iter() if element.get("id")}
    unit = root.find("asset/unit")
    scale = float(unit.get("meter", "1")) if unit is not None else 1.0
    scenes, shown = root.findall("library_visual_scenes/visual_scene"), root.find("scene/instance_visual_scene")
    if shown is not None:
        scenes = [_target(named, shown.get("url"))]
    if len(scenes) > 1:
        raise ValueError(f"the file has {len(scenes)} visual scenes, and no <scene> names one of them")
    if scenes:
        placed = _instances(scenes[0].findall("node"), named)
    else:
        placed = [(np.eye(4), geometry) for geometry in root.findall("library_geometries/geometry")]
    surfaces: dict[ET.Element, TriangleMesh] = {}
    parts, count = [], 0
    for pose, geometry in placed:
        if geometry not in surfaces:
            surfaces[geometry] = _surface(geometry, named)
        count += max(len(surfaces[geometry].vertices), len(surfaces[geometry].faces))
        if count > _MOST_FACES:
            raise ValueError(f"the file has more than {_MOST_FACES} faces or vertices")
        parts.append(_placed(surfaces[geometry], pose))
    if not any(len(part.faces) for part in parts):
        raise ValueError("the file holds no triangles")
    whole = joined(*parts)
    return TriangleMesh(whole.vertices * scale, whole.faces)


def _instances(roots: list[ET.Element], named: dict[str, ET.Element]) -> list[tuple[np.ndarray, ET.Element]]:
    """Return each geometry below the nodes `roots` with its pose in the scene. `named` maps "#id" to elements."""
    placed: list[tuple[np.ndarray, ET.Element]] = []
    stack = [(np.eye(4), node) for node in reversed(roots)]
    visits = 0
    while stack:
        above, node = stack.pop()
        visits += 1
        if visits > _MOST_NODES:
            raise ValueError(f"the scene has more than {_MOST_NODES} nodes, or a node contains itself")
        pose = above @ _pose(node)
        for instance in (*node.findall("instance_geometry"), *node.findall("instance_controller")):
            geometry = _target(named, instance.get("url"))
            if geometry.tag == "controller":
                geometry = _target(named, next((skin.get("source") for skin in geometry.iter("skin")), None))
            placed.append((pose, geometry))
        below = [*node.findall("node"), *(_target(named, i.get("url")) for i in node.findall("instance_node"))]
        stack.extend((pose, child) for child in reversed(below))
    return placed


def _pose(node: ET.Element) -> Float[np.ndarray, "4 4"]:
    """Return the product of a node's transforms, in the order in which they are written."""
    pose = np.eye(4)
    for element in node:
        if element.tag not in ("matrix", "translate", "rotate", "scale"):
            continue
        values = np.array((element.text or "").split(), dtype=float)
        step = np.eye(4)
        if element.tag == "matrix":
            step = values.reshape(4, 4)
        elif element.tag == "translate":
            step[:3, 3] = values
        elif element.tag == "scale":
            step[:3, :3] = np.diag(values.reshape(3))
        else:
            axis = values[:3] / max(float(np.linalg.norm(values[:3])), 1e-12)
            step[:3, :3] = axis_rotation(axis, np.deg2rad(values[3]))
        pose = pose @ step
    return pose


def _surface(geometry: ET.Element, named: dict[str, ET.Element]) -> TriangleMesh:
    """Return the surface of a geometry in its own frame. `named` maps "#id" to elements."""
    vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], 0
    known: dict[ET.Element, tuple[int, int]] = {}
    for element in geometry.iterfind("mesh/*"):
        if element.tag not in _FACES:
            continue
        if element.find("ph") is not None:
            raise ValueError(f"<{element.tag}> has a polygon with holes (<ph>); export the mesh as triangles")
        inputs = element.findall("input")
        stride = 1 + max((int(entry.get("offset", "0")) for entry in inputs), default=0)
        corner = next((entry for entry in inputs if entry.get("semantic") == "VERTEX"), None)
        if corner is None:
            raise ValueError(f"<{element.tag}> has no VERTEX input")
        shared = _target(named, corner.get("source"))
        if shared not in known:
            vertices.append(_positions(shared, named))
            known[shared] = count, len(vertices[-1])
            count += len(vertices[-1])
        start, available = known[shared]
        offset = int(corner.get("offset", "0"))
        loops = [np.array((p.text or "").split(), dtype=np.int64)[offset::stride] for p in element.findall("p")]
        if element.tag == "tristrips":
            loops = [_strip(loop) for loop in loops]
        indices = np.concatenate([np.zeros(0, dtype=np.int64), *loops])
        if element.tag in ("triangles", "tristrips"):
            sides = np.full(len(indices) // 3, 3)
        elif element.tag == "polylist":
            sides = np.array((element.findtext("vcount") or "").split(), dtype=np.int64)
        else:
            sides = np.array([len(loop) for loop in loops], dtype=np.int64)
        # Each count is checked separately, because the sum of absurd counts could overflow to a small number.
        few = not (sides < 0).any() and (sides <= len(indices)).all() and sides.sum() <= len(indices)
        if not few or (len(indices) and not 0 <= indices.min() <= indices.max() < available):
            raise ValueError(f"<{element.tag}> names vertices that the file does not hold")
        faces.append(_fans(indices, sides) + start)
    return TriangleMesh(np.concatenate(vertices), np.concatenate(faces))


def _placed(mesh: TriangleMesh, pose: Float[np.ndarray, "4 4"]) -> TriangleMesh:
    faces = mesh.faces[:, ::-1] if np.linalg.det(pose[:3, :3]) < 0 else mesh.faces
    return TriangleMesh(mesh.vertices @ pose[:3, :3].T + pose[:3, 3], faces)


def _positions(vertices: ET.Element, named: dict[str, ET.Element]) -> Float[np.ndarray, "vertices 3"]:
    entry = next((entry for entry in vertices.findall("input") if entry.get("semantic") == "POSITION"), None)
    if entry is None:
        raise ValueError("<vertices> has no POSITION input")
    source = _target(named, entry.get("source"))
    accessor = source.find("technique_common/accessor")
    stride = max(3, int(accessor.get("stride", "3"))) if accessor is not None else 3
    values = np.array((source.findtext("float_array") or "").split(), dtype=float)
    return values[: len(values) // stride * stride].reshape(-1, stride)[:, :3]


def _strip(corners: Int[np.ndarray, "corners"]) -> Int[np.ndarray, "_"]:
    faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces.ravel()


def _fans(indices: Int[np.ndarray, "corners"], sides: Int[np.ndarray, "polygons"]) -> Int[np.ndarray, "faces 3"]:
    starts = np.cumsum(sides) - sides
    fans = [np.zeros((0, 3), dtype=np.int64)]
    for number in np.unique(sides[sides > 2]):
        first = starts[sides == number]
        for k in range(1, int(number) - 1):
            fans.append(np.stack([indices[first], indices[first + k], indices[first + k + 1]], axis=1))
    return np.concatenate(fans)


def _target(named: dict[str, ET.Element], reference: str | None) -> ET.Element:
    if reference not in named:
        raise ValueError(f"an element refers to {reference!r}, which is not in the file")
    return named[reference]
