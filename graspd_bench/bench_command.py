"""The command `graspd bench`: run or resume studies, and write their results, tables, charts and pages."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graspd_core.cli.options import add_plugin_option
from graspd_core.cli.output import answer, bar, busy, print_error, print_note
from graspd_core.cli.running import EXIT_INTERRUPTED, EXIT_OK, Interrupt
from graspd_core.errors import ConfigError

if TYPE_CHECKING:
    from graspd_bench.run_studies import Plan


EXIT_FAULTS = 1


def add_command(commands: Any) -> None:
    """Add `bench` to the commands of the parser."""
    parser = commands.add_parser("bench")
    parser.set_defaults(run=run)
    parser.add_argument("studies", nargs="*", metavar="STUDY", help="main (default), all, or a name of docs/bench.md")
    parser.add_argument("--suite", action="append", default=[], metavar="STUDY", help="another way to give STUDY")
    several: dict[str, Any] = {"nargs": "+", "default": ()}
    parser.add_argument("--presets", **several, metavar="PRESET", help="default: all built-in presets")
    add_plugin_option(parser)
    parser.add_argument(
        "--objects", **several, metavar="OBJECT", help="shape:NAME, meshes in metres or folders; default: all shapes"
    )
    cases = "cases to run. stress: names or families, maps: names, cell: sizes or ARM+HAND"
    parser.add_argument("--cases", **several, metavar="CASE", help=cases)
    parser.add_argument("--seeds", **several, type=int, metavar="N", help="default: by study")
    parser.add_argument("--count", type=int, default=None, help="grasps of a case (default: by study and method)")
    parser.add_argument("--hand", default="", metavar="NAME|PATH", help="default: allegro_right")
    parser.add_argument("--trials", default="", metavar="A,B", help="trials of raw grasps (listed in docs/bench.md)")
    parser.add_argument("--import", dest="imported", default="", metavar="PATH", help="grasps to compare with graspd's")
    parser.add_argument("--joint-order", default="", metavar="A,B,…", help="joint names of imported npy files")
    parser.add_argument("--python", default="", metavar="PATH", help="Python that runs the checkout of dexgraspbench")
    parser.add_argument("--armature", action="store_true", help="dexgraspbench: also try its hand with our armature")
    parser.add_argument("--grasps", default="", metavar="FILE", help="dexgraspbench: our grasps (default: plan)")
    parser.add_argument("--quick", action="store_true", help="run few objects and grasps, which takes minutes")
    parser.add_argument("--out", type=Path, default=Path("results/bench"), metavar="DIR", help="folder of records")
    parser.add_argument("--processes", type=int, default=1, help="cases at a time, each on one thread (default 1)")
    parser.add_argument("--any-code", action="store_true", help="keep finished cases of other versions of the code")
    parser.add_argument("--no-run", action="store_true", help="only report on the finished cases")
    parser.add_argument("--compare", type=Path, default=None, metavar="OLD.json", help="list changes since OLD")
    parser.add_argument("--chart", type=Path, default=None, metavar="PATH", help="PATH.png, PATH.svg, …")
    parser.add_argument(
        "--readme", type=Path, action="append", default=[], metavar="FILE", help="fill marked sections (repeatable)"
    )


def run(options: argparse.Namespace) -> int:
    """Run the command. Store finished cases. Return the exit status: 0, 1 if a case has faults, 130 after Ctrl-C."""
    from graspd_bench.result_store import read_results, results_document, write_results
    from graspd_bench.run_studies import faults_of, make_plan, records_of, run_plan, studies_of
    from graspd_bench.study import Request
    from graspd_core.io.grasps_json import check_writable

    if options.processes < 1:
        raise ConfigError(f"processes: {options.processes}; valid: 1 or more")
    words = list(options.studies)
    # The word after `dexgraspbench` is the folder of its checkout, not a study.
    after = words.index("dexgraspbench") + 1 if "dexgraspbench" in words else len(words)
    checkout = "".join(words[after : after + 1])
    del words[after : after + 1]
    several = {name: tuple(getattr(options, name)) for name in ("presets", "objects", "cases", "seeds")}
    listed = {name: tuple(filter(None, getattr(options, name).split(","))) for name in ("trials", "joint_order")}
    names = ("count", "hand", "quick", "imported", "python", "armature", "grasps")
    request = Request(**several, **listed, **{name: getattr(options, name) for name in names}, checkout=checkout)
    studies = studies_of([*words, *options.suite] or ["imported" if options.imported else "main"])
    old_code = options.any_code or options.no_run
    plan = make_plan(studies, request, options.out, any_code=old_code, failed=options.no_run)
    old = read_results(options.compare) if options.compare else None
    for path in (options.out / "results.json", options.chart):
        if path:
            check_writable(path)
    with Interrupt() as interrupt, Lines(plan, 0 if options.no_run else options.processes) as lines:
        for job, record in run_plan(plan, options.processes, interrupt.is_interrupted) if not options.no_run else ():
            lines(job.study, record)
    if interrupt.is_interrupted():
        kept = f"{len(plan.done)} of {len(plan.jobs)} cases are finished; {options.out} keeps their results"
        print_error(f"interrupted; {kept}")
        return EXIT_INTERRUPTED
    every = [record for own in records_of(plan).values() for record in own]
    write_results(options.out / "results.json", every)
    answer(results_document(every))
    _report(options, plan)
    if old is not None:
        from graspd_bench.figures import comparison

        print(f"\n{comparison(old, every)}")
    faults = faults_of(plan)
    for line in faults:
        print_error(f"failed: {line}")
    return EXIT_FAULTS if faults else EXIT_OK


def _report(options: argparse.Namespace, plan: Plan) -> None:
    from graspd_bench.run_studies import report_of
    from graspd_bench.tables import fill, written

    with busy("report"):
        sections = report_of(plan, options.chart)
    # The tables of single objects are long, and the section `bench` repeats a part of `bench-all`.
    tables = [written(parts) for name, parts in sections.items() if name not in ("bench-objects", "bench")]
    print("\n\n".join(filter(None, tables)))
    wrong = []
    for document in options.readme:
        try:
            fill(document, sections)
        except ConfigError as error:
            wrong.append(error)
    # Every document is filled before the first error is raised.
    if wrong:
        raise wrong[0]


class Lines:
    """Progress display: a bar on a terminal, otherwise a line per case. It begins with an estimate of the time."""

    def __init__(self, plan: Plan, processes: int) -> None:
        self.plan, self.processes = plan, processes

    def __enter__(self) -> Lines:
        total, done = len(self.plan.jobs), len(self.plan.done)
        if done:
            print_note(f"{done} of {total} cases had finished in earlier runs")
        if self.plan.missing and self.processes:
            minutes = self.plan.seconds(self.processes) / 60
            cost = f"{len(self.plan.missing)} cases, about {minutes:.0f} minutes on {self.processes} idle cores"
            print_note(cost)
        self._bar = bar("cases", total, done)
        return self

    def __call__(self, study: str, record: dict[str, Any]) -> None:
        from graspd_bench.study_registry import STUDIES

        summary = "; ".join(STUDIES[study].faults(record)) or STUDIES[study].summary(record)
        if self._bar is not None:
            self._bar.set_postfix_str(f"{study} {record['label']}: {summary}")
            self._bar.update()
        else:
            took = f"{record.get('case_cpu', 0.0):.1f} CPU s"
            where = f"{len(self.plan.done)}/{len(self.plan.jobs)} {study} {record['label']}"
            print_note(f"{where}: {summary}, {took}")

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
