"""Projected Adam on a batch of starts: its state and its step.

The search of `closed_form.ClosedForm` by the compiled kernel: same schedule, same results up to rounding.

Every start is stepped by itself, on as many threads as torch has (`torch.set_num_threads`). A start ends alike on one
thread and on many, alone and in a batch.

The closed-form relaxation as a solver: projected Adam on all starts, then on those that are not hopeless.

Coarse to fine: the padding radius and the contact width shrink together while exploring, and stay at their end values
while refining. The best iterate of each start is judged at the end values only, so that early, padded ones never win.
"""

from __future__ import annotations

import time
from ctypes import byref
from dataclasses import asdict, dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.optimize.candidates import PlannerInput, PlannerOutput, initial_poses_of, problem_of
from graspd_core.optimize.closed_form.closed_form_config import ClosedFormConfig, LossWeights, drop_steps, rows_kept
from graspd_core.optimize.kernel import builds as structs
from graspd_core.optimize.kernel.builds import call
from graspd_core.optimize.kernel_problem import KernelProblem, kernel_problem
from graspd_core.optimize.loop import Hooks, Poses, Solution, adam_moments, minimise, moved_along, pack, unpack
from graspd_core.optimize.losses import hard_contact, soft_contact
from graspd_core.optimize.problem import Problem, Terms, evaluate, least_distance


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
    mean, square, top, root = adam_moments(state.mean, state.square, gradient, count)
    rates = torch.full_like(state.x[0], config.joint_rate)
    rates[:3] = config.translation_rate
    rates[3:7] = config.rotation_rate
    rates[7:] *= problem.hand.joint_scale
    x = state.x - rate * rates * (top / root)
    quaternion = x[:, 3:7] / x[:, 3:7].norm(dim=-1, keepdim=True)
    joints = x[:, 7:].clamp(problem.hand.lower, problem.hand.upper)
    return replace(state, x=torch.cat([x[:, :3], quaternion, joints], -1), mean=mean, square=square)


def evaluate_compiled(
    problem: KernelProblem,
    x: Float[Tensor, "batch variables"],
    radius: Float[Tensor, "batch"],
    delta: float,
    weights: LossWeights,
    *,
    fine: bool = False,
    sharp: bool = False,
    soft: bool = True,
) -> tuple[Float[Tensor, "batch"], Float[Tensor, "batch variables"], Terms]:
    """Weighted loss of every row, its gradient, and the terms; the rows are `AdamState.x`."""
    x, radius = x.contiguous(), radius.contiguous()
    loss, gradient, terms = torch.empty(len(x)), torch.empty_like(x), torch.empty(len(x), len(Terms._fields))
    given = byref(problem.struct), byref(structs.Weights(**asdict(weights))), len(x), x.data_ptr(), radius.data_ptr()
    found = loss.data_ptr(), gradient.data_ptr(), terms.data_ptr()
    call("graspd_evaluate", *given, delta, fine, sharp, soft, *found, torch.get_num_threads())
    return loss, gradient, Terms(*terms.T)


def least_distance_compiled(problem: KernelProblem, x: Float[Tensor, "batch variables"]) -> Float[Tensor, "batch"]:
    """Least distance of any coarse candidate to the object [m]; the rows are `AdamState.x`."""
    x = x.contiguous()
    distance = torch.empty(len(x))
    arguments = byref(problem.struct), len(x), x.data_ptr(), distance.data_ptr(), torch.get_num_threads()
    call("graspd_least_distance", *arguments)
    return distance


def minimise_compiled(
    config: ClosedFormConfig, keep: int, problem: Problem, compiled: KernelProblem, starts: Poses, hooks: Hooks
) -> Solution[AdamState]:
    """What `loop.minimise` does with `ClosedForm(config, keep)`, for the problem as the kernel reads it.

    Raises:
        MemoryError: too little memory for the threads.
    """
    x = pack(moved_along(starts, problem.hand.pivot))
    state = initial_state(problem, starts, least_distance_compiled(compiled, x).clamp(0.0, config.radius_start))
    steps = config.explore_steps + config.refine_steps + config.polish_steps
    follow = _Follow(hooks, steps)
    for begin, end in pairwise(sorted({0, *drop_steps(config), steps})):
        kept = rows_kept(config, keep, len(state.x), begin)
        if kept < len(state.x):
            state = state[state.loss.argsort(stable=True)[:kept]]
        _run_steps(compiled, config, state, (begin, end), follow)
    poses, loss = state.best()
    return Solution(poses, torch.nan_to_num(loss, nan=torch.inf, posinf=torch.inf), follow.done, follow.interrupted)


@dataclass
class _Follow:
    """Lets the caller's hooks follow a run of several calls and end it.

    Attributes:
        hooks: of the caller.
        steps: of a full run.
        done: steps done by all rows.
        interrupted: "", "cancelled" or "deadline".
        reported: when, a `time.perf_counter()` value.
    """

    hooks: Hooks
    steps: int
    done: int = 0
    interrupted: str = ""
    reported: float = -float("inf")

    def look(self, done: int, state: AdamState) -> bool:
        """Report that so many steps are done; whether to stop."""
        now = time.perf_counter()
        if self.hooks.stop():
            self.interrupted = "cancelled"
        elif now >= self.hooks.deadline:
            self.interrupted = "deadline"
        elif done > 0 and (now - self.reported >= self.hooks.interval or done == self.steps):
            self.hooks.report(done, self.steps, float(state.loss.min()))
            if self.hooks.watch is not None:
                self.hooks.watch(state.best()[0])
            self.reported = now
        return bool(self.interrupted)


def _run_steps(
    compiled: KernelProblem, config: ClosedFormConfig, state: AdamState, span: tuple[int, int], follow: _Follow
) -> None:
    """The steps of a span, of every row of the state, in place; returns within milliseconds of an interruption."""
    begin, end = span
    rows = len(state.x)
    if rows == 0 or follow.interrupted or follow.look(begin, state):
        return
    pointers = structs.State(**{name: getattr(state, name).data_ptr() for name in structs.names_of(structs.State)})
    arguments = byref(compiled.struct), byref(_schedule(config)), byref(pointers), rows, begin, end
    call(
        "graspd_run_steps",
        *arguments,
        torch.get_num_threads(),
        watch=lambda done: follow.look(min(begin + done // rows, end - 1), state),
    )
    if not follow.interrupted:
        follow.done = end
        follow.look(end, state)


def _schedule(config: ClosedFormConfig) -> structs.Schedule:
    values = asdict(config)
    same = {name: values[name] for name in structs.names_of(structs.Schedule) if name in values}
    weights = {name: structs.Weights(**values[name]) for name in ("weights", "polish_weights")}
    return structs.Schedule(**same | weights, soft=config.activation == "soft")


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
