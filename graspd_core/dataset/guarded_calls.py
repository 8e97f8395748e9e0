"""Blocks on a worker of Ray: the work in a child process with limits, its files written whole by the worker.

What a block does, hang, crash, or fill memory, it does to the child; the worker writes down what it was. The worker
itself needs neither torch nor MuJoCo.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

from graspd_core.dataset.dataset_store import DatasetStore, block_path
from graspd_core.runtime.worker_process import WorkerProcess

if TYPE_CHECKING:
    from graspd_core.dataset.block_rows import MadeBlock, ReadyObject
    from graspd_core.dataset.blocks import Block, DatasetObject
    from graspd_core.methods.plan_config import PlanConfig

T = TypeVar("T")

# Calls after which the child is replaced, which bounds what libraries leak.
_CALLS = 200
_KINDS = {TimeoutError: "hung", MemoryError: "memory", ChildProcessError: "died"}


@dataclass(frozen=True)
class Limits:
    """What one block, or making one object ready, may take: seconds, and MB of resident memory."""

    seconds: float = 1800.0
    most_mb: float = 4096.0


@dataclass(frozen=True)
class Report:
    """What came of a block, or of making an object ready.

    Attributes:
        key: of the block or the object.
        failed: kind of failure (raised, hung, memory, died, lost); empty where it was written.
        error: what failed.
        rows, verified: numbers of candidates.
        failures: numbers of failed candidates by trial and kind of reason.
        size: of the file [bytes].
        cpu: seconds.
        peak_mb: peak of the child's memory.
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


def prepare_object(
    thing: DatasetObject, content: bytes | None, config: PlanConfig, store: DatasetStore, limits: Limits
) -> tuple[Report, bytes]:
    """Make an object ready and keep its mesh; what its blocks share, or where it failed, the record and nothing."""
    from graspd_core.dataset import block_rows

    try:
        ready: ReadyObject = call_guarded(limits, block_rows.make_ready, thing, content, config)
    except Exception as error:
        return failed_report(store, thing.key, {"object": thing.source, **thing.asked}, error), b""
    store.write(f"objects/{ready.sha256}.parquet", ready.file)
    return Report(thing.key), ready.shared


def run_block(block: Block, hand: bytes, shared: bytes, store: DatasetStore, limits: Limits) -> Report:
    """Make a block and keep it."""
    from graspd_core.dataset import block_rows

    try:
        made: MadeBlock = call_guarded(limits, block_rows.make_block, block, hand, shared)
    except Exception as error:
        return failed_report(
            store, block.key, {"object": block.object.source, "hand": block.hand, **block.asked}, error
        )
    store.write(block_path(block.hand_name, made.object_sha256, block.key), made.file)
    return Report(
        block.key,
        rows=made.rows,
        verified=made.verified,
        failures=made.failures,
        size=len(made.file),
        cpu=made.cpu,
        peak_mb=made.peak_mb,
    )


def failed_report(store: DatasetStore, key: str, asked: dict[str, Any], error: BaseException) -> Report:
    """Write down what failed."""
    from graspd_core.bench.result_store import failure

    record = failure(error, _KINDS.get(type(error), "raised"))
    store.write(f"failed/{key}.json", (json.dumps({"key": key, "asked": asked, **record}, indent=1) + "\n").encode())
    return Report(key, failed=record["failed"], error=record["error"])


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
