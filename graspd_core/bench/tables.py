"""Results as Markdown, and into the marked sections of documents."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from graspd_core.bench.figures import Row, by_name, per_verified, rows, spread
from graspd_core.bench.names import is_hand, is_preset
from graspd_core.bench.result_store import Record
from graspd_core.errors import ConfigError
from graspd_core.formats.grasps_json import save_text
from graspd_core.metrics.metric_registry import METRICS

_PLANNED = ("first_wall", "cpu_per_verified", "rounds")
_SUMMARY = ("standard", "hard", "sd_cm", "penetration_mm", "contact_area_cm2", "cpu_per_grasp", "cpu_per_verified")


def _columns() -> list[tuple[str, str, str]]:
    """Columns of both tables: heading, figure, format; a summary takes means over objects."""
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
    """A row a preset: means over its objects, of raw grasps."""
    return _summary("preset", by_name(row for row in rows(records) if is_preset(row.name)))


def hands_table(records: Sequence[Record]) -> str:
    """A row a hand: likewise, all with the same preset; and the object on which fewest held."""
    found = by_name(row for row in rows(records) if is_hand(row.name))
    worst = [min(group, key=lambda row: row.held / row.asked) for group in found.values()]
    hands = {name.removeprefix("hand:"): group for name, group in found.items()}
    return _summary("hand", hands, ("fewest held", [f"{row.object} {row.held}/{row.asked}" for row in worst]))


def _summary(kind: str, found: Mapping[str, Sequence[Row]], last: tuple[str, list[str]] | None = None) -> str:
    """A row a name, with a last column if there is one to add; nothing where there are no names."""
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
    """A table a preset: medians over each object's grasps, and their means."""
    blocks = []
    for name, group in by_name(row for row in rows(records) if is_preset(row.name)).items():
        columns = [column for column in _columns() if _known({name: group}, column[1])]
        body = [
            [row.object, *(_form(row.values[f], form) if f != "standard" else f"{row.held}/{row.asked}"
                           for _, f, form in columns)]
            for row in group
        ]  # fmt: skip
        body.append(["**mean**", *(_mean(group, figure, form) for _, figure, form in columns)])
        blocks.append(f"`{name}`:\n\n{markdown_table(['object', *(heading for heading, _, _ in columns)], body)}")
    return "\n\n".join(blocks)


def planned_table(records: Sequence[Record]) -> str:
    """A row a preset of planned runs: verified grasps and what they cost, trials and all."""
    body = []
    for name, group in by_name(rows(records, "verified")).items():
        held, asked = sum(row.held for row in group), sum(row.asked for row in group)
        first, worst = spread(group, "first_cpu"), max((r.values["first_cpu"] or 0.0 for r in group), default=0.0)
        body.append([
            f"`{name}`", f"{held}/{asked}",
            f"{first.median:.2f} ({worst:.2f})" if first else "–",
            *(_mean(group, figure, "{:.3g}") for figure in _PLANNED),
            f"{max(row.values['peak_mb'] or 0.0 for row in group):.0f}",
        ])  # fmt: skip
    headings = ["preset", "verified", "first verified CPU s, median (worst)", "first verified s", "CPU s per verified"]
    return markdown_table([*headings, "rounds", "peak MB"], body) if body else ""


def pace_table(records: Sequence[Record]) -> str:
    """The optimiser alone, and a fresh process."""
    body = []
    for r in records:
        if r["error"]:
            continue
        if r["kind"] == "pace":
            cost = r["cpu"]["optimise"]
            steps = f", {cost / r['grasp_steps'] * 1e6:.0f} µs a grasp-step" if r["grasp_steps"] else ""
            what = f"raw grasps, `{r['name']}`, {r['object']}, batch {r['asked']}"
            body.append([what, f"{cost / r['asked']:.3f} CPU s each{steps}; {r['peak_mb']:.0f} MB at the peak"])
        elif r["kind"] == "start":
            what = f"first verified grasp of a fresh process without a cache, `{r['name']}`, {r['object']}"
            body.append([what, f"{r['wall']['total']:.1f} s, {r['cpu']['total']:.1f} CPU s"])
    return markdown_table(["speed and size", ""], body) if body else ""


def sections(records: Sequence[Record], charts: Mapping[str, Path], document: Path) -> dict[str, str]:
    """Text of every section that a document may have, by the name of its marker."""
    planned, pace = planned_table(records), pace_table(records)
    return {
        "bench": "\n\n".join(
            filter(None, (_picture(charts, "speed", document), summary_table(records), about(records)))
        ),
        "bench-planned": "\n\n".join(filter(None, (_picture(charts, "planned", document), planned, pace))),
        "bench-ladder": _picture(charts, "ladder", document),
        "bench-hands": hands_table(records),
        "bench-objects": object_tables(records),
        "metrics": metrics_table(),
    }


def metrics_table() -> str:
    """A row a metric: its name, unit and definition."""
    return markdown_table(
        ["metric", "unit in files", "definition"],
        [[f"`{name}`", row.unit, row.description] for name, row in METRICS.items()],
    )


def about(records: Sequence[Record]) -> str:
    """One sentence on what was run, where."""
    raw = [r for r in records if r["kind"] == "raw"]
    seeds, objects = sorted({r["seed"] for r in raw}), {r["object"] for r in raw}
    codes, machines = sorted({r["code"] for r in records}), sorted({r["machine"] for r in records})
    seconds = sum(r.get("cell_cpu", 0.0) for r in records)
    return (
        f"{len(records)} cells, {len(objects)} objects, seeds {', '.join(map(str, seeds))}; hand "
        f"{', '.join(sorted({r['hand'] for r in records}))}; {seconds / 60:.0f} CPU minutes on {'; '.join(machines)}; "
        f"code {', '.join(codes)}.{_missing(records)}"
    )


def _missing(records: Sequence[Record]) -> str:
    """What the means leave out: cells that raised, and objects that some presets have not been tried on."""
    raised = sum(bool(r["error"]) for r in records)
    found = by_name(row for row in rows(records) if is_preset(row.name))
    objects = {r["object"] for r in records if r["kind"] == "raw" and is_preset(r["name"])}
    fewer = [f"`{name}` of {len(group)}" for name, group in found.items() if len(group) < len(objects)]
    return (f" {raised} cells raised and are in no figure." if raised else "") + (
        f" Means are over {len(objects)} objects, but {', '.join(fewer)} only." if fewer else ""
    )


def fill(document: Path, texts: Mapping[str, str]) -> list[str]:
    """Rewrite the marked sections of a document; sections without text stay. Returns the names of those rewritten.

    A section stands between `<!-- NAME:begin -->` and `<!-- NAME:end -->`.

    Raises:
        ConfigError: the document cannot be read, or has none of the sections.
    """
    try:
        text = document.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{document}: {error.strerror or error}") from None
    filled = []
    for name, content in texts.items():
        # On lines of their own: a document may also speak of its markers.
        section = re.compile(rf"^(<!-- {name}:begin -->\n).*?^(<!-- {name}:end -->)$", re.DOTALL | re.MULTILINE)
        if content and section.search(text):
            text = section.sub(lambda found, new=content: f"{found[1]}{new}\n{found[2]}", text, count=1)
            filled.append(name)
    if not filled:
        raise ConfigError(f"{document}: has none of the sections {', '.join(texts)}; valid: <!-- bench:begin --> …")
    save_text(document, text)
    return filled


_TITLES = {"speed": "Speed against accuracy", "planned": "Planned grasps", "ladder": "Settings sweeps"}


def _picture(charts: Mapping[str, Path], name: str, document: Path) -> str:
    if name not in charts:
        return ""
    link = Path(os.path.relpath(charts[name].resolve(), document.resolve().parent)).as_posix()
    return f"![{_TITLES[name]}]({link})"


def _known(groups: Mapping[str, Sequence[Row]], figure: str) -> bool:
    return any(row.values.get(figure) is not None for group in groups.values() for row in group)


def _mean(group: Sequence[Row], figure: str, form: str) -> str:
    over = spread(group, figure)
    value = per_verified(group) if figure == "cpu_per_verified" else over and over.mean
    return _form(value, form)


def _form(value: float | None, form: str) -> str:
    return "–" if value is None else form.format(value)


def markdown_table(headings: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A table in Markdown; cells must not have bars of their own."""
    lines = [headings, ["---"] * len(headings), *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines).replace("| --- |", "|---|").replace(" --- |", "---|")
