"""Solve the closed-form relaxation by projected Adam: explore from all starts, then refine and polish the best starts.

Exploring shrinks two lengths: the padding around the object, and the width of the soft contact. Only iterates of the
last steps (`fine_steps`) may become the best iterate of a start.

`ClosedForm` runs in torch. `minimise_compiled` runs the same schedule in the compiled kernel, with the same results up
to rounding. The kernel optimises every start by itself, on as many threads as torch has (`torch.set_num_threads`). The
result for a start does not depend on the number of threads or on the other starts.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

from graspd_core.optimize.candidates import PlannerInput, PlannerOutput
from graspd_core.optimize.closed_form.closed_form_config import ClosedFormConfig, LossWeights, drop_steps, rows_kept
from graspd_core.optimize.initial_poses import draw_starts
from graspd_core.optimize.kernel import builds as structs
from graspd_core.optimize.kernel_problem import KernelProblem
from graspd_core.optimize.loop import (
    Follow,
    Hooks,
    Poses,
    Positions,
    Rows,
    Solution,
    Values,
    adam_moments,
    minimise,
    moved_along,
    pack,
    unpack,
)
from graspd_core.optimize.losses import hard_contact, soft_contact
from graspd_core.optimize.problem import Problem, Terms, evaluate, least_distance

# Step size at the end of the run, as a share of the first step size.
_FINAL_RATE = 0.05
# Smaller batches are padded to this many rows with copies of the first row. Matrix products of one to three rows are
# summed in another order, so a start would give another result alone than in a batch.
_FEWEST_ROWS = 8
# Least number of starts and of kept starts. A smaller batch takes hardly less time and gives less choice.
_FEWEST_STARTS, _FEWEST_KEPT = 16, 8


@dataclass(frozen=True)
class AdamState:
    """Iterate, gradient moments and best iterate of every start: rows of translation, quaternion and joints.

    The translation is the position of `pivot`, the point about which a step turns the hand. If the base frame is far
    from the palm, a small rotation about the base origin would move the fingers away from the object.
    """

    pivot: Positions
    x: Rows
    mean: Rows
    square: Rows
    radius: Values
    best_x: Rows
    best_loss: Values
    loss: Values

    def __getitem__(self, rows: Tensor) -> AdamState:
        return AdamState(**{name: value[rows] for name, value in vars(self).items()})


def initial_state(problem: Problem, starts: Poses, radius: Values) -> AdamState:
    """Return the state before the first step. `radius` [m] is the object's padding in the first step of each start."""
    x = pack(moved_along(starts, problem.hand.pivot))
    worst = x.new_full((len(x),), torch.inf)
    pivot = problem.hand.pivot.expand(len(x), 3)
    return AdamState(pivot, x, torch.zeros_like(x), torch.zeros_like(x), radius, x.clone(), worst, worst.clone())


def adam_step(
    problem: Problem, state: AdamState, gradient: Tensor, rate: float, count: int, config: ClosedFormConfig
) -> AdamState:
    """Take one Adam step (Kingma & Ba 2015) with per-variable step sizes, and clamp joints to their limits."""
    mean, square, top, root = adam_moments(state.mean, state.square, gradient, count)
    rates = torch.full_like(state.x[0], config.joint_rate)
    rates[:3] = config.translation_rate
    rates[3:7] = config.rotation_rate
    rates[7:] *= problem.hand.joint_scale
    x = state.x - rate * rates * (top / root)
    quaternion = x[:, 3:7] / x[:, 3:7].norm(dim=-1, keepdim=True)
    joints = x[:, 7:].clamp(problem.hand.lower, problem.hand.upper)
    return replace(state, x=torch.cat([x[:, :3], quaternion, joints], -1), mean=mean, square=square)


def weighted(terms: Terms, weights: LossWeights) -> Values:
    present = {name: value for name, value in terms._asdict().items() if value is not None}
    return sum((getattr(weights, name) * value for name, value in present.items()), torch.zeros(()))


@dataclass(frozen=True)
class ClosedForm:
    """The solver of docs/method.md, §2. `keep` is the number of starts kept after exploring."""

    config: ClosedFormConfig
    keep: int

    @property
    def steps(self) -> int:
        return self.config.explore_steps + self.config.refine_steps + self.config.polish_steps

    def init(self, problem: Problem, starts: Poses) -> AdamState:
        with torch.no_grad():
            nearest = least_distance(problem, starts)
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
        radius = state.radius * remaining
        loss, gradient = self.value_and_gradient(problem, state.x, radius, delta, fine=fine, sharp=polish)
        if fine or (config.fine_steps == 0 and polish) or (config.polish_steps == 0 and remaining == 0.0):
            better = loss < state.best_loss
            state = replace(
                state,
                best_x=torch.where(better[:, None], state.x, state.best_x),
                best_loss=torch.where(better, loss, state.best_loss),
            )
        fade = 1 + torch.cos(torch.tensor(torch.pi * index / self.steps)).item()
        rate = _FINAL_RATE + (1 - _FINAL_RATE) * 0.5 * fade
        return replace(adam_step(problem, state, gradient, rate, index + 1, config), loss=loss)

    def best(self, state: AdamState) -> tuple[Poses, Values]:
        """Return each start's best iterate and its loss. Without a best iterate, return the last iterate."""
        scored = torch.isfinite(state.best_loss)
        poses = unpack(torch.where(scored[:, None], state.best_x, state.x))
        return moved_along(poses, -state.pivot), torch.where(scored, state.best_loss, state.loss)

    def value_and_gradient(
        self, problem: Problem, x: Rows, radius: Values, delta: float, *, fine: bool, sharp: bool
    ) -> tuple[Values, Rows]:
        """Return loss and gradient of every start. If either is not finite, return infinity and a zero gradient."""
        rows = len(x)
        short = max(0, _FEWEST_ROWS - rows)
        x = torch.cat([x, x[:1].expand(short, -1)]).detach().requires_grad_(True)
        radius = torch.cat([radius, radius[:1].expand(short)])
        poses = moved_along(unpack(x), -problem.hand.pivot)
        activate = soft_contact if self.config.activation == "soft" else hard_contact
        terms = evaluate(problem, poses, radius, delta, fine=fine, sharp=sharp, activate=activate)
        loss = weighted(terms, self.config.polish_weights if sharp else self.config.weights)
        (gradient,) = torch.autograd.grad(loss.sum(), x)
        finite = torch.isfinite(gradient).all(-1) & torch.isfinite(loss)
        loss = torch.where(finite, loss.detach(), torch.full_like(loss, torch.inf))
        return loss[:rows], torch.where(finite[:, None], gradient, torch.zeros_like(gradient))[:rows]


def minimise_compiled(
    solver: ClosedForm, problem: Problem, compiled: KernelProblem, starts: Poses, hooks: Hooks
) -> Solution:
    """Run `solver` like `loop.minimise`, but in the kernel. Raises MemoryError: too little memory for the threads."""
    config, x = solver.config, pack(moved_along(starts, problem.hand.pivot)).contiguous()
    nearest = torch.empty(len(x))
    compiled.call("graspd_least_distance", len(x), x, nearest)
    state = initial_state(problem, starts, nearest.clamp(0.0, config.radius_start))
    follow = Follow(hooks, solver.steps)
    for begin, end in pairwise(sorted({0, *drop_steps(config), solver.steps})):
        kept = rows_kept(config, solver.keep, len(state.x), begin)
        if kept < len(state.x):
            state = state[state.loss.argsort(stable=True)[:kept]]
        _run_steps(compiled, solver, state, (begin, end), follow)
    return follow.solution(*solver.best(state))


def _run_steps(
    compiled: KernelProblem, solver: ClosedForm, state: AdamState, span: tuple[int, int], follow: Follow
) -> None:
    """Run the steps `span` (first, end) in the kernel and change `state`. A stop ends the run within milliseconds."""
    (begin, end), rows = span, len(state.x)

    def over(done: int) -> bool:
        if not follow.over() and done > 0:
            follow.report(done, lambda: (solver.best(state)[0], state.loss))
        return bool(follow.interrupted)

    if rows == 0 or follow.interrupted or over(begin):
        return
    pointers = structs.State(**{name: getattr(state, name).data_ptr() for name in structs.names_of(structs.State)})
    compiled.call(
        "graspd_run_steps",
        *(_schedule(solver.config), pointers, rows, begin, end),
        watch=lambda done: over(min(begin + done // rows, end - 1)),
    )
    if not follow.interrupted:
        follow.done = end
        over(end)


def _schedule(config: ClosedFormConfig) -> structs.Schedule:
    values = asdict(config)
    same = {name: values[name] for name in structs.names_of(structs.Schedule) if name in values}
    weights = {name: structs.Weights(**values[name]) for name in ("weights", "polish_weights")}
    return structs.Schedule(**same | weights, soft=config.activation == "soft")


def plan(task: PlannerInput) -> PlannerOutput:
    """Run the closed-form relaxation from `starts_per_grasp` starts for every requested grasp."""
    settings, problem = task.config.settings, task.problem
    count = max(_FEWEST_STARTS, round(task.count * settings.starts_per_grasp))
    compiled = problem.compiled
    drawn = {"fingertips": settings.fingertip_starts, "restrictions": task.restrictions, "compiled": compiled}
    starts = draw_starts(task.scene, task.hand, count, task.seed, task.device, task.dtype, **drawn)
    if len(starts.joints) == 0:
        return PlannerOutput(starts)
    solver = ClosedForm(settings, keep=max(_FEWEST_KEPT, round(task.count * settings.keep_per_grasp)))
    if compiled is None:
        solution = minimise(solver, problem, starts, task.hooks)
    else:
        solution = minimise_compiled(solver, problem, compiled, starts, task.hooks)
    return PlannerOutput(solution.poses[torch.isfinite(solution.loss)], solution.interrupted)
