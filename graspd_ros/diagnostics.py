"""The node's health on /diagnostics."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import Header


@dataclass(frozen=True)
class Health:
    """What the node knows about itself.

    Attributes:
        name: the node's fully qualified name.
        hand: name of the loaded hand.
        ready: whether the hand is loaded and everything is warm.
        worker_alive: whether the worker's thread serves.
        running: id of the request that is worked on, empty when idle.
        waiting: requests that wait.
        queue_size: most requests that may wait.
        accepted, succeeded, partial, failed, cancelled, superseded, refused: requests since the start, by their end.
        verified: grasps since the start that held in the trial.
        rejected: grasps since the start that did not.
        audited: verified grasps since the start that were tried once more with a pull at full length.
        audits_disagreed: those of them that failed there.
        failed_in_a_row: requests that failed since the last that did not.
        last_latency: seconds from the last answered request to its answer, None before the first.
        last_first_verified: seconds from that request to its first verified grasp, None where there was none.
        last_error: the last failure in one line, empty without one.
        clouds_received: clouds and depth images that came.
        clouds_superseded: those that gave way to newer ones.
        transforms: whether /tf is heard.
    """

    name: str
    hand: str
    ready: bool
    worker_alive: bool
    running: str = ""
    waiting: int = 0
    queue_size: int = 0
    accepted: int = 0
    succeeded: int = 0
    partial: int = 0
    failed: int = 0
    cancelled: int = 0
    superseded: int = 0
    refused: int = 0
    verified: int = 0
    rejected: int = 0
    audited: int = 0
    audits_disagreed: int = 0
    failed_in_a_row: int = 0
    last_latency: float | None = None
    last_first_verified: float | None = None
    last_error: str = ""
    clouds_received: int = 0
    clouds_superseded: int = 0
    transforms: bool = False


def health_message(health: Health, stamp: Time, memory: int) -> DiagnosticArray:
    """One status; its level is for alarms, its message for people, its values for graphs.

    Args:
        health: what the node knows.
        stamp: now.
        memory: resident memory of the process and its children [bytes].
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
    """Memory of a process (this one) and its children that is in RAM [bytes]; 0 where the system does not tell.

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
    return {
        "worker": "busy" if state == "idle" and health.running else state,
        "current request": health.running,
        "queue length": str(health.waiting),
        "queue size": str(health.queue_size),
        "last latency [s]": _seconds(health.last_latency),
        "last first verified [s]": _seconds(health.last_first_verified),
        "requests accepted": str(health.accepted),
        "requests succeeded": str(health.succeeded),
        "requests partial": str(health.partial),
        "requests failed": str(health.failed),
        "requests cancelled": str(health.cancelled),
        "requests superseded": str(health.superseded),
        "requests refused": str(health.refused),
        "grasps verified": str(health.verified),
        "grasps failed": str(health.rejected),
        "grasps audited": str(health.audited),
        "audits that disagreed": str(health.audits_disagreed),
        "last error": health.last_error,
        "clouds received": str(health.clouds_received),
        "clouds superseded": str(health.clouds_superseded),
        "transforms heard": "yes" if health.transforms else "no: tf2_msgs is not installed",
        "memory [MB]": f"{memory / 1e6:.0f}" if memory else "",
    }


def _seconds(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
