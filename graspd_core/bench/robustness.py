"""Figures of the ranking by robustness, from the rows of benchmarks/robust.py."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

Row = dict[str, Any]


def orders(
    rows: Sequence[Row],
) -> tuple[Float[np.ndarray, "places"], Float[np.ndarray, "places"], Float[np.ndarray, "places"]]:
    """Mean share held at each place, first to last: by score, by the noisy trial, and in the best order there is.

    As many places as the shortest plan has grasps. Grasps that are level keep the order of the score.
    """
    places = min(len(row["held"]) for row in rows)
    held = [np.array(row["held"]) for row in rows]
    noise = [h[np.argsort(-np.array(row["ranked_by"]), kind="stable")] for h, row in zip(held, rows, strict=True)]
    best = [np.sort(h)[::-1] for h in held]
    by_score, by_noise, at_best = (np.mean([h[:places] for h in found], axis=0) for found in (held, noise, best))
    return by_score, by_noise, at_best


def correlation(rows: Sequence[Row], key: str) -> float:
    """Spearman's rank correlation of a figure with the share held, within each plan, mean over plans that differ."""
    from scipy.stats import rankdata

    found = [
        float(np.corrcoef(rankdata(row[key]), rankdata(row["held"]))[0, 1])
        for row in rows
        if np.ptp(row[key]) > 0 and np.ptp(row["held"]) > 0
    ]
    return float(np.mean(found)) if found else float("nan")
