"""What every search for poses shares: its signature, its result, and the problem that results are ranked in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch

from graspd_core.config import PlanConfig
from graspd_core.geometry.scene import Scene
from graspd_core.hands.model import HandModel
from graspd_core.optimise.problem import Problem, build_problem
from graspd_core.optimise.solver import Hooks, Poses


@dataclass(frozen=True)
class Found:
    """What a search ended with.

    Attributes:
        problem: scene and hand as tensors, in whose terms the poses are made into grasps.
        poses: hand poses that the search believes in, at most a few times as many as asked for, in any order.
        interrupted: why it ended early: "", "cancelled" or "deadline".
    """

    problem: Problem
    poses: Poses
    interrupted: str = ""


class Search(Protocol):
    """How poses are found; one for every `config.Method`."""

    def __call__(
        self,
        scene: Scene,
        hand: HandModel,
        *,
        count: int,
        seed: int,
        config: PlanConfig,
        hooks: Hooks,
        device: str,
        dtype: torch.dtype,
    ) -> Found:
        """Poses for `count` grasps; numerical trouble is a pose that is not there, never an exception."""
        ...


def problem_of(
    scene: Scene, hand: HandModel, config: PlanConfig, *, seed: int, device: str, dtype: torch.dtype
) -> Problem:
    """The problem by the closed form's settings, in which every method's poses are made into grasps and ranked."""
    settings = config.closed_form
    return build_problem(
        scene,
        hand,
        candidates=settings.candidates,
        features=settings.features,
        directions=settings.directions,
        friction=min(settings.friction, scene.object.friction),
        seed=seed,
        device=device,
        dtype=dtype,
        trust_floor=settings.trust_floor,
    )
