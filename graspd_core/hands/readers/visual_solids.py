"""What a hand looks like: the visual shapes of its URDF, for pictures; nothing is computed with them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from graspd_core.hands.model import HandModel, Primitive
from graspd_core.hands.readers.urdf import read_visuals
from graspd_core.hands.readers.xml_io import read_xml
from graspd_core.mesh.convex_parts import limited_hull
from graspd_core.mesh.mesh_files import simplify
from graspd_core.types import TriangleMesh

# Of all meshes of a hand together, and of each.
_MOST_TRIANGLES, _FEWEST_TRIANGLES = 4000, 60
# Simplifying gets stuck on torn surfaces, and may lose a thin part: what stays so many times too fine, or comes out
# smaller than this, is drawn as its hull.
_STUCK, _SHRUNK = 1.5, 0.95


def visual_solids(hand: HandModel, prefix: str = "") -> tuple[Primitive, ...]:
    """The shapes that a viewer draws, placed as `hand.primitives` are; a mesh is a `hull` that need not be convex.

    Meshes of more than 4000 triangles together are simplified to as many, at most half as many again. A link without
    visuals has its collision solids, and so has a hand that no URDF describes.

    Args:
        hand: any loaded hand.
        prefix: that it was loaded with.

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
            found += [replace(shape, link=index) for shape in read_visuals(path, link)]
    shown = {shape.link for shape in found}
    share = _MOST_TRIANGLES / max(sum(len(shape.faces) for shape in found), 1)
    return (*(_simpler(shape, share) for shape in found), *(s for s in hand.primitives if s.link not in shown))


def _simpler(shape: Primitive, share: float) -> Primitive:
    """A mesh with a share of its triangles."""
    count = max(int(len(shape.faces) * share), _FEWEST_TRIANGLES)
    if shape.kind != "hull" or len(shape.faces) <= count:
        return shape
    mesh = simplify(TriangleMesh(shape.vertices, shape.faces), count)
    extents = [np.ptp(vertices, axis=0) for vertices in (mesh.vertices[np.unique(mesh.faces)], shape.vertices)]
    if len(mesh.faces) > count * _STUCK or (extents[0] < _SHRUNK * extents[1]).any():
        mesh = limited_hull(shape.vertices, count // 2)
    return replace(shape, vertices=mesh.vertices, faces=mesh.faces)
