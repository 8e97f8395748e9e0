"""Random baseline that every method should beat. The hand approaches from a random direction and closes until contact.

The open hand faces the object's centre of mass from a uniformly random direction, with a random roll. It moves along
the palm's normal until first contact. Then the fingers close (`finger_closing`). There is no optimisation and no
ranking. The method returns the first hands that touch the object with enough links, and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from graspd_core.hands.kinematics import forward
from graspd_core.hands.model import HandModel
from graspd_core.optimize.candidates import PlannerInput, PlannerOutput
from graspd_core.optimize.loop import Poses, minimise, pack, unpack
from graspd_core.optimize.obstacle_distance import hand_reach, obstacle_gaps
from graspd_core.optimize.plan_config import Method
from graspd_core.optimize.problem import Problem
from graspd_core.se3 import quaternion_from_rotation, random_rotations
from graspd_dataset.finger_closing import CLOSE_STEPS, Closing, link_gaps, make_closing


@dataclass(frozen=True)
class RandomClosureConfig:
    """Settings of the random baseline.

    Attributes:
        rounds: maximum number of rounds. Each round tries as many approaches as there are requested grasps.
        touching: number of links that must touch the object. Links connected by fixed joints count as one.
        close_steps: number of steps in which the fingers close.
    """

    rounds: int = 4
    touching: int = 3
    close_steps: int = CLOSE_STEPS


# The advance ends at this distance from the object [m], or after this many steps of sphere tracing.
_TOUCHING, _ADVANCES = 0.0003, 60


def plan(task: PlannerInput) -> PlannerOutput:
    """Return up to `task.count` closed hands from random directions. Discard the hands of an interrupted round."""
    settings, hand, count = task.config.settings, task.hand, task.count
    problem = task.problem
    closing = make_closing(problem, hand, settings.close_steps)
    least = min(settings.touching, int(hand.link_group.max()) + 1)
    tries = task.allowed(draw_approaches(problem, hand, count * settings.rounds, task.seed))
    kept, interrupted = tries[torch.arange(0, device=task.device)], ""
    for rows in torch.arange(len(tries.joints), device=task.device).split(count):
        if interrupted or len(kept.joints) >= count or len(rows) == 0:
            break
        solution = minimise(closing, problem, advance(problem, closing, hand, tries[rows]), task.hooks)
        interrupted = solution.interrupted
        if not interrupted:
            groups = touching_groups(problem, closing, hand, solution.poses, task.config.grasp_stages.touch_reach)
            good = (groups >= least) & clear_of_obstacles(problem, solution.poses)
            kept = unpack(torch.cat([pack(kept), pack(solution.poses[good])]))
    return PlannerOutput(kept[torch.arange(min(count, len(kept.joints)), device=task.device)], interrupted)


def draw_approaches(problem: Problem, hand: HandModel, count: int, seed: int) -> Poses:
    """Draw open hands away from the object, with palms towards its centre of mass. Directions and rolls are uniform."""
    generator = torch.Generator().manual_seed(seed)
    rotation = random_rotations(count, generator, torch.float64)
    away = problem.object.length + hand_reach(hand)
    palm = torch.as_tensor(hand.palm_center + away * hand.palm_normal)
    translation = problem.object.center.double().cpu() - rotation @ palm
    joints = torch.as_tensor(hand.open_posture).clamp(torch.as_tensor(hand.lower), torch.as_tensor(hand.upper))
    return Poses(
        translation.to(problem.hand.lower),
        quaternion_from_rotation(rotation).to(problem.hand.lower),
        joints.expand(count, -1).to(problem.hand.lower),
    )


@torch.no_grad()
def advance(problem: Problem, closing: Closing, hand: HandModel, poses: Poses) -> Poses:
    """Move the hands along their palm normals until first contact, or until the palm is at the centre of mass.

    The method is sphere tracing: each step is as long as the hand's current distance from the object.
    """
    forwards = poses.base.rotation @ torch.as_tensor(hand.palm_normal).to(problem.hand.lower)
    left = torch.full_like(poses.translation[:, 0], problem.object.length + hand_reach(hand))
    for _ in range(_ADVANCES):
        gap = link_gaps(problem, poses, closing.sphere_links)[:, 0].amin(-1) - _TOUCHING
        step = gap.clamp_min(0.0).minimum(left)
        if not bool((step > 0.1 * _TOUCHING).any()):
            break
        poses = Poses(poses.translation + step[:, None] * forwards, poses.quaternion, poses.joints)
        left = left - step
    return poses


def touching_groups(
    problem: Problem, closing: Closing, hand: HandModel, poses: Poses, reach: float
) -> Float[Tensor, "batch"]:
    """Return for each pose how many links are within `reach` [m] of the object. Rigidly joined links count as one."""
    near = link_gaps(problem, poses, closing.sphere_links)[:, 0] <= reach
    groups = torch.as_tensor(hand.link_group, device=near.device)
    found = torch.zeros(len(near), int(groups.max()) + 1, device=near.device, dtype=problem.hand.lower.dtype)
    return found.scatter_reduce(1, groups.expand(len(near), -1), near.to(found), "amax").sum(-1)


def clear_of_obstacles(problem: Problem, poses: Poses) -> Bool[Tensor, "batch"]:
    """Return for each hand whether it penetrates neither the support nor a neighbouring object."""
    if problem.obstacles is None:
        return torch.ones(len(poses.joints), dtype=torch.bool, device=poses.joints.device)
    links = forward(problem.hand.kinematics, poses.joints)
    return obstacle_gaps(problem.obstacles, poses.base, links).amin(-1) >= 0.0


METHOD = Method(__name__, RandomClosureConfig, "random closure", "#7F7F7F", "D", 16)
