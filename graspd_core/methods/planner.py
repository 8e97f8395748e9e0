"""What every method shares: its input and output, the initial poses, and the problem that results are ranked in."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from graspd_core.hands.model import HandModel
from graspd_core.methods.initial_poses import draw_starts
from graspd_core.methods.loop import Hooks
from graspd_core.methods.plan_config import PlanConfig
from graspd_core.methods.poses import Poses
from graspd_core.methods.problem import Problem, build_problem
from graspd_core.methods.restrictions import UNRESTRICTED, BoundRestrictions
from graspd_core.scene.scene import Scene


@dataclass(frozen=True)
class PlannerOutput:
    """What a method ended with.

    Attributes:
        problem: scene and hand as tensors, in whose terms the poses are made into grasps.
        poses: hand poses that the method found, at most a few times as many as asked for, in any order.
        interrupted: why it ended early: "", "cancelled" or "deadline".
    """

    problem: Problem
    poses: Poses
    interrupted: str = ""


@dataclass(frozen=True)
class PlannerInput:
    """What a method is asked for.

    Attributes:
        scene, hand: what is to be grasped by what.
        count: grasps asked for.
        seed: of everything that is drawn.
        config: settings of the run.
        hooks: how the run is followed and ended.
        device, dtype: of the tensors.
        restrictions: what the initial poses must allow.
    """

    scene: Scene
    hand: HandModel
    count: int
    seed: int
    config: PlanConfig
    hooks: Hooks
    device: str = "cpu"
    dtype: torch.dtype = torch.float32
    restrictions: BoundRestrictions = UNRESTRICTED


def problem_of(task: PlannerInput) -> Problem:
    """The problem in which every method's poses are made into grasps and ranked."""
    scene = task.restrictions.searched(task.scene)
    return build_problem(scene, task.hand, task.config.problem, seed=task.seed, device=task.device, dtype=task.dtype)


def initial_poses_of(task: PlannerInput, count: int, fingertips: float = 0.0) -> Poses:
    """`count` seeded poses on the object's hull; fewer, perhaps none, where the restrictions leave no more.

    A share `fingertips` of them are put there with their fingertips, the others with their palms.
    """
    drawn = {"fingertips": fingertips, "restrictions": task.restrictions}
    return draw_starts(task.scene, task.hand, count, task.seed, task.device, task.dtype, **drawn)


def allowed_of(task: PlannerInput, starts: Poses) -> Poses:
    """Those initial poses that the restrictions allow, for a method that draws its own."""
    if not task.restrictions.each:
        return starts
    turns = starts.quaternion / starts.quaternion.norm(dim=-1, keepdim=True)
    given = (values.double().cpu().numpy() for values in (starts.translation, turns, starts.joints))
    return starts[torch.as_tensor(task.restrictions.starts(*given), device=starts.joints.device)]
