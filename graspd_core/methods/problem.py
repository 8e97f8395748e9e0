"""The assembled problem: everything a solver evaluates, as tensors on one device, and the terms of one evaluation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from graspd_core.config import ProblemConfig
from graspd_core.contact.wrench_support import disturbance_directions, wrench_support
from graspd_core.hands.collision_tensors import pair_distance, solid_bound
from graspd_core.hands.kinematics import forward, place_points
from graspd_core.hands.model import HandModel
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.methods import losses
from graspd_core.methods.obstacle_distance import ObstacleTensors, make_obstacle_tensors, obstacle_gaps
from graspd_core.methods.problem_tensors import (
    HandTensors,
    ObjectTensors,
    PointSet,
    make_hand_tensors,
    make_object_tensors,
)
from graspd_core.scene.confidence import sample_confidence
from graspd_core.scene.scene import Scene
from graspd_core.se3 import SE3, rotation_from_quaternion

REACH_WHEN_SHARP = 0.01
# Candidates that the task looks at, and pairs of sharp point and solid that polishing looks at.
TASK_POINTS, FEATURE_PAIRS = 96, 96
# Free space that the hand keeps to obstacles [m]; what is low on a table is held by fingertips that all but touch it.
OBSTACLE_MARGIN = 0.001


@dataclass(frozen=True)
class Problem:
    """One hand, one object, one set of disturbances, on one device and dtype.

    Attributes:
        hand, object: laid out as tensors.
        directions: unit disturbance wrenches.
        friction: coefficient planned with, never above the object's own.
        obstacles: what else is in the way, None where nothing is: then nothing is evaluated for it.
    """

    hand: HandTensors
    object: ObjectTensors
    directions: Float[Tensor, "directions 6"]
    friction: float
    obstacles: ObstacleTensors | None = None


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
    settings: ProblemConfig,
    *,
    seed: int,
    device: str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> Problem:
    """Lay scene and hand out as tensors; `seed` spreads the disturbances beyond the signed axes."""
    return Problem(
        hand=make_hand_tensors(hand, settings.candidates, settings.patch_size, device, dtype),
        object=make_object_tensors(scene, settings, device, dtype),
        directions=disturbance_directions(settings.directions, seed).to(device=device, dtype=dtype),
        friction=min(settings.friction, scene.object.friction),
        obstacles=make_obstacle_tensors(scene, hand, device, dtype),
    )


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
    links = forward(problem.hand.kinematics, joints)
    return HandPlacement(base, links, base.apply(place_points(points.matrix, links)))


def feature_distance(
    problem: Problem, features: Float[Tensor, "features 3"], placed: HandPlacement
) -> tuple[Float[Tensor, "batch pairs"], Int[Tensor, "batch pairs"]]:
    """Signed distance of the object's sharp points to the hand's solids [m], of the nearest pairs; their solids."""
    in_base = placed.base.apply_inverse(features)
    with torch.no_grad():
        every = solid_bound(problem.hand.solids, placed.links, in_base)
    count = len(problem.hand.solids.link)
    pairs = every.flatten(1).topk(min(FEATURE_PAIRS, every[0].numel()), largest=False).indices
    solids = pairs % count
    rows = torch.arange(len(pairs), device=pairs.device)[:, None]
    return pair_distance(problem.hand.solids, placed.links, in_base[rows, pairs // count], solids), solids


def _nearest_of_group(
    distance: Float[Tensor, "batch pairs"], groups: Int[Tensor, "batch pairs"], count: int
) -> Float[Tensor, "batch groups"]:
    """Least distance per group, infinite where no pair belongs to it; pairs of no group go to a last, dropped one."""
    start = distance.new_full((len(distance), count + 1), torch.inf)
    return start.scatter_reduce(1, groups, distance, "amin")[:, :count]


def _wrench_resistance(
    problem: Problem,
    points: Float[Tensor, "batch points 3"],
    distance: Float[Tensor, "batch points"],
    normal: Float[Tensor, "batch points 3"],
    *,
    radius: Float[Tensor, "batch"],
    activate: Callable[..., Tensor],
) -> Float[Tensor, "batch"]:
    """The loss of the worst disturbances, from the points nearest to the padded surface: no others push."""
    near = (distance.detach() - radius[:, None]).abs().topk(min(TASK_POINTS, distance.shape[-1]), largest=False).indices
    rows = torch.arange(len(near), device=near.device)[:, None]
    target, position = problem.object, points[rows, near]
    activation = activate(distance[rows, near], radius)
    if target.confidence is not None:
        activation = activation * sample_confidence(target.confidence, target.sdf, position)
    arms = (position - target.center) / target.length
    support = wrench_support(arms, normal[rows, near], activation, problem.directions, problem.friction)
    return losses.wrench_resistance(support, problem.friction)


def evaluate(
    problem: Problem,
    translation: Float[Tensor, "batch 3"],
    quaternion: Float[Tensor, "batch 4"],
    joints: Float[Tensor, "batch joints"],
    radius: Float[Tensor, "batch"],
    delta: float,
    *,
    fine: bool = False,
    sharp: bool = False,
    activate: Callable[..., Tensor] = losses.soft_contact,
) -> Terms:
    """All loss terms of a batch of poses at padding `radius` [m] and contact width `delta` [m].

    Args:
        fine: look at all candidates.
        sharp: look at all sharp points, and draw in only what is all but there.
        activate: how much a candidate counts as a contact, by its distance, `radius` and `delta`.
    """
    points = problem.hand.fine if fine else problem.hand.coarse
    placed = hand_forward(problem, points, translation, quaternion, joints)
    distance, normal = sample_sdf(problem.object.sdf, placed.points)
    gap = (distance - radius[:, None])[:, points.groups].amin(-1)
    sunk = losses.penetration(distance, radius)
    features = problem.object.features if sharp else problem.object.features[: problem.object.coarse_features]
    if len(features):
        edge, solids = feature_distance(problem, features, placed)
        sunk = sunk + losses.penetration(edge, torch.zeros_like(radius))
        gap = torch.minimum(gap, _nearest_of_group(edge, problem.hand.group_of_solid[solids], gap.shape[-1]))
    spheres = place_points(problem.hand.spheres.matrix, placed.links)
    obstacle = None
    if problem.obstacles is not None:
        gaps = obstacle_gaps(problem.obstacles, placed.base, placed.links)
        obstacle = losses.penetration(gaps, torch.full_like(radius, OBSTACLE_MARGIN))
    return Terms(
        wrench_resistance=_wrench_resistance(
            problem, placed.points, distance, normal, radius=radius, activate=partial(activate, delta=delta)
        ),
        distance=losses.touch(
            gap, torch.full_like(problem.hand.reach, REACH_WHEN_SHARP) if sharp else problem.hand.reach
        ),
        penetration=sunk,
        self_collision=losses.self_collision(spheres, problem.hand.spheres.radii, problem.hand.spheres.weight),
        posture=losses.posture(joints, problem.hand.lower, problem.hand.upper),
        obstacle=obstacle,
    )


def least_distance(
    problem: Problem,
    translation: Float[Tensor, "batch 3"],
    quaternion: Float[Tensor, "batch 4"],
    joints: Float[Tensor, "batch joints"],
) -> Float[Tensor, "batch"]:
    """Least distance of any coarse contact candidate to the object [m]."""
    placed = hand_forward(problem, problem.hand.coarse, translation, quaternion, joints)
    return sample_sdf(problem.object.sdf, placed.points)[0].amin(-1)
