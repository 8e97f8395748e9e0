"""The chart of the ranking by robustness: what it buys at each place of the list, and what it costs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from graspd_core.bench.charts.chart_style import figure, save
from graspd_core.bench.studies.robust_ranking import orders
from graspd_core.bench.study import Record
from graspd_core.methods.method_registry import METHODS

_SCORE, _NOISE, _BEST = (METHODS[name].colour for name in ("graspd2022", "closed_form", "random_closure"))


def draw_robust(rows: Sequence[Record], path: Path) -> Path:
    """Share held by place on the left, CPU seconds by shape on the right. Returns the PNG's path."""
    with figure(8.0, 3.0, ncols=2) as (made, (gain, cost)):
        by_score, by_noise, best = (100.0 * order for order in orders(rows))
        places = np.arange(1, len(best) + 1)
        gain.plot(places, best, ":", color=_BEST, lw=1.4, label="best order there is")
        gain.plot(places, by_noise, "o-", color=_NOISE, ms=4.5, lw=1.4, label="ranked by noisy trials")
        gain.plot(places, by_score, "s--", color=_SCORE, ms=4.5, lw=1.4, label="ranked by score")
        gain.set_xticks(places)
        gain.set_xlabel("place in the list of verified grasps")
        gain.set_ylabel("held 5 mm and 5° out of place [%]")
        gain.legend(frameon=False, loc="lower left")
        shapes = list(dict.fromkeys(row["shape"] for row in rows))
        for key, offset, colour, label in (
            ("plan_cpu_s", -0.2, _SCORE, "without ranking"),
            ("ranked_plan_cpu_s", 0.2, _NOISE, "with ranking"),
        ):
            seconds = [np.mean([row[key] for row in rows if row["shape"] == shape]) for shape in shapes]
            cost.bar(np.arange(len(shapes)) + offset, seconds, 0.38, color=colour, label=label)
        cost.set_xticks(range(len(shapes)), shapes)
        cost.set_ylabel(f"CPU seconds for {len(best)} verified grasps")
        cost.set_ylim(0.0, 1.3 * cost.get_ylim()[1])
        cost.legend(frameon=False, ncols=2, loc="upper center")
        return save(made, path)
