"""Make blocks on a Ray worker. A child process with limits plans the grasps, and the worker writes the files.

If a block hangs, crashes or fills the memory, only the child ends. The worker then records the failure. The worker
imports neither torch nor MuJoCo. It passes pickled values to the child.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

from graspd_core.errors import ConfigError
from graspd_core.runtime.worker_process import WorkerProcess
from graspd_dataset.dataset_store import DatasetStore, block_path, file_hash

T = TypeVar("T")

# A new child replaces the old one after this many calls, because libraries may never free some memory.
_CALLS = 200
_KINDS = {TimeoutError: "hung", MemoryError: "memory", ChildProcessError: "died"}


@dataclass(frozen=True)
class Limits:
    """Limits of the child while it makes one block or prepares one object: wall time [s] and resident memory [MB].

    Raises:
        ConfigError: a limit is not positive.
    """

    seconds: float = 1800.0
    most_mb: float = 4096.0

    def __post_init__(self) -> None:
        for name, value in (("patience", self.seconds), ("memory", self.most_mb)):
            if not value > 0:
                raise ConfigError(f"{name}: {value:g}; valid: a positive number")


@dataclass(frozen=True)
class Report:
    """What a worker reports about one block or one prepared object.

    Attributes:
        key: key of the block or the object.
        failed: kind of failure: raised (an error), hung, memory, died, lost (with its worker). Empty on success.
        error: description of the failure.
        rows, verified: number of all candidates, and of verified candidates.
        failures: number of failed candidates for each kind of failure (`failure_kind`).
        cpu: CPU time of the child [s].
        peak_mb: peak memory of the child [MB].
        files: path and SHA-256 of each written file.
    """

    key: str
    failed: str = ""
    error: str = ""
    rows: int = 0
    verified: int = 0
    failures: dict[str, int] = field(default_factory=dict)
    cpu: float = 0.0
    peak_mb: float = 0.0
    files: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ReadyObject:
    """A prepared object, which all blocks of this object share.

    Attributes:
        sha256: hash of the object's cleaned mesh.
        file: content of the object's file in `objects/`.
        shared: the pickled scene, and arrays computed from it, such as the SDF grid and the convex parts.
    """

    sha256: str
    file: bytes
    shared: bytes


@dataclass(frozen=True)
class MadeBlock:
    """A block that was made.

    Attributes:
        file: content of the Parquet file.
        object_sha256: hash of the object's cleaned mesh.
        report: report without `files`.
    """

    file: bytes
    object_sha256: str
    report: Report


@dataclass(frozen=True)
class Job:
    """A block to make or an object to prepare, in the form that is sent to a worker.

    Attributes:
        key: key of the block or the object.
        asked: what was requested, in values for JSON. A record of a failure contains it.
        pickled: the pickled block, or the pickled pair of object and settings.
        hand: name of a block's hand. Empty for an object.
    """

    key: str
    asked: dict[str, Any]
    pickled: bytes
    hand: str = ""


def prepare_object(job: Job, content: bytes | None, store: DatasetStore, limits: Limits) -> tuple[Report, bytes]:
    """Prepare an object and write its mesh file. Return the report and `ReadyObject.shared` (empty after a failure)."""
    try:
        ready = call_guarded(limits, ready_of, job.pickled, content)
    except Exception as error:
        return failed_report(store, job, error), b""
    path = f"objects/{ready.sha256}.parquet"
    store.write(path, ready.file)
    return Report(job.key, files={path: file_hash(ready.file)}), ready.shared


def run_block(job: Job, hand: bytes, shared: bytes, store: DatasetStore, limits: Limits) -> Report:
    """Make a block and write its file, or write a record of the failure. Return the report."""
    try:
        made = call_guarded(limits, block_of, job.pickled, hand, shared)
    except Exception as error:
        return failed_report(store, job, error)
    path = block_path(job.hand, made.object_sha256, job.key)
    store.write(path, made.file)
    return replace(made.report, files={path: file_hash(made.file)})


def ready_of(pickled: bytes, content: bytes | None) -> ReadyObject:
    """Call `make_ready` in the child. `pickled` holds the object and its settings."""
    from graspd_dataset.block_rows import make_ready

    thing, config = pickle.loads(pickled)
    return make_ready(thing, content, config)


def block_of(pickled: bytes, hand: bytes, shared: bytes) -> MadeBlock:
    """Call `make_block` in the child. `pickled` holds the block."""
    from graspd_dataset.block_rows import make_block

    return make_block(pickle.loads(pickled), hand, shared)


def failed_report(store: DatasetStore, job: Job, error: BaseException) -> Report:
    """Write the record of a failure to `failed/`. Return the report that names the failure."""
    from graspd_dataset.run_records import failure

    record = failure(error, _KINDS.get(type(error), "raised"))
    entry = {"key": job.key, "asked": job.asked, **record}
    store.write(f"failed/{job.key}.json", (json.dumps(entry, indent=1) + "\n").encode())
    return Report(job.key, failed=record["failed"], error=record["error"])


class _Child:
    """The child process that does the work of this worker. The first `call` starts the child."""

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
