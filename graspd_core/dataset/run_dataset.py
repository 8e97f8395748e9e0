"""The blocks that are missing, a bounded number at a time: objects made ready ahead, nothing done twice."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from graspd_core.dataset.blocks import Block, DatasetObject, by_object
from graspd_core.dataset.dataset_store import DatasetStore, keys_below
from graspd_core.dataset.guarded_calls import Report
from graspd_core.dataset.ray_engine import RayEngine

# How often a stop is looked for [s].
_POLL = 0.5
# Blocks submitted for every one that runs: the next is there when one ends, and a stop drops few.
_AHEAD = 2


def missing_blocks(blocks: Sequence[Block], store: DatasetStore, *, retry_failed: bool = False) -> list[Block]:
    """The blocks whose file is not there, by listing; those that failed, or whose object did, only where asked for."""
    there = keys_below(store, "grasps")
    failed = set() if retry_failed else keys_below(store, "failed")
    return [b for b in blocks if b.key not in there and not failed & {b.key, b.object.key}]


def run_blocks(
    blocks: Sequence[Block], engine: RayEngine, stop: Callable[[], bool] = lambda: False
) -> Iterator[tuple[Block | DatasetObject, Report]]:
    """Run blocks and yield each with its report as it ends; objects that fail too, their blocks are dropped then.

    Raises:
        StorageError: a file could not be written; what was written before stays.
    """
    waiting = deque(by_object(blocks))
    preparing: dict[Any, tuple[DatasetObject, list[Block], Any]] = {}
    ready: deque[tuple[Block, Any]] = deque()
    running: dict[Any, Block] = {}
    while (waiting or preparing or ready or running) and not stop():
        slots = engine.slots()
        while waiting and len(preparing) < slots and len(preparing) + len(ready) < _AHEAD * slots:
            thing, own = waiting.popleft()
            handle, shared = engine.submit_object(thing, own[0].config)
            preparing[handle] = thing, own, shared
        while ready and len(running) < _AHEAD * slots:
            block, shared = ready.popleft()
            running[engine.submit_block(block, shared)] = block
        for handle in engine.wait([*preparing, *running], _POLL):
            if handle in running:
                block = running.pop(handle)
                yield block, engine.report(handle, block.key)
                continue
            thing, own, shared = preparing.pop(handle)
            report = engine.report(handle, thing.key)
            if report.failed:
                yield thing, report
            else:
                ready.extend((block, shared) for block in own)
