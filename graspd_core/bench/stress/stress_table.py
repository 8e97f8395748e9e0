"""Endings as Markdown: a row a case, and what they come to together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from graspd_core.bench.report import markdown_table
from graspd_core.bench.stress.run_stress_case import StressEnding, faults
from graspd_core.bench.stress.stress_case import GRASP, Case
from graspd_core.bench.stress.stress_cases import CASES, ending_of
from graspd_core.bench.study import Record, Sections
from graspd_core.types import Outcome

# Longer messages end in dots [characters].
_MESSAGE = 110
_HEADINGS = ("case", "what is wrong", "ending", "load s", "plan s", "peak MB", "held/tried", "again", "true", "told")


def stress_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """What held and every fault; and the table."""
    endings = {CASES[record["name"]]: ending_of(record) for record in records}
    return {"stress-summary": [summary(endings)], "stress": [stress_table(endings)]}


def stress_table(endings: Mapping[Case, StressEnding]) -> str:
    """A table a family; faults in bold."""
    blocks = []
    for family in dict.fromkeys(case.family for case in endings):
        body = [_line(case, ending) for case, ending in endings.items() if case.family == family]
        blocks.append(f"**{family}**\n\n{markdown_table(_HEADINGS, body)}")
    return "\n\n".join(blocks)


def summary(endings: Mapping[Case, StressEnding]) -> str:
    """What held of all that should, and every fault, a line each."""
    wrong = [f"* `{case.name}`: {fault}" for case, ending in endings.items() for fault in faults(case, ending)]
    lines = [f"{len(endings)} cases, {len(wrong)} faults."]
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


def _line(case: Case, ending: StressEnding) -> list[str]:
    good = ending.ending in case.expect
    # That all went well is told by the ending.
    told = ending.message.removeprefix(Outcome.SUCCEEDED.value).removeprefix("; ")
    told = told.replace("|", "\\|").replace("\n", " ")
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
        told if len(told) <= _MESSAGE else f"{told[:_MESSAGE].rstrip()} …",
    ]
