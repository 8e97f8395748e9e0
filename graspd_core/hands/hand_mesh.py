"""A hand at a posture as one triangle mesh, for pictures, volumes and viewers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.model import HandModel, Primitive
from graspd_core.mesh.shapes import joined
from graspd_core.types import TriangleMesh


def hand_mesh(hand: HandModel, q: Float[np.ndarray, "joints"]) -> TriangleMesh:
    """Every collision primitive at joint values q, base frame [m]: closed bodies that overlap, not one solid.

    Curved faces are inscribed, with vertices on the true surface.
    """
    rotations, translations = link_poses(hand, q)
    meshes = [(primitive.link, primitive_mesh(primitive)) for primitive in hand.primitives]
    return joined(*(replace(m, vertices=m.vertices @ rotations[k].T + translations[k]) for k, m in meshes))


def primitive_mesh(primitive: Primitive) -> TriangleMesh:
    """One primitive, triangulated, in the frame of its link [m]."""
    import trimesh

    size = primitive.size
    if primitive.kind == "hull":
        vertices, faces = primitive.vertices, primitive.faces
    else:
        if primitive.kind == "box":
            made = trimesh.creation.box(extents=2.0 * np.asarray(size))
        elif primitive.kind == "sphere":
            made = trimesh.creation.icosphere(subdivisions=2, radius=size[0])
        elif primitive.kind == "capsule":
            made = trimesh.creation.capsule(height=2.0 * size[1], radius=size[0], count=(16, 16))
        else:
            made = trimesh.creation.cylinder(radius=size[0], height=2.0 * size[1], sections=24)
        vertices, faces = np.asarray(made.vertices), np.asarray(made.faces, dtype=np.int64)
    return TriangleMesh(vertices @ primitive.rotation.T + primitive.translation, faces)
