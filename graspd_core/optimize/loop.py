"""Batches of hand poses, and the rows of numbers that solvers step.

The loop that every solver shares: starts in, best iterates out; stop and deadline are obeyed within a step.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from graspd_core.optimize.problem import Problem
from graspd_core.se3 import SE3, rotation_from_quaternion


@dataclass(frozen=True)
class Poses:
    """A batch of hand poses on the problem's device.

    Attributes:
        translation: base origin in the object frame [m].
        quaternion: base orientation, wxyz, any non-zero length.
        joints: [rad].
    """

    translation: Float[Tensor, "batch 3"]
    quaternion: Float[Tensor, "batch 4"]
    joints: Float[Tensor, "batch joints"]

    @property
    def base(self) -> SE3:
        """`T_object_base`."""
        return SE3(rotation_from_quaternion(self.quaternion), self.translation)

    def __getitem__(self, rows: Tensor) -> Poses:
        return Poses(self.translation[rows], self.quaternion[rows], self.joints[rows])


def pack(poses: Poses) -> Float[Tensor, "batch variables"]:
    """Rows of translation, quaternion, joints."""
    return torch.cat([poses.translation, poses.quaternion, poses.joints], -1)


def unpack(x: Float[Tensor, "batch variables"]) -> Poses:
    """Inverse of `pack`."""
    return Poses(x[:, :3], x[:, 3:7], x[:, 7:])


def moved_along(poses: Poses, point: Float[Tensor, "*batch 3"]) -> Poses:
    """The poses with their translation moved along a vector of the base frame [m]."""
    turned = (rotation_from_quaternion(poses.quaternion) @ point[..., None]).squeeze(-1)
    return Poses(poses.translation + turned, poses.quaternion, poses.joints)


S = TypeVar("S")
# How fast Adam's running means forget, of the gradient and of its square.
_BETA1, _BETA2, _EPSILON = 0.9, 0.98, 1e-8


@runtime_checkable
class Solver(Protocol[S]):
    """A frozen value that holds its hyper-parameters; the loop below drives it."""

    @property
    def steps(self) -> int:
        """Number of steps of a full run."""
        ...

    def init(self, problem: Problem, starts: Poses) -> S:
        """The state before the first step."""
        ...

    def step(self, problem: Problem, state: S, index: int) -> S:
        """One step; may drop hopeless starts."""
        ...

    def best(self, state: S) -> tuple[Poses, Float[Tensor, "batch"]]:
        """Best iterate of each start so far and its loss."""
        ...


@dataclass(frozen=True)
class Hooks:
    """How the caller follows and ends a run.

    Attributes:
        report: called with (step, steps, best loss) at most every `interval` seconds.
        stop: true ends the run within one step.
        deadline: `time.perf_counter()` value at which the run ends within one step.
        interval: least time between reports [s].
        watch: called with the best poses so far beside every report; None where nobody looks.
    """

    report: Callable[[int, int, float], None] = field(default=lambda step, steps, loss: None)
    stop: Callable[[], bool] = field(default=lambda: False)
    deadline: float = float("inf")
    interval: float = 0.1
    watch: Callable[[Poses], None] | None = None


@dataclass(frozen=True)
class Solution(Generic[S]):
    """Where a run ended.

    Attributes:
        poses: best iterate of every start that was kept.
        loss: its loss; infinite where no iterate was finite.
        steps: steps done.
        interrupted: why it ended early, empty when it ran to its end: "cancelled" or "deadline".
    """

    poses: Poses
    loss: Float[Tensor, "batch"]
    steps: int
    interrupted: str = ""


def minimise(solver: Solver[S], problem: Problem, starts: Poses, hooks: Hooks) -> Solution[S]:
    """Run `solver` from `starts`; never raises for numerical trouble, a start that diverges just never improves."""
    state = solver.init(problem, starts)
    last_report = -float("inf")
    done, interrupted = 0, ""
    while done < solver.steps:
        now = time.perf_counter()
        if hooks.stop():
            interrupted = "cancelled"
            break
        if now >= hooks.deadline:
            interrupted = "deadline"
            break
        state = solver.step(problem, state, done)
        done += 1
        if now - last_report >= hooks.interval or done == solver.steps:
            poses, loss = solver.best(state)
            hooks.report(done, solver.steps, float(loss.min()))
            if hooks.watch is not None:
                hooks.watch(poses)
            last_report = now
    poses, loss = solver.best(state)
    return Solution(poses, torch.nan_to_num(loss, nan=torch.inf, posinf=torch.inf), done, interrupted)


def adam_moments(
    mean: Float[Tensor, "batch variables"],
    square: Float[Tensor, "batch variables"],
    gradient: Float[Tensor, "batch variables"],
    count: int,
) -> tuple[
    Float[Tensor, "batch variables"],
    Float[Tensor, "batch variables"],
    Float[Tensor, "batch variables"],
    Float[Tensor, "batch variables"],
]:
    """Return Adam's moments after step number `count`, from one (Kingma & Ba 2015, §2).

    Returns:
        The running means of the gradient and of its square, and the two whose quotient is the direction of the step.
    """
    mean = _BETA1 * mean + (1 - _BETA1) * gradient
    square = _BETA2 * square + (1 - _BETA2) * gradient * gradient
    return mean, square, mean / (1 - _BETA1**count), (square / (1 - _BETA2**count)).sqrt() + _EPSILON
