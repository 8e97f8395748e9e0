"""Study `stress`: all stress cases by name, functions that run them, and Markdown tables of how they ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from graspd_bench import study
from graspd_bench.stress.broken_clouds import cloud_cases
from graspd_bench.stress.broken_meshes import extreme_cases, mesh_cases
from graspd_bench.stress.run_stress_case import GRASP, Case, StressEnding, faults, run_case
from graspd_bench.study import Record, Request, Sections
from graspd_bench.tables import markdown_table
from graspd_core.errors import ConfigError, choices
from graspd_core.types import Outcome

CASES: dict[str, Case] = {case.name: case for case in (*mesh_cases(), *cloud_cases(), *extreme_cases())}
# Time in addition to the limits of loading and planning, before a process counts as hung [s].
_PATIENCE = 60.0
# Names of families and cases for a quick run. Each case takes about a second.
_QUICK = ("hand", "nan-vertices", "empty")
# Messages in the table are cut to this length [characters].
_MESSAGE = 110
_HEADINGS = ("case", "what is wrong", "ending", "load s", "plan s", "peak MB", "held/tried", "again", "true", "told")


@dataclass(frozen=True)
class StressRun(study.Case):
    """One run of a stress case: the name of the case, and the preset with which grasps are planned."""

    name: str
    preset: str


def stress_runs(request: Request) -> tuple[StressRun, ...]:
    """Return a run for each requested case, by name or family (default: all). Raises ConfigError: unknown name."""
    families = sorted({case.family for case in CASES.values()})
    names = request.cases or (_QUICK if request.quick else ())
    if unknown := [name for name in names if name not in CASES and name not in families]:
        raise ConfigError(f"unknown case {unknown[0]!r}; {choices(unknown[0], (*families, *sorted(CASES)))}")
    chosen = [case.name for case in CASES.values() if not names or case.name in names or case.family in names]
    return tuple(StressRun(name, request.preset()) for name in chosen)


def run_stress(run: StressRun) -> Record:
    """Run a case. Return its ending as a record."""
    return asdict(run_case(CASES[run.name], run.preset))


def stress_patience(run: StressRun) -> float:
    """Return the seconds until a case counts as hung. Allow two loadings, as the second trial reloads the object."""
    case = CASES[run.name]
    return 2 * case.loading + case.deadline + _PATIENCE


def ending_of(record: Record) -> StressEnding:
    """Return the ending in a record. If the process failed, the ending is "crash" or "hang"."""
    if record["error"]:
        return StressEnding(record["name"], "hang" if record["failed"] == "hung" else "crash", record["error"])
    return StressEnding(**{name: record[name] for name in StressEnding.__dataclass_fields__})


def stress_faults(record: Record) -> tuple[str, ...]:
    """Return how the ending in a record breaks the expectations of its case, one line per fault."""
    return faults(CASES[record["name"]], ending_of(record))


def stress_summary(record: Record) -> str:
    """Return how the case of a record ended, and how long loading and planning took, in a few words."""
    ending = ending_of(record)
    return f"{ending.ending}, {ending.loading + ending.planning:.1f} s"


def stress_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return a section with the summary of all endings, and a section with a table of endings for each family."""
    endings = {CASES[record["name"]]: ending_of(record) for record in records}
    return {"stress-summary": [summary(endings)], "stress": [stress_table(endings)]}


def stress_table(endings: Mapping[Case, StressEnding]) -> str:
    """Return a table for each family of cases, with one ending per row. Unexpected endings are bold."""
    blocks = []
    for family in dict.fromkeys(case.family for case in endings):
        body = [_line(case, ending) for case, ending in endings.items() if case.family == family]
        blocks.append(f"**{family}**\n\n{markdown_table(_HEADINGS, body)}")
    return "\n\n".join(blocks)


def summary(endings: Mapping[Case, StressEnding]) -> str:
    """Return a text: how many cases end in a verified grasp, how many grasps pass the second trial, and all faults."""
    wrong = [f"* `{c.name}`: {_shortened(fault)}" for c, e in endings.items() for fault in faults(c, e)]
    lines = [f"Cases: {len(endings)}. Faults: {len(wrong)}."]
    for family in dict.fromkeys(case.family for case in endings):
        lines.append(_share(family, [(c, e) for c, e in endings.items() if c.family == family and c.whole]))
    verified, again = (sum(getattr(e, name) for e in endings.values()) for name in ("verified", "again"))
    lines.append(f"{again} of {verified} verified grasps hold in a second trial.")
    truths = [ending for ending in endings.values() if ending.true is not None]
    if truths:
        held = sum(ending.true or 0 for ending in truths)
        none = [e.case for e in truths if e.verified and not e.true]
        lines.append(
            f"{held} of {sum(e.verified for e in truths)} verified on a cloud hold on the true object"
            + (f" (none of {', '.join(none)})." if none else ".")
        )
    return "\n\n".join([" ".join(filter(None, lines)), *(["\n".join(wrong)] if wrong else [])])


def _share(family: str, whole: Sequence[tuple[Case, StressEnding]]) -> str:
    if not whole:
        return ""
    grasped = sum(ending.ending == GRASP for _, ending in whole)
    share = f"{grasped} of {len(whole)} ({grasped / len(whole):.0%})"
    return f"{family}: {share} with something to grasp end in a verified grasp."


def _shortened(message: str) -> str:
    return message if len(message) <= _MESSAGE else f"{message[:_MESSAGE].rstrip()} …"


def _line(case: Case, ending: StressEnding) -> list[str]:
    good = ending.ending in case.expect
    # The column of the ending already shows success.
    message = ending.message.removeprefix(Outcome.SUCCEEDED.value).removeprefix("; ")
    message = message.replace("|", "\\|").replace("\n", " ")
    return [
        f"`{case.name}`",
        case.about,
        ending.ending if good else f"**{ending.ending}**",
        f"{ending.loading:.1f}",
        f"{ending.planning:.1f}",
        f"{ending.memory:.0f}",
        f"{ending.verified}/{ending.tried}" if ending.tried else "–",
        str(ending.again) if ending.verified else "–",
        "–" if ending.true is None or not ending.verified else str(ending.true),
        _shortened(message),
    ]
