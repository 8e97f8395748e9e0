"""Geoms of an MJCF file as primitives."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from graspd_core.hands.model import Primitive, PrimitiveKind
from graspd_core.hands.readers.link_meshes import LARGEST_SIZE, mesh_hull
from graspd_core.hands.readers.mjcf_values import MjcfSettings, read_pose, turn_z_to
from graspd_core.hands.readers.xml_io import wrong
from graspd_core.hands.readers.xml_values import read_numbers
from graspd_core.mesh.convex_parts import limited_hull
from graspd_core.types import TriangleMesh

# How many of a geom's sizes count.
_SIZES = {"box": 3, "ellipsoid": 3, "sphere": 1, "capsule": 2, "cylinder": 2}
_PLAIN: dict[str, PrimitiveKind] = {
    "box": "box",
    "sphere": "sphere",
    "capsule": "capsule",
    "cylinder": "cylinder",
}


def read_geom(settings: MjcfSettings, geom: ET.Element, meshes: Mapping[str, ET.Element]) -> Primitive:
    """One geom, its class's attributes included, as a primitive of link zero; ellipsoids and meshes as hulls.

    Raises:
        HandError: its type is not known, its size not positive, or its mesh not there.
    """
    path = settings.path
    rotation, translation = read_pose(settings, geom)
    kind = geom.get("type", "sphere")
    if kind == "mesh":
        hull = _mesh(settings, geom, meshes)
        return Primitive(0, "hull", rotation, translation, (), hull.vertices, hull.faces)
    if kind not in _SIZES or "mesh" in geom.attrib:
        raise wrong(path, geom, f"<geom type={kind!r}> is not read; known: {', '.join((*_SIZES, 'mesh'))}")
    if "fromto" in geom.attrib:
        ends = read_numbers(path, geom, "fromto", 6, "").reshape(2, 3)
        length = float(np.linalg.norm(ends[1] - ends[0]))
        if not 1e-9 < length < LARGEST_SIZE or kind not in ("capsule", "cylinder"):
            raise wrong(path, geom, f"<geom fromto={geom.get('fromto')!r}>: only a capsule or cylinder of some length")
        # MuJoCo's z runs from the second end to the first; a solid of revolution looks the same either way.
        rotation, translation = turn_z_to((ends[1] - ends[0]) / length), ends.mean(0)
        size = np.array([_sizes(settings, geom, 1)[0], 0.5 * length])
    else:
        size = _sizes(settings, geom, _SIZES[kind])
    if kind == "ellipsoid":
        import trimesh

        hull = limited_hull(np.asarray(trimesh.creation.icosphere(subdivisions=2).vertices) * size, 200)
        return Primitive(0, "hull", rotation, translation, (), hull.vertices, hull.faces)
    return Primitive(0, _PLAIN[kind], rotation, translation, tuple(size.tolist()))


def _sizes(settings: MjcfSettings, geom: ET.Element, count: int) -> Float[np.ndarray, "n"]:
    words = (geom.get("size") or "").split()
    values = read_numbers(settings.path, geom, "size", len(words) or 1, "")
    # More sizes than the type needs are allowed, and mean nothing.
    if len(values) < count or not ((values[:count] > 0) & (values[:count] <= LARGEST_SIZE)).all():
        text = f"<geom size={geom.get('size')!r}>"
        raise wrong(settings.path, geom, f"{text}: expected {count} positive number(s) of at most {LARGEST_SIZE:g} m")
    return values[:count]


def _mesh(settings: MjcfSettings, geom: ET.Element, meshes: Mapping[str, ET.Element]) -> TriangleMesh:
    name = geom.get("mesh", "")
    if name not in meshes:
        raise wrong(settings.path, geom, f"names the mesh {name!r}; known: {', '.join(meshes) or 'none'}")
    asset = meshes[name]
    for key in ("refpos", "refquat", "builtin"):
        if key in asset.attrib:
            raise wrong(settings.path, asset, f"<mesh {key}=...> is not read")
    scale = read_numbers(settings.path, asset, "scale", 3, "1 1 1")
    if (scale == 0).any():
        raise wrong(settings.path, asset, f"<mesh scale={asset.get('scale')!r}>: a factor cannot be zero")
    if "vertex" in asset.attrib:
        words = str(asset.get("vertex")).split()
        points = read_numbers(settings.path, asset, "vertex", len(words) // 3 * 3, "").reshape(-1, 3) * scale
        if len(points) == 0 or np.abs(points).max() > LARGEST_SIZE:
            raise wrong(
                settings.path, asset, f"<mesh vertex=...>: {len(points)} points, not all within {LARGEST_SIZE:g} m"
            )
        return limited_hull(points, settings.corners)
    return mesh_hull(
        settings.path, asset, str(Path(settings.mesh_folder) / (asset.get("file") or "")), scale, settings.corners
    )
