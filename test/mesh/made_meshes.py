"""Meshes that tests of several folders make."""

from typing import Any

import numpy as np
import trimesh

from graspd_core import TriangleMesh, make_shape


def taken(made: trimesh.Trimesh) -> TriangleMesh:
    """A mesh that trimesh made."""
    return TriangleMesh(np.array(made.vertices), np.array(made.faces, dtype=np.int64))


def box_of(half: Any, centre: Any = (0.0, 0.0, 0.0)) -> TriangleMesh:
    """A box of given half sides, or a cube of one half side, about a centre [m]."""
    unit = make_shape("box")
    return TriangleMesh(unit.vertices / np.abs(unit.vertices).max(0) * half + np.asarray(centre, float), unit.faces)


def box_between(low: Any, high: Any) -> TriangleMesh:
    """A box of twelve triangles from its lowest corner to its highest [m]."""
    return taken(trimesh.creation.box(bounds=[low, high]))
