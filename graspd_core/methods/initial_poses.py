"""Seeded starts: the palm faces a random point of the object's convex hull, fingers open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.hands.kinematics import forward, link_poses, make_kinematics
from graspd_core.hands.model import HandModel
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.methods.obstacle_distance import RETREAT, ObstacleTensors, make_obstacle_tensors, obstacle_gaps
from graspd_core.methods.poses import Poses
from graspd_core.methods.problem_tensors import fingertip_groups
from graspd_core.scene.scene import Scene
from graspd_core.se3 import SE3, quaternion_from_rotation, rotation_from_axis_angle
from graspd_core.types import TriangleMesh

# Distance of the palm from the hull [m], tilt of the palm against the hull's normal [rad], spread of the joints.
_STANDOFF = (0.005, 0.05)
_TILT = 0.35
_JOINT_NOISE = 0.1
# Places drawn for each start kept, surface points that tell the object's width, and how much width matters [m].
_POOL, _SPAN_POINTS, _SPAN_SCALE = 6, 400, 0.012
# Among obstacles more places are drawn; how deep a hand reaches into one [m] that makes its place e times rarer, and
# how far a hand is lifted off the support to stay above it [m].
_POOL_AMONG_OBSTACLES, _DEPTH_SCALE, _HIGHEST_LIFT = 18, 0.005, 0.03
# The slab of the object that a hand closes around [m].
_SLAB_HALF_BREADTH, _SLAB_DEPTH = 0.05, 0.09


def draw_starts(scene: Scene, hand: HandModel, count: int, seed: int, device: str, dtype: torch.dtype) -> Poses:
    """`count` seeded starts with the palm on the object's convex hull, preferring places that the hand can span.

    After the published initialisation of Grasp'D (a random surface point, palm towards it, random roll), but on the
    hull, so that no palm starts inside a hollow, and with place and roll drawn in favour of narrow cross-sections.
    Where there are obstacles, hands that would reach into them, or could not have come there, are drawn last.
    """
    generator = torch.Generator().manual_seed(seed)
    obstacles = make_obstacle_tensors(scene, hand, "cpu", torch.float64)
    pool = (_POOL if obstacles is None else _POOL_AMONG_OBSTACLES) * count
    points, normals = surface_samples(convex_hull(scene.object.mesh), pool, seed)

    def uniform(low: float, high: float) -> Float[Tensor, "pool"]:
        return low + (high - low) * torch.rand(pool, generator=generator, dtype=torch.float64)

    outward = torch.as_tensor(normals)
    tilt_axis = torch.linalg.cross(outward, torch.randn(pool, 3, generator=generator, dtype=torch.float64))
    tilt_axis = tilt_axis / tilt_axis.norm(dim=-1, keepdim=True)
    facing = (rotation_from_axis_angle(tilt_axis, uniform(-_TILT, _TILT)) @ outward[..., None]).squeeze(-1)
    rotation = aligning_rotation(torch.as_tensor(hand.palm_normal), -facing)
    rotation = rotation_from_axis_angle(facing, uniform(-np.pi, np.pi)) @ rotation
    palm = torch.as_tensor(points) + uniform(*_STANDOFF)[:, None] * outward
    translation = palm - (rotation @ torch.as_tensor(hand.palm_center)[:, None]).squeeze(-1)
    spread = torch.as_tensor(hand.upper - hand.lower)
    noise = _JOINT_NOISE * (torch.rand(pool, len(spread), generator=generator, dtype=torch.float64) - 0.5)
    joints = torch.as_tensor(hand.open_posture) + noise * spread
    joints = joints.clamp(torch.as_tensor(hand.lower), torch.as_tensor(hand.upper))

    blocked = torch.zeros(pool, dtype=torch.float64)
    if obstacles is not None:
        links = forward(make_kinematics(hand, dtype=torch.float64), joints)
        raised, blocked = raise_clear(obstacles, SE3(rotation, translation), links)
        palm, translation = palm + raised - translation, raised

    surface, _ = surface_samples(scene.object.mesh, _SPAN_POINTS, seed)
    half_width = half_widths(torch.as_tensor(surface), palm, rotation, hand)
    # Gumbel noise makes the best `count` a draw without replacement with weights exp(−half width / scale).
    gumbel = -torch.log(-torch.log(uniform(1e-12, 1.0)))
    chosen = (gumbel - half_width / _SPAN_SCALE - blocked / _DEPTH_SCALE).topk(count).indices
    return Poses(
        translation[chosen].to(device, dtype),
        quaternion_from_rotation(rotation[chosen]).to(device, dtype),
        joints[chosen].to(device, dtype),
    )


def raise_clear(
    obstacles: ObstacleTensors, base: SE3, links: SE3
) -> tuple[Float[Tensor, "batch 3"], Float[Tensor, "batch"]]:
    """Origins of hands moved off the support, within bounds; and how deep they reach into anything [m].

    They are looked at where they are moved to and drawn back from there; `links` are the link poses in the base frame.
    """
    translation = base.translation
    if obstacles.normal is not None:
        depth = -obstacle_gaps(replace(obstacles, sdfs=()), base, links).amin(-1)
        translation = translation + depth.clamp(0.0, _HIGHEST_LIFT)[:, None] * obstacles.normal
    behind = translation + RETREAT * (base.rotation @ obstacles.retreat)
    gaps = [obstacle_gaps(obstacles, SE3(base.rotation, at), links).amin(-1) for at in (translation, behind)]
    return translation, (-torch.stack(gaps).amin(0)).clamp_min(0.0)


def half_widths(
    surface: Float[Tensor, "points 3"],
    palm: Float[Tensor, "batch 3"],
    rotation: Float[Tensor, "batch 3 3"],
    hand: HandModel,
) -> Float[Tensor, "batch"]:
    """How far the object reaches from the middle of the palm along the direction in which the fingers close [m].

    Only the slab of the object counts that the fingers close around: a hand's breadth wide, and as deep as they reach.
    """
    normal = torch.as_tensor(hand.palm_normal)
    closing = torch.as_tensor(closing_axis(hand))
    local = (surface[None] - palm[:, None]) @ rotation
    along, depth = local @ closing, local @ normal
    across = local @ torch.linalg.cross(normal, closing)
    within = (across.abs() < _SLAB_HALF_BREADTH) & (depth < _SLAB_DEPTH)
    width = torch.where(within, along.abs(), 0.0).amax(-1)
    # A palm that faces past the object has nothing to close around.
    return torch.where(within.any(-1), width, torch.inf)


def closing_axis(hand: HandModel) -> Float[np.ndarray, "3"]:
    """Unit direction in the palm plane along which the fingertips travel most from open to closed, base frame."""
    tips = [int(np.flatnonzero(hand.link_group == group)[-1]) for group in fingertip_groups(hand)]
    travel = (link_poses(hand, hand.closed_posture)[1] - link_poses(hand, hand.open_posture)[1])[tips]
    in_plane = travel - np.outer(travel @ hand.palm_normal, hand.palm_normal)
    return np.linalg.svd(in_plane)[2][0]


def aligning_rotation(source: Float[Tensor, "3"], targets: Float[Tensor, "batch 3"]) -> Float[Tensor, "batch 3 3"]:
    """Rotations that turn unit vector `source` onto each unit target (any roll), through a Householder pair."""
    # Two reflections make a rotation; the first maps source to its mirror, the second maps that to the target.
    helper = torch.eye(3, dtype=targets.dtype)[source.abs().argmin()]
    middle = torch.linalg.cross(source, helper)
    middle = middle / middle.norm()
    return reflection_onto(middle.expand_as(targets), targets) @ reflection_onto(
        source.expand_as(targets), middle.expand_as(targets)
    )


def reflection_onto(a: Float[Tensor, "batch 3"], b: Float[Tensor, "batch 3"]) -> Float[Tensor, "batch 3 3"]:
    """Householder reflections that swap unit vectors a and b; the identity's mirror where they agree."""
    v = a - b
    same = v.norm(dim=-1, keepdim=True) < 1e-9
    # Where a = b any mirror plane that contains a will do.
    fallback = torch.linalg.cross(a, torch.eye(3, dtype=a.dtype)[a.abs().argmin(-1)])
    v = torch.where(same, fallback, v)
    v = v / v.norm(dim=-1, keepdim=True)
    return torch.eye(3, dtype=a.dtype) - 2 * v[..., :, None] * v[..., None, :]


def convex_hull(mesh: TriangleMesh) -> TriangleMesh:
    """Convex hull of a mesh; a flat mesh, which has none, is returned as it is."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(mesh.vertices)
    except QhullError:
        return mesh
    corners = hull.points[hull.simplices]
    # Qhull leaves the winding to chance; its equations point outwards.
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = (normals * hull.equations[:, :3]).sum(-1) < 0
    faces = hull.simplices.astype(np.int64)
    faces[inward] = faces[inward][:, ::-1]
    used, compact = np.unique(faces, return_inverse=True)
    return TriangleMesh(mesh.vertices[used], compact.reshape(-1, 3))
