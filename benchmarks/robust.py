"""What does ranking by robustness cost, and what does it buy? Not a test.

    python benchmarks/robust.py --out results/robust.json [--shapes torus hammer ...] [--seeds 0 1] [--count 8]
    python benchmarks/robust.py --out results/robust.json --report [--chart docs/figures/robust]    runs nothing

Of every shape and seed, as many verified grasps as asked for, in the order of the optimiser's score; then the same
grasps in the order of the noisy trial. Both orders are judged by noisy trials of other errors, with pulls of 2 s.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

# Shapes whose grasps do not all survive an error of 5 mm and 5°.
SHAPES = ("box", "plate", "torus", "bottle", "l_block", "hammer")
PRESET = "balanced"
# Errors of the evaluating trials: as many for each grasp, from a seed that no plan draws from.
EVALUATIONS, EVALUATION_SEED = 16, 977


def shape_row(shape: str, seed: int, count: int, friction: float) -> dict:
    """One plan with ranking, split into its costs; what each grasp was ranked by, and what it really holds."""
    import torch

    from graspd_core.hands.library import load_hand
    from graspd_core.methods.plan_config import load_preset
    from graspd_core.planning.plan_grasps import plan_grasps
    from graspd_core.scene.load_scene import load_scene
    from graspd_core.scene.scene import object_parts
    from graspd_core.trials.noisy_trial import noisy_share, pose_errors
    from graspd_core.trials.world import PROTOCOLS, at_friction, build_world
    from graspd_core.types import Verdict

    torch.set_num_threads(1)
    config = load_preset(PRESET)
    ranked = replace(config, robust=replace(config.robust, rank=True))
    hand = load_hand("allegro_right", candidates=config.problem.fine_candidates)
    scene = load_scene(f"shape:{shape}", resolution=config.resolution, friction=friction)
    # First-use work of libraries belongs to neither run.
    parts = object_parts(scene.object)
    plan_grasps(scene, hand, count=1, seed=seed, preset="fast")
    began = time.process_time()
    plain = plan_grasps(scene, hand, count=count, seed=seed, preset=config)
    between = time.process_time()
    robust = plan_grasps(scene, hand, count=count, seed=seed, preset=ranked)
    ended = time.process_time()
    shares = {g.score: g.metrics["robustness"] for g in robust.grasps if g.metrics and g.verdict is Verdict.VERIFIED}
    protocol = at_friction(PROTOCOLS["standard"], friction)
    world, errors = build_world(hand, scene.object, parts, protocol), pose_errors(EVALUATION_SEED, EVALUATIONS)
    verified = [g for g in plain.grasps if g.verdict is Verdict.VERIFIED]
    return {
        "shape": shape,
        "seed": seed,
        "friction": friction,
        "plan_cpu_s": between - began,
        "ranked_plan_cpu_s": ended - between,
        # In the order of the score, as a plan without ranking gives them.
        "score": [g.score for g in verified],
        "ranked_by": [shares[g.score] for g in verified],
        "held": [noisy_share(world, g, protocol, errors) for g in verified],
    }


def report(rows: list[dict]) -> str:
    """Costs and gains as Markdown."""
    from graspd_core.bench.robustness import correlation, orders

    lines = [
        "| shape | plan, CPU s | with ranking | first by score holds | first by noise | the best "
        "| first four by score | first four by noise |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for shape in [*dict.fromkeys(row["shape"] for row in rows), "all"]:
        here = [row for row in rows if shape in ("all", row["shape"])]
        plan, ranked = (sum(row[key] for row in here) / len(here) for key in ("plan_cpu_s", "ranked_plan_cpu_s"))
        score, noise, best = orders(here)
        shares = (score[0], noise[0], best[0], score[:4].mean(), noise[:4].mean())
        lines.append(f"| {shape} | {plan:.1f} | {ranked:.1f} | " + " | ".join(f"{s:.1%}" for s in shares) + " |")
    score, noise = (correlation(rows, key) for key in ("score", "ranked_by"))
    lines += ["", f"Rank correlation with the share held, within a plan, mean: score {score:.2f}, noise {noise:.2f}."]
    return "\n".join(lines)


def main() -> None:
    from graspd_core.mesh.shapes import SHAPES as KNOWN

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/robust.json"))
    parser.add_argument("--shapes", nargs="+", choices=KNOWN, default=list(SHAPES), metavar="SHAPE")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--count", type=int, default=8, help="verified grasps of each plan")
    parser.add_argument("--friction", type=float, default=0.6, help="of the objects")
    parser.add_argument("--report", action="store_true", help="run nothing")
    parser.add_argument("--chart", type=Path, default=None, metavar="PATH", help="without ending: PNG and SVG")
    options = parser.parse_args()
    rows = json.loads(options.out.read_text()) if options.report else []
    options.out.parent.mkdir(parents=True, exist_ok=True)
    for seed in [] if options.report else options.seeds:
        for shape in options.shapes:
            rows.append(shape_row(shape, seed, options.count, options.friction))
            options.out.write_text(json.dumps(rows, indent=1) + "\n")
            print(f"{shape}, seed {seed}: {rows[-1]['held']}", flush=True)
    print(report(rows))
    if options.chart:
        from graspd_core.bench.charts.robustness_chart import draw_robust

        print(draw_robust(rows, options.chart))


if __name__ == "__main__":
    main()
