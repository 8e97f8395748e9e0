"""`graspd bench`: presets × objects × seeds, resumable, to figures, tables and charts."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from graspd_core.cli import stress_command as stress
from graspd_core.cli.running import EXIT_INTERRUPTED, EXIT_OK, Interrupt
from graspd_core.errors import ConfigError

EXIT_FAILED_CELLS = 1


def add_command(commands: Any) -> None:
    """Add this command to the parser's."""
    parser = commands.add_parser("bench", help="measure presets and methods on objects; tables and charts")
    parser.set_defaults(run=run)
    parser.add_argument(
        "--suite", action="append", default=None, metavar="NAME", help="main (default), ladder, hands; or stress"
    )
    parser.add_argument("--presets", nargs="+", default=(), metavar="PRESET", help="default: all built-in ones")
    parser.add_argument(
        "--objects", nargs="+", default=(), metavar="OBJECT", help="shape:NAME, meshes or folders; default: all shapes"
    )
    parser.add_argument(
        "--cases", nargs="+", default=(), metavar="CASE", help="of stress: names, families; default: all"
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=(0,), metavar="N")
    parser.add_argument("--count", type=int, default=None, help="grasps of a raw cell (default: by method)")
    parser.add_argument("--hand", default="allegro_right", metavar="NAME|PATH")
    parser.add_argument("--trials", default="", metavar="A,B", help="of raw grasps (docs/bench.md lists them)")
    parser.add_argument("--quick", action="store_true", help="few objects and grasps: minutes")
    parser.add_argument("--out", type=Path, default=Path("results/bench"), metavar="DIR", help="for finished cells")
    parser.add_argument("--processes", type=int, default=1, help="cells at a time, each on one thread (default 1)")
    parser.add_argument("--any-code", action="store_true", help="keep finished cells of other versions of the code")
    parser.add_argument("--no-run", action="store_true", help="only report on the finished cells")
    parser.add_argument("--compare", type=Path, default=None, metavar="OLD.json", help="what moved since that run")
    parser.add_argument("--chart", type=Path, default=None, metavar="PATH", help="PATH.png, PATH.svg, …")
    parser.add_argument(
        "--readme", type=Path, action="append", default=[], metavar="FILE", help="fill its marked sections (repeatable)"
    )


def run(options: argparse.Namespace) -> int:
    """Returns the exit status: 0, 1 where a cell raised, 130 after Ctrl-C; finished cells are kept either way."""
    from graspd_core.bench.benchmark_workers import run_cells
    from graspd_core.bench.measurements.measurement import code_version
    from graspd_core.bench.result_store import read_cells, read_results, write_results
    from graspd_core.bench.suites import SuiteRequest, cells_of
    from graspd_core.formats.grasps_json import check_writable

    if options.processes < 1:
        raise ConfigError(f"processes: {options.processes}; at least 1")
    if options.suite == ["stress"]:
        return stress.run(options)
    if options.cases or "stress" in (options.suite or ()):
        raise ConfigError("suite: stress is run by itself, and it alone has cases; valid: --suite stress [--cases …]")
    request = SuiteRequest(
        presets=tuple(options.presets),
        objects=tuple(options.objects),
        seeds=tuple(options.seeds),
        count=options.count,
        hand=options.hand,
        trials=tuple(name for name in options.trials.split(",") if name),
        quick=options.quick,
    )
    cells = cells_of(options.suite or ["main"], request)
    old = read_results(options.compare) if options.compare else None
    for path in (options.out / "results.json", options.chart):
        if path:
            check_writable(path)
    code = code_version()
    done = read_cells(options.out, cells, None if options.any_code or options.no_run else code)
    todo = [] if options.no_run else [cell for cell in cells if cell not in done]
    errors = []
    with Interrupt() as interrupt, Lines(len(cells), len(done)) as lines:
        for cell, record in run_cells(todo, options.out, code, options.processes, interrupt.came):
            done[cell] = record
            lines(record)
            if record["error"]:
                errors.append(f"{what(record)}: {record['error']}")
    if interrupt.came():
        print(f"graspd: interrupted; {len(done)} of {len(cells)} cells are kept in {options.out}", file=sys.stderr)
        return EXIT_INTERRUPTED
    records = [done[cell] for cell in cells if cell in done]
    write_results(options.out / "results.json", records)
    _report(options, records, old)
    for line in errors:
        print(f"graspd: failed: {line}", file=sys.stderr)
    return EXIT_FAILED_CELLS if errors else EXIT_OK


def _report(options: argparse.Namespace, records: list[dict[str, Any]], old: list[dict[str, Any]] | None) -> None:
    from graspd_core.bench import tables
    from graspd_core.bench.comparison import comparison

    charts: dict[str, Path] = {}
    if options.chart:
        from graspd_core.bench.charts.speed_chart import draw_charts

        charts = draw_charts(records, options.chart)
    for document in options.readme:
        tables.fill(document, tables.sections(records, charts, document))
    print("\n\n".join(filter(None, (tables.summary_table(records), tables.hands_table(records)))))
    if planned := tables.planned_table(records):
        print(f"\n{planned}")
    if old is not None:
        print(f"\n{comparison(old, records)}")


def what(record: dict[str, Any]) -> str:
    """A cell in words."""
    return f"{record['kind']} {record['name']} {record['object']} seed {record['seed']}"


class Lines:
    """Progress over cells: a bar on a terminal, elsewhere a line a cell."""

    def __init__(self, total: int, done: int) -> None:
        self.total, self.done = total, done

    def __enter__(self) -> Lines:
        self._bar: Any = None
        if sys.stderr.isatty():
            from tqdm import tqdm

            self._bar = tqdm(total=self.total, initial=self.done, desc="cells", file=sys.stderr)
        elif self.done:
            print(f"graspd: {self.done} of {self.total} cells had finished before", file=sys.stderr)
        return self

    def __call__(self, record: dict[str, Any]) -> None:
        self.done += 1
        came = record["error"] or (f"{record['held']}/{record['asked']} held" if "held" in record else "measured")
        if self._bar is not None:
            self._bar.set_postfix_str(f"{what(record)}: {came}")
            self._bar.update()
        else:
            took = f"{record.get('cell_cpu', 0.0):.1f} CPU s"
            print(f"graspd: {self.done}/{self.total} {what(record)}: {came}, {took}", file=sys.stderr, flush=True)

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
