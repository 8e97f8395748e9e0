"""Projected Adam on a batch of starts: its state and its step."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.methods.closed_form.closed_form_config import ClosedFormConfig
from graspd_core.methods.poses import Poses, moved_along, pack, unpack
from graspd_core.methods.problem import Problem

_BETA1, _BETA2, _ADAM_EPSILON = 0.9, 0.98, 1e-8


@dataclass(frozen=True)
class AdamState:
    """Iterate, moments and best iterate of every start, as rows of one matrix (translation, quaternion, joints).

    The translation is that of `pivot`, the point of the hand that a step of the quaternion leaves where it is: about
    the origin of a base frame far from the palm, a small turn would throw the fingers off the object.
    """

    pivot: Float[Tensor, "batch 3"]
    x: Float[Tensor, "batch variables"]
    mean: Float[Tensor, "batch variables"]
    square: Float[Tensor, "batch variables"]
    radius: Float[Tensor, "batch"]
    best_x: Float[Tensor, "batch variables"]
    best_loss: Float[Tensor, "batch"]
    loss: Float[Tensor, "batch"]

    def __getitem__(self, rows: Tensor) -> AdamState:
        return AdamState(**{name: value[rows] for name, value in vars(self).items()})

    def best(self) -> tuple[Poses, Float[Tensor, "batch"]]:
        """The best iterate of every start and its loss; the last one where none was scored."""
        scored = torch.isfinite(self.best_loss)
        poses = unpack(torch.where(scored[:, None], self.best_x, self.x))
        return moved_along(poses, -self.pivot), torch.where(scored, self.best_loss, self.loss)


def initial_state(problem: Problem, starts: Poses, radius: Float[Tensor, "batch"]) -> AdamState:
    """The state before the first step, padded by `radius` [m]."""
    x = pack(moved_along(starts, problem.hand.pivot))
    worst = x.new_full((len(x),), torch.inf)
    pivot = problem.hand.pivot.expand(len(x), 3)
    return AdamState(pivot, x, torch.zeros_like(x), torch.zeros_like(x), radius, x.clone(), worst, worst.clone())


def adam_step(
    problem: Problem, state: AdamState, gradient: Tensor, rate: float, count: int, config: ClosedFormConfig
) -> AdamState:
    """One Adam step (Kingma & Ba 2015) with per-variable rates; joints are projected onto their limits."""
    mean = _BETA1 * state.mean + (1 - _BETA1) * gradient
    square = _BETA2 * state.square + (1 - _BETA2) * gradient * gradient
    direction = (mean / (1 - _BETA1**count)) / ((square / (1 - _BETA2**count)).sqrt() + _ADAM_EPSILON)
    rates = torch.full_like(state.x[0], config.joint_rate)
    rates[:3] = config.translation_rate
    rates[3:7] = config.rotation_rate
    rates[7:] *= problem.hand.joint_scale
    x = state.x - rate * rates * direction
    quaternion = x[:, 3:7] / x[:, 3:7].norm(dim=-1, keepdim=True)
    joints = x[:, 7:].clamp(problem.hand.lower, problem.hand.upper)
    return replace(state, x=torch.cat([x[:, :3], quaternion, joints], -1), mean=mean, square=square)
