"""Studies end to end: what is asked, what has finished before, the rest run, and what came of it onto pages."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from graspd_core.bench.report import sourced
from graspd_core.bench.result_store import code_version, read_record
from graspd_core.bench.run_cases import Job, run_cases
from graspd_core.bench.study import Picture, Record, Request, Study
from graspd_core.bench.study_registry import STUDIES
from graspd_core.errors import ConfigError

# Every study that needs nothing that is not shipped.
ALL = "all"


@dataclass(frozen=True)
class Plan:
    """All jobs of a command, and the records of those that have finished before."""

    folder: Path
    jobs: tuple[Job, ...]
    done: dict[Job, Record]

    @property
    def missing(self) -> tuple[Job, ...]:
        return tuple(job for job in self.jobs if job not in self.done)

    def seconds(self, processes: int) -> float:
        """Seconds that what is missing takes on quiet cores, roughly."""
        return sum(STUDIES[job.study].seconds(job.case) for job in self.missing) / processes


def studies_of(names: Sequence[str]) -> dict[str, Study]:
    """Studies by their names, each once, `all` being those that need nothing from the user.

    Raises:
        ConfigError: there is no such study; the message lists the valid ones.
    """
    if unknown := [name for name in names if name not in (*STUDIES, ALL)]:
        raise ConfigError(f"unknown suite {unknown[0]!r}; valid suites: {', '.join(STUDIES)}, {ALL}")
    usual = [name for name, study in STUDIES.items() if study.usual]
    return {name: STUDIES[name] for given in names for name in (usual if given == ALL else [given])}


def make_plan(
    studies: dict[str, Study], request: Request, folder: Path, *, any_code: bool = False, failed: bool = False
) -> Plan:
    """Plan the jobs of some studies.

    Args:
        any_code: records of other versions of the code count as finished, too.
        failed: so do those of cases that failed.

    Raises:
        GraspdError: the request names something unknown, or something that no study looks at.
    """
    taken = {field for study in studies.values() for field in study.takes}
    for field, usual in vars(Request()).items():
        if getattr(request, field) != usual and field not in taken:
            raise ConfigError(f"{field}: {', '.join(studies)} does not look at it; valid: {', '.join(sorted(taken))}")
    jobs, done = [], {}
    for name, study in studies.items():
        code = code_version(study.sources)
        for case in study.cases(request):
            jobs.append(Job(name, case, study.run, code, study.alone, study.patience(case)))
            record = read_record(folder, name, case, None if any_code else code, failed=failed)
            if record is not None:
                done[jobs[-1]] = record
    return Plan(folder, tuple(jobs), done)


def run_plan(plan: Plan, processes: int, stop: Callable[[], bool] = lambda: False) -> Iterator[tuple[Job, Record]]:
    """Run what is missing; yield each job as it ends, and add it to those that are done."""
    for job, record in run_cases(plan.missing, plan.folder, processes, stop):
        plan.done[job] = record
        yield job, record


def records_of(plan: Plan) -> dict[str, list[Record]]:
    """Records by study, in the order of the cases."""
    found: dict[str, list[Record]] = {job.study: [] for job in plan.jobs}
    for job in plan.jobs:
        if job in plan.done:
            found[job.study].append(plan.done[job])
    return found


def report_of(plan: Plan, chart: Path | None) -> dict[str, Sequence[str | Picture]]:
    """Sections of all studies that have records, by marker; charts are drawn where a path is given."""
    sections: dict[str, Sequence[str | Picture]] = {}
    for name, records in records_of(plan).items():
        study = STUDIES[name]
        shown = [record for record in records if study.failures or not record["error"]]
        if shown:
            sections |= sourced(f"graspd bench {name}", records, study.sections(shown, chart))
    return sections


def faults_of(plan: Plan) -> list[str]:
    """What is wrong, a line each."""
    return [
        f"{job.study} {job.case.label}: {fault}"
        for job in plan.jobs
        if job in plan.done
        for fault in STUDIES[job.study].faults(plan.done[job])
    ]
