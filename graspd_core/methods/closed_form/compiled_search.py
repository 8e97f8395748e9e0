"""The search of `closed_form.ClosedForm` by the compiled kernel: same schedule, same results up to rounding.

Every start is stepped by itself, on as many threads as torch has (`torch.set_num_threads`). A start ends alike on one
thread and on many, alone and in a batch.
"""

from __future__ import annotations

import time
from ctypes import byref
from dataclasses import asdict, dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.kernel import structs
from graspd_core.kernel.builds import call
from graspd_core.methods.closed_form.adam import AdamState, initial_state
from graspd_core.methods.closed_form.closed_form_config import ClosedFormConfig, LossWeights, drop_steps, rows_kept
from graspd_core.methods.kernel_problem import KernelProblem
from graspd_core.methods.loop import Hooks, Solution
from graspd_core.methods.poses import Poses, moved_along, pack
from graspd_core.methods.problem import Problem, Terms


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
