"""Geoms of an MJCF file, as MuJoCo has compiled them, as primitives; errors about an element of MuJoCo's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.errors import HandError, shown
from graspd_core.hands.model import Primitive, PrimitiveKind
from graspd_core.hands.readers.link_meshes import LARGEST_SIZE, mesh_hull
from graspd_core.hands.readers.xml_io import Element, wrong
from graspd_core.mesh.convex_parts import limited_hull
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import TriangleMesh

# How many of a geom's sizes count.
_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "ellipsoid": 3}
_PLAIN: dict[str, PrimitiveKind] = {"sphere": "sphere", "capsule": "capsule", "cylinder": "cylinder", "box": "box"}
_CORNERS_OF_ELLIPSOID = 200


@dataclass(frozen=True, eq=False)
class MeshAsset:
    """A mesh of the file.

    Attributes:
        place: its line and name, for errors.
        file: relative to the file's folder; empty for a mesh whose vertices are in the file.
        scale: of its coordinates, along each axis.
        vertices: of a mesh without file [m].
    """

    place: Element
    file: str
    scale: Float[np.ndarray, "3"]
    vertices: Float[np.ndarray, "_ 3"]


def read_assets(path: Path, spec: Any) -> dict[str, MeshAsset]:
    """The meshes of a parsed file by name.

    Raises:
        HandError: one is moved or turned, or has no size.
    """
    assets = {}
    for mesh in spec.meshes:
        if np.any(mesh.refpos) or not np.array_equal(mesh.refquat, (1, 0, 0, 0)):
            raise fault(path, mesh, "<mesh refpos=...> and <mesh refquat=...> are not read")
        if not np.all(mesh.scale):
            raise fault(path, mesh, f"<mesh scale={shown(list(mesh.scale))}>: a factor cannot be zero")
        file = str(Path(spec.meshdir) / mesh.file) if mesh.file else ""
        vertices = np.array(mesh.uservert, dtype=float).reshape(-1, 3)
        assets[mesh.name or Path(mesh.file).stem] = MeshAsset(_place(mesh), file, np.array(mesh.scale), vertices)
    return assets


def fault(path: Path, element: Any, message: str) -> HandError:
    """The error to raise about an element of a `MjSpec`: names the file, the line, and what it belongs to."""
    return wrong(path, _place(element), message)


def _place(element: Any) -> Element:
    named = element if element.name or not hasattr(element, "parent") else element.parent
    place = Element(type(named).__name__.removeprefix("Mjs").lower())
    place.line = int(element.info.removeprefix("line ") or 0)
    place.owner = f"{place.tag} {named.name!r}" if named.name else ""
    return place


def type_name(element: Any) -> str:
    """The type of a geom or joint as MJCF writes it."""
    return element.type.name.partition("_")[2].lower()


def pose(position: Float[np.ndarray, "3"], quaternion: Float[np.ndarray, "4"]) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation [m] of one of a model's poses."""
    return rotation_from_quaternion(torch.as_tensor(np.array(quaternion))).numpy(), np.array(position)


def check_type(path: Path, geom: Any, assets: Mapping[str, MeshAsset]) -> None:
    """Raise HandError for a geom of a type that is not read, or a mesh that the file does not hold."""
    kind, known = type_name(geom), (*_SIZES, "mesh")
    if kind not in known or (geom.meshname and kind != "mesh"):
        raise fault(path, geom, f"<geom type={kind!r}> is not read; known: {', '.join(known)}")
    if kind == "mesh" and geom.meshname not in assets:
        raise fault(path, geom, f"names the mesh {geom.meshname!r}; known: {', '.join(assets) or 'none'}")


def read_geom(path: Path, model: Any, geom: Any, hull: TriangleMesh | None) -> Primitive:
    """One geom as a primitive of link zero: ellipsoids and meshes, of which `hull` is one, as hulls.

    Raises:
        HandError: it is larger than anything of a hand.
    """
    rotation, translation = pose(model.geom_pos[geom.id], model.geom_quat[geom.id])
    if hull is not None:
        return Primitive(0, "hull", rotation, translation, (), hull.vertices, hull.faces)
    kind = type_name(geom)
    size = model.geom_size[geom.id, : _SIZES[kind]].copy()
    if not (size <= LARGEST_SIZE).all():
        raise fault(path, geom, f"<geom size='{size}'>: larger than {LARGEST_SIZE:g} m; lengths are in metres")
    if kind in _PLAIN:
        return Primitive(0, _PLAIN[kind], rotation, translation, tuple(size.tolist()))
    import trimesh

    ball = limited_hull(np.asarray(trimesh.creation.icosphere(subdivisions=2).vertices) * size, _CORNERS_OF_ELLIPSOID)
    return Primitive(0, "hull", rotation, translation, (), ball.vertices, ball.faces)


def asset_hull(path: Path, mesh: MeshAsset, corners: int) -> TriangleMesh:
    """The hull of a mesh, of some `corners` at most [m].

    Raises:
        HandError: its file is not there or not a mesh, or it is larger than anything of a hand.
    """
    if mesh.file:
        return mesh_hull(path, mesh.place, mesh.file, mesh.scale, corners)
    points = mesh.vertices * mesh.scale
    if len(points) < 4 or np.abs(points).max() > LARGEST_SIZE:
        text = f"{len(points)} points; expected four or more, within {LARGEST_SIZE:g} m"
        raise wrong(path, mesh.place, f"<mesh vertex=...>: {text}")
    return limited_hull(points, corners)
