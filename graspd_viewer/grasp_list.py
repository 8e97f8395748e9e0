"""List of grasps beside the 3D scene: filter it, sort it, and show values as text and HTML.

Names and reasons may come from untrusted files. So they are escaped in HTML.
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence

from graspd_core.types import Grasp, Verdict
from graspd_core.verify.metrics import METRICS
from graspd_viewer.drawing import FORCE, GUESSED, HAND, NORMAL, OBJECT, TURN, VERDICTS, WEAKEST, css

ALL = "all"
# A grasp that holds on the likeliest shape of the object, but passes too few robustness checks to be verified.
LESS_SURE = "less sure"
FILTERS = (ALL, "verified", LESS_SURE, "unverified", "failed")
# Metrics for which less is better. For all other metrics more is better.
_LESS = ("penetration", "contact_depth", "self_penetration", "intersection_volume", "least_friction")
ORDERS = ("rank", "score", "probability", "displacement", *METRICS)
# Columns of the table, and number of rows before and after the selected grasp.
_COLUMNS, _AROUND = ("payload", "penetration", "contact_area"), 2
BLOCK = "<div style='font-size:0.8em;line-height:1.5;padding:0 0.8em'>"
_LEGEND = (
    ("object", OBJECT, "■"), ("guessed part", GUESSED, "■"), ("hand", HAND, "■"), ("normal at a contact", NORMAL, "➔"),
    ("force, 4 mm for a newton", FORCE, "➔"), ("weakest push", WEAKEST, "➔"), ("axis of its turn", TURN, "➔"),
)  # fmt: skip
_OTHER_FIGURES = {
    "score": "the optimiser's own measure; larger is better; the score ranks grasps of one file before any trial",
    "probability": "probability of holding on the true object, if cameras saw the object",
    "displacement": "greatest displacement of the object's centre of mass until the trial ended",
    "rotation": "greatest rotation of the object until the trial ended",
}


def standing(grasp: Grasp) -> str:
    """Return the name under which the list filters a grasp: its verdict, or `LESS_SURE` if tried but unverified."""
    return LESS_SURE if grasp.verdict is Verdict.UNVERIFIED and grasp.trials else str(grasp.verdict)


def listed(grasps: Sequence[Grasp], which: str, by: str) -> list[int]:
    """Return the ranks of the grasps that pass filter `which`, sorted by `by`, best first. Missing values come last.

    An unknown `which` passes all grasps, and an unknown `by` sorts by rank. Only forged messages have such names.
    """
    ranks = [rank for rank, grasp in enumerate(grasps) if which not in FILTERS[1:] or standing(grasp) == which]

    def place(rank: int) -> tuple[bool, float]:
        value = _value(grasps[rank], rank, by)
        return (True, 0.0) if value is None else (False, value)

    return sorted(ranks, key=place)


def _value(grasp: Grasp, rank: int, by: str) -> float | None:
    """Return the value of a grasp to sort by (smaller is better). None if the grasp has no such value."""
    if by == "score":
        return -grasp.score
    if by == "probability":
        return None if grasp.probability is None else -grasp.probability
    if by == "displacement":
        return max((t.displacement for t in grasp.trials if math.isfinite(t.displacement)), default=None)
    value = (grasp.metrics or {}).get(by) if by in METRICS else float(rank)
    return value if value is None or by in _LESS or by == "rank" or by not in METRICS else -value


def label(grasp: Grasp, rank: int) -> str:
    """Return a grasp's text for the dropdown list."""
    said = standing(grasp)
    mark = {"verified": "✓", LESS_SURE: "~", "failed": "✗"}.get(said, "·")
    return f"{mark} #{rank} {said}{_likely(grasp, ', ')}, {len(grasp.contacts)} contacts"


def _likely(grasp: Grasp, before: str) -> str:
    return "" if grasp.probability is None else f"{before}{100 * grasp.probability:.0f} %"


def legend_html() -> str:
    """Return the legend of the scene's colours."""
    patches = (
        f"<span style='white-space:nowrap;margin-right:0.8em'>"
        f"<span style='color:{css(colour)}'>{mark}</span> {name}</span>"
        for name, colour, mark in _LEGEND
    )
    return f"{BLOCK}{' '.join(patches)}</div>"


def table_html(grasps: Sequence[Grasp], ranks: Sequence[int], chosen: int | None) -> str:
    """Return HTML: the number of grasps of each filter, and a table of the grasps around rank `chosen`."""
    if not ranks:
        return "<i>no grasp passes this filter</i>"
    middle = ranks.index(chosen) if chosen in ranks else 0
    first = max(0, min(middle - _AROUND, len(ranks) - 2 * _AROUND - 1))
    head = "".join(f"<th>{html.escape(METRICS[name].title)}</th>" for name in _COLUMNS)
    rows = [_row(grasps[rank], rank, rank == chosen) for rank in ranks[first : first + 2 * _AROUND + 1]]
    said = [standing(grasp) for grasp in grasps]
    counts = ", ".join(f"{said.count(word)} {word}" for word in FILTERS[1:] if word in said)
    return (
        f"{BLOCK}{middle + 1} of {len(ranks)} shown ({counts})"
        f"<table style='width:100%;text-align:right'><tr><th>#</th><th></th>{head}</tr>{''.join(rows)}</table></div>"
    )


def figures_html(grasp: Grasp, rank: int) -> str:
    """Return HTML with all values of one grasp. Each value has its description as a tooltip."""
    reason = f": {html.escape(grasp.reason)}" if grasp.reason else ""
    head = f"<b>#{rank} <span style='color:{css(VERDICTS[grasp.verdict])}'>{standing(grasp)}</span></b>{reason}"
    figures = []
    if grasp.probability is not None:
        figures.append(_figure("probability", _likely(grasp, ""), _OTHER_FIGURES["probability"]))
    for trial in grasp.trials:
        if math.isfinite(trial.displacement) and math.isfinite(trial.rotation):
            name = html.escape(trial.name)
            travel, turn = f"{1e3 * trial.displacement:.1f} mm", f"{math.degrees(trial.rotation):.1f}°"
            figures += [
                _figure(f"{name} displacement", travel, _OTHER_FIGURES["displacement"]),
                _figure(f"{name} rotation", turn, _OTHER_FIGURES["rotation"]),
            ]
    figures.append(_figure("score", f"{grasp.score:.2f}", _OTHER_FIGURES["score"]))
    for name, value in (grasp.metrics or {}).items():
        if value is not None:
            row = METRICS[name]
            text = f"{value * row.scale:.{row.digits}f} {row.unit}"
            figures.append(_figure(row.name.replace("_", " "), text, row.description))
    links = "touching: " + html.escape(", ".join(contact.link for contact in grasp.contacts) or "nothing")
    columns = f"<div style='columns:2;column-gap:1em'>{''.join(figures)}</div>"
    return f"{BLOCK}{head}{columns}{links}</div>"


def _figure(name: str, value: str, meaning: str) -> str:
    said = html.escape(meaning, quote=True)
    return f"<div title='{said}' style='cursor:help'>{name} <b>{html.escape(value)}</b></div>"


def _row(grasp: Grasp, rank: int, chosen: bool) -> str:
    colour = css(VERDICTS[grasp.verdict])
    values = [(METRICS[name], (grasp.metrics or {}).get(name)) for name in _COLUMNS]
    cells = "".join(f"<td>{'–' if v is None else format(v * row.scale, f'.{row.digits}f')}</td>" for row, v in values)
    back = "background:rgba(130,150,190,0.3)" if chosen else ""
    return f"<tr style='{back}'><td>{rank}</td><td style='color:{colour}'>●{_likely(grasp, ' ')}</td>{cells}</tr>"
