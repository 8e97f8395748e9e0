"""Failure maps as heat maps: the share held in every cell, methods side by side, and where half of it is lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from graspd_core.bench.charts.chart_style import figure, save
from graspd_core.bench.failure_maps.map_case import Place
from graspd_core.bench.failure_maps.map_registry import MAPS, METHODS, Map
from graspd_core.bench.report import markdown_table
from graspd_core.bench.study import Picture, Record, Sections

Shares = Mapping[tuple[Place, Place], float]

# Nuñez, Anderton and Renslow (2018): even in lightness, and alike to those who see no red or green.
_COLOURS = "cividis"
_CELL, _EDGE = 0.52, "#D55E00"


def draw_map(drawn: Map, methods: Mapping[str, Shares], path: Path) -> Path:
    """One panel a method, by its caption. Returns the PNG's path.

    Cells without a record stay white; rows and columns in which no panel has any are left out.
    """
    drawn = _known(drawn, methods)
    columns, rows = len(drawn.across.places), len(drawn.up.places)
    width = len(methods) * max(columns * _CELL, 2.6) + 1.5
    with figure(width, rows * _CELL + 1.3, ncols=len(methods), squeeze=False, sharey=True) as (made, axes):
        made.get_layout_engine().set(wspace=0.06)
        image = None
        for axis, (caption, shares) in zip(axes[0], methods.items(), strict=True):
            image = _panel(axis, drawn, shares)
            axis.set_title(caption, fontsize=9)
            axis.set_xlabel(drawn.across.label)
        axes[0][0].set_ylabel(drawn.up.label)
        bar = made.colorbar(image, ax=list(axes[0]), fraction=0.04, pad=0.015)
        bar.set_label("grasps that held [%]")
        bar.outline.set_visible(False)
        return save(made, path)


def _known(drawn: Map, methods: Mapping[str, Shares]) -> Map:
    places = [place for shares in methods.values() for place in shares]
    across = tuple(x for x in drawn.across.places if any(x == place[0] for place in places))
    up = tuple(y for y in drawn.up.places if any(y == place[1] for place in places))
    if not places:
        return drawn
    return replace(drawn, across=replace(drawn.across, places=across), up=replace(drawn.up, places=up))


def _panel(axis: Any, drawn: Map, shares: Shares) -> Any:
    across, up = drawn.across.places, drawn.up.places
    grid = np.array([[100 * shares.get((x, y), np.nan) for x in across] for y in up])
    image = axis.imshow(grid, cmap=_COLOURS, vmin=0, vmax=100, origin="lower", aspect="auto")
    for row, column in np.argwhere(np.isfinite(grid)):
        value = grid[row, column]
        colour = "white" if value < 50 else "black"
        axis.text(column, row, f"{value:.0f}", ha="center", va="center", color=colour, fontsize=8)
    _border(axis, grid)
    axis.set_xticks(range(len(across)), [_written(place) for place in across])
    axis.set_yticks(range(len(up)), [_written(place) for place in up])
    for ticks, places in ((axis.set_xticks, across), (axis.set_yticks, up)):
        ticks(np.arange(1, len(places)) - 0.5, minor=True)
    axis.tick_params(which="both", length=0)
    axis.grid(False)
    axis.grid(which="minor", color="white", lw=1.0)
    for spine in axis.spines.values():
        spine.set_visible(False)
    return image


def _border(axis: Any, grid: Any) -> None:
    """A line between cells of which one holds at least half of its grasps and the other less."""
    works, known = grid >= 50, np.isfinite(grid)
    beside = (works[:, 1:] != works[:, :-1]) & known[:, 1:] & known[:, :-1]
    above = (works[1:] != works[:-1]) & known[1:] & known[:-1]
    line: dict[str, Any] = {"color": _EDGE, "lw": 2.2, "solid_capstyle": "round"}
    for row, column in np.argwhere(beside):
        axis.plot([column + 0.5] * 2, [row - 0.5, row + 0.5], **line)
    for row, column in np.argwhere(above):
        axis.plot([column - 0.5, column + 0.5], [row + 0.5] * 2, **line)


def _written(place: Place) -> str:
    return place if isinstance(place, str) else f"{place:g}"


def map_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """A picture a map, under the marker of its name, and all failures by reason."""
    sections: dict[str, list[str | Picture | None]] = {}
    body = []
    for name, drawn in MAPS.items():
        panels = {
            f"{method} (preset {preset})": [r for r in records if (r["map"], r["preset"]) == (name, preset)]
            for method, preset in METHODS.items()
        }
        if not any(panels.values()):
            continue
        if chart is not None:
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
