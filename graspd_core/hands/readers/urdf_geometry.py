"""Shapes of a URDF as primitives: boxes, spheres, cylinders and capsules as they are, meshes as convex hulls."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from graspd_core.hands.model import Primitive, PrimitiveKind
from graspd_core.hands.readers.link_meshes import LARGEST_SIZE, mesh_hull, whole_mesh
from graspd_core.hands.readers.xml_io import read_numbers, read_origin, wrong
from graspd_core.types import TriangleMesh

_ROUND: dict[str, PrimitiveKind] = {"cylinder": "cylinder", "capsule": "capsule"}
_SHAPES = ("box", "sphere", "cylinder", "capsule", "mesh")


def read_primitives(path: Path, link: ET.Element, corners: int) -> tuple[list[Primitive], bool]:
    """The primitives of one `<link>`, link number zero, and whether they are those of its visuals.

    A link without `<collision>` collides with what it shows. A mesh is a hull of `corners` at most.

    Raises:
        HandError: a shape is unknown, has no positive size, or its mesh cannot be found or read.
    """
    elements = colliding(link)
    shown = bool(elements) and elements[0].tag == "visual"
    hull = partial(mesh_hull, corners=corners)
    return [_read_primitive(path, element, hull) for element in elements], shown


def read_visuals(path: Path, link: ET.Element) -> list[Primitive]:
    """What one `<link>` shows, link number zero: as `read_primitives`, but meshes are whole and need not be convex."""
    return [_read_primitive(path, element, whole_mesh) for element in link.findall("visual")]


def colliding(link: ET.Element) -> list[ET.Element]:
    """The elements of a `<link>` that its solids are read from."""
    return link.findall("collision") or link.findall("visual")


def _read_primitive(path: Path, element: ET.Element, read_mesh: Callable[..., TriangleMesh]) -> Primitive:
    rotation, translation = read_origin(path, element)
    geometry = element.find("geometry")
    shapes = [] if geometry is None else list(geometry)
    if not shapes:
        raise wrong(path, element, f"a <{element.tag}> element has no geometry")
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
