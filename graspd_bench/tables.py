"""Markdown tables of records, and replacement of the marked sections of Markdown pages by new texts."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from graspd_bench.figures import Row, by_name, is_few, is_hand, is_preset, mean_of, rows, spread
from graspd_bench.study import Picture, Record, Sections
from graspd_bench.suites import DECADES
from graspd_core.errors import ConfigError
from graspd_core.io.grasps_json import save_text
from graspd_core.verify.metrics import METRICS
from graspd_dataset.run_records import markdown_table


def provenance(command: str, records: Sequence[Record]) -> str:
    """Return a sentence on the origin of results: command, dates, commits, code versions, machines and CPU time."""

    def of(name: str) -> str:
        return ", ".join(sorted({str(record.get(name) or "unknown") for record in records}))

    failed = sum(bool(record["error"]) for record in records)
    minutes = sum(record.get("case_cpu", 0.0) for record in records) / 60
    line = f"Made {of('made')} by `{command}` at commit {of('commit')} (code {of('code')}): "
    line += f"{len(records)} cases, {minutes:.0f} CPU minutes on {of('machine')}."
    return line + (f" {failed} cases failed and are in no figure." if failed else "")


def sourced(command: str, records: Sequence[Record], sections: Sections) -> dict[str, Sequence[str | Picture]]:
    """Return the sections that are not empty. Append the sentence of `provenance` to each section."""
    filled = {name: [part for part in parts if part] for name, parts in sections.items()}
    return {name: [*parts, provenance(command, records)] for name, parts in filled.items() if parts}


def written(parts: Sequence[str | Picture], document: Path | None = None) -> str:
    """Return the parts of a section as Markdown. Pictures are links relative to `document`. None: no pictures."""
    texts = []
    for part in parts:
        if isinstance(part, str):
            texts.append(part)
        elif document is not None:
            link = Path(os.path.relpath(part.png.resolve(), document.resolve().parent)).as_posix()
            texts.append(f"![{part.title}]({link})")
    return "\n\n".join(texts)


def fill(document: Path, sections: Mapping[str, Sequence[str | Picture]]) -> list[str]:
    """Replace the marked sections of a document by new texts. Return the names of the replaced sections.

    A section stands between `<!-- NAME:begin -->` and `<!-- NAME:end -->`.
    Raises ConfigError: the document cannot be read, or has none of the sections.
    """
    try:
        text = document.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{document}: {error.strerror or error}") from None
    filled = []
    for name, parts in sections.items():
        # A marker fills a whole line, because the text of a document may also mention a marker.
        section = re.compile(rf"^(<!-- {name}:begin -->\n).*?^(<!-- {name}:end -->)$", re.DOTALL | re.MULTILINE)
        if section.search(text):
            new = written(parts, document)
            text = section.sub(lambda found, new=new: f"{found[1]}{new}\n{found[2]}", text, count=1)
            filled.append(name)
    if not filled:
        raise ConfigError(f"{document}: has none of the sections {', '.join(sections)}; add <!-- NAME:begin --> …")
    save_text(document, text)
    return filled


_PLANNED = ("first_wall", "cpu_per_verified", "rounds")
_TITLES = {
    "speed": "Speed against accuracy",
    "short": "Speed against accuracy",
    "planned": "Planned grasps",
    "ladder": "Settings sweeps",
}
_SUMMARY = ("standard", "hard", "sd_cm", "penetration_mm", "contact_area_cm2", "cpu_per_grasp", "cpu_per_verified")


def _columns() -> list[tuple[str, str, str]]:
    """Return the columns of the tables: heading, key in `Row.values`, and number format."""
    return [
        ("held", "standard", "{:.0%}"),
        ("held, hard", "hard", "{:.0%}"),
        ("held, noisy", "noisy", "{:.0%}"),
        ("SD cm", "sd_cm", "{:.2f}"),
        ("under gravity cm", "gravity_cm", "{:.2f}"),
        *((row.title, row.key, f"{{:.{row.digits}f}}") for row in METRICS.values()),
        ("CPU s per grasp", "cpu_per_grasp", "{:.3g}"),
        ("CPU s per verified", "cpu_per_verified", "{:.3g}"),
    ]


def summary_table(records: Sequence[Record]) -> str:
    """Return a table of raw grasps with a row for each preset. The numbers are means over objects."""
    return _summary("preset", by_name(row for row in rows(records) if is_preset(row.name)))


def hands_table(records: Sequence[Record]) -> str:
    """Return a table with a row per hand: means over objects, and the object with the smallest share of held grasps."""
    found = by_name(row for row in rows(records) if is_hand(row.name))
    # Without the standard trial, no cell of the last column is known.
    tried = _known(found, "standard")
    worst = [min(group, key=lambda row: row.held / row.count) for group in found.values()] if tried else []
    hands = {name.removeprefix("hand:"): group for name, group in found.items()}
    last = ("fewest held", [f"{row.object} {row.held}/{row.count}" for row in worst])
    return _summary("hand", hands, last if tried else None)


def _summary(kind: str, found: Mapping[str, Sequence[Row]], last: tuple[str, list[str]] | None = None) -> str:
    """Return a table with a row for each name, "" if `found` is empty. `last` is an extra column: heading and cells."""
    if not found:
        return ""
    columns = [column for column in _columns() if column[1] in _SUMMARY and _known(found, column[1])]
    body = [
        [f"`{name}`", *(_mean(group, figure, form) for _, figure, form in columns)] for name, group in found.items()
    ]
    headings = [kind, *(heading for heading, _, _ in columns)]
    if last is not None:
        headings.append(last[0])
        body = [[*line, cell] for line, cell in zip(body, last[1], strict=True)]
    return markdown_table(headings, body)


def object_tables(records: Sequence[Record]) -> str:
    """Return a table for each preset: a row for each object with medians over its grasps, and the mean over objects."""
    blocks = []
    for name, group in by_name(row for row in rows(records) if is_preset(row.name)).items():
        columns = [column for column in _columns() if _known({name: group}, column[1])]
        body = [
            [row.object, *(_form(row.values[f], form) if f != "standard" else f"{row.held}/{row.count}"
                           for _, f, form in columns)]
            for row in group
        ]  # fmt: skip
        body.append(["**mean**", *(_mean(group, figure, form) for _, figure, form in columns)])
        blocks.append(f"`{name}`:\n\n{markdown_table(['object', *(heading for heading, _, _ in columns)], body)}")
    return "\n\n".join(blocks)


def planned_table(records: Sequence[Record]) -> str:
    """Return a table of runs that plan verified grasps, by preset: grasps, times and CPU time with trials."""
    body = []
    for name, group in by_name(rows(records, "verified")).items():
        held, count = sum(row.held for row in group), sum(row.count for row in group)
        first, worst = spread(group, "first_cpu"), max((r.values["first_cpu"] or 0.0 for r in group), default=0.0)
        body.append([
            f"`{name}`", f"{held}/{count}",
            f"{first.median:.2f} ({worst:.2f})" if first else "–",
            *(_mean(group, figure, "{:.3g}") for figure in _PLANNED),
            f"{max(row.values['peak_mb'] or 0.0 for row in group):.0f}",
        ])  # fmt: skip
    headings = ["preset", "verified", "first verified CPU s, median (worst)", "first verified s", "CPU s per verified"]
    return markdown_table([*headings, "rounds", "peak MB"], body) if body else ""


def pace_table(records: Sequence[Record]) -> str:
    """Return a table of computing times: of a raw grasp in a batch, and from a new process to a verified grasp."""
    body = []
    for r in records:
        if r["error"]:
            continue
        if r["kind"] == "pace":
            cost = r["cpu"]["optimise"]
            steps = f", {cost / r['grasp_steps'] * 1e6:.0f} µs a grasp-step" if r["grasp_steps"] else ""
            what = f"raw grasps, `{r['name']}`, {r['object']}, batch {r['count']}"
            body.append([what, f"{cost / r['count']:.3f} CPU s each{steps}; {r['peak_mb']:.0f} MB at the peak"])
        elif r["kind"] == "start":
            what = f"first verified grasp of a fresh process without a cache, `{r['name']}`, {r['object']}"
            body.append([what, f"{r['wall']['total']:.1f} s, {r['cpu']['total']:.1f} CPU s"])
    return markdown_table(["speed and size", ""], body) if body else ""


def main_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return the sections of study `main`: short table, table of all presets, planned grasps, tables of objects."""
    drawn = drawn_charts(records, chart)
    few = [record for record in records if is_few(record["name"])]
    return {
        "bench": [drawn.get("short"), summary_table(few)],
        "bench-all": [drawn.get("speed"), summary_table(records), missing(records)],
        "bench-planned": [drawn.get("planned"), planned_table(records), pace_table(records)],
        "bench-objects": [object_tables(records)],
    }


def ladder_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return the section of study `ladder`: the chart of hold success and CPU time over each swept setting."""
    return {"bench-ladder": [drawn_charts(records, chart).get("ladder")]}


def decades_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return a table for each setting: how many of the requested raw grasps held, summed over objects."""
    groups = by_name(rows(records))
    blocks = []
    for title, _, setting, values in DECADES:
        scale = 1e3 if "[mm]" in title else 1.0
        found = [groups.get(f"{setting}={value:g}", []) for value in values]
        known = [_known({setting: group}, "standard") for group in found]
        held = [f"{sum(r.held for r in group)}/{sum(r.count for r in group)}" for group in found]
        share = [text if tried else "–" for text, tried in zip(held, known, strict=True)]
        blocks.append(markdown_table([title, *(f"{v * scale:g}" for v in values)], [[f"`{setting}`", *share]]))
    return {"decades": blocks}


def hands_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return the section of study `hands`: one table of all hands."""
    return {"bench-hands": [hands_table(records)]}


def drawn_charts(records: Sequence[Record], chart: Path | None) -> Mapping[str, Picture]:
    """Draw the charts for which the records have data. Return them by name. If `chart` is None, draw none."""
    if chart is None:
        return {}
    from graspd_bench.charts import draw_charts

    return {name: Picture(_TITLES[name], png) for name, png in draw_charts(records, chart).items()}


def metrics_table() -> str:
    """Return a table with a row for each metric: name, unit and definition."""
    return markdown_table(
        ["metric", "unit in files", "definition"],
        [[f"`{name}`", row.unit, row.description] for name, row in METRICS.items()],
    )


def missing(records: Sequence[Record]) -> str:
    """Return a sentence that names presets without results for some objects, or "" if there are no such presets."""
    found = by_name(row for row in rows(records) if is_preset(row.name))
    objects = {r["object"] for r in records if r["kind"] == "raw" and is_preset(r["name"])}
    fewer = [f"`{name}` of {len(group)}" for name, group in found.items() if len(group) < len(objects)]
    return f"Means are over {len(objects)} objects, but {', '.join(fewer)} only." if fewer else ""


def _known(groups: Mapping[str, Sequence[Row]], figure: str) -> bool:
    return any(row.values.get(figure) is not None for group in groups.values() for row in group)


def _mean(group: Sequence[Row], figure: str, form: str) -> str:
    return _form(mean_of(group, figure), form)


def _form(value: float | None, form: str) -> str:
    return "–" if value is None else form.format(value)
