"""`graspd bench --suite stress`: what breaks methods, case by case, and what came of it."""

from __future__ import annotations

import argparse
import sys

from graspd_core.cli.running import EXIT_INTERRUPTED, EXIT_OK, Interrupt
from graspd_core.errors import ConfigError

EXIT_FAULTS = 1


def run(options: argparse.Namespace) -> int:
    """Returns the exit status: 0, 1 where an ending was wrong, 130 after Ctrl-C; endings are kept either way."""
    from graspd_core.bench.measurements.measurement import code_version
    from graspd_core.bench.stress.run_stress_case import faults
    from graspd_core.bench.stress.stress_suite import EndingStore, cases_of, run_cases
    from graspd_core.bench.stress.stress_table import stress_table, summary
    from graspd_core.bench.tables import fill
    from graspd_core.methods.plan_config import load_preset

    if len(options.presets) > 1:
        raise ConfigError(f"presets: {', '.join(options.presets)}; the stress suite takes one at a time")
    preset = (options.presets or ["balanced"])[0]
    load_preset(preset)
    cases = cases_of(options.cases)
    store = EndingStore(options.out, preset, code_version("stress"), any_code=options.any_code or options.no_run)
    kept = {case: found for case in cases if (found := store.read(case)) is not None}
    endings = {case: ending for case, (ending, _) in kept.items()}
    codes = {code for _, code in kept.values()}
    todo = [] if options.no_run else [case for case in cases if case not in endings]
    with Interrupt() as interrupt:
        for case, ending in run_cases(todo, store, options.processes, interrupt.came):
            endings[case] = ending
            codes.add(store.code)
            wrong = "".join(f"\n  {fault}" for fault in faults(case, ending))
            took = f"{ending.loading + ending.planning:.1f} s"
            print(f"graspd: {len(endings)}/{len(cases)} {case.name}: {ending.ending}, {took}{wrong}", file=sys.stderr)
    if interrupt.came():
        print(f"graspd: interrupted; {len(endings)} of {len(cases)} cases are kept in {options.out}", file=sys.stderr)
        return EXIT_INTERRUPTED
    found = {case: endings[case] for case in cases if case in endings}
    came, table = f"{summary(found)}\n\nPreset `{preset}`; code {', '.join(sorted(codes))}.", stress_table(found)
    for document in options.readme:
        fill(document, {"stress-summary": came, "stress": table})
    print(f"{came}\n\n{table}")
    return EXIT_FAULTS if any(faults(case, ending) for case, ending in found.items()) else EXIT_OK
