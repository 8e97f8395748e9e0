"""The assembled problem: everything a solver evaluates, as tensors on one device, and the terms of one evaluation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from graspd_core.contact.wrench_support import disturbance_directions, wrench_support
from graspd_core.hands.collision_spheres import collision_spheres
from graspd_core.hands.collision_tensors import CollisionTensors, make_collision_tensors, pair_distance, solid_bound
from graspd_core.hands.kinematics import Kinematics, forward, make_kinematics, place_points, placement
from graspd_core.hands.model import HandModel
from graspd_core.mesh.sdf import GridSDF, sample_sdf
from graspd_core.mesh.sharp_features import sharp_points, thin_share
from graspd_core.methods import losses
from graspd_core.methods.obstacle_distance import ObstacleTensors, make_obstacle_tensors, obstacle_gaps
from graspd_core.scene.confidence import sample_confidence
from graspd_core.scene.scene import Scene
from graspd_core.se3 import SE3, rotation_from_quaternion

# How far a group of links is drawn to the surface [m]: the ends of fingers from afar, the rest to finish a contact.
_REACH_OF_TIPS = 0.1
_REACH_OF_OTHERS = 0.004
_REACH_WHEN_FINE = 0.01
# Candidates that the task looks at, and pairs of sharp point and solid that polishing looks at.
_TASK_POINTS, _FEATURE_PAIRS = 96, 96
# Free space that the hand keeps to obstacles [m].
OBSTACLE_MARGIN = 0.002
# A base frame this near to the middle of the palm lies in the palm [m].
_PALM_RADIUS = 0.05
# Share of thin surface from which an object counts as thin-walled.
_THIN_WALLED = 0.6


@dataclass(frozen=True)
class PointSet:
    """Contact candidates of a hand.

    Attributes:
        matrix: places them by their links' poses, see `hands.kinematics.placement`.
        links: link of each.
        groups: candidates of each rigid group of links, padded by repetition.
    """

    matrix: Float[Tensor, "points columns"]
    links: Int[Tensor, "points"]
    groups: Int[Tensor, "groups members"]


@dataclass(frozen=True)
class Problem:
    """One hand, one object, one set of disturbances, on one device and dtype.

    Attributes:
        kinematics: forward kinematics of the hand.
        sdf: signed distance field of the object.
        coarse: the first, evenly spread contact candidates; what most steps look at.
        fine: all contact candidates; what the last steps look at.
        reach: attraction range of each rigid group of links [m].
        solids: the hand's collision primitives.
        group_of_solid: index of each solid's rigid group.
        features: sharp points of the object's surface, which candidates would not notice sinking in [m].
        coarse_features: how many of them, from the first, the coarse steps look at too: none, but on thin walls, which
            a finger could otherwise step through.
        sphere_matrix: places the proxy spheres for self-collision likewise.
        sphere_radii: of the proxy spheres [m].
        sphere_weight: 1 / 2R of the checked pairs with R the sum of their radii, zero elsewhere [1/m].
        lower: joint limits [rad].
        upper: joint limits [rad].
        pivot: the point that the solver turns the hand about, base frame [m].
        joint_scale: travel of each joint that counts as much as one radian, one where it turns [rad] or [m].
        directions: unit disturbance wrenches.
        center: object's centre of mass [m].
        length: characteristic length of torques [m].
        friction: coefficient planned with.
        obstacles: what else is in the way, None where nothing is: then nothing is evaluated for it.
        trust: how far the surface near each node of `sdf` is known, raised to a floor; None: all of it, likewise.
    """

    kinematics: Kinematics
    sdf: GridSDF
    coarse: PointSet
    fine: PointSet
    reach: Float[Tensor, "groups"]
    solids: CollisionTensors
    group_of_solid: Int[Tensor, "solids"]
    features: Float[Tensor, "features 3"]
    coarse_features: int
    sphere_matrix: Float[Tensor, "spheres columns"]
    sphere_radii: Float[Tensor, "spheres"]
    sphere_weight: Float[Tensor, "spheres spheres"]
    lower: Float[Tensor, "joints"]
    upper: Float[Tensor, "joints"]
    pivot: Float[Tensor, "3"]
    joint_scale: Float[Tensor, "joints"]
    directions: Float[Tensor, "directions 6"]
    center: Float[Tensor, "3"]
    length: float
    friction: float
    obstacles: ObstacleTensors | None = None
    confidence: Float[Tensor, "x y z"] | None = None


class Terms(NamedTuple):
    """Loss terms of a batch of starts, unweighted; the fields are those of `LossWeights`.

    `obstacle` is None where the scene has none.
    """

    wrench_resistance: Float[Tensor, "batch"]
    distance: Float[Tensor, "batch"]
    penetration: Float[Tensor, "batch"]
    self_collision: Float[Tensor, "batch"]
    posture: Float[Tensor, "batch"]
    obstacle: Float[Tensor, "batch"] | None = None


def build_problem(
    scene: Scene,
    hand: HandModel,
    *,
    candidates: int,
    features: int,
    directions: int,
    friction: float,
    seed: int,
    device: str,
    dtype: torch.dtype,
    confidence_floor: float = 0.0,
) -> Problem:
    """Lay scene and hand out as tensors.

    Args:
        candidates: size of the coarse set of contact candidates; the fine set is all that the hand was loaded with.
        features: sharp points of the object at most.
        directions: number of disturbance wrenches.
        friction: coefficient planned with.
        seed: of the spread of disturbances beyond the signed axes.
        confidence_floor: what a contact on surface that was only guessed counts.
    """

    def tensor(values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, device=device, dtype=dtype)

    def index(values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, device=device, dtype=torch.long)

    present = np.unique(hand.link_group[hand.candidate_link[:candidates]])

    def point_set(count: int) -> PointSet:
        links = hand.candidate_link[:count]
        points = tensor(hand.candidate_points[:count])
        return PointSet(
            placement(hand.num_links, points, index(links)),
            index(links),
            index(_members(hand.link_group[links], present)),
        )

    thin = thin_share(scene.object.mesh) > _THIN_WALLED
    solids = make_collision_tensors(hand, device, dtype)
    group_of_solid = hand.link_group[solids.link.cpu().numpy()]
    centers, radii, sphere_links = collision_spheres(hand)
    checked = ~hand.adjacent[np.ix_(sphere_links, sphere_links)]
    return Problem(
        kinematics=make_kinematics(hand, device, dtype),
        sdf=scene.sdf.to(device, dtype),
        coarse=point_set(candidates),
        fine=point_set(len(hand.candidate_link)),
        solids=solids,
        group_of_solid=index(np.searchsorted(present, group_of_solid)),
        features=tensor(sharp_points(scene.object.mesh, features * 2 if thin else features)),
        coarse_features=features if thin else 0,
        reach=tensor(np.where(np.isin(present, fingertip_groups(hand)), _REACH_OF_TIPS, _REACH_OF_OTHERS)),
        sphere_matrix=placement(hand.num_links, tensor(centers), index(sphere_links)),
        sphere_radii=tensor(radii),
        sphere_weight=tensor(np.triu(checked, 1) * 0.5 / (radii[:, None] + radii[None, :])),
        lower=tensor(hand.lower),
        upper=tensor(hand.upper),
        pivot=tensor(_pivot(hand)),
        joint_scale=tensor(hand.joint_scale),
        directions=disturbance_directions(directions, seed).to(device=device, dtype=dtype),
        center=tensor(scene.object.center_of_mass),
        length=scene.object.radius,
        friction=friction,
        obstacles=make_obstacle_tensors(scene, hand, device, dtype),
        confidence=None
        if scene.confidence is None
        else confidence_floor + (1 - confidence_floor) * scene.confidence.to(device, dtype),
    )


def _pivot(hand: HandModel) -> Float[np.ndarray, "3"]:
    """The middle of the palm, or the base frame's origin where that lies in the palm [m]."""
    far = np.linalg.norm(hand.palm_center) > _PALM_RADIUS
    return hand.palm_center if far else np.zeros(3)


def fingertip_groups(hand: HandModel) -> Int[np.ndarray, "tips"]:
    """Groups of rigidly joined links at the ends of the fingers: those that move no further group."""
    groups, parents = hand.link_group, hand.link_parent
    inner = {int(groups[p]) for link, p in enumerate(parents) if p >= 0 and groups[link] != groups[p]}
    return np.array(sorted(set(groups.tolist()) - inner), dtype=int)


def _members(group_of: Int[np.ndarray, "n"], present: Int[np.ndarray, "groups"]) -> Int[np.ndarray, "groups width"]:
    """Indices that belong to each group, rows padded by repetition; a group without any repeats the first index."""
    members = [np.flatnonzero(group_of == group) for group in present]
    width = max(map(len, members))
    return np.stack([np.resize(m if len(m) else [0], width) for m in members])


class HandPlacement(NamedTuple):
    """A batch of hands: `T_object_base`, `T_base_link` of every link, contact candidates in the object frame [m]."""

    base: SE3
    links: SE3
    points: Float[Tensor, "batch points 3"]


def hand_forward(
    problem: Problem,
    points: PointSet,
    translation: Float[Tensor, "batch 3"],
    quaternion: Float[Tensor, "batch 4"],
    joints: Float[Tensor, "batch joints"],
) -> HandPlacement:
    """Where links and contact candidates are, for a batch of poses."""
    base = SE3(rotation_from_quaternion(quaternion), translation)
    links = forward(problem.kinematics, joints)
    return HandPlacement(base, links, base.apply(place_points(points.matrix, links)))


def feature_distance(
    problem: Problem, features: Float[Tensor, "features 3"], placed: HandPlacement
) -> tuple[Float[Tensor, "batch pairs"], Int[Tensor, "batch pairs"]]:
    """Signed distance of the object's sharp points to the hand's solids [m], of the nearest pairs; their solids."""
    in_base = placed.base.apply_inverse(features)
    with torch.no_grad():
        every = solid_bound(problem.solids, placed.links, in_base)
    count = len(problem.solids.link)
    pairs = every.flatten(1).topk(min(_FEATURE_PAIRS, every[0].numel()), largest=False).indices
    solids = pairs % count
    rows = torch.arange(len(pairs), device=pairs.device)[:, None]
    return pair_distance(problem.solids, placed.links, in_base[rows, pairs // count], solids), solids


def _nearest_of_group(
    distance: Float[Tensor, "batch pairs"], groups: Int[Tensor, "batch pairs"], count: int
) -> Float[Tensor, "batch groups"]:
    """Least distance per group, infinite where no pair belongs to it."""
    start = distance.new_full((len(distance), count), torch.inf)
    return start.scatter_reduce(1, groups, distance, "amin")


def evaluate(
    problem: Problem,
    translation: Float[Tensor, "batch 3"],
    quaternion: Float[Tensor, "batch 4"],
    joints: Float[Tensor, "batch joints"],
    radius: Float[Tensor, "batch"],
    delta: float,
    fine: bool = False,
    activate: Callable[..., Tensor] = losses.soft_contact,
) -> Terms:
    """All loss terms of a batch of poses at padding `radius` [m] and contact width `delta` [m].

    Args:
        fine: look at all candidates and all sharp points.
        activate: how much a candidate counts as a contact, by its distance, `radius` and `delta`.
    """
    points = problem.fine if fine else problem.coarse
    placed = hand_forward(problem, points, translation, quaternion, joints)
    distance, normal = sample_sdf(problem.sdf, placed.points)
    gap = (distance - radius[:, None])[:, points.groups].amin(-1)
    sunk = losses.penetration(distance, radius)
    features = problem.features if fine else problem.features[: problem.coarse_features]
    if len(features):
        sharp, solids = feature_distance(problem, features, placed)
        sunk = sunk + losses.penetration(sharp, torch.zeros_like(radius))
        gap = torch.minimum(gap, _nearest_of_group(sharp, problem.group_of_solid[solids], gap.shape[-1]))
    # Only what is near the padded surface can push; the rest costs time and adds nothing.
    near = (
        (distance.detach() - radius[:, None]).abs().topk(min(_TASK_POINTS, distance.shape[-1]), largest=False).indices
    )
    rows = torch.arange(len(near), device=near.device)[:, None]
    activation = activate(distance[rows, near], radius, delta)
    if problem.confidence is not None:
        activation = activation * sample_confidence(problem.confidence, problem.sdf, placed.points[rows, near])
    support = wrench_support(
        (placed.points[rows, near] - problem.center) / problem.length,
        normal[rows, near],
        activation,
        problem.directions,
        problem.friction,
    )
    spheres = place_points(problem.sphere_matrix, placed.links)
    obstacle = None
    if problem.obstacles is not None:
        gaps = obstacle_gaps(problem.obstacles, placed.base, placed.links)
        obstacle = losses.penetration(gaps, torch.full_like(radius, OBSTACLE_MARGIN))
    return Terms(
        wrench_resistance=losses.wrench_resistance(support, problem.friction),
        distance=losses.touch(gap, torch.full_like(problem.reach, _REACH_WHEN_FINE) if fine else problem.reach),
        penetration=sunk,
        self_collision=losses.self_collision(spheres, problem.sphere_radii, problem.sphere_weight),
        posture=losses.posture(joints, problem.lower, problem.upper),
        obstacle=obstacle,
    )


def least_distance(
    problem: Problem,
    translation: Float[Tensor, "batch 3"],
    quaternion: Float[Tensor, "batch 4"],
    joints: Float[Tensor, "batch joints"],
) -> Float[Tensor, "batch"]:
    """Least distance of any coarse contact candidate to the object [m]."""
    placed = hand_forward(problem, problem.coarse, translation, quaternion, joints)
    return sample_sdf(problem.sdf, placed.points)[0].amin(-1)
