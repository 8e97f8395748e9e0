"""Runs of missing blocks, a bounded number at a time: objects prepared ahead, nothing done twice.

Beside the data lie the record of the command, its cost, and the data card made of it.
"""

from __future__ import annotations

import json
import os
import platform
import shlex
from collections import deque
from collections.abc import Callable, Iterator, Sequence
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
    """One command over all its sessions.

    Attributes:
        command: that can be typed again.
        code, commit: that ran.
        made: days.
        machine: cores, kind and Python.
        blocks: that it asks for.
        done: blocks written.
        cpu: seconds in the processes of blocks.
        wall: seconds.
        peak_mb: greatest peak of a process of blocks.
        files: hashes of the files written, by path.
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
    """Return the command for a request, in as few words as possible."""
    usual, words = DatasetRequest(request.objects), ["graspd", "dataset", *request.objects]
    for item in fields(request):
        value = getattr(request, item.name)
        if item.name == "objects" or value == getattr(usual, item.name):
            continue
        several = value if isinstance(value, tuple) else (value,)
        words += [f"--{item.name.replace('_', '-')}", *(f"{v:g}" if isinstance(v, float) else str(v) for v in several)]
    return shlex.join([*words, "--out", out])


def begin_run(store: DatasetStore, request: DatasetRequest, blocks: int, *, any_code: bool = False) -> RunRecord:
    """Return the record of this command, as earlier sessions left it.

    Raises ConfigError: other code made the present content, and that is not wanted.
    """
    code = code_version()
    records = run_records(store)
    others = sorted({record.code for record in records} - {code})
    if others and not any_code:
        raise ConfigError(
            f"{store.shown}: made by code {others[0]}, this is {code}; --any-code adds to it all the same"
        )
    machine = f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}"
    new = RunRecord(command_of(request, store.shown), code, commit(), date.today().isoformat(), machine, blocks)
    return next((replace(record, blocks=blocks) for record in records if record.path == new.path), new)


def write_run(store: DatasetStore, record: RunRecord) -> None:
    told = {"format": FORMAT, "version": SCHEMA_VERSION, **asdict(record)}
    store.write(record.path, (json.dumps(told, indent=1) + "\n").encode())


def run_records(store: DatasetStore) -> list[RunRecord]:
    """Read the records of a data set."""
    names = {item.name for item in fields(RunRecord)}
    told = [read_record(store, path) for path in store.list("runs")]
    return [RunRecord(**{key: value for key, value in record.items() if key in names}) for record in told]


def with_unrecorded(store: DatasetStore, record: RunRecord) -> RunRecord:
    """Return the record with hashes of files that no record holds, as of a killed session or of earlier code."""
    known = recorded_hashes(store).keys() | record.files.keys()
    paths = [path for folder in ("grasps", "objects") for path in store.list(folder) if path not in known]
    return replace(record, files=record.files | {path: file_hash(store.read(path)) for path in paths})


def data_card(store: DatasetStore, stats: DatasetStats) -> str:
    """Return the README.md of a data set: its content, its making, its licence."""
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
        f"{stats.rows} grasps that were tried in MuJoCo, {stats.size / 2**20:.1f} MB. A row is a candidate, failed",
        "ones included: three postures, contacts, metrics, every trial's figures, the verdict and its reason.",
        f"The columns are described in graspd's docs/dataset.md (schema version {SCHEMA_VERSION}).",
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
        *(f"- {r.made}, code {r.code}, commit {r.commit or 'unknown'}; {r.machine}" for r in records),
        f"- {done} blocks in {cpu / 3600:.2f} CPU hours; at most {max((r.peak_mb for r in records), default=0):.0f} MB "
        "a process",
        "",
        "## What it is not",
        "",
        "No grasp was tried on a robot. Verified means that it held in simulation, with the mass and friction of",
        "its row.",
        "",
        "## Licence",
        "",
        _LICENCE[own],
        "",
    ]
    return "\n".join(lines)


_LICENCE = {
    True: "Apache-2.0; the objects are shapes of graspd.",
    False: "The grasps: Apache-2.0. Meshes in `objects/` that are not shapes of graspd: as their owners say.",
}


def _objects(command: str) -> list[Any]:
    words = shlex.split(command)[2:]
    return words[: next(i for i, word in enumerate(words) if word.startswith("--"))]


# How often a stop is looked for [s].
_POLL = 0.5
# Blocks submitted for every one that runs: the next is there when one ends, and a stop drops few.
_AHEAD = 2


def missing_blocks(blocks: Sequence[Block], store: DatasetStore, *, retry_failed: bool = False) -> list[Block]:
    """Return the blocks without a file. Failed blocks, or blocks of failed objects, are included on request."""
    there = keys_below(store, "grasps")
    failed = set() if retry_failed else keys_below(store, "failed")
    return [b for b in blocks if b.key not in there and not failed & {b.key, b.object.key}]


def run_blocks(
    blocks: Sequence[Block], engine: RayEngine, stop: Callable[[], bool] = lambda: False
) -> Iterator[tuple[Block | DatasetObject, Report]]:
    """Run blocks and yield each with its report as it ends. Objects too: a failed one drops its blocks.

    Raises StorageError: a file could not be written. Earlier files stay.
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
