"""The closed-form relaxation as a solver: projected Adam on all starts, then on those that are not hopeless.

Coarse to fine: the padding radius and the contact width shrink together while exploring, and stay at their end values
while refining. The best iterate of each start is judged at the end values only, so that early, padded ones never win.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.methods.closed_form.adam import AdamState, adam_step, initial_state
from graspd_core.methods.closed_form.closed_form_config import ClosedFormConfig, LossWeights, rows_kept
from graspd_core.methods.closed_form.compiled_search import minimise_compiled
from graspd_core.methods.kernel_problem import kernel_problem
from graspd_core.methods.loop import minimise
from graspd_core.methods.losses import hard_contact, soft_contact
from graspd_core.methods.planner import PlannerInput, PlannerOutput, initial_poses_of, problem_of
from graspd_core.methods.poses import Poses, moved_along, unpack
from graspd_core.methods.problem import Problem, Terms, evaluate, least_distance

# Share of the step size that is left at the end of the run.
_FINAL_RATE = 0.05
# Fewer rows than this are evaluated among copies of the first: products of one to three rows are summed in another
# order than those of more, and from the last bit of a float32 a start would go another way alone than among others.
_FEWEST_ROWS = 8

# However few grasps are asked for: a small batch costs hardly less than this one, and has little to choose from.
_FEWEST_STARTS, _FEWEST_KEPT = 16, 8


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
        with torch.no_grad():
            nearest = least_distance(problem, starts.translation, starts.quaternion, starts.joints)
        return initial_state(problem, starts, nearest.clamp(0.0, self.config.radius_start))

    def step(self, problem: Problem, state: AdamState, index: int) -> AdamState:
        config = self.config
        kept = rows_kept(config, self.keep, len(state.x), index)
        if kept < len(state.x):
            state = state[state.loss.argsort()[:kept]]
        remaining = max(0.0, 1.0 - index / max(config.explore_steps, 1))
        delta = config.delta_end * (config.delta_start / config.delta_end) ** remaining
        if config.activation == "hard":
            delta = config.delta_end
        polish = index >= config.explore_steps + config.refine_steps
        fine = index >= self.steps - min(config.fine_steps, config.polish_steps)
        loss, gradient = self.value_and_gradient(
            problem, state.x, state.radius * remaining, delta, fine=fine, sharp=polish
        )
        if fine or (config.fine_steps == 0 and polish) or (config.polish_steps == 0 and remaining == 0.0):
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
        return state.best()

    def value_and_gradient(
        self,
        problem: Problem,
        x: Float[Tensor, "batch variables"],
        radius: Float[Tensor, "batch"],
        delta: float,
        *,
        fine: bool,
        sharp: bool,
    ) -> tuple[Float[Tensor, "batch"], Float[Tensor, "batch variables"]]:
        """Loss per start and its gradient; a start whose gradient is not finite stands still."""
        rows = len(x)
        short = max(0, _FEWEST_ROWS - rows)
        x = torch.cat([x, x[:1].expand(short, -1)]).detach().requires_grad_(True)
        radius = torch.cat([radius, radius[:1].expand(short)])
        poses = moved_along(unpack(x), -problem.hand.pivot)
        activate = soft_contact if self.config.activation == "soft" else hard_contact
        looked = {"fine": fine, "sharp": sharp, "activate": activate}
        terms = evaluate(problem, poses.translation, poses.quaternion, poses.joints, radius, delta, **looked)
        loss = weighted(terms, self.config.polish_weights if sharp else self.config.weights)
        (gradient,) = torch.autograd.grad(loss.sum(), x)
        finite = torch.isfinite(gradient).all(-1) & torch.isfinite(loss)
        loss = torch.where(finite, loss.detach(), torch.full_like(loss, torch.inf))
        return loss[:rows], torch.where(finite[:, None], gradient, torch.zeros_like(gradient))[:rows]


def plan(task: PlannerInput) -> PlannerOutput:
    """The closed-form relaxation from `starts_per_grasp` starts for every grasp asked for."""
    settings = task.config.settings
    problem = problem_of(task)
    starts = initial_poses_of(
        task, max(_FEWEST_STARTS, round(task.count * settings.starts_per_grasp)), settings.fingertip_starts
    )
    if len(starts.joints) == 0:
        return PlannerOutput(problem, starts)
    solver = ClosedForm(settings, keep=max(_FEWEST_KEPT, round(task.count * settings.keep_per_grasp)))
    compiled = kernel_problem(problem)
    if compiled is None:
        solution = minimise(solver, problem, starts, task.hooks)
    else:
        solution = minimise_compiled(settings, solver.keep, problem, compiled, starts, task.hooks)
    return PlannerOutput(problem, solution.poses[torch.isfinite(solution.loss)], solution.interrupted)
