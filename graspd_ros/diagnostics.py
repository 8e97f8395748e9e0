"""The node's health on /diagnostics: what it counts since its start, and how that is told."""

from __future__ import annotations

import os
import threading
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from graspd_msgs.msg import Grasp, GraspArray
from std_msgs.msg import Header

from graspd_core.types import GraspResult

_ENDS = {
    GraspArray.SUCCEEDED: "requests succeeded",
    GraspArray.PARTIAL: "requests partial",
    GraspArray.FAILED: "requests failed",
    GraspArray.CANCELLED: "requests cancelled",
    GraspArray.SUPERSEDED: "requests superseded",
    GraspArray.REFUSED: "requests refused",
}
# What is counted since the start, by the key that tells it.
ACCEPTED, RECEIVED, SUPERSEDED = "requests accepted", "clouds received", "clouds superseded"
VERIFIED, FAILED = "grasps verified", "grasps failed"


@dataclass(frozen=True)
class Health:
    """What the node knows about itself.

    Attributes:
        name: the node's fully qualified name.
        hand: name of the loaded hand.
        ready: whether the hand is loaded and everything is warm.
        worker_alive: whether the worker's thread serves.
        running: id of the request that is worked on, empty when idle.
        waiting: requests that wait, of at most `queue_size`.
        transforms: whether /tf is heard.
        counts: since the start, by the key that tells them.
        failed_in_a_row: requests that failed since the last that did not.
        last_latency: seconds from the last answered request to its answer, None before the first.
        last_first_verified: seconds from that request to its first verified grasp, None where there was none.
        last_error: the last failure in one line, empty without one.
    """

    name: str
    hand: str
    ready: bool
    worker_alive: bool
    running: str = ""
    waiting: int = 0
    queue_size: int = 0
    transforms: bool = False
    counts: Mapping[str, int] = field(default_factory=dict)
    failed_in_a_row: int = 0
    last_latency: float | None = None
    last_first_verified: float | None = None
    last_error: str = ""


class Counters:
    """Counts by name, and the last figures. Safe from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._last: dict[str, Any] = {}

    def count(self, key: str) -> None:
        """Count one more of a key."""
        with self._lock:
            self._counts[key] += 1

    def answered(self, message: GraspArray) -> None:
        """Count a request that got its answer, and its grasps."""
        with self._lock:
            self._counts[_ENDS[message.status]] += 1
            self._counts[VERIFIED] += sum(grasp.verdict == Grasp.VERIFIED for grasp in message.grasps)
            self._counts[FAILED] += sum(grasp.verdict == Grasp.FAILED for grasp in message.grasps)
            if message.status == GraspArray.FAILED:
                self._last["failed_in_a_row"] = self._last.get("failed_in_a_row", 0) + 1
                self._last["last_error"] = message.message
            elif message.status in (GraspArray.SUCCEEDED, GraspArray.PARTIAL):
                self._last["failed_in_a_row"] = 0

    def planned(self, result: GraspResult, latency: float) -> None:
        """Count a run that ended `latency` seconds after its request came."""
        with self._lock:
            self._last |= {"last_latency": latency, "last_first_verified": result.timing.first_verified}

    def clear(self) -> None:
        """Begin anew."""
        with self._lock:
            self._counts.clear()
            self._last.clear()

    def health(self, **state: Any) -> Health:
        """Return the counts, and what else the node knows about itself."""
        with self._lock:
            return Health(**state, counts=dict(self._counts), **self._last)


def health_message(health: Health, stamp: Time, memory: int) -> DiagnosticArray:
    """Return one status; its level is for alarms, its message for people, its values for graphs.

    `memory` is the resident memory of the process and its children [bytes].
    """
    level, message = _verdict(health)
    status = DiagnosticStatus(
        level=level,
        name=f"{health.name.lstrip('/')}: grasp synthesis",
        message=message,
        hardware_id=health.hand,
        values=[KeyValue(key=key, value=value) for key, value in _values(health, memory).items()],
    )
    return DiagnosticArray(header=Header(stamp=stamp), status=[status])


def resident_memory(pid: int | None = None) -> int:
    """Return what of a process (this one) and its children is in RAM [bytes]; 0 where the system does not tell.

    What they share counts for each.
    """
    process = Path("/proc", str(pid or os.getpid()))
    try:
        pages = int((process / "statm").read_text().split()[1])
        tasks = list((process / "task").iterdir())
    except OSError:
        return 0
    children = [int(child) for task in tasks for child in _words(task / "children")]
    return pages * os.sysconf("SC_PAGE_SIZE") + sum(map(resident_memory, children))


def _words(file: Path) -> list[str]:
    try:
        return file.read_text().split()
    except OSError:  # of a thread that has ended meanwhile
        return []


def _verdict(health: Health) -> tuple[bytes, str]:
    """The worst that holds."""
    if not health.worker_alive:
        return DiagnosticStatus.ERROR, "the worker has ended: restart the node"
    if not health.ready:
        return DiagnosticStatus.WARN, "warming up"
    if health.failed_in_a_row:
        times = "the last request" if health.failed_in_a_row == 1 else f"the last {health.failed_in_a_row} requests"
        return DiagnosticStatus.WARN, f"{times} failed: {health.last_error or 'no reason given'}"
    if health.queue_size and health.waiting >= health.queue_size:
        return DiagnosticStatus.WARN, f"the queue is full: {health.waiting} wait"
    return DiagnosticStatus.OK, f"works on {health.running}" if health.running else "waits for requests"


def _values(health: Health, memory: int) -> dict[str, str]:
    state = "ended" if not health.worker_alive else "warming up" if not health.ready else "idle"

    def counted(*keys: str) -> dict[str, str]:
        return {key: str(health.counts.get(key, 0)) for key in keys}

    return {
        "worker": "busy" if state == "idle" and health.running else state,
        "current request": health.running,
        "queue length": str(health.waiting),
        "queue size": str(health.queue_size),
        "last latency [s]": _seconds(health.last_latency),
        "last first verified [s]": _seconds(health.last_first_verified),
        **counted(ACCEPTED, *_ENDS.values(), VERIFIED, FAILED),
        "last error": health.last_error,
        **counted(RECEIVED, SUPERSEDED),
        "transforms heard": "yes" if health.transforms else "no: tf2_msgs is not installed",
        "memory [MB]": f"{memory / 1e6:.0f}" if memory else "",
    }


def _seconds(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
