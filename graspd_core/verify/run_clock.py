"""Keep the clock and the hooks of one run, and make the result of the run."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from graspd_core.perception.scene import moved_grasp
from graspd_core.types import (
    Grasp,
    GraspResult,
    Outcome,
    Progress,
    ProgressHook,
    Snapshot,
    Stage,
    StopHook,
    Timing,
    WatchHook,
)


class Run:
    """Clock and hooks of a run.

    Attributes:
        began: start of the run, a `time.perf_counter()` value.
        cancelled: whether the stop hook has returned true.
        watch: hook that gets snapshots of the hands, or None if nobody watches.
        origin: origin of the planning frame, in the frame of the request [m].
    """

    def __init__(
        self,
        began: float,
        deadline: float | None,
        progress: ProgressHook | None,
        stop: StopHook | None,
        watch: WatchHook | None = None,
    ):
        self.began = began
        self.watch = watch
        self.origin = np.zeros(3)
        self.cancelled = False
        self._end = began + deadline if deadline is not None else float("inf")
        self._progress, self._stop = progress, stop

    def over(self) -> bool:
        """Return True if the run must end. Only the run's thread may call `over`, because it calls the stop hook."""
        self.cancelled = self.cancelled or (self._stop is not None and self._stop())
        return self.known_over()

    def known_over(self) -> bool:
        """Return True if the run must end. Any thread may call `known_over`, because it does not call the stop hook."""
        return self.cancelled or self.late()

    def late(self) -> bool:
        """Return True if the deadline has passed."""
        return time.perf_counter() >= self._end

    def report(self, stage: Stage, step: int, of: int, best: float, verified: int, found: Grasp | None = None) -> None:
        """Call the progress hook, if there is one, with the elapsed time. Move `found` to the frame of the request."""
        if self._progress is not None:
            found = None if found is None else moved_grasp(found, self.origin)
            self._progress(Progress(stage, step, of, best, verified, time.perf_counter() - self.began, found))

    def show(self, seen: Snapshot) -> None:
        """Call the watch hook, if there is one, with positions in the frame of the request."""
        if self.watch is not None:
            self.watch(replace(seen, positions=seen.positions + self.origin))

    @property
    def ended_early(self) -> Outcome | None:
        """`CANCELLED` if the stop hook ended the run, `DEADLINE` if the deadline has passed, else None."""
        return Outcome.CANCELLED if self.cancelled else Outcome.DEADLINE if self.late() else None


def result_of(
    grasps: Sequence[Grasp],
    count: int,
    *,
    method: str,
    seed: int = 0,
    timing: Timing | None = None,
    ended_early: Outcome | None = None,
    message: str = "",
    warnings: tuple[str, ...] = (),
    refused: Mapping[str, int] | None = None,
) -> GraspResult:
    """Return the result of a run. The outcome is success if at least `count` grasps are usable.

    Else it is `ended_early` if given, TOO_FEW, or NO_CANDIDATES. `refused` counts the refused candidates by reason.
    """
    few = Outcome.TOO_FEW if grasps else Outcome.NO_CANDIDATES
    enough = sum(grasp.usable for grasp in grasps) >= count
    return GraspResult(
        Outcome.SUCCEEDED if enough else ended_early or few,
        tuple(grasps),
        timing or Timing(),
        seed,
        method,
        message,
        warnings,
        refused=refused or {},
        count=count,
    )
