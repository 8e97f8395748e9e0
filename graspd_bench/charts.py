"""Charts of speed against accuracy, of planned grasps, and of settings sweeps.

Markers differ in shape and colour, so that prints without colour remain readable.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from graspd_bench.figures import (
    Row,
    by_name,
    is_few,
    is_preset,
    is_sweep_value,
    parent_of,
    pareto_front,
    rows,
    share_interval,
    short_name,
    spread,
)
from graspd_bench.study import Record
from graspd_bench.suites import SWEEPS
from graspd_core.errors import Extra
from graspd_core.optimize.plan_config import method_row

# Colour of the Pareto front. Methods have colours of Okabe and Ito (2008), which colour-blind readers can distinguish.
FRONT = "#222222"
_STYLE: Any = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.edgecolor": "#888888",
    "svg.hashsalt": "graspd",
    "figure.dpi": 100,
}
# Style of the line from a distant label to its point.
_LEADER = {"arrowstyle": "-", "lw": 0.5, "alpha": 0.6, "shrinkA": 0, "shrinkB": 3}
# Possible positions of a label around its point: angles [rad] and distances [points]. The nearest free one is used.
_ANGLES = np.deg2rad([0, 180, 90, 270, 45, 135, 315, 225, 22, 158, 202, 338, 67, 113, 247, 293])
_DISTANCES = (7.0, 13.0, 20.0, 28.0, 38.0, 50.0, 64.0)


@contextmanager
def figure(width: float, height: float, **grid: Any) -> Iterator[tuple[Any, Any]]:
    """Yield a figure (`width` by `height` inches) and the axes of `subplots(**grid)`. Close the figure afterwards."""
    with Extra("bench"):
        import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    with matplotlib.rc_context(_STYLE):
        made, axes = pyplot.subplots(figsize=(width, height), layout="constrained", **grid)
        try:
            yield made, axes
        finally:
            pyplot.close(made)


def save(made: Any, path: Path) -> Path:
    """Write a figure as PNG and SVG and return the PNG's path. Equal data give byte-identical files."""
    png, svg = path.with_name(f"{path.name}.png"), path.with_name(f"{path.name}.svg")
    png.parent.mkdir(parents=True, exist_ok=True)
    made.savefig(png, dpi=160, metadata={"Software": None})
    made.savefig(svg, metadata={"Date": None, "Creator": None})
    return png


def place_labels(
    axes: Any, points: Sequence[tuple[float, float]], texts: Sequence[str], colours: Sequence[str]
) -> None:
    """Write a label beside each point, inside the axes, so that it overlaps no point and no other label, if possible.

    Call this function after all drawing, because it needs the final layout.
    """
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=2, foreground="white")]
    canvas = axes.figure.canvas
    canvas.draw()
    renderer = canvas.get_renderer()
    scale = axes.figure.dpi / 72.0
    frame = axes.get_window_extent(renderer)
    at = axes.transData.transform(np.array(points))
    taken = [(x - 5 * scale, y - 5 * scale, x + 5 * scale, y + 5 * scale) for x, y in at]
    for index in np.argsort(-at[:, 1]):
        label = axes.annotate(
            texts[index], points[index], xytext=(0, 0), textcoords="offset points", color=colours[index],
            fontsize=7.5, ha="center", va="center", zorder=6, path_effects=halo,
            arrowprops=_LEADER | {"color": colours[index]},
        )  # fmt: skip
        box = label.get_window_extent(renderer)
        half = np.array([box.width, box.height]) / 2 + scale
        others = [t for i, t in enumerate(taken) if i != index]
        places = [_place(at[index], half, d * scale, angle) for d, angle in product(_DISTANCES, _ANGLES)]
        best = min(places, key=lambda place: _trouble(place, half, others, frame))
        label.set_position(tuple((best - at[index]) / scale))
        taken.append((*(best - half), *(best + half)))
        if np.linalg.norm(best - at[index]) < half[0] + 10 * scale:
            label.arrow_patch.set_visible(False)


def _place(point: np.ndarray, half: np.ndarray, distance: float, angle: float) -> np.ndarray:
    corner = np.array([np.cos(angle), np.sin(angle)])
    return point + corner * distance + np.sign(np.round(corner, 6)) * half * np.abs(corner) ** 0.5


def _trouble(place: np.ndarray, half: np.ndarray, taken: Sequence[tuple[float, ...]], frame: Any) -> float:
    """Return a label position's cost: area shared with `taken` boxes, plus 50 times the length outside the axes."""
    low, high = place - half, place + half
    shared = 0.0
    for x0, y0, x1, y1 in taken:
        shared += max(0.0, min(high[0], x1) - max(low[0], x0)) * max(0.0, min(high[1], y1) - max(low[1], y0))
    outside = max(0.0, frame.x0 - low[0]) + max(0.0, high[0] - frame.x1)
    outside += max(0.0, frame.y0 - low[1]) + max(0.0, high[1] - frame.y1)
    return shared + 50.0 * outside


_LABELS = {
    "candidates": "contact candidates",
    "directions": "disturbance directions",
    "resolution": "grid nodes a side",
    "steps": "steps",
}
_SUCCESS, _TIME = method_row("closed_form").colour, method_row("graspd2022").colour


@dataclass(frozen=True)
class Panel:
    """Chart panel that plots one value against time.

    Attributes:
        figure: name of the value in `figures.Row.values`.
        label: label of the vertical axis.
        factor: factor that converts the value to the unit of the label.
        less_is_better: True if smaller values are better.
        mean: if True, plot the mean over objects instead of the median. The median of a success rate hides failures.
        log: True if the vertical axis is logarithmic.
    """

    figure: str
    label: str
    factor: float = 1.0
    less_is_better: bool = True
    mean: bool = False
    log: bool = False


PANELS = (
    Panel("standard", "hold success, raw [%]", factor=100.0, less_is_better=False, mean=True),
    Panel("sd_cm", "simulation displacement SD [cm]", log=True),
    Panel("penetration_mm", "penetration [mm]"),
)
# Least value on a logarithmic axis [cm]. Smaller values are drawn at this value.
_LEAST = 0.01
# Greatest number of objects that a chart lists by name. A chart with more objects gives only their number.
_NAMED = 4


@dataclass(frozen=True)
class Point:
    """Point of one preset on a panel. `x` and `y` are (low, middle, high). `held` is True if any grasp held.

    Low and high are quartiles over objects. For one object, they are quartiles over grasps. For a share, they are the
    95 % interval.
    """

    name: str
    method: str
    x: tuple[float, float, float]
    y: tuple[float, float, float]
    held: bool


def draw_charts(records: Sequence[Record], path: Path) -> dict[str, Path]:
    """Draw all charts for which the records have data, as png and svg. Return the path of each png by chart's name.

    The files of chart "speed" are named `path`. Those of "short", "planned" and "ladder" end with _short and so on.
    """
    found = rows(records)
    swept = [row for row in found if is_sweep_value(row.name)]
    presets = by_name(row for row in found if is_preset(row.name))
    few = {name: group for name, group in presets.items() if is_few(name)}
    about, planned = (about_records(records, kind) for kind in ("raw", "verified"))
    drawn = {
        "speed": draw_speed(presets, path, about),
        "short": draw_speed(few, path.with_name(f"{path.name}_short"), about),
        "planned": draw_planned(by_name(rows(records, "verified")), path.with_name(f"{path.name}_planned"), planned),
        "ladder": draw_sweeps(swept, path.with_name(f"{path.name}_ladder")) if swept else None,
    }
    return {name: png for name, png in drawn.items() if png}


def about_records(records: Sequence[Record], kind: str) -> str:
    """Describe the runs of `kind` in two lines: hands, objects, grasps and meaning of error bars. "" if none ran."""
    rows = [r for r in records if r.get("kind") == kind and not r["error"] and is_preset(r["name"])]
    if not rows:
        return ""
    hands, objects = ([*dict.fromkeys(Path(r[key]).name for r in rows)] for key in ("hand", "object"))
    counts = Counter[str]()
    for record in rows:
        counts[record["name"]] += record["count"]
    few, most = min(counts.values()), max(counts.values())
    names = ", ".join(objects) if len(objects) <= _NAMED else f"{len(objects)} objects"
    number = f"{few}" if few == most else f"{few} to {most}"
    # Times are measured per run, so planned grasps of a single object have no bars.
    bars = "objects" if len(objects) > 1 else "grasps" if kind == "raw" else ""
    shares = ", the 95 % interval of a share" if kind == "raw" else ""
    note = f"; bars: quartiles over {bars}{shares}" if bars else ""
    return f"{', '.join(hands)}; {names}\nn = {number} grasps a preset{note}"


def draw_planned(presets: dict[str, list[Row]], path: Path, about: str = "") -> Path | None:
    """Draw CPU time per verified grasp against CPU time to the first one. Return the PNG's path. None without data."""
    panel = Panel("cpu_per_verified", "CPU seconds per verified grasp, all included")
    points = points_of(presets, "first_cpu", panel)
    if not points:
        return None
    with figure(4.8, 4.2, squeeze=False) as (made, axes):
        axis = axes[0][0]
        _draw_panel(axis, points, panel)
        axis.set_xscale("linear")
        axis.set_xlabel(f"CPU seconds to the first verified grasp\n{about}".strip())
        axis.set_xlim(left=0.0)
        names = [p.name for p in points]
        place_labels(axis, [(p.x[1], p.y[1]) for p in points], names, [method_row(p.method).colour for p in points])
        return save(made, path)


def draw_speed(presets: dict[str, list[Row]], path: Path, about: str = "") -> Path | None:
    """Draw each `PANELS` value against CPU seconds per raw grasp. Return the PNG's path, or None if data are missing.

    `about` is the text below the chart, from `about_records`.
    """
    panels = [(panel, points) for panel in PANELS if (points := points_of(presets, "cpu_per_grasp", panel))]
    if not panels:
        return None
    with figure(4.6 * len(panels), 4.4, ncols=len(panels), squeeze=False) as (made, axes):
        fronts = [_draw_panel(axis, points, panel) for axis, (panel, points) in zip(axes[0], panels, strict=True)]
        made.supxlabel(f"CPU seconds per raw grasp (one thread, log scale)\n{about}".strip(), fontsize=9)
        drawn = [point for _, points in panels for point in points]
        _legend(made, drawn, front=max(fronts) > 1)
        for axis, (_, points) in zip(axes[0], panels, strict=True):
            names, colours = [short_name(p.name) for p in points], [method_row(p.method).colour for p in points]
            place_labels(axis, [(p.x[1], p.y[1]) for p in points], names, colours)
        return save(made, path)


def points_of(presets: dict[str, list[Row]], time: str, panel: Panel) -> list[Point]:
    """Return a point for each preset that has both values: `time` and the panel's, in the unit of the panel's label."""
    points = []
    for name, group in presets.items():
        x, y = spread(group, time), spread(group, panel.figure)
        if x and y:
            heights = (y.low, y.mean if panel.mean else y.median, y.high)
            if panel.mean:
                low, high = share_interval(
                    round(sum((row.values[panel.figure] or 0.0) * row.count for row in group)),
                    sum(row.count for row in group),
                )
                heights = (min(low, y.mean), y.mean, max(high, y.mean))
            low, mid, high = (max(height * panel.factor, _LEAST if panel.log else 0.0) for height in heights)
            held = any(row.held for row in group)
            points.append(Point(name, group[0].method, (x.low, x.median, x.high), (low, mid, high), held))
    return points


def _draw_panel(axis: Any, points: Sequence[Point], panel: Panel) -> int:
    """Draw the points of a panel and their Pareto front. Return the number of points on the front."""
    place = {p.name: (p.x[1], p.y[1]) for p in points}
    for p in points:
        (x, y), method, parent = place[p.name], method_row(p.method), parent_of(p.name)
        colour = method.colour
        if parent in place:
            axis.plot(*zip(place[parent], (x, y), strict=True), color=colour, lw=0.8, ls=":", alpha=0.7, zorder=2)
        bars = {"xerr": _bars(*p.x), "yerr": _bars(*p.y)}
        axis.errorbar(x, y, **bars, fmt="none", ecolor=colour, elinewidth=1.0, alpha=0.45, zorder=3)
        filling = "white" if parent else colour
        style = {"color": colour, "ms": 7, "mew": 1.3, "mfc": filling, "ls": "none", "zorder": 5}
        axis.plot(x, y, method.marker, **style, clip_on=False)
    # A preset without any held grasp is drawn, but is not part of the front: its low penetration is no merit.
    spots = np.array([place[p.name] for p in points if p.held] or list(place.values()))
    front = spots[pareto_front(spots * [1.0, 1.0 if panel.less_is_better else -1.0])]
    axis.plot(*front[front[:, 0].argsort()].T, color=FRONT, lw=1.2, alpha=0.6, zorder=1)
    axis.set_xscale("log")
    axis.set_ylabel(panel.label)
    axis.margins(0.18, 0.1)
    _few_ticks(axis.xaxis)
    if panel.log:
        axis.set_yscale("log")
        _few_ticks(axis.yaxis)
    else:
        low, high = axis.get_ylim()
        axis.set_ylim((0.0, high) if panel.less_is_better else (max(0.0, low), 100.0))
    better = "left and down" if panel.less_is_better else "left and up"
    axis.set_title(f"better: {better}", fontsize=7.5, color="#666666")
    return len(front)


def _few_ticks(axis: Any) -> None:
    """Label a logarithmic axis with few round numbers. If it spans less than one decade, space the ticks evenly."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

    low, high = axis.get_view_interval()
    axis.set_major_locator(
        MaxNLocator(4) if high < 10 * low else LogLocator(subs=(1.0, 3.0) if high < 300 * low else (1.0,))
    )
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _bars(low: float, middle: float, high: float) -> list[list[float]]:
    return [[max(0.0, middle - low)], [max(0.0, high - middle)]]


def _legend(made: Any, points: Sequence[Point], *, front: bool) -> None:
    """Add a legend with the methods of the points, and with ablations and Pareto front if they are drawn."""
    from matplotlib.lines import Line2D

    plain = {"ls": "none", "ms": 7, "mew": 1.3}
    handles = [
        Line2D([], [], marker=method_row(m).marker, color=method_row(m).colour, label=method_row(m).label, **plain)
        for m in dict.fromkeys(point.method for point in points)
    ]
    if any(parent_of(point.name) for point in points):
        handles.append(Line2D([], [], marker="o", color="#666666", mfc="white", label="ablation", **plain))
    if front:
        handles.append(Line2D([], [], color=FRONT, lw=1.2, alpha=0.6, label="Pareto front"))
    made.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False, fontsize=8.5)


def draw_sweeps(found: Sequence[Row], path: Path) -> Path:
    """Draw hold success and CPU time over the values of each swept setting, one panel each. Return the PNG's path."""
    sweeps = {name: {} for name in SWEEPS}
    for name, group in by_name(found).items():
        sweep, sweep_value = name.split("=")
        sweeps[sweep][float(sweep_value)] = group
    present = {name: dict(sorted(sweep_values.items())) for name, sweep_values in sweeps.items() if sweep_values}
    with figure(3.2 * len(present), 3.0, ncols=len(present), squeeze=False, sharey=True) as (made, axes):
        seconds = [axis.twinx() for axis in axes[0]]
        for axis, second, (name, sweep_values) in zip(axes[0], seconds, present.items(), strict=True):
            _draw_line(axis, sweep_values, "standard", 100.0, _SUCCESS, "o-")
            _draw_line(second, sweep_values, "cpu_with_scene", 1.0, _TIME, "s--")
            axis.set_xscale("log", base=2)
            axis.set_xticks(list(sweep_values), [f"{sweep_value:g}" for sweep_value in sweep_values])
            axis.minorticks_off()
            axis.set_xlabel(_LABELS[name])
            axis.set_ylim(0.0, 100.0)
            second.grid(False)
            second.tick_params(axis="y", colors=_TIME, labelright=second is seconds[-1])
        for second in seconds:
            second.set_ylim(0.0, 1.1 * max(max(line.get_ydata()) for s in seconds for line in s.lines))
        axes[0][0].set_ylabel("hold success, raw [%]", color=_SUCCESS)
        axes[0][0].tick_params(axis="y", colors=_SUCCESS)
        seconds[-1].set_ylabel("CPU seconds per raw grasp,\nits share of the grid included", color=_TIME)
        return save(made, path)


def _draw_line(axis, sweep_values: dict[float, list[Row]], name: str, factor: float, colour: str, line: str) -> None:
    over = {sweep_value: found for sweep_value, group in sweep_values.items() if (found := spread(group, name))}
    axis.plot(list(over), [s.mean * factor for s in over.values()], line, color=colour, ms=4.5, lw=1.4, clip_on=False)
    low, high = ([getattr(s, end) * factor for s in over.values()] for end in ("low", "high"))
    axis.fill_between(list(over), low, high, color=colour, alpha=0.12, lw=0)
