"""Draw seeded initial poses: an open or half-closed hand that faces a random point of the object's convex hull.

An `Aim` restricts the approach direction, the roll, and the part of the object that the palm faces.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import QhullError
from torch import Tensor

from graspd_core.hands.fingers import find_fingers, placed_tips
from graspd_core.hands.kinematics import drawn_back, forward, link_poses, make_kinematics, place_points, placement
from graspd_core.hands.model import HandModel
from graspd_core.mesh.convex_parts import hull_surface
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.optimize import kernel_problem
from graspd_core.optimize.kernel_problem import KernelProblem
from graspd_core.optimize.loop import Joints, Poses, Positions, Values
from graspd_core.optimize.obstacle_distance import ObstacleTensors, least_gap, make_obstacle_tensors, obstacle_gaps
from graspd_core.optimize.restrictions import UNRESTRICTED, Aim, BoundRestrictions
from graspd_core.perception.scene import Scene
from graspd_core.se3 import SE3, aligning_rotation, normalize, quaternion_from_rotation, rotation_from_axis_angle
from graspd_core.types import TriangleMesh

# Greatest tilt of the palm from the hull's normal [rad], and range of the palm's distance from the object [m].
_TILT, _PALM_STANDOFF = 0.35, (0.005, 0.05)
# Starts with fingertips: range of the closing fraction (0 open, 1 closed), and of the distance to the object [m].
_SHARE_CLOSED, _TIP_STANDOFF = (0.2, 0.8), (-0.01, 0.01)
# Poses drawn per start, points that measure the width, half width that makes a pose e times less likely [m].
_POOL, _SPAN_POINTS, _SPAN_SCALE = 6, 400, 0.012
# Among obstacles: poses drawn for each start kept, the depth in an obstacle that makes a pose e times less likely [m],
# and the greatest lift off the support [m].
_POOL_AMONG_OBSTACLES, _DEPTH_SCALE, _HIGHEST_LIFT = 18, 0.005, 0.03
# Penalties are computed for this many rows per start at once (`_lowered`).
_ROWS_AT_ONCE = 6
# With restrictions: the greatest number of pools, and the seed step between two pools.
_MOST_POOLS, _POOL_SEED_STEP = 20, 7_919
# A hand closes around a slab of the object: the slab's half breadth, and its depth from `StartPool.grip` [m].
_SLAB_HALF_BREADTH, _SLAB_DEPTH = 0.05, 0.09
# Joint noise as a share of the range, and radius around the palm's axis in which the palm avoids the surface [m].
_JOINT_NOISE, _PALM_RADIUS = 0.1, 0.04
# Starts use this share of the approach cone and of the roll tolerance, because the optimiser turns the hand a little.
_INNER = 0.8


@dataclass(frozen=True)
class StartPool:
    """Hand poses in the object frame, from which the starts are chosen.

    Attributes:
        grip: middle of the palm, or middle between the fingertips, base frame [m]. This point faces the object.
        standoff: distance of the grip from the object [m].
        middle: position of the grip, object frame [m].
        rotation: orientation of the base.
        translation: origin of the base, object frame [m].
        joints: joint values [rad] or [m].
        depth: how far the faced place lies behind the first surface in front of the palm [m]. 0 without `Aim.places`.
    """

    grip: Float[Tensor, "batch 3"]
    standoff: Float[Tensor, "batch"]
    middle: Float[Tensor, "batch 3"]
    rotation: Float[Tensor, "batch 3 3"]
    translation: Float[Tensor, "batch 3"]
    joints: Float[Tensor, "batch joints"]
    depth: Float[Tensor, "batch"]

    def __getitem__(self, rows: Tensor) -> StartPool:
        return StartPool(*(values[rows] for values in vars(self).values()))


def draw_starts(
    scene: Scene,
    hand: HandModel,
    count: int,
    seed: int,
    device: str,
    dtype: torch.dtype,
    *,
    fingertips: float = 0.0,
    restrictions: BoundRestrictions = UNRESTRICTED,
    compiled: KernelProblem | None = None,
) -> Poses:
    """Draw `count` seeded starts with the palm near the object's convex hull, where the hand can span the object.

    As in Grasp'D, the palm faces a random point with a random roll. The points are on the hull, so that no palm starts
    inside a hollow. Narrow cross-sections are preferred. A share `fingertips` of the starts has half-closed fingers,
    with the fingertips at the point, because an open hand does not reach small or low objects. A pose is rarely chosen
    if the hand penetrates an obstacle at the pose or at its retreat (`compiled`, if given, measures the depths). With
    restrictions, at most `_MOST_POOLS` pools of poses are drawn. If all pools contain too few allowed poses, fewer than
    `count` starts are returned, perhaps none.
    """
    generator = torch.Generator().manual_seed(seed)
    # Distances to obstacles take most of the time. Single precision is enough for them.
    obstacles = make_obstacle_tensors(restrictions.searched(scene), hand, "cpu", torch.float32)
    pool = (_POOL if obstacles is None else _POOL_AMONG_OBSTACLES) * count
    hull = convex_hull(scene.object.mesh)
    surface = torch.as_tensor(surface_samples(scene.object.mesh, _SPAN_POINTS, seed)[0])

    def draw(seed: int) -> StartPool:
        drawn = _draw_pool(hull, hand, pool, seed, generator, fingertips)
        return drawn if restrictions.aim is None else _aimed(drawn, restrictions.aim, surface, hand, generator)

    drawn = _allowed(draw, pool, seed, restrictions) if restrictions.each else draw(seed)
    if obstacles is not None:
        links = forward(make_kinematics(hand, dtype=torch.float32), drawn.joints.float())
        lift = _lift(obstacles, SE3(drawn.rotation.float(), drawn.translation.float()), links)
        drawn = replace(drawn, middle=drawn.middle + lift, translation=drawn.translation + lift)

    half_width = half_widths(surface, drawn.middle, drawn.rotation, hand)
    # With Gumbel noise, the best poses are a random draw without replacement, with weights exp(−half width / scale).
    gumbel = -torch.log(-torch.log(_uniform(1e-12, 1.0, len(drawn.joints), generator)))
    preference = gumbel - (half_width + drawn.depth) / _SPAN_SCALE
    if obstacles is not None:
        preference = _lowered(preference, count, _penalty(drawn, obstacles, links, compiled))
    chosen = preference.topk(min(count, len(preference))).indices
    return Poses(
        drawn.translation[chosen].to(device, dtype),
        quaternion_from_rotation(drawn.rotation[chosen]).to(device, dtype),
        drawn.joints[chosen].to(device, dtype),
    )


def _draw_pool(
    hull: TriangleMesh, hand: HandModel, count: int, seed: int, generator: torch.Generator, fingertips: float
) -> StartPool:
    """Draw open or half-closed hands that face random points of the hull, with random roll."""
    points, normals = surface_samples(hull, count, seed)
    outward = torch.as_tensor(normals)
    tilt_axis = torch.linalg.cross(outward, torch.randn(count, 3, generator=generator, dtype=torch.float64))
    tilt_axis = tilt_axis / tilt_axis.norm(dim=-1, keepdim=True)
    tilt = _uniform(-_TILT, _TILT, count, generator)
    facing = (rotation_from_axis_angle(tilt_axis, tilt) @ outward[..., None]).squeeze(-1)
    rotation = aligning_rotation(torch.as_tensor(hand.palm_normal), -facing)
    rotation = rotation_from_axis_angle(facing, _uniform(-np.pi, np.pi, count, generator)) @ rotation
    standoff = _uniform(*_PALM_STANDOFF, count, generator)
    grip = torch.as_tensor(hand.palm_center).repeat(count, 1)
    lower, upper = torch.as_tensor(hand.lower), torch.as_tensor(hand.upper)
    noise = _JOINT_NOISE * (torch.rand(count, len(lower), generator=generator, dtype=torch.float64) - 0.5)
    joints = (torch.as_tensor(hand.open_posture) + noise * (upper - lower)).clamp(lower, upper)
    if fingertips:
        some = _uniform(0.0, 1.0, count, generator) < fingertips
        share = torch.where(some, _uniform(*_SHARE_CLOSED, count, generator), 0.0)[:, None]
        joints = joints + share * (torch.as_tensor(hand.closed_posture) - joints)
        standoff = torch.where(some, _uniform(*_TIP_STANDOFF, count, generator), standoff)
        grip[some] = between_fingertips(hand, joints[some])
    middle = torch.as_tensor(points) + standoff[:, None] * outward
    translation = middle - (rotation @ grip[..., None]).squeeze(-1)
    return StartPool(grip, standoff, middle, rotation, translation, joints, torch.zeros(count, dtype=torch.float64))


def _uniform(low: float, high: float, count: int, generator: torch.Generator) -> Float[Tensor, "count"]:
    return low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)


def _aimed(
    pool: StartPool, aim: Aim, surface: Float[Tensor, "points 3"], hand: HandModel, generator: torch.Generator
) -> StartPool:
    """Turn and move the hands of a pool so that they meet `aim`. The joints do not change.

    The grip of each hand faces a random place of `aim`, or a random `surface` point [m] if `aim` has no places. The
    grip keeps its standoff from the first surface on the line from the palm to the faced point.
    """
    count, rotation = len(pool.joints), pool.rotation
    if aim.direction is not None:
        axis = torch.as_tensor(aim.direction).expand(count, 3)
        least = float(np.cos(_INNER * aim.angle))
        tilted = torch.acos(_uniform(least, 1.0, count, generator).clamp(-1.0, 1.0))
        square = normalize(torch.linalg.cross(axis, torch.randn(count, 3, generator=generator, dtype=torch.float64)))
        approach = (rotation_from_axis_angle(square, tilted) @ axis[..., None]).squeeze(-1)
        rotation = aligning_rotation(torch.as_tensor(hand.approach), approach)
        turn = _uniform(-np.pi, np.pi, count, generator)
        rotation = rotation_from_axis_angle(approach, turn) @ rotation
    if aim.roll is not None:
        approach = rotation @ torch.as_tensor(hand.approach)
        turn = aim.roll.missing(approach, rotation)
        turn = turn + _INNER * _uniform(-aim.roll.tolerance, aim.roll.tolerance, count, generator)
        rotation = rotation_from_axis_angle(approach, turn) @ rotation
    places = surface if aim.places is None else torch.as_tensor(aim.places)
    faced = places[torch.randint(len(places), (count,), generator=generator)]
    facing = rotation @ torch.as_tensor(hand.palm_normal)
    depth = _standing_off(faced, facing, surface)
    middle = faced - (depth + pool.standoff)[:, None] * facing
    translation = middle - (rotation @ pool.grip[..., None]).squeeze(-1)
    depth = torch.zeros_like(depth) if aim.places is None else depth
    return replace(pool, middle=middle, rotation=rotation, translation=translation, depth=depth)


def _standing_off(places: Positions, facing: Positions, surface: Float[Tensor, "points 3"]) -> Values:
    away = surface[None] - places[:, None]
    back = -(away * facing[:, None]).sum(-1)
    near = (away + back[..., None] * facing[:, None]).norm(dim=-1) < _PALM_RADIUS
    return torch.where(near, back, 0.0).amax(-1).clamp_min(0.0)


def _allowed(draw: Callable[[int], StartPool], wanted: int, seed: int, restrictions: BoundRestrictions) -> StartPool:
    """Draw pools with new seeds until the restrictions allow `wanted` hands, at most `_MOST_POOLS` pools."""
    kept: list[StartPool] = []
    for again in range(_MOST_POOLS):
        drawn = draw(seed + again * _POOL_SEED_STEP)
        quaternions = quaternion_from_rotation(drawn.rotation)
        allowed = restrictions.starts(drawn.translation.numpy(), quaternions.numpy(), drawn.joints.numpy())
        kept.append(drawn[torch.as_tensor(allowed)])
        if sum(len(pool.joints) for pool in kept) >= wanted:
            break
    columns = zip(*(vars(pool).values() for pool in kept), strict=True)
    return StartPool(*(torch.cat(values)[:wanted] for values in columns))


def _lift(obstacles: ObstacleTensors, base: SE3, links: SE3) -> Positions | float:
    """Return the translation that lifts each hand out of the support, at most by `_HIGHEST_LIFT` [m]."""
    if obstacles.normal is None:
        return 0.0
    depth = -obstacle_gaps(replace(obstacles, sdfs=()), base, links).amin(-1)
    return depth.clamp(0.0, _HIGHEST_LIFT)[:, None] * obstacles.normal


def _depth(obstacles: ObstacleTensors, base: SE3, links: SE3) -> Values:
    """Return the depth of each hand in obstacles, at its pose or at its retreat, whichever is greater [m]."""
    behind = drawn_back(base.translation, base.rotation, obstacles.approach)
    twice = SE3(base.rotation.repeat(2, 1, 1), torch.cat([base.translation, behind]))
    both = SE3(links.rotation.repeat(2, 1, 1, 1), links.translation.repeat(2, 1, 1))
    return -least_gap(obstacles, twice, both).view(2, len(behind)).amin(0).clamp_max(0.0)


def _penalty(
    pool: StartPool, obstacles: ObstacleTensors, links: SE3, compiled: KernelProblem | None
) -> Callable[[Tensor], Values]:
    """Return a function of rows of the pool that returns their depths in obstacles, relative to `_DEPTH_SCALE`."""
    base = SE3(pool.rotation.float(), pool.translation.float())
    if compiled is None:
        return lambda rows: _depth(obstacles, base[rows], links[rows]) / _DEPTH_SCALE
    turned = torch.cat([quaternion_from_rotation(base.rotation), pool.joints.float()], -1)
    behind = drawn_back(base.translation, base.rotation, obstacles.approach)
    x = torch.stack([torch.cat([at, turned], -1) for at in (base.translation, behind)])

    def penalty(rows: Tensor) -> Values:
        return -kernel_problem.least_gap(compiled, x[:, rows].flatten(0, 1), 0.0).view(2, -1).amin(0) / _DEPTH_SCALE

    return penalty


def _lowered(preference: Values, count: int, penalty: Callable[[Tensor], Values]) -> Values:
    """Return `preference` minus `penalty`. Rows that cannot be among the `count` greatest may get −inf.

    A penalty is never negative, but slow to compute. So the loop ends once no other row can be among the greatest.
    """
    lowered = torch.full_like(preference, -torch.inf)
    for rows in preference.argsort(descending=True).split(_ROWS_AT_ONCE * count):
        if bool((lowered.topk(min(count, len(lowered))).values >= preference[rows[:1]]).all()):
            break
        lowered[rows] = preference[rows] - penalty(rows)
    return lowered


def depth_of_starts(scene: Scene, hand: HandModel, count: int, restrictions: BoundRestrictions) -> float:
    """Draw `count` starts. Return the least depth in obstacles (`_depth`) of any start [m], 0 without obstacles."""
    obstacles = make_obstacle_tensors(scene, hand, "cpu", torch.float64)
    if obstacles is None:
        return 0.0
    starts = draw_starts(scene, hand, count, 0, "cpu", torch.float64, restrictions=restrictions)
    links = forward(make_kinematics(hand, dtype=torch.float64), starts.joints)
    base = replace(starts.base, translation=starts.translation + _lift(obstacles, starts.base, links))
    return float(_depth(obstacles, base, links).amin()) if len(starts.joints) else 0.0


def half_widths(
    surface: Float[Tensor, "points 3"], middle: Positions, rotation: Float[Tensor, "batch 3 3"], hand: HandModel
) -> Values:
    """Return how far the object extends from the grip along the closing direction of the fingers [m].

    Only points between the fingers count, in a slab as wide as a hand. If the slab is empty, the result is infinite.
    """
    normal = torch.as_tensor(hand.palm_normal)
    closing = torch.as_tensor(closing_axis(hand))
    axes = (rotation @ torch.stack([closing, normal, torch.linalg.cross(normal, closing)], -1)).unbind(-1)
    along, depth, across = (axis @ surface.T - (axis * middle).sum(-1, keepdim=True) for axis in axes)
    within = (across.abs() < _SLAB_HALF_BREADTH) & (depth < _SLAB_DEPTH)
    width = torch.where(within, along.abs(), 0.0).amax(-1)
    # If the palm faces past the object, the hand has nothing to close around.
    return torch.where(within.any(-1), width, torch.inf)


def closing_axis(hand: HandModel) -> Float[np.ndarray, "3"]:
    """Return the direction of greatest fingertip travel when closing: a unit vector in the palm plane, base frame."""
    tips = [int(np.flatnonzero(hand.link_group == group)[-1]) for group in hand.fingertip_groups]
    travel = (link_poses(hand, hand.closed_posture)[1] - link_poses(hand, hand.open_posture)[1])[tips]
    in_plane = travel - np.outer(travel @ hand.palm_normal, hand.palm_normal)
    return np.linalg.svd(in_plane)[2][0]


def between_fingertips(hand: HandModel, joints: Joints) -> Positions:
    """Return the middle between the fingertips of the two sides from which the hand closes, base frame [m]."""
    fingers = find_fingers(hand)
    travel = placed_tips(hand, fingers, hand.closed_posture) - placed_tips(hand, fingers, hand.open_posture)
    along = torch.as_tensor(travel @ closing_axis(hand))
    matrix = placement(hand.num_links, torch.as_tensor(fingers.points), torch.as_tensor(fingers.links))
    tips = place_points(matrix, forward(make_kinematics(hand, dtype=torch.float64), joints))
    sides = [tips[:, side].mean(1) for side in (along > 0, along <= 0) if side.any()]
    return torch.stack(sides).mean(0)


def convex_hull(mesh: TriangleMesh) -> TriangleMesh:
    """Return the convex hull of a mesh. A flat mesh has no hull and is returned unchanged."""
    try:
        return hull_surface(mesh.vertices)
    except QhullError:
        return mesh
