"""Run a solver from starts to the best iterates. A stop or a deadline ends the run within one step."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.se3 import SE3, rotation_from_quaternion

if TYPE_CHECKING:
    from graspd_core.optimize.problem import Problem

# Arrays with one row per start: a value, the solver's variables, base position [m], joints [rad] or [m], hand points
# [m], and distances of the points from the object [m].
Values = Float[Tensor, "batch"]
Rows = Float[Tensor, "batch variables"]
Positions = Float[Tensor, "batch 3"]
Joints = Float[Tensor, "batch joints"]
Points = Float[Tensor, "batch points 3"]
Distances = Float[Tensor, "batch points"]


@dataclass(frozen=True)
class Poses:
    """A batch of hand poses on the problem's device.

    Attributes:
        translation: base origin in the object frame [m].
        quaternion: base orientation, wxyz, of any non-zero length.
        joints: joint values [rad] or [m].
    """

    translation: Float[Tensor, "batch 3"]
    quaternion: Float[Tensor, "batch 4"]
    joints: Float[Tensor, "batch joints"]

    @property
    def base(self) -> SE3:
        """Pose of the base, `T_object_base`."""
        return SE3(rotation_from_quaternion(self.quaternion), self.translation)

    def __getitem__(self, rows: Tensor) -> Poses:
        return Poses(self.translation[rows], self.quaternion[rows], self.joints[rows])


def pack(poses: Poses) -> Rows:
    """Return rows of translation, quaternion and joints: the variables of the solvers."""
    return torch.cat([poses.translation, poses.quaternion, poses.joints], -1)


def unpack(x: Rows) -> Poses:
    """Return the poses of rows that `pack` made."""
    return Poses(x[:, :3], x[:, 3:7], x[:, 7:])


def moved_along(poses: Poses, point: Float[Tensor, "*batch 3"]) -> Poses:
    """Return the poses with each base moved by the vector `point`, given in the base frame [m]."""
    turned = (rotation_from_quaternion(poses.quaternion) @ point[..., None]).squeeze(-1)
    return Poses(poses.translation + turned, poses.quaternion, poses.joints)


S = TypeVar("S")
# Adam: decay rates of the running means of the gradient and of its square, and a number that prevents division by 0.
_BETA1, _BETA2, _EPSILON = 0.9, 0.98, 1e-8


@runtime_checkable
class Solver(Protocol[S]):
    """An optimiser: a frozen object with its hyper-parameters. `minimise` runs `steps` steps of the optimiser."""

    @property
    def steps(self) -> int: ...

    def init(self, problem: Problem, starts: Poses) -> S:
        """Return the state before the first step."""
        ...

    def step(self, problem: Problem, state: S, index: int) -> S:
        """Return the state after one step. The solver may drop hopeless starts."""
        ...

    def best(self, state: S) -> tuple[Poses, Values]:
        """Return the best iterate of each start so far, and the loss of each best iterate."""
        ...


@dataclass(frozen=True)
class Hooks:
    """Callbacks of the caller to follow a run and to end it.

    Attributes:
        report: called with (step, steps, best loss) at most every `interval` seconds.
        stop: called before every step. If it returns True, the run ends.
        deadline: `time.perf_counter()` value after which the run ends within one step.
        interval: least time between reports [s].
        watch: called at every report with the best poses so far. None for no call.
    """

    report: Callable[[int, int, float], None] = field(default=lambda step, steps, loss: None)
    stop: Callable[[], bool] = field(default=lambda: False)
    deadline: float = float("inf")
    interval: float = 0.1
    watch: Callable[[Poses], None] | None = None


@dataclass(frozen=True)
class Solution:
    """The result of a run.

    Attributes:
        poses: best iterate of every start that was kept.
        loss: loss of each best iterate. Infinite if the start had no finite iterate.
        steps: number of steps done.
        interrupted: why the run ended early: "cancelled" or "deadline". Empty for a full run.
    """

    poses: Poses
    loss: Float[Tensor, "batch"]
    steps: int
    interrupted: str = ""


@dataclass
class Follow:
    """Progress of a run of `steps` steps, reported to the hooks. `reported` is the time of the last report."""

    hooks: Hooks
    steps: int
    done: int = 0
    interrupted: str = ""
    reported: float = -float("inf")

    def over(self) -> bool:
        """Return True if the hooks end the run, and store the reason in `interrupted`."""
        if self.hooks.stop():
            self.interrupted = "cancelled"
        elif time.perf_counter() >= self.hooks.deadline:
            self.interrupted = "deadline"
        return bool(self.interrupted)

    def report(self, done: int, best: Callable[[], tuple[Poses, Values]]) -> None:
        """Report `done` steps if `interval` has passed since the last report, or if all steps are done."""
        now = time.perf_counter()
        if now - self.reported < self.hooks.interval and done != self.steps:
            return
        poses, loss = best()
        self.hooks.report(done, self.steps, float(loss.min()))
        if self.hooks.watch is not None:
            self.hooks.watch(poses)
        self.reported = now

    def solution(self, poses: Poses, loss: Values) -> Solution:
        return Solution(poses, torch.nan_to_num(loss, nan=torch.inf, posinf=torch.inf), self.done, self.interrupted)


def minimise(solver: Solver[S], problem: Problem, starts: Poses, hooks: Hooks) -> Solution:
    """Run `solver` from `starts`. A start that diverges keeps its best iterate. Numerical errors never raise."""
    state, follow = solver.init(problem, starts), Follow(hooks, solver.steps)
    while follow.done < solver.steps and not follow.over():
        state = solver.step(problem, state, follow.done)
        follow.done += 1
        follow.report(follow.done, partial(solver.best, state))
    return follow.solution(*solver.best(state))


def adam_moments(mean: Rows, square: Rows, gradient: Rows, count: int) -> tuple[Rows, Rows, Rows, Rows]:
    """Return Adam's moments after step `count`, counted from one (Kingma & Ba 2015, §2).

    Returns:
        The running means of the gradient and of its square, and numerator and denominator of the step direction.
    """
    mean = _BETA1 * mean + (1 - _BETA1) * gradient
    square = _BETA2 * square + (1 - _BETA2) * gradient * gradient
    return mean, square, mean / (1 - _BETA1**count), (square / (1 - _BETA2**count)).sqrt() + _EPSILON
