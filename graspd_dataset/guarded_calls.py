"""Blocks on a worker of Ray: the work in a child process with limits, its files written whole by the worker.

A block that hangs, crashes, or fills memory harms the child only, and the worker records it. The worker itself loads
neither torch nor MuJoCo: it passes pickled values on to the child.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from graspd_core.runtime.worker_process import WorkerProcess
from graspd_dataset.dataset_store import DatasetStore, block_path, file_hash

T = TypeVar("T")

# Calls after which the child is replaced, which bounds what libraries leak.
_CALLS = 200
_KINDS = {TimeoutError: "hung", MemoryError: "memory", ChildProcessError: "died"}


@dataclass(frozen=True)
class Limits:
    """Limits of one block, or of preparing one object: seconds, and MB of resident memory."""

    seconds: float = 1800.0
    most_mb: float = 4096.0


@dataclass(frozen=True)
class Report:
    """The result of a block, or of preparing an object.

    Attributes:
        key: of the block or the object.
        failed: kind of failure (raised, hung, memory, died, lost), empty for a written one.
        error: what failed.
        rows, verified: numbers of candidates.
        failures: numbers of failed candidates by trial and kind of reason.
        size: of the file [bytes].
        cpu: seconds.
        peak_mb: peak of the child's memory.
        files: hashes of the files that were written, by path.
    """

    key: str
    failed: str = ""
    error: str = ""
    rows: int = 0
    verified: int = 0
    failures: dict[str, int] = field(default_factory=dict)
    size: int = 0
    cpu: float = 0.0
    peak_mb: float = 0.0
    files: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ReadyObject:
    """A prepared object, for every process that grasps it.

    Attributes:
        sha256: of its cleaned mesh.
        file: bytes of its row in `objects/`.
        shared: pickled scene and what was built for it: the distance grid, the convex parts.
    """

    sha256: str
    file: bytes
    shared: bytes


@dataclass(frozen=True)
class MadeBlock:
    """A block's file and what it took.

    Attributes:
        object_sha256: of the cleaned mesh.
        file: bytes of its Parquet file.
        rows, verified: numbers of candidates.
        failures: numbers of failed candidates by trial and kind of reason.
        cpu: seconds of this process.
        peak_mb: peak of its memory.
    """

    object_sha256: str
    file: bytes
    rows: int
    verified: int
    failures: dict[str, int]
    cpu: float
    peak_mb: float


@dataclass(frozen=True)
class Job:
    """A block, or an object to make ready, as it goes to a worker.

    Attributes:
        key: of the block or the object.
        asked: for the record of a failure, JSON-ready.
        pickled: the block, or the pair of an object and the settings.
        hand: of a block, the name of its hand.
    """

    key: str
    asked: dict[str, Any]
    pickled: bytes
    hand: str = ""


def prepare_object(job: Job, content: bytes | None, store: DatasetStore, limits: Limits) -> tuple[Report, bytes]:
    """Prepare an object and keep its mesh. Return the report, and what its blocks share, empty for a failure."""
    try:
        ready = call_guarded(limits, ready_of, job.pickled, content)
    except Exception as error:
        return failed_report(store, job, error), b""
    path = f"objects/{ready.sha256}.parquet"
    store.write(path, ready.file)
    return Report(job.key, files={path: file_hash(ready.file)}), ready.shared


def run_block(job: Job, hand: bytes, shared: bytes, store: DatasetStore, limits: Limits) -> Report:
    """Make a block and keep it."""
    try:
        made = call_guarded(limits, block_of, job.pickled, hand, shared)
    except Exception as error:
        return failed_report(store, job, error)
    path = block_path(job.hand, made.object_sha256, job.key)
    store.write(path, made.file)
    return Report(
        job.key,
        rows=made.rows,
        verified=made.verified,
        failures=made.failures,
        size=len(made.file),
        cpu=made.cpu,
        peak_mb=made.peak_mb,
        files={path: file_hash(made.file)},
    )


def ready_of(pickled: bytes, content: bytes | None) -> ReadyObject:
    """Call `make_ready` of an object and settings, in the child."""
    from graspd_dataset.block_rows import make_ready

    thing, config = pickle.loads(pickled)
    return make_ready(thing, content, config)


def block_of(pickled: bytes, hand: bytes, shared: bytes) -> MadeBlock:
    """Call `make_block`, in the child."""
    from graspd_dataset.block_rows import make_block

    return make_block(pickle.loads(pickled), hand, shared)


def failed_report(store: DatasetStore, job: Job, error: BaseException) -> Report:
    """Record a failure."""
    from graspd_dataset.run_records import failure

    record = failure(error, _KINDS.get(type(error), "raised"))
    told = {"key": job.key, "asked": job.asked, **record}
    store.write(f"failed/{job.key}.json", (json.dumps(told, indent=1) + "\n").encode())
    return Report(job.key, failed=record["failed"], error=record["error"])


class _Child:
    """The child of this process, started with the first call."""

    def __init__(self) -> None:
        self._process: WorkerProcess | None = None
        self._left = 0

    def call(self, limits: Limits, work: Callable[..., T], *arguments: Any) -> T:
        if self._process is None or self._left <= 0:
            self.close()
            self._process, self._left = WorkerProcess(killed_with_thread=True), _CALLS
        self._left -= 1
        return self._process.bounded(limits.seconds, limits.most_mb, work, *arguments)

    def close(self) -> None:
        if self._process is not None:
            self._process.close()
            self._process = None


_CHILD = _Child()
call_guarded, close_child = _CHILD.call, _CHILD.close
