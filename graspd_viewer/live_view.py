"""Show a run while it plans: the hands of the optimiser, then candidates in the colours of their verdicts."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from graspd_core.hands.model import HandModel
from graspd_core.types import Progress, Snapshot, Stage, Verdict
from graspd_viewer.drawing import HAND, VERDICTS, skeletons
from graspd_viewer.scene_nodes import SceneNodes
from graspd_viewer.server import LatestJobs
from graspd_viewer.session import Session

# Least time between two drawings [s], and greatest number of hands drawn.
INTERVAL, _MOST_HANDS = 0.2, 256
_WORDS = {Stage.OPTIMISE: "searching", Stage.VERIFY: "trying"}


class LiveView:
    """Functions that `plan_grasps` calls (hooks). They pass snapshots of the hands to the drawing thread.

    Args:
        jobs: queue of the drawing thread.
        nodes: the page's scene nodes, in which the hands are drawn.
        show: function that shows a line of text, and how much of the stage is done (0 to 1).
    """

    def __init__(self, jobs: LatestJobs, nodes: SceneNodes, show: Callable[[str, float], None]) -> None:
        self._jobs, self._nodes, self._show = jobs, nodes, show
        self._hand: HandModel | None = None
        self._origin = np.zeros(3)
        self._drawn = -float("inf")

    def begin(self, session: Session) -> None:
        """Start to show a run, with the hand and the origin of `session`."""
        self._origin, self._hand = session.origin, session.hand

    def end(self) -> None:
        """Stop showing the run, and remove the drawn hands."""
        self._hand = None
        self._jobs.submit("live", lambda: self._nodes.draw_lines(np.zeros((0, 2, 3)), np.zeros((0, 3))))

    def progress(self, progress: Progress) -> None:
        """Show a progress report. `plan_grasps` gets this function as `progress`."""
        found = f", {progress.verified} verified" if progress.verified else ""
        line = f"{_WORDS.get(progress.stage, progress.stage)} {progress.step} of {progress.of}{found}"
        share = progress.step / progress.of if progress.of else 0.0
        self._jobs.submit("progress", lambda: self._show(f"{line}, {progress.elapsed:.1f} s", share), self._wait())

    def watch(self, seen: Snapshot) -> None:
        """Draw a snapshot later, and return at once. `plan_grasps` gets this function as `watch`."""
        hand = self._hand
        if hand is not None:
            self._jobs.submit("live", lambda: self._draw(hand, seen), self._wait())

    def _wait(self) -> float:
        return max(0.0, self._drawn + INTERVAL - time.monotonic())

    def _draw(self, hand: HandModel, seen: Snapshot) -> None:
        self._drawn = time.monotonic()
        if self._hand is not hand:
            return
        kept = slice(None, _MOST_HANDS)
        few = Snapshot(seen.positions[kept] - self._origin, seen.quaternions_wxyz[kept], seen.joint_positions[kept])
        lines = skeletons(hand, few)
        verdicts = seen.verdicts[kept] or (None,) * len(lines)
        tints = np.array([HAND if verdict is None else VERDICTS[Verdict(verdict)] for verdict in verdicts])
        colours = np.repeat(tints, lines.shape[1], axis=0) if len(lines) else np.zeros((0, 3))
        self._nodes.show_hand(False)
        self._nodes.draw_lines(lines.reshape(-1, 2, 3).astype(np.float32), colours)
