"""Study `robust`: verified grasps ranked by score, the same grasps ranked by noisy trials, and the cost of both.

A noisy trial has a random pose error. Further noisy trials, with pulls of 2 s and other errors, evaluate both rankings.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from graspd_bench.charts import figure, save
from graspd_bench.study import ObjectCase, Picture, Record, Request, Sections, object_cases
from graspd_core.optimize.plan_config import method_row
from graspd_core.perception.scene import object_parts
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.types import Verdict
from graspd_core.verify.hold_trial import noisy_share, pose_errors
from graspd_core.verify.world import PROTOCOLS, at_friction, build_world
from graspd_dataset.run_records import markdown_table, object_name

# Shapes for which some grasps fail if the hand is displaced by up to 5 mm and 5°.
SHAPES = ("shape:box", "shape:plate", "shape:torus", "shape:bottle", "shape:l_block", "shape:hammer")
# Number of evaluation trials per grasp, and the seed of their errors, which no plan uses.
EVALUATIONS, EVALUATION_SEED = 16, 977
FRICTION = 0.6
_SCORE, _NOISE, _BEST = (method_row(name).colour for name in ("graspd2022", "closed_form", "random_closure"))


def robust_cases(request: Request) -> tuple[ObjectCase, ...]:
    """Return a case for each shape and seed."""
    return object_cases(request, SHAPES, 8)


def run_robust(case: ObjectCase) -> Record:
    """Plan with and without ranking by noisy trials. Return both CPU times, and three numbers for each verified grasp.

    The numbers are its score, and the fractions of ranking trials and of evaluation trials that it passes.
    """
    config = case.config
    ranked = replace(config, robust=replace(config.robust, rank=True))
    hand, scene = case.load(friction=FRICTION)
    # The convex parts are computed first, so that neither plan pays for them.
    parts = object_parts(scene.object)
    began = time.process_time()
    plain = plan_grasps(scene, hand, count=case.count, seed=case.seed, preset=config)
    between = time.process_time()
    robust = plan_grasps(scene, hand, count=case.count, seed=case.seed, preset=ranked)
    ended = time.process_time()
    shares = {g.score: g.metrics["robustness"] for g in robust.tried if g.metrics and g.verdict is Verdict.VERIFIED}
    protocol = at_friction(PROTOCOLS["standard"], FRICTION)
    world, errors = build_world(hand, scene.object, parts, protocol), pose_errors(EVALUATION_SEED, EVALUATIONS)
    verified = [g for g in plain.tried if g.verdict is Verdict.VERIFIED]
    return {
        "shape": object_name(case.object),
        "plan_cpu_s": between - began,
        "ranked_plan_cpu_s": ended - between,
        # The plan without ranking returns grasps in the order of the score. These lists have the same order.
        "score": [g.score for g in verified],
        "ranked_by": [shares[g.score] for g in verified],
        "shares": [noisy_share(world, g, protocol, errors) for g in verified],
    }


def robust_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return the chart, a table by shape (planning time, fraction of noisy trials held), and the rank correlations."""
    rows = [record for record in records if record["shares"]]
    if not rows:
        return {}
    headings = ["shape", "plan, CPU s", "with ranking", "first by score holds", "first by noise", "the best"]
    headings += ["first four by score", "first four by noise"]
    body = []
    for shape in [*dict.fromkeys(row["shape"] for row in rows), "all"]:
        here = [row for row in rows if shape in ("all", row["shape"])]
        costs = (np.mean([row[key] for row in here]) for key in ("plan_cpu_s", "ranked_plan_cpu_s"))
        score, noise, best = orders(here)
        gains = (score[0], noise[0], best[0], score[:4].mean(), noise[:4].mean())
        body.append([shape, *(f"{cost:.1f}" for cost in costs), *(f"{gain:.1%}" for gain in gains)])
    score, noise = (correlation(rows, key) for key in ("score", "ranked_by"))
    line = f"Rank correlation with the fraction held, within a plan, mean: score {score:.2f}, noise {noise:.2f}."
    picture = chart and Picture("What ranking buys at each place", draw_robust(rows, chart.with_name("robust")))
    return {"robust": [picture, markdown_table(headings, body), line]}


def orders(
    rows: Sequence[Record],
) -> tuple[Float[np.ndarray, "places"], Float[np.ndarray, "places"], Float[np.ndarray, "places"]]:
    """Return the mean fraction of trials held at each rank in three orders: by score, by noisy trials, best possible.

    There are as many ranks as the shortest plan has grasps. Ties in the noisy trials keep the order of the score.
    """
    places = min(len(row["shares"]) for row in rows)
    held = [np.array(row["shares"]) for row in rows]
    noise = [h[np.argsort(-np.array(row["ranked_by"]), kind="stable")] for h, row in zip(held, rows, strict=True)]
    best = [np.sort(h)[::-1] for h in held]
    by_score, by_noise, at_best = (np.mean([h[:places] for h in found], axis=0) for found in (held, noise, best))
    return by_score, by_noise, at_best


def correlation(rows: Sequence[Record], key: str) -> float:
    """Return `key`'s Spearman correlation with the fraction of trials held, mean over plans where both vary, or NaN."""
    from scipy.stats import rankdata

    found = [
        float(np.corrcoef(rankdata(row[key]), rankdata(row["shares"]))[0, 1])
        for row in rows
        if np.ptp(row[key]) > 0 and np.ptp(row["shares"]) > 0
    ]
    return float(np.mean(found)) if found else float("nan")


def draw_robust(rows: Sequence[Record], path: Path) -> Path:
    """Draw the fraction held over the rank (left), and planning CPU time by shape (right). Return the PNG's path."""
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
