"""Chart of the settings sweeps: one setting at a time, hold success and CPU seconds against its value."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from graspd_core.bench.charts.chart_style import figure, save
from graspd_core.bench.figures import Row, by_name, spread
from graspd_core.bench.suites import SWEEPS
from graspd_core.methods.method_registry import METHODS

_LABELS = {
    "candidates": "contact candidates",
    "directions": "disturbance directions",
    "resolution": "grid nodes a side",
    "steps": "steps",
}
_SUCCESS, _TIME = METHODS["closed_form"].colour, METHODS["graspd2022"].colour


def draw_sweeps(found: Sequence[Row], path: Path) -> Path:
    """Draw a panel for every sweep. Returns the PNG's path."""
    sweeps = {name: {} for name in SWEEPS}
    for name, group in by_name(found).items():
        sweep, sweep_value = name.split("=")
        sweeps[sweep][float(sweep_value)] = group
    present = {name: dict(sorted(sweep_values.items())) for name, sweep_values in sweeps.items() if sweep_values}
    with figure(3.2 * len(present), 3.0, ncols=len(present), squeeze=False, sharey=True) as (made, axes):
        seconds = [axis.twinx() for axis in axes[0]]
        for axis, second, (name, sweep_values) in zip(axes[0], seconds, present.items(), strict=True):
            _draw(axis, sweep_values, "standard", 100.0, _SUCCESS, "o-")
            _draw(second, sweep_values, "cpu_with_scene", 1.0, _TIME, "s--")
            axis.set_xscale("log", base=2)
            axis.set_xticks(list(sweep_values), [f"{sweep_value:g}" for sweep_value in sweep_values])
            axis.minorticks_off()
            axis.set_xlabel(_LABELS[name])
            axis.set_ylim(-4.0, 104.0)
            second.grid(False)
            second.tick_params(axis="y", colors=_TIME, labelright=second is seconds[-1])
        for second in seconds:
            second.set_ylim(0.0, 1.1 * max(max(line.get_ydata()) for s in seconds for line in s.lines))
        axes[0][0].set_ylabel("hold success, raw [%]", color=_SUCCESS)
        axes[0][0].tick_params(axis="y", colors=_SUCCESS)
        seconds[-1].set_ylabel("CPU seconds per raw grasp,\nits share of the grid included", color=_TIME)
        return save(made, path)


def _draw(axis, sweep_values: dict[float, list[Row]], name: str, factor: float, colour: str, line: str) -> None:
    """Mean over objects, with quartiles as a band."""
    over = {sweep_value: found for sweep_value, group in sweep_values.items() if (found := spread(group, name))}
    axis.plot(list(over), [s.mean * factor for s in over.values()], line, color=colour, ms=4.5, lw=1.4)
    low, high = ([getattr(s, end) * factor for s in over.values()] for end in ("low", "high"))
    axis.fill_between(list(over), low, high, color=colour, alpha=0.12, lw=0)
