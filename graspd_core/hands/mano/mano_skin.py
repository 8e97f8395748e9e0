"""Compute MANO's forward function in torch: blend shapes and linear blend skinning, batched and differentiable.

Sources: Romero, Tzionas and Black, "Embodied Hands", 2017, after SMPL (Loper et al. 2015). Gradients in shape, pose and
translation are exact, also at zero rotation.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from graspd_core.errors import HandError
from graspd_core.hands.mano.mano_file import PARENTS, ManoData
from graspd_core.mesh.topology import face_edges
from graspd_core.se3 import rotation_from_quaternion, safe_norm


def rest(
    data: ManoData, betas: Float[Tensor, "batch shapes"]
) -> tuple[Float[Tensor, "batch vertices 3"], Float[Tensor, "batch 16 3"]]:
    """Return the vertices and joint positions of a shape at rest [m]. Missing betas are zero."""
    arrays = data.template, data.shape_directions[..., : betas.shape[-1]], data.joint_regressor
    template, directions, regressor = (torch.as_tensor(array).to(betas) for array in arrays)
    shaped = template + torch.einsum("vcs,bs->bvc", directions, betas)
    return shaped, regressor @ shaped


def skin_vertices(
    data: ManoData,
    betas: Float[Tensor, "batch shapes"],
    rotations: Float[Tensor, "batch 16 3 3"],
    translation: Float[Tensor, "batch 3"],
) -> tuple[Float[Tensor, "batch vertices 3"], Float[Tensor, "batch 16 3"]]:
    """Return the vertices and joint positions of the posed hand [m].

    Args:
        data: MANO model.
        betas: shape coefficients.
        rotations: rotation of every body relative to its parent, in model axes. Rotation 0 turns the whole hand.
        translation: shift of all vertices and joints [m].
    """
    shaped, joints = rest(data, betas)
    feature = (rotations[:, 1:] - torch.eye(3, dtype=rotations.dtype, device=rotations.device)).flatten(1)
    posed = shaped + torch.einsum("vcp,bp->bvc", torch.as_tensor(data.pose_directions).to(betas), feature)
    turns, places = [rotations[:, 0]], [joints[:, 0]]
    for body in range(1, len(PARENTS)):
        parent = PARENTS[body]
        bone = joints[:, body] - joints[:, parent]
        places.append(places[parent] + (turns[parent] @ bone[..., None]).squeeze(-1))
        turns.append(turns[parent] @ rotations[:, body])
    turn, place = torch.stack(turns, 1), torch.stack(places, 1)
    shift = place - (turn @ joints[..., None]).squeeze(-1)
    weights = torch.as_tensor(data.weights).to(betas)
    mixed = torch.einsum("vj,bjrc->bvrc", weights, torch.cat([turn, shift[..., None]], -1))
    vertices = (mixed[..., :3] @ posed[..., None]).squeeze(-1) + mixed[..., 3]
    return vertices + translation[:, None], place + translation[:, None]


def rotation_from_vector(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation matrices of axis-angle vectors [rad]. The function is smooth at zero."""
    half = 0.5 * safe_norm(vector)[..., None]
    return rotation_from_quaternion(torch.cat([half.cos(), 0.5 * torch.sinc(half / torch.pi) * vector], -1))


def wrist_loop(data: ManoData) -> Int[np.ndarray, "loop"]:
    """Return the indices of the vertices around the wrist opening, in the direction of face edges. Empty if no opening.

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


def close_wrist(data: ManoData, vertices: Float[Tensor, "batch vertices 3"]) -> Float[Tensor, "batch closed 3"]:
    """Return the vertices for `closed_faces`, with the hub of the fan appended. The hub is the mean of the loop."""
    loop = wrist_loop(data)
    if len(loop) == 0:
        return vertices
    return torch.cat([vertices, vertices[:, loop].mean(1, keepdim=True)], 1)
