"""Compute forward kinematics of a batch of postures, and the mesh of a hand at a posture.

Functions of tensors are differentiable in the joint values, with exact gradients. A joint rotates by Rodrigues' formula
`R = I + sin(q) K + (1 - cos(q)) K²`. Each term is multiplied by the joint's constant offset in advance. So the pose of
a link in its parent is a weighted sum of constant matrices. Links of equal depth are computed together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from graspd_core.hands.model import HandModel, Primitive
from graspd_core.se3 import SE3, rotation_from_quaternion
from graspd_core.types import Posture, TriangleMesh, joined

# In this order: joint values of one posture, points [m], the link of each point, and `T_base_link` of each link [m].
JointValues = Float[np.ndarray, "joints"]
LinkPoints = Float[np.ndarray, "points 3"]
LinkNumbers = Int[np.ndarray, "points"]
LinkPoses = tuple[Float[np.ndarray, "links 3 3"], Float[np.ndarray, "links 3"]]

# Distance between pregrasp and retreat, straight back against the approach direction [m].
RETREAT = 0.1


@dataclass(frozen=True, eq=False)
class Kinematics:
    """A hand's constants as tensors on one device. Links are sorted by depth.

    Attributes:
        constant, sine, cosine: `T_parent_link = constant + sin(q) sine + cos(q) cosine`, upper three rows.
        slide: translation per metre of a prismatic joint. None if no joint is prismatic.
        joint: actuated joint of each sorted link. 0 for a fixed link, whose sine, cosine and slide are zero.
        multiplier, shift: a coupled joint has the value multiplier · q + shift. None if no joint is coupled.
        level_sizes: number of links at each depth, starting with the base.
        level_parents: index of each link's parent among the links one level up, for each depth from 2 on. None for a
            depth at which link i has parent i.
        order: position of each link of the hand in the sorted list.
    """

    constant: Float[Tensor, "links 3 4"]
    sine: Float[Tensor, "links 3 4"]
    cosine: Float[Tensor, "links 3 4"]
    slide: Float[Tensor, "links 3 4"] | None
    joint: Int[Tensor, "links"]
    level_sizes: tuple[int, ...]
    level_parents: tuple[Int[Tensor, "_"] | None, ...]
    order: Int[Tensor, "links"]
    multiplier: Float[Tensor, "links"] | None = None
    shift: Float[Tensor, "links"] | None = None


# A hand is hashed by identity, so a copy made by `replace` is another hand. Hands are large, so the cache is small.
@lru_cache(maxsize=8)
def make_kinematics(
    hand: HandModel, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
) -> Kinematics:
    """Return the constants that `forward` needs. The most recent results are cached."""
    depth = link_depths(hand.link_parent)
    order = np.argsort(depth, kind="stable")
    position = np.argsort(order, kind="stable")
    sizes = tuple(int(n) for n in np.bincount(depth))
    parents: list[Tensor | None] = []
    for level in range(2, len(sizes)):
        members = order[depth[order] == level]
        local = position[hand.link_parent[members]] - sum(sizes[: level - 1])
        one_to_one = np.array_equal(local, np.arange(sizes[level - 1]))
        parents.append(None if one_to_one else torch.as_tensor(local, device=device))
    constant, sine, cosine, slide = _coefficients(hand)

    def tensor(array: np.ndarray) -> Tensor:
        return torch.as_tensor(array[order], device=device, dtype=dtype).contiguous()

    return Kinematics(
        constant=tensor(constant),
        sine=tensor(sine),
        cosine=tensor(cosine),
        slide=tensor(slide) if slide.any() else None,
        joint=torch.as_tensor(np.maximum(hand.link_joint[order], 0), device=device),
        level_sizes=sizes,
        level_parents=tuple(parents),
        order=torch.as_tensor(position, device=device),
        multiplier=tensor(hand.link_multiplier) if hand.mimics else None,
        shift=tensor(hand.link_shift) if hand.mimics else None,
    )


def forward(kinematics: Kinematics, q: Float[Tensor, "batch joints"]) -> SE3:
    """Return `T_base_link` of every link at joint values q [rad] or [m]. The shape is batch by links."""
    k = kinematics
    values = q[:, k.joint]
    if k.multiplier is not None and k.shift is not None:
        values = values * k.multiplier + k.shift
    local = k.constant + values.sin()[..., None, None] * k.sine + values.cos()[..., None, None] * k.cosine
    if k.slide is not None:
        local = local + values[..., None, None] * k.slide
    # The base and its children need no product, because all poses are relative to the base frame.
    levels = list(local.split(list(k.level_sizes), dim=1))
    for depth, parents in enumerate(k.level_parents, start=2):
        parent = levels[depth - 1] if parents is None else levels[depth - 1][:, parents]
        turned = parent[..., :3] @ levels[depth]
        levels[depth] = torch.cat([turned[..., :3], turned[..., 3:] + parent[..., 3:]], dim=-1)
    world = torch.cat(levels, dim=1)[:, k.order]
    return SE3(world[..., :3], world[..., 3])


def placement(
    num_links: int, points: Float[Tensor, "points 3"], links: Int[Tensor, "points"], *, directions: bool = False
) -> Float[Tensor, "points columns"]:
    """Return a constant matrix with which `place_points` transforms link-frame points (or directions).

    Row p holds the homogeneous coordinates of point p in the four columns of its link. `place_points` is then one
    matrix product for the whole batch. This is twice as fast as gathering a rotation per point.
    """
    matrix = points.new_zeros(len(points), num_links, 4)
    rows = torch.arange(len(points), device=points.device)
    matrix[rows, links, :3] = points
    matrix[rows, links, 3] = 0.0 if directions else 1.0
    return matrix.flatten(1)


def place_points(matrix: Float[Tensor, "points columns"], links: SE3) -> Float[Tensor, "batch points 3"]:
    """Return the points of a `placement` in the base frame [m], at the link poses of `forward`."""
    batch = links.rotation.shape[0]
    poses = torch.cat([links.rotation, links.translation[..., None]], dim=-1)
    # The sizes are explicit, because a size of −1 cannot be resolved for an empty batch.
    columns = poses.permute(1, 3, 0, 2).reshape(4 * poses.shape[1], 3 * batch)
    return (matrix @ columns).unflatten(1, (batch, 3)).transpose(0, 1)


def point_jacobian(
    hand: HandModel, q: JointValues, points: LinkPoints, links: LinkNumbers
) -> Float[np.ndarray, "points 3 joints"]:
    """Return the geometric Jacobian of link-frame points at one posture, base frame: `dx = J dq`, `τ = Σ Jᵀ f`.

    A revolute joint with axis a through o moves a point x of a descendant link by `a × (x − o)`. A prismatic joint
    moves the point by `a`. A coupled joint adds motion times multiplier to the column of the actuated joint.
    """
    rotation, translation = link_poses(hand, q)
    x = in_base((rotation, translation), points, links)
    jacobian = np.zeros((len(points), 3, hand.num_joints))
    # behind[i, j] is True if link i lies on the chain from the base to link j.
    behind = np.eye(hand.num_links, dtype=bool)
    for link in range(1, hand.num_links):
        behind[:, link] |= behind[:, hand.link_parent[link]]
    for link in np.flatnonzero(hand.link_joint >= 0):
        axis = rotation[link] @ hand.joint_axis[link]
        revolute = hand.joint_kind[link] == "revolute"
        columns = np.cross(axis, x - translation[link]) if revolute else np.broadcast_to(axis, x.shape)
        jacobian[:, :, hand.link_joint[link]] += hand.link_multiplier[link] * columns * behind[link, links, None]
    return jacobian


def link_poses(hand: HandModel, q: JointValues) -> LinkPoses:
    """Return `T_base_link` of every link at one posture as numpy arrays: rotations and origins [m]."""
    links = forward(make_kinematics(hand, dtype=torch.float64), torch.as_tensor(q)[None].double())[0]
    return links.rotation.numpy(), links.translation.numpy()


def in_base(poses: LinkPoses, points: LinkPoints, links: LinkNumbers) -> LinkPoints:
    """Return link-frame points in the base frame [m], at the poses of `link_poses`."""
    rotations, translations = poses
    return np.einsum("pij,pj->pi", rotations[links], points) + translations[links]


def drawn_back(
    position: Float[Tensor, "*batch 3"],
    rotation: Float[Tensor, "*batch 3 3"],
    approach: Float[Tensor, "3"],
    distance: float = RETREAT,
) -> Float[Tensor, "*batch 3"]:
    """Return base positions [m] moved by `distance` [m] straight back against the approach direction."""
    return position - distance * (rotation @ approach)


def retreat_posture(hand: HandModel, pregrasp: Posture, distance: float = RETREAT) -> Posture:
    """Return the pregrasp moved by `distance` [m] straight back against the hand's approach direction."""
    rotation = rotation_from_quaternion(torch.as_tensor(pregrasp.quaternion_wxyz, dtype=torch.float64)).numpy()
    return replace(pregrasp, position=pregrasp.position - distance * rotation @ hand.approach)


def link_depths(parent: Int[np.ndarray, "links"]) -> Int[np.ndarray, "links"]:
    """Return the number of joints, fixed ones included, between each link and the base."""
    depth = np.zeros(len(parent), dtype=np.int64)
    for link, above in enumerate(parent):
        if above >= 0:
            depth[link] = depth[above] + 1
    return depth


def _coefficients(hand: HandModel) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the four constant 3x4 matrices of each link (see `Kinematics`), in the hand's link order."""
    offset, axis = hand.link_offset_rotation, hand.joint_axis[..., None]
    turns, slides = (np.array(hand.joint_kind)[:, None, None] == kind for kind in ("revolute", "prismatic"))
    cross = np.where(turns, np.cross(np.eye(3), hand.joint_axis[:, None]), 0.0)
    still = np.zeros_like(axis)
    parts = (
        (offset @ (np.eye(3) + cross @ cross), hand.link_offset_translation[..., None]),
        (offset @ cross, still),
        (-offset @ cross @ cross, still),
        (np.zeros_like(cross), np.where(slides, offset @ axis, still)),
    )
    constant, sine, cosine, slide = (np.concatenate(part, -1) for part in parts)
    return constant, sine, cosine, slide


def hand_mesh(hand: HandModel, q: JointValues) -> TriangleMesh:
    """Return all collision primitives at joint values q as one mesh of overlapping closed bodies, base frame [m].

    Curved faces are approximated by triangles with vertices on the true surface.
    """
    rotations, translations = link_poses(hand, q)
    meshes = [(primitive.link, primitive_mesh(primitive)) for primitive in hand.primitives]
    return joined(*(replace(m, vertices=m.vertices @ rotations[k].T + translations[k]) for k, m in meshes))


def primitive_mesh(primitive: Primitive) -> TriangleMesh:
    """Return the triangle mesh of one primitive in the frame of its link [m]."""
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
