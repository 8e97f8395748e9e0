"""Compute MANO's skin: blend shapes, linear blend skinning, and the closed wrist.

Sources: Romero, Tzionas and Black, "Embodied Hands", 2017, after SMPL (Loper et al. 2015).
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int

from graspd_core.errors import HandError
from graspd_core.hands.mano.mano_file import PARENTS, ManoData
from graspd_core.mesh.topology import face_edges


def rest(
    data: ManoData, betas: Float[np.ndarray, "shapes"]
) -> tuple[Float[np.ndarray, "vertices 3"], Float[np.ndarray, "16 3"]]:
    """Return the vertices and joint positions of a shape at rest [m]."""
    arrays = data.template, data.shape_directions, data.joint_regressor, betas
    template, directions, regressor, coefficients = map(torch.as_tensor, arrays)
    shaped = template + directions @ coefficients
    return shaped.numpy(), (regressor @ shaped).numpy()


def skin_vertices(
    data: ManoData,
    vertices: Float[np.ndarray, "vertices 3"],
    joints: Float[np.ndarray, "16 3"],
    turns: Float[np.ndarray, "16 3 3"],
    places: Float[np.ndarray, "16 3"],
) -> Float[np.ndarray, "vertices 3"]:
    """Return the vertices of the posed hand [m].

    Args:
        data: MANO model.
        vertices, joints: vertices and joint positions at rest [m].
        turns: rotation of every body from its orientation at rest, in model axes.
        places: joint positions of the posed hand [m].
    """
    from_parent = turns[list(PARENTS[1:])].transpose(0, 2, 1) @ turns[1:]
    posed = vertices + data.pose_directions @ (from_parent - np.eye(3)).ravel()
    shifts = places - np.einsum("jrc,jc->jr", turns, joints)
    mixed = np.einsum("vj,jrc->vrc", data.weights, turns)
    return np.einsum("vrc,vc->vr", mixed, posed) + data.weights @ shifts


def wrist_loop(data: ManoData) -> Int[np.ndarray, "loop"]:
    """Return the indices of the vertices around the wrist opening, in the direction of face edges. Empty if closed.

    Raises HandError: the boundary is not a single loop, faces have opposite winding, or three faces share an edge.
    """
    edges = face_edges(data.faces).tolist()
    present = set(map(tuple, edges))
    if len(present) != len(edges):
        raise HandError(f"{data.path}: f: faces of opposite winding, or an edge that three faces share")
    after = {a: b for a, b in present if (b, a) not in present}
    if not after:
        return np.zeros(0, dtype=np.int64)
    start = min(after)
    loop = [start]
    while (following := after.get(loop[-1])) not in (start, None) and len(loop) <= len(after):
        loop.append(following)
    open_edges = sum((b, a) not in present for a, b in present)
    if len(loop) != open_edges:
        raise HandError(f"{data.path}: f: the boundary is not one loop around the wrist")
    return np.array(loop)


def closed_faces(data: ManoData) -> Int[np.ndarray, "faces 3"]:
    """Return the faces, with the wrist closed by a fan around one more vertex. MANO's 1538 faces become 1554."""
    loop = wrist_loop(data)
    hub = np.full(len(loop), len(data.template))
    return np.concatenate([data.faces, np.column_stack([np.roll(loop, -1), loop, hub])])


def close_wrist(data: ManoData, vertices: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "closed 3"]:
    """Return the vertices for `closed_faces`, with the hub of the fan appended. The hub is the mean of the loop."""
    loop = wrist_loop(data)
    return np.vstack([vertices, vertices[loop].mean(0)]) if len(loop) else vertices
