"""Counts of what the node did since its start, for /diagnostics. Safe from any thread."""

from __future__ import annotations

import threading
from collections import Counter
from typing import Any

from graspd_msgs.msg import Grasp, GraspArray

from graspd_core.types import GraspResult
from graspd_ros.diagnostics import Health

_NAMES = {
    GraspArray.SUCCEEDED: "succeeded",
    GraspArray.PARTIAL: "partial",
    GraspArray.FAILED: "failed",
    GraspArray.CANCELLED: "cancelled",
    GraspArray.SUPERSEDED: "superseded",
    GraspArray.REFUSED: "refused",
}


class Counters:
    """Counts by name, and the last figures."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._last: dict[str, Any] = {}

    def count(self, name: str, number: int = 1) -> None:
        """One more of `accepted`, `clouds_received` or `clouds_superseded`."""
        with self._lock:
            self._counts[name] += number

    def answered(self, message: GraspArray) -> None:
        """A request got its answer."""
        failed = message.status == GraspArray.FAILED
        with self._lock:
            self._counts[_NAMES[message.status]] += 1
            self._counts["verified"] += sum(grasp.verdict == Grasp.VERIFIED for grasp in message.grasps)
            self._counts["rejected"] += sum(grasp.verdict == Grasp.FAILED for grasp in message.grasps)
            if failed:
                self._counts["failed_in_a_row"] += 1
                self._last["last_error"] = message.message
            elif message.status in (GraspArray.SUCCEEDED, GraspArray.PARTIAL):
                self._counts["failed_in_a_row"] = 0

    def planned(self, result: GraspResult, latency: float) -> None:
        """A run ended `latency` seconds after its request came."""
        with self._lock:
            self._counts["audited"] += result.audits.audited
            self._counts["audits_disagreed"] += result.audits.disagreed
            self._last |= {"last_latency": latency, "last_first_verified": result.timing.first_verified}

    def clear(self) -> None:
        """Begin anew."""
        with self._lock:
            self._counts.clear()
            self._last.clear()

    def health(self, **state: Any) -> Health:
        """The counts, and what else the node knows about itself."""
        with self._lock:
            return Health(**state, **self._counts, **self._last)
