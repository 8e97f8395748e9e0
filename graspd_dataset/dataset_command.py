"""The command `graspd dataset`: make a data set of grasps on Ray, or inspect one. A stopped run can be resumed."""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graspd_core.cli.options import add_plugin_option
from graspd_core.cli.output import answer, bar, busy, print_error, print_note
from graspd_core.cli.running import EXIT_INTERRUPTED, EXIT_OK, Interrupt
from graspd_core.errors import ConfigError

if TYPE_CHECKING:
    from graspd_dataset.blocks import Block, DatasetRequest
    from graspd_dataset.dataset_store import DatasetStore
    from graspd_dataset.guarded_calls import Limits, Report
    from graspd_dataset.run_dataset import RunRecord


EXIT_FAULTS = 1
# Seconds between two lines of progress, and between two writes of the run record.
_LINES, _RECORDS = 10.0, 30.0


def add_command(commands: Any) -> None:
    """Add this command to the parser."""
    parser = commands.add_parser("dataset")
    parser.set_defaults(run=run)
    parser.add_argument(
        "words",
        nargs="+",
        metavar="OBJECT",
        help="objects: shape:NAME, meshes in metres (otherwise give --scales), folders. "
        "Or an action (stats, validate, merge, sample, export) and its data sets",
    )
    parser.add_argument("--out", default="", metavar="DIR|s3://…", help="data set to write. sample: a .parquet file")
    make = parser.add_argument_group("making a data set")
    make.add_argument("--hands", nargs="+", default=("allegro_right",), metavar="NAME|PATH")
    make.add_argument("--per-object", type=int, default=128, metavar="N", help="grasps per object, scale and hand")
    make.add_argument("--block", type=int, default=128, metavar="N", help="verified grasps per file (default 128)")
    add_plugin_option(make)
    make.add_argument("--preset", default="balanced")
    make.add_argument("--seed", type=int, default=0)
    make.add_argument("--scales", nargs="+", type=float, default=(1.0,), metavar="FACTOR", help="default 1")
    make.add_argument("--random-scales", nargs=3, type=float, default=(0, 1, 1), metavar=("N", "LOW", "HIGH"))
    make.add_argument("--mass", type=float, default=None, metavar="KG", help="default: a heavy object's mass")
    make.add_argument("--friction", type=float, default=0.6, metavar="MU", help="default 0.6")
    make.add_argument("--verify", default="standard", metavar="TRIALS")
    make.add_argument("--measure", default="verified", metavar="WHICH", help="verified (default), all, or none")
    make.add_argument("--dry-run", action="store_true", help="make one block per hand and estimate hours and bytes")
    ray = parser.add_argument_group("where to run")
    ray.add_argument("--address", default=None, metavar="ray://…", help="a Ray cluster (default: this machine)")
    ray.add_argument("--workers", type=int, default=None, metavar="N", help="on this machine (default: all cores)")
    ray.add_argument("--ray-dir", type=Path, default=None, metavar="DIR", help="folder of Ray's files (default: /tmp)")
    ray.add_argument("--patience", type=float, default=1800.0, metavar="SEC", help="time limit of a block")
    ray.add_argument("--memory", type=float, default=4096.0, metavar="MB", help="memory limit of a block")
    ray.add_argument("--retry-failed", action="store_true", help="repeat failed blocks and objects")
    ray.add_argument("--any-code", action="store_true", help="add to a data set of another code version")
    parser.add_argument("--count", type=int, default=1000, metavar="N", help="sample: number of rows")
    parser.add_argument("--to", default="isaac", metavar="FORMAT", help="export: isaac, graspgen or dexgraspbench")
    parser.add_argument("--verdict", choices=("verified", "failed", "unverified"), default=None, help="sample: verdict")


def run(options: argparse.Namespace) -> int:
    """Run the command. Return the exit status: 0, 1 if blocks failed or `validate` found faults, 130 if stopped."""
    from graspd_dataset.dataset_store import DatasetStore

    action, places = options.words[0], options.words[1:]
    if action not in _ACTIONS:
        return _make(options)
    if not places or (action not in ("merge",) and len(places) > 1):
        valid = "one or more" if action == "merge" else "exactly one"
        raise ConfigError(f"dataset {action}: {len(places)} data sets; valid: {valid}")
    return _ACTIONS[action](options, [DatasetStore(place) for place in places])


def _make(options: argparse.Namespace) -> int:
    from graspd_dataset.blocks import blocks_of
    from graspd_dataset.dataset_store import DatasetStore
    from graspd_dataset.guarded_calls import Limits
    from graspd_dataset.run_dataset import begin_run, missing_blocks, with_unrecorded, write_run

    if not options.out:
        raise ConfigError("--out is missing; give a directory or s3://bucket/path")
    if options.workers is not None and options.workers < 1:
        raise ConfigError(f"workers: {options.workers}; valid: 1 or more")
    request, store = _request(options), DatasetStore(options.out)
    limits = Limits(options.patience, options.memory)
    blocks = blocks_of(request)
    missing = missing_blocks(blocks, store, retry_failed=options.retry_failed)
    there = f"{len(blocks) - len(missing)} of {len(blocks)} blocks are skipped: each has a file or a failure on record"
    print_note(there)
    if options.dry_run:
        from graspd_dataset.block_rows import dry_run

        text = dry_run(missing, limits, options.workers)
        print(text)
        answer({"blocks": len(missing), "estimate": text})
        return EXIT_OK
    record = begin_run(store, request, len(blocks), any_code=options.any_code)
    with Interrupt() as interrupt:
        lines, record = (
            _run_missing(options, store, limits, missing, record, interrupt) if missing else (Lines(0), record)
        )
    write_run(store, with_unrecorded(store, record))
    _finish(store)
    if interrupt.is_interrupted():
        print_error(f"interrupted; {store.label} keeps finished blocks; repeat the command to continue")
        return EXIT_INTERRUPTED
    return EXIT_FAULTS if lines.wrong else EXIT_OK


def _run_missing(
    options: argparse.Namespace,
    store: DatasetStore,
    limits: Limits,
    missing: list[Block],
    record: RunRecord,
    interrupt: Interrupt,
) -> tuple[Lines, RunRecord]:
    """Make the missing blocks. Write the run record every 30 s. Return the progress display and the updated record."""
    from graspd_dataset.dataset_store import keys_below
    from graspd_dataset.ray_engine import RayEngine, ray_running
    from graspd_dataset.run_dataset import remove_failure, run_blocks, write_run

    failed = keys_below(store, "failed")
    lines, began, written = Lines(len(missing)), time.monotonic(), 0.0
    with ray_running(options.address, options.workers, options.ray_dir) as ray, lines:
        engine = RayEngine(ray, store, limits, ship=options.address is not None)
        for what, report in run_blocks(missing, engine, interrupt.is_interrupted):
            lines(what, report)
            remove_failure(store, report, failed)
            if time.monotonic() > written + _RECORDS:
                write_run(store, lines.added_to(record, time.monotonic() - began))
                written = time.monotonic()
    return lines, lines.added_to(record, time.monotonic() - began)


def _finish(store: DatasetStore) -> None:
    """Write the data card (README.md of the data set), and print the counts. If there are no blocks, do nothing."""
    from graspd_dataset.inspect_dataset import stats_of, stats_table
    from graspd_dataset.run_dataset import data_card

    if not store.list("grasps"):
        return
    with busy("count"):
        stats = stats_of(store)
    store.write("README.md", data_card(store, stats).encode())
    print(stats_table(stats))
    answer({"dataset": store.label, **vars(stats)})


def _request(options: argparse.Namespace) -> DatasetRequest:
    from graspd_dataset.blocks import DatasetRequest

    number, low, high = options.random_scales
    if not float(number).is_integer():
        raise ConfigError(f"random-scales: {number:g} {low:g} {high:g}; valid: N >= 0 and 0 < LOW <= HIGH")
    names = ("per_object", "block", "preset", "seed", "mass", "friction", "verify", "measure")
    return DatasetRequest(
        objects=tuple(options.words),
        hands=tuple(options.hands),
        scales=tuple(options.scales),
        random_scales=(int(number), float(low), float(high)),
        **{name: getattr(options, name) for name in names},
    )


class Lines:
    """Display of progress: a bar on a terminal, otherwise a line every 10 s. Failures are printed immediately."""

    def __init__(self, blocks: int) -> None:
        self.wrong = 0
        self._blocks, self._done, self._rows, self._verified = blocks, 0, 0, 0
        self._cpu = self._peak = self._reported = 0.0
        self._failures: Counter[str] = Counter()
        self._files: dict[str, str] = {}
        self._began = time.monotonic()
        self._bar: Any = None

    def __enter__(self) -> Lines:
        self._bar = bar("blocks", self._blocks)
        return self

    def __call__(self, what: Any, report: Report) -> None:
        from graspd_dataset.blocks import DatasetObject

        self._files.update(report.files)
        if report.failed:
            self.wrong += 1
            name = getattr(what, "source", None) or f"{what.object.source} {what.hand} seed {what.seed}"
            print_error(f"{report.failed}: {name}: {report.error}")
        elif not isinstance(what, DatasetObject):
            self._done += 1
            self._rows, self._verified = self._rows + report.rows, self._verified + report.verified
            self._cpu, self._peak = self._cpu + report.cpu, max(self._peak, report.peak_mb)
            self._failures.update(report.failures)
        if self._bar is not None:
            self._bar.set_postfix_str(self._text())
            self._bar.update(self._done - self._bar.n)
        elif time.monotonic() > self._reported + _LINES:
            self._reported = time.monotonic()
            print_note(f"{self._done}/{self._blocks} blocks, {self._text()}")

    def _text(self) -> str:
        seconds = max(time.monotonic() - self._began, 1e-9)
        reasons = ", ".join(f"{number} {reason}" for reason, number in self._failures.most_common(2))
        text = f"{self._verified} of {self._rows} verified, {self._verified / seconds:.1f}/s"
        return f"{text}; {reasons}" if reasons else text

    def added_to(self, record: RunRecord, wall: float) -> RunRecord:
        """Return the run record plus the work of this session. `wall` is the session's duration [s]."""
        more = {"done": record.done + self._done, "cpu": record.cpu + self._cpu, "wall": record.wall + wall}
        return replace(record, **more, peak_mb=max(record.peak_mb, self._peak), files=record.files | self._files)

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
        elif self._done:
            print_note(f"{self._done}/{self._blocks} blocks, {self._text()}")


def _stats(options: argparse.Namespace, stores: list[DatasetStore]) -> int:
    from graspd_dataset.inspect_dataset import reason_lines, stats_of, stats_table

    with busy("count"):
        stats = stats_of(stores[0])
    print("\n".join([stats_table(stats), "", *reason_lines(stats)]))
    answer({"dataset": stores[0].label, **vars(stats)})
    return EXIT_OK


def _validate(options: argparse.Namespace, stores: list[DatasetStore]) -> int:
    from graspd_dataset.inspect_dataset import faults_of_dataset, recorded_hashes

    with busy("validate"):
        faults = list(faults_of_dataset(stores[0]))
    if not faults:
        paths, known = stores[0].list("grasps"), recorded_hashes(stores[0])
        without = sum(path not in known for path in paths)
        note = f"; {without} without a hash on record" if without else ""
        print(f"{stores[0].label}: {len(paths)} blocks, no fault{note}")
    print("\n".join(faults), end="\n" if faults else "")
    answer({"dataset": stores[0].label, "faults": faults})
    return EXIT_FAULTS if faults else EXIT_OK


def _merge(options: argparse.Namespace, stores: list[DatasetStore]) -> int:
    from graspd_dataset.dataset_store import DatasetStore
    from graspd_dataset.merge_datasets import merge

    if not options.out:
        raise ConfigError("--out is missing; give the directory of the merged data set")
    out = DatasetStore(options.out)
    with busy("merge"):
        copied, common = merge(stores, out)
    print(f"{out.label}: {copied} blocks copied, {common} were already there")
    _finish(out)
    return EXIT_OK


def _sample(options: argparse.Namespace, stores: list[DatasetStore]) -> int:
    from graspd_core.io.grasps_json import check_writable
    from graspd_core.runtime.disk_cache import save_bytes
    from graspd_dataset.merge_datasets import sample

    if not options.out.endswith(".parquet"):
        raise ConfigError(f"--out {options.out}; valid: a path that ends with .parquet")
    check_writable(Path(options.out))
    with busy("sample"):
        content, rows = sample(stores[0], options.count, options.seed, options.verdict)
    save_bytes(Path(options.out), content)
    print(f"{options.out}: {rows} rows")
    answer({"file": options.out, "rows": rows})
    return EXIT_OK


def _export(options: argparse.Namespace, stores: list[DatasetStore]) -> int:
    from graspd_dataset.export_grasps import export

    if not options.out:
        raise ConfigError("--out is missing; give the folder to write")
    with busy("export"):
        files, grasps = export(stores[0], options.to, Path(options.out))
    print(f"{options.out}: {grasps} grasps of {files} pairs of hand and object")
    answer({"folder": options.out, "grasps": grasps, "pairs": files})
    return EXIT_OK


_ACTIONS = {"stats": _stats, "validate": _validate, "merge": _merge, "sample": _sample, "export": _export}
