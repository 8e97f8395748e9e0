"""How charts look: light, printable, told apart by shape as well as by colour; and labels that keep apart."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

# Colours of Okabe and Ito (2008), which the colour-blind can tell apart; a marker's shape says the same.
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
# The line from a label that stands far off to its point.
_LEADER = {"arrowstyle": "-", "lw": 0.5, "alpha": 0.6, "shrinkA": 0, "shrinkB": 3}
# Where a label may stand about its point, in points of print; the nearest free place is taken.
_ANGLES = np.deg2rad([0, 180, 90, 270, 45, 135, 315, 225, 22, 158, 202, 338, 67, 113, 247, 293])
_DISTANCES = (7.0, 13.0, 20.0, 28.0, 38.0, 50.0, 64.0)


@contextmanager
def figure(width: float, height: float, **grid: Any) -> Iterator[tuple[Any, Any]]:
    """A figure and its axes in the common style [inches]; closed at the end."""
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
    """Write PNG and SVG, the same bytes for the same data; returns the PNG's path."""
    png, svg = path.with_name(f"{path.name}.png"), path.with_name(f"{path.name}.svg")
    png.parent.mkdir(parents=True, exist_ok=True)
    made.savefig(png, dpi=160, metadata={"Software": None})
    made.savefig(svg, metadata={"Date": None, "Creator": None})
    return png


def place_labels(
    axes: Any, points: Sequence[tuple[float, float]], texts: Sequence[str], colours: Sequence[str]
) -> None:
    """Write a label beside each point of an axes, clear of the points, of other labels and of the frame.

    Call it last: it needs the final layout.
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
    """Centre of a label whose nearest edge is that far from its point."""
    way = np.array([np.cos(angle), np.sin(angle)])
    return point + way * distance + np.sign(np.round(way, 6)) * half * np.abs(way) ** 0.5


def _trouble(place: np.ndarray, half: np.ndarray, taken: Sequence[tuple[float, ...]], frame: Any) -> float:
    """Area that a label would share with what is there, or have outside the frame; ties go to the first place."""
    low, high = place - half, place + half
    shared = 0.0
    for x0, y0, x1, y1 in taken:
        shared += max(0.0, min(high[0], x1) - max(low[0], x0)) * max(0.0, min(high[1], y1) - max(low[1], y0))
    outside = max(0.0, frame.x0 - low[0]) + max(0.0, high[0] - frame.x1)
    outside += max(0.0, frame.y0 - low[1]) + max(0.0, high[1] - frame.y1)
    return shared + 50.0 * outside
