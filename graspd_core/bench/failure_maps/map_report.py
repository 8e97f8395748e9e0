"""Records of maps to the shares that a picture shows, to pictures, and to the reasons of failures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from graspd_core.bench.failure_maps.map_case import Place
from graspd_core.bench.failure_maps.map_registry import MAPS, METHODS
from graspd_core.bench.report import markdown_table
from graspd_core.bench.study import Picture, Record, Sections


def map_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """A picture a map, under the marker of its name, and all failures by reason."""
    sections: dict[str, list[str | Picture | None]] = {}
    body = []
    for name, drawn in MAPS.items():
        panels = {
            f"{method} (preset {preset})": [
                r for r in records if not r["error"] and (r["map"], r["preset"]) == (name, preset)
            ]
            for method, preset in METHODS.items()
        }
        if not any(panels.values()):
            continue
        if chart is not None:
            from graspd_core.bench.charts.failure_map_chart import draw_map

            png = draw_map(drawn, {title: shares(own) for title, own in panels.items()}, chart.with_name(f"map_{name}"))
            sections[f"map-{name.replace('_', '-')}"] = [Picture(f"Success over {drawn.title}", png)]
        body += [[drawn.title, title, _counts(reasons(own))] for title, own in panels.items()]
    return {**sections, "map-failures": [markdown_table(["map", "method", "failures by reason"], body)] if body else []}


def shares(records: Sequence[Record]) -> dict[tuple[Place, Place], float]:
    """Share of the grasps asked for that held, all objects together, by place across and up."""
    held, asked = Counter[tuple[Place, Place]](), Counter[tuple[Place, Place]]()
    for record in records:
        for cell in record["cells"]:
            held[record["across"], cell["up"]] += cell["held"]
            asked[record["across"], cell["up"]] += record["count"]
    return {place: held[place] / asked[place] for place in asked}


def reasons(records: Sequence[Record]) -> Counter[str]:
    """Why grasps failed, and how many each."""
    return sum((Counter(cell["reasons"]) for record in records for cell in record["cells"]), Counter[str]())


def _counts(why: Counter[str]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in why.most_common()) or "no failure"
