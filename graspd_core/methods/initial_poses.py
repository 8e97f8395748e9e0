"""Seeded starts: the palm faces a random point of the object's convex hull, fingers open."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
from graspd_core.methods.restrictions import UNRESTRICTED, BoundRestrictions
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
# Pools drawn at most where restrictions forbid starts, and how far apart the seeds of two pools are.
_MOST_POOLS, _POOL_SEED_STEP = 20, 7_919
# The slab of the object that a hand closes around [m].
_SLAB_HALF_BREADTH, _SLAB_DEPTH = 0.05, 0.09


def draw_starts(
    scene: Scene,
    hand: HandModel,
    count: int,
    seed: int,
    device: str,
    dtype: torch.dtype,
    *,
    restrictions: BoundRestrictions = UNRESTRICTED,
) -> Poses:
    """`count` seeded starts with the palm on the object's convex hull, preferring places that the hand can span.

    After the published initialisation of Grasp'D (a random surface point, palm towards it, random roll), but on the
    hull, so that no palm starts inside a hollow, and with place and roll drawn in favour of narrow cross-sections.
    Where there are obstacles, hands that would reach into them, or could not have come there, are drawn last.
    Restrictions have starts drawn until there are enough that they allow, or `_MOST_POOLS` times as many were drawn:
    then there are fewer than `count`, perhaps none.
    """
    generator = torch.Generator().manual_seed(seed)
    obstacles = make_obstacle_tensors(scene, hand, "cpu", torch.float64)
    pool = (_POOL if obstacles is None else _POOL_AMONG_OBSTACLES) * count
    hull = convex_hull(scene.object.mesh)
    drawn = _draw_pool(hull, hand, pool, seed, generator)
    if restrictions.each:
        drawn = _allowed(drawn, hull, hand, pool, seed, generator, restrictions)
    blocked = torch.zeros(len(drawn.joints), dtype=torch.float64)
    if obstacles is not None:
        links = forward(make_kinematics(hand, dtype=torch.float64), drawn.joints)
        raised, blocked = raise_clear(obstacles, SE3(drawn.rotation, drawn.translation), links)
        drawn = replace(drawn, palm=drawn.palm + raised - drawn.translation, translation=raised)

    surface, _ = surface_samples(scene.object.mesh, _SPAN_POINTS, seed)
    half_width = half_widths(torch.as_tensor(surface), drawn.palm, drawn.rotation, hand)
    # Gumbel noise makes the best `count` a draw without replacement with weights exp(−half width / scale).
    gumbel = -torch.log(-torch.log(_uniform(1e-12, 1.0, len(drawn.joints), generator)))
    preference = gumbel - half_width / _SPAN_SCALE - blocked / _DEPTH_SCALE
    chosen = preference.topk(min(count, len(preference))).indices
    return Poses(
        drawn.translation[chosen].to(device, dtype),
        quaternion_from_rotation(drawn.rotation[chosen]).to(device, dtype),
        drawn.joints[chosen].to(device, dtype),
    )


@dataclass(frozen=True)
class _Pool:
    """Hands that starts are chosen from: middle of the palm and origin of the base [m], turn, joints [rad]."""

    palm: Float[Tensor, "batch 3"]
    rotation: Float[Tensor, "batch 3 3"]
    translation: Float[Tensor, "batch 3"]
    joints: Float[Tensor, "batch joints"]

    def __getitem__(self, rows: Tensor) -> _Pool:
        return _Pool(*(values[rows] for values in vars(self).values()))


def _uniform(low: float, high: float, count: int, generator: torch.Generator) -> Float[Tensor, "count"]:
    return low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)


def _draw_pool(hull: TriangleMesh, hand: HandModel, count: int, seed: int, generator: torch.Generator) -> _Pool:
    """Open hands whose palms face random points of the hull, rolled at random."""
    points, normals = surface_samples(hull, count, seed)
    outward = torch.as_tensor(normals)
    tilt_axis = torch.linalg.cross(outward, torch.randn(count, 3, generator=generator, dtype=torch.float64))
    tilt_axis = tilt_axis / tilt_axis.norm(dim=-1, keepdim=True)
    tilt = _uniform(-_TILT, _TILT, count, generator)
    facing = (rotation_from_axis_angle(tilt_axis, tilt) @ outward[..., None]).squeeze(-1)
    rotation = aligning_rotation(torch.as_tensor(hand.palm_normal), -facing)
    rotation = rotation_from_axis_angle(facing, _uniform(-np.pi, np.pi, count, generator)) @ rotation
    palm = torch.as_tensor(points) + _uniform(*_STANDOFF, count, generator)[:, None] * outward
    translation = palm - (rotation @ torch.as_tensor(hand.palm_center)[:, None]).squeeze(-1)
    spread = torch.as_tensor(hand.upper - hand.lower)
    noise = _JOINT_NOISE * (torch.rand(count, len(spread), generator=generator, dtype=torch.float64) - 0.5)
    joints = torch.as_tensor(hand.open_posture) + noise * spread
    joints = joints.clamp(torch.as_tensor(hand.lower), torch.as_tensor(hand.upper))
    return _Pool(palm, rotation, translation, joints)


def _allowed(
    drawn: _Pool,
    hull: TriangleMesh,
    hand: HandModel,
    wanted: int,
    seed: int,
    generator: torch.Generator,
    restrictions: BoundRestrictions,
) -> _Pool:
    """The hands that the restrictions allow, and so many more drawn alike until there are `wanted`."""
    kept: list[_Pool] = []
    for again in range(1, _MOST_POOLS + 1):
        quaternions = quaternion_from_rotation(drawn.rotation)
        allowed = restrictions.starts(drawn.translation.numpy(), quaternions.numpy(), drawn.joints.numpy())
        kept.append(drawn[torch.as_tensor(allowed)])
        if sum(len(pool.joints) for pool in kept) >= wanted or again == _MOST_POOLS:
            break
        drawn = _draw_pool(hull, hand, wanted, seed + again * _POOL_SEED_STEP, generator)
    columns = zip(*(vars(pool).values() for pool in kept), strict=True)
    return _Pool(*(torch.cat(values)[:wanted] for values in columns))


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
