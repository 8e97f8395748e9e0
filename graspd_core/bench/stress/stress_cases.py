"""Every stress case by its name, and what the benchmark runs of them."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from graspd_core.bench import study
from graspd_core.bench.stress.broken_clouds import cloud_cases
from graspd_core.bench.stress.broken_meshes import mesh_cases
from graspd_core.bench.stress.extremes import extreme_cases
from graspd_core.bench.stress.run_stress_case import StressEnding, faults, run_case
from graspd_core.bench.stress.stress_case import Case
from graspd_core.bench.study import Record, Request
from graspd_core.errors import ConfigError

CASES: dict[str, Case] = {case.name: case for case in (*mesh_cases(), *cloud_cases(), *extreme_cases())}
# Beyond loading and planning, before a process is called hung [s].
_PATIENCE = 60.0
# Of a small run: a family of those that take a second each.
_QUICK = ("hand", "nan-vertices", "empty")


@dataclass(frozen=True)
class StressRun(study.Case):
    """A stress case by its name, planned with a preset."""

    name: str
    preset: str


def stress_runs(request: Request) -> tuple[StressRun, ...]:
    """Cases by their names or families, all of them for no name. Raises ConfigError: there is no such case."""
    families = sorted({case.family for case in CASES.values()})
    names = request.cases or (_QUICK if request.quick else ())
    if unknown := [name for name in names if name not in CASES and name not in families]:
        raise ConfigError(f"unknown case {unknown[0]!r}; valid: {', '.join(families)}, {', '.join(sorted(CASES))}")
    chosen = [case.name for case in CASES.values() if not names or case.name in names or case.family in names]
    return tuple(StressRun(name, request.preset()) for name in chosen)


def run_stress(run: StressRun) -> Record:
    """What a case ends in."""
    return asdict(run_case(CASES[run.name], run.preset))


def stress_patience(run: StressRun) -> float:
    """Seconds until a case is called hung. It is loaded twice: for the second trial, too."""
    case = CASES[run.name]
    return 2 * case.loading + case.deadline + _PATIENCE


def ending_of(record: Record) -> StressEnding:
    """The ending that a record tells of; where its process failed, a crash or a hang."""
    if record["error"]:
        return StressEnding(record["name"], "hang" if record["failed"] == "hung" else "crash", record["error"])
    return StressEnding(**{name: record[name] for name in StressEnding.__dataclass_fields__})


def stress_faults(record: Record) -> tuple[str, ...]:
    """What is wrong with the ending that a record tells of."""
    return faults(CASES[record["name"]], ending_of(record))


def stress_came(record: Record) -> str:
    """The ending and its seconds."""
    ending = ending_of(record)
    return f"{ending.ending}, {ending.loading + ending.planning:.1f} s"
