"""Collision elements of a URDF as primitives: boxes, spheres, cylinders as they are, meshes as convex hulls."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from graspd_core.errors import HandError
from graspd_core.hands.elements import read_numbers, read_origin
from graspd_core.hands.model import Primitive


def read_primitives(path: Path, link: int, element: ET.Element) -> list[Primitive]:
    """The primitives of one `<link>`.

    Raises:
        HandError: a shape is unknown, has no positive size, or its mesh cannot be found or read.
    """
    return [_read_primitive(path, link, collision) for collision in element.findall("collision")]


def _read_primitive(path: Path, link: int, collision: ET.Element) -> Primitive:
    rotation, translation = read_origin(path, collision)
    geometry = collision.find("geometry")
    shapes = [] if geometry is None else list(geometry)
    if not shapes:
        raise HandError(f"{path}: a <collision> element has no geometry")
    shape = shapes[0]
    if shape.tag == "box":
        half = 0.5 * _positive(path, shape, "size", 3)
        return Primitive(link, "box", rotation, translation, tuple(half.tolist()))
    if shape.tag == "sphere":
        return Primitive(link, "sphere", rotation, translation, (float(_positive(path, shape, "radius", 1)[0]),))
    if shape.tag in ("cylinder", "capsule"):
        radius, length = (float(_positive(path, shape, key, 1)[0]) for key in ("radius", "length"))
        kind = "cylinder" if shape.tag == "cylinder" else "capsule"
        return Primitive(link, kind, rotation, translation, (radius, 0.5 * length))
    if shape.tag == "mesh":
        scale = read_numbers(path, shape, "scale", 3, "1 1 1")
        vertices, faces = _hull(resolve_mesh(path, shape.get("filename") or ""), scale)
        return Primitive(link, "hull", rotation, translation, (), vertices, faces)
    raise HandError(f"{path}: unknown collision shape <{shape.tag}>; known: box, sphere, cylinder, capsule, mesh")


def resolve_mesh(urdf: Path, filename: str) -> Path:
    """Where a mesh named by a URDF lies: `package://` and relative paths are looked for upwards from the URDF.

    Raises:
        HandError: no such file.
    """
    plain = filename.removeprefix("file://")
    if plain.startswith("package://"):
        inside = Path(plain.removeprefix("package://"))
        tails = [inside, Path(*inside.parts[1:])]
    else:
        tails = [Path(plain)]
    for folder in urdf.resolve().parents:
        for tail in tails:
            if (folder / tail).is_file():
                return folder / tail
    raise HandError(f"{urdf}: mesh {filename!r} was not found beside the file or above it")


def _positive(path: Path, shape: ET.Element, key: str, count: int) -> Float[np.ndarray, "n"]:
    values = read_numbers(path, shape, key, count, "")
    if (values <= 0).any():
        raise HandError(f"{path}: <{shape.tag} {key}={shape.get(key)!r}>: sizes must be positive")
    return values


def _hull(mesh: Path, scale: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Convex hull of a mesh file, coincident corners merged [m]."""
    import trimesh

    try:
        loaded = trimesh.load(mesh, force="mesh")
        hull = trimesh.Trimesh(np.asarray(loaded.vertices) * scale, loaded.faces).convex_hull  # type: ignore[union-attr]
    # trimesh and its readers raise many unrelated types for a bad file; whichever it is, the file is the culprit.
    except Exception as error:
        raise HandError(f"{mesh}: cannot be read as a collision mesh: {error}".splitlines()[0]) from error
    return np.asarray(hull.vertices, dtype=np.float64), np.asarray(hull.faces, dtype=np.int64)
