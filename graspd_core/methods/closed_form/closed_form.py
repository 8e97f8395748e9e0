"""The closed-form relaxation as a solver: projected Adam on all starts, then on those that are not hopeless.

Coarse to fine: the padding radius and the contact width shrink together while exploring, and stay at their end values
while refining. The best iterate of each start is judged at the end values only, so that early, padded ones never win.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.methods.closed_form.closed_form_config import ClosedFormConfig, LossWeights
from graspd_core.methods.loop import minimise
from graspd_core.methods.losses import hard_contact, soft_contact
from graspd_core.methods.planner import PlannerInput, PlannerOutput, initial_poses_of, problem_of
from graspd_core.methods.poses import Poses, moved_along, pack, unpack
from graspd_core.methods.problem import Problem, Terms, evaluate, least_distance

_BETA1, _BETA2, _ADAM_EPSILON = 0.9, 0.98, 1e-8
# Share of the step size that is left at the end of the run.
_FINAL_RATE = 0.05
# Fewer rows than this are evaluated among copies of the first: products of one to three rows are summed in another
# order than those of more, and from the last bit of a float32 a start would go another way alone than among others.
_FEWEST_ROWS = 8

# However few grasps are asked for: a small batch costs hardly less than this one, and has little to choose from.
_FEWEST_STARTS, _FEWEST_KEPT = 16, 8


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


def weighted(terms: Terms, weights: LossWeights) -> Float[Tensor, "batch"]:
    """Weighted sum of the terms that there are."""
    present = {name: value for name, value in terms._asdict().items() if value is not None}
    return sum((getattr(weights, name) * value for name, value in present.items()), torch.zeros(()))


@dataclass(frozen=True)
class ClosedForm:
    """The solver of docs/method.md, §2.

    Attributes:
        config: hyper-parameters.
        keep: starts kept after exploring.
    """

    config: ClosedFormConfig
    keep: int

    @property
    def steps(self) -> int:
        return self.config.explore_steps + self.config.refine_steps + self.config.polish_steps

    def init(self, problem: Problem, starts: Poses) -> AdamState:
        x = pack(moved_along(starts, problem.hand.pivot))
        with torch.no_grad():
            nearest = least_distance(problem, starts.translation, starts.quaternion, starts.joints)
        zeros = torch.zeros_like(x)
        worst = x.new_full((len(x),), torch.inf)
        pivot = problem.hand.pivot.expand(len(x), 3)
        return AdamState(pivot, x, zeros, zeros, nearest.clamp(0.0, self.config.radius_start), x, worst, worst)

    def step(self, problem: Problem, state: AdamState, index: int) -> AdamState:
        config = self.config
        if index == config.explore_steps and self.keep < len(state.x):
            state = state[state.loss.argsort()[: self.keep]]
        remaining = max(0.0, 1.0 - index / max(config.explore_steps, 1))
        delta = config.delta_end * (config.delta_start / config.delta_end) ** remaining
        if config.activation == "hard":
            delta = config.delta_end
        polish = index >= config.explore_steps + config.refine_steps
        loss, gradient = self.value_and_gradient(problem, state.x, state.radius * remaining, delta, polish)
        if polish or (config.polish_steps == 0 and remaining == 0.0):
            better = loss < state.best_loss
            state = replace(
                state,
                best_x=torch.where(better[:, None], state.x, state.best_x),
                best_loss=torch.where(better, loss, state.best_loss),
            )
        rate = _FINAL_RATE + (1 - _FINAL_RATE) * 0.5 * (
            1 + torch.cos(torch.tensor(torch.pi * index / self.steps)).item()
        )
        return replace(adam_step(problem, state, gradient, rate, index + 1, config), loss=loss)

    def best(self, state: AdamState) -> tuple[Poses, Float[Tensor, "batch"]]:
        scored = torch.isfinite(state.best_loss)
        poses = unpack(torch.where(scored[:, None], state.best_x, state.x))
        return moved_along(poses, -state.pivot), torch.where(scored, state.best_loss, state.loss)

    def value_and_gradient(
        self,
        problem: Problem,
        x: Float[Tensor, "batch variables"],
        radius: Float[Tensor, "batch"],
        delta: float,
        polish: bool,
    ) -> tuple[Float[Tensor, "batch"], Float[Tensor, "batch variables"]]:
        """Loss per start and its gradient; a start whose gradient is not finite stands still."""
        rows = len(x)
        short = max(0, _FEWEST_ROWS - rows)
        x = torch.cat([x, x[:1].expand(short, -1)]).detach().requires_grad_(True)
        radius = torch.cat([radius, radius[:1].expand(short)])
        poses = moved_along(unpack(x), -problem.hand.pivot)
        activate = soft_contact if self.config.activation == "soft" else hard_contact
        terms = evaluate(
            problem, poses.translation, poses.quaternion, poses.joints, radius, delta, fine=polish, activate=activate
        )
        loss = weighted(terms, self.config.polish_weights if polish else self.config.weights)
        (gradient,) = torch.autograd.grad(loss.sum(), x)
        finite = torch.isfinite(gradient).all(-1) & torch.isfinite(loss)
        loss = torch.where(finite, loss.detach(), torch.full_like(loss, torch.inf))
        return loss[:rows], torch.where(finite[:, None], gradient, torch.zeros_like(gradient))[:rows]


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


def plan(task: PlannerInput) -> PlannerOutput:
    """The closed-form relaxation from `starts_per_grasp` starts for every grasp asked for."""
    settings = task.config.settings
    problem = problem_of(task)
    count = task.count * (1.0 if problem.obstacles is None else settings.obstacle_factor)
    starts = initial_poses_of(task, max(_FEWEST_STARTS, round(count * settings.starts_per_grasp)))
    solver = ClosedForm(settings, keep=max(_FEWEST_KEPT, round(count * settings.keep_per_grasp)))
    solution = minimise(solver, problem, starts, task.hooks)
    return PlannerOutput(problem, solution.poses[torch.isfinite(solution.loss)], solution.interrupted)
