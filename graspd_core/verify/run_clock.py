"""Keep the clock and the hooks of one run, and decide its outcome."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from graspd_core.perception.scene import moved_grasp
from graspd_core.types import Grasp, Outcome, Progress, ProgressHook, Snapshot, Stage, StopHook, WatchHook


@dataclass(eq=False)
class Run:
    """Clock and hooks of a run.

    Attributes:
        began: start of the run, a `time.perf_counter()` value.
        deadline: time after `began` at which the run ends [s]. None for no limit.
        progress: hook that gets progress reports, or None.
        stop: stop hook, a function that ends the run by returning true, or None.
        watch: hook that gets snapshots of the hands, or None if nobody watches.
        origin: origin of the planning frame, in the frame of the request [m].
        cancelled: whether the stop hook has returned true.
    """

    began: float
    deadline: float | None
    progress: ProgressHook | None
    stop: StopHook | None
    watch: WatchHook | None = None
    origin: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    cancelled: bool = False

    def over(self) -> bool:
        """Return True if the run must end. Only the run's thread may call `over`, because it calls the stop hook."""
        self.cancelled = self.cancelled or (self.stop is not None and self.stop())
        return self.known_over()

    def known_over(self) -> bool:
        """Return True if the run must end. Any thread may call `known_over`, because it does not call the stop hook."""
        return self.cancelled or self.late()

    def late(self) -> bool:
        """Return True if the deadline has passed."""
        return self.deadline is not None and time.perf_counter() >= self.began + self.deadline

    def report(self, stage: Stage, step: int, of: int, best: float, verified: int, found: Grasp | None = None) -> None:
        """Call the progress hook, if there is one, with the elapsed time. Move `found` to the frame of the request."""
        if self.progress is not None:
            found = None if found is None else moved_grasp(found, self.origin)
            self.progress(Progress(stage, step, of, best, verified, time.perf_counter() - self.began, found))

    def show(self, seen: Snapshot) -> None:
        """Call the watch hook, if there is one, with positions in the frame of the request."""
        if self.watch is not None:
            self.watch(replace(seen, positions=seen.positions + self.origin))

    @property
    def ended_early(self) -> Outcome | None:
        """`CANCELLED` if the stop hook ended the run, `DEADLINE` if the deadline has passed, else None."""
        return Outcome.CANCELLED if self.cancelled else Outcome.DEADLINE if self.late() else None


def outcome_of(grasps: Sequence[Grasp], count: int, ended_early: Outcome | None = None) -> Outcome:
    """Return `SUCCEEDED` if `count` grasps are usable, else `ended_early`, else the kind of shortage."""
    if sum(grasp.usable for grasp in grasps) >= count:
        return Outcome.SUCCEEDED
    return ended_early or (Outcome.TOO_FEW if grasps else Outcome.NO_CANDIDATES)
