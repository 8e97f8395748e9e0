"""Make the blocks that a data set lacks. Each object is prepared once, before its blocks.

This module also makes the run record (command, cost, files) and the data card, a README.md about the data set.
"""

from __future__ import annotations

import json
import os
import platform
import shlex
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import date
from typing import Any

from graspd_core.errors import ConfigError
from graspd_dataset.blocks import Block, DatasetObject, DatasetRequest, by_object, content_key
from graspd_dataset.dataset_store import FORMAT, SCHEMA_VERSION, DatasetStore, file_hash, keys_below, read_record
from graspd_dataset.guarded_calls import Report
from graspd_dataset.inspect_dataset import DatasetStats, reason_lines, recorded_hashes, stats_table
from graspd_dataset.ray_engine import RayEngine
from graspd_dataset.run_records import code_version, commit


@dataclass(frozen=True)
class RunRecord:
    """Run record: one command, and its work in all sessions. A resumed run is a new session.

    Attributes:
        command: the command line, ready to be typed again.
        code, commit: version of the code that ran, and its git commit.
        made: date of the first session.
        machine: number of cores, architecture and Python version.
        blocks: number of requested blocks.
        done: number of blocks written.
        cpu: CPU time of the processes that make blocks [s].
        wall: duration of all sessions [s].
        peak_mb: greatest peak memory of a process that makes blocks [MB].
        files: path and SHA-256 of each written file.
    """

    command: str
    code: str
    commit: str
    made: str
    machine: str
    blocks: int
    done: int = 0
    cpu: float = 0.0
    wall: float = 0.0
    peak_mb: float = 0.0
    files: dict[str, str] = field(default_factory=dict)

    @property
    def path(self) -> str:
        return f"runs/{content_key([self.command, self.code])}.json"


def command_of(request: DatasetRequest, out: str) -> str:
    """Return the command line of a request, without options that have the default value."""
    usual, words = DatasetRequest(request.objects), ["graspd", "dataset", *request.objects]
    for item in fields(request):
        value = getattr(request, item.name)
        if item.name == "objects" or value == getattr(usual, item.name):
            continue
        several = value if isinstance(value, tuple) else (value,)
        words += [f"--{item.name.replace('_', '-')}", *map(_word, several)]
    return shlex.join([*words, "--out", out])


def _word(value: Any) -> str:
    """Return a value as a word of a command line. Numbers are shortened without loss."""
    short = f"{value:g}" if isinstance(value, float) else str(value)
    return short if not isinstance(value, float) or float(short) == value else repr(value)


def begin_run(store: DatasetStore, request: DatasetRequest, blocks: int, *, any_code: bool = False) -> RunRecord:
    """Return the run record of this command: the stored record if there is one, otherwise a new one.

    Raises ConfigError: another code version made the data set, and `any_code` is false.
    """
    code = code_version()
    records = run_records(store)
    others = sorted({record.code for record in records} - {code})
    if others and not any_code:
        told = f"made by code version {others[0]}, but this is version {code}"
        raise ConfigError(f"{store.label}: {told}; give --any-code to add anyway")
    machine = f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}"
    new = RunRecord(command_of(request, store.label), code, commit(), date.today().isoformat(), machine, blocks)
    return next((replace(record, blocks=blocks) for record in records if record.path == new.path), new)


def write_run(store: DatasetStore, record: RunRecord) -> None:
    content = {"format": FORMAT, "version": SCHEMA_VERSION, **asdict(record)}
    store.write(record.path, (json.dumps(content, indent=1) + "\n").encode())


def run_records(store: DatasetStore) -> list[RunRecord]:
    """Read the records of all commands that wrote to a data set."""
    names = {item.name for item in fields(RunRecord)}
    records = [read_record(store, path) for path in store.list("runs")]
    return [RunRecord(**{key: value for key, value in record.items() if key in names}) for record in records]


def with_unrecorded(store: DatasetStore, record: RunRecord) -> RunRecord:
    """Return the record plus hashes of unrecorded files. Killed sessions and earlier code leave such files."""
    known = recorded_hashes(store).keys() | record.files.keys()
    paths = [path for folder in ("grasps", "objects") for path in store.list(folder) if path not in known]
    return replace(record, files=record.files | {path: file_hash(store.read(path)) for path in paths})


def data_card(store: DatasetStore, stats: DatasetStats) -> str:
    """Return the text of the data card (README.md): content, commands, cost and licence."""
    records = run_records(store)
    own = all(word.startswith("shape:") for record in records for word in _objects(record.command))
    cpu, done = sum(r.cpu for r in records), sum(r.done for r in records)
    front = {"license": "apache-2.0" if own else "other", "tags": ["robotics", "grasping"]}
    lines = [
        "---",
        *(f"{key}: {json.dumps(value)}" for key, value in front.items()),
        "configs:",
        "- {config_name: grasps, data_files: 'grasps/*/*/*.parquet', default: true}",
        "- {config_name: objects, data_files: 'objects/*.parquet'}",
        "---",
        "",
        "# Grasps by graspd",
        "",
        f"{stats.rows} grasps that were tried in MuJoCo, {stats.size / 2**20:.1f} MB. A row is a candidate, verified",
        "or failed: three postures, contacts, metrics, results of every trial, the verdict and its reason.",
        f"The columns are described in graspd's docs/tables/dataset.md (schema version {SCHEMA_VERSION}).",
        "",
        stats_table(stats),
        "",
        "Why grasps failed:",
        "",
        *(f"- {line}" for line in reason_lines(stats)),
        "",
        "## How it was made",
        "",
        *(f"    {record.command}\n" for record in records),
        *(f"- {r.made}, code version {r.code}, commit {r.commit or 'unknown'}; {r.machine}" for r in records),
        f"- {done} blocks in {cpu / 3600:.2f} CPU hours; at most {max((r.peak_mb for r in records), default=0):.0f} MB "
        "a process",
        "",
        "## What it is not",
        "",
        "No grasp was tried on a robot. Verified means that the grasp held in simulation, with the mass and friction",
        "of its row.",
        "",
        "## Licence",
        "",
        _LICENCE[own],
        "",
    ]
    return "\n".join(lines)


_LICENCE = {
    True: "Apache-2.0. The objects are shapes of graspd.",
    False: "Grasps and shapes of graspd: Apache-2.0. Other meshes in `objects/`: the licences of their owners.",
}


def _objects(command: str) -> list[Any]:
    words = shlex.split(command)[2:]
    return words[: next(i for i, word in enumerate(words) if word.startswith("--"))]


# Interval at which a run checks whether to stop [s].
_POLL = 0.5
# Submitted blocks per task that can run at a time. So no worker waits for work, and a stop drops few blocks.
_AHEAD = 2


def missing_blocks(blocks: Sequence[Block], store: DatasetStore, *, retry_failed: bool = False) -> list[Block]:
    """Return the blocks without a file. Skip failed blocks and blocks of failed objects, unless `retry_failed`."""
    there = keys_below(store, "grasps")
    failed = set() if retry_failed else keys_below(store, "failed")
    return [b for b in blocks if b.key not in there and not failed & {b.key, b.object.key}]


def remove_failure(store: DatasetStore, report: Report, failed: Collection[str]) -> None:
    """Remove the record of an earlier failure if the object or block has succeeded. `failed`: all keys on record."""
    if report.key in failed and not report.failed:
        store.remove(f"failed/{report.key}.json")


def run_blocks(
    blocks: Sequence[Block], engine: RayEngine, stop: Callable[[], bool] = lambda: False
) -> Iterator[tuple[Block | DatasetObject, Report]]:
    """Prepare objects and make their blocks. Yield each object or block with its report when the task ends.

    The blocks of a failed object are skipped. The run ends when `stop` returns True.
    Raises StorageError: a file could not be written. Files that were written earlier remain.
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
            yield thing, report
            if not report.failed:
                ready.extend((block, shared) for block in own)
