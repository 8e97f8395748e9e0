"""Does the second simulator agree? Hold and displacement trials of the same grasps in MuJoCo and PyBullet. Not a test.

    python benchmarks/simulators.py --out results/simulators.json [--grasps 4] [--hold 2.0] [--shapes mug bowl ...]

Of every authored shape, the first grasps of the optimiser's own ranking, none filtered by a trial, and each of them
once more with the hand out of place by up to 5 mm and 5°, as in the noisy trial, so that failures are among them.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, replace
from pathlib import Path

SEED = 0


def shape_trials(shape: str, grasps: int, hold_time: float, preset: str = "balanced") -> list[dict]:
    """Both simulators on the grasps of one shape: a row each."""
    import numpy as np
    import torch

    from graspd_core.bench.bullet.bullet_displacement import bullet_displacement
    from graspd_core.bench.bullet.bullet_hold import bullet_hold_trial
    from graspd_core.bench.bullet.bullet_world import build_bullet_world
    from graspd_core.hands.library import load_hand
    from graspd_core.methods.candidates import find_candidates
    from graspd_core.methods.loop import Hooks
    from graspd_core.methods.plan_config import load_preset
    from graspd_core.scene.load_scene import load_scene
    from graspd_core.scene.scene import object_parts
    from graspd_core.trials.displacement_trial import build_frozen_world, displacement_trial
    from graspd_core.trials.hold_trial import hold_trial
    from graspd_core.trials.noisy_trial import displaced, pose_error
    from graspd_core.trials.world import PROTOCOLS, build_world

    torch.set_num_threads(1)
    config = load_preset(preset)
    hand = load_hand("allegro_right", candidates=config.problem.fine_candidates)
    scene = load_scene(f"shape:{shape}", resolution=config.resolution)
    found = find_candidates(scene, hand, count=grasps, seed=SEED, config=config, hooks=Hooks()).grasps[:grasps]
    parts = object_parts(scene.object)
    standard = PROTOCOLS["standard"]
    short = replace(standard, hold_time=hold_time)
    world = build_world(hand, scene.object, parts, standard)
    bullet, frozen = build_bullet_world(hand, scene.object, parts), build_frozen_world(hand, scene.object, parts)
    rng = np.random.default_rng(SEED)
    cases = [(False, g) for g in found] + [(True, displaced(g, *pose_error(rng), world.center_of_mass)) for g in found]
    rows = []
    for moved, grasp in cases:
        began = time.process_time()
        second = bullet_hold_trial(bullet, grasp, short)
        bullet_seconds = time.process_time() - began
        rows.append(
            {
                "shape": shape,
                "displaced": moved,
                "mujoco": asdict(hold_trial(world, grasp, short)),
                "mujoco_full": asdict(hold_trial(world, grasp, standard)),
                "bullet": asdict(second),
                "bullet_cpu_s": bullet_seconds,
                "sd_bullet": bullet_displacement(bullet, grasp.grasp),
                "sd_mujoco": displacement_trial(frozen, grasp.grasp),
            }
        )
    return rows


def report(rows: list[dict]) -> str:
    """The confusion table, every disagreement with both reasons, and the displacements side by side, as Markdown."""
    import numpy as np

    def count(mujoco: bool, bullet: bool) -> int:
        return sum(r["mujoco"]["passed"] == mujoco and r["bullet"]["passed"] == bullet for r in rows)

    agreed = (count(True, True) + count(False, False)) / len(rows)
    same = sum(r["mujoco"]["passed"] == r["mujoco_full"]["passed"] for r in rows)
    lines = [
        f"{agreed:.1%} of {len(rows)} grasps judged alike; MuJoCo judges {same} as it does in 2 s.",
        "",
        "| | PyBullet holds | PyBullet drops |",
        "|---|---|---|",
        f"| **MuJoCo holds** | {count(True, True)} | {count(True, False)} |",
        f"| **MuJoCo drops** | {count(False, True)} | {count(False, False)} |",
        "",
    ]
    for row in rows:
        if row["mujoco"]["passed"] != row["bullet"]["passed"]:
            kind = "displaced" if row["displaced"] else "as planned"
            lines.append(f"* {row['shape']}, {kind}: MuJoCo {_said(row['mujoco'])}; PyBullet {_said(row['bullet'])}")
    pairs = np.array([[r["sd_bullet"], r["sd_mujoco"]] for r in rows]) * 100
    alike = float((np.abs(pairs[:, 0] - pairs[:, 1]) < 0.5).mean())
    lines += [
        "",
        f"Displacement trial: mean {pairs[:, 0].mean():.2f} cm in PyBullet, {pairs[:, 1].mean():.2f} cm in MuJoCo, "
        f"median {np.median(pairs[:, 0]):.2f} and {np.median(pairs[:, 1]):.2f} cm; within 5 mm of each other on "
        f"{alike:.1%}, correlation {np.corrcoef(pairs.T)[0, 1]:.2f}.",
    ]
    return "\n".join(lines)


def _said(hold: dict) -> str:
    return hold["reason"] or f"holds ({hold['displacement'] * 100:.1f} cm, {hold['rotation'] * 57.3:.0f}°)"


def main() -> None:
    from graspd_core.mesh.shapes import SHAPES

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/simulators.json"))
    parser.add_argument("--grasps", type=int, default=4, help="of each shape; as many again out of place")
    parser.add_argument("--hold", type=float, default=2.0, help="seconds of each pull, in both simulators")
    parser.add_argument("--shapes", nargs="+", choices=SHAPES, default=list(SHAPES), metavar="SHAPE")
    options = parser.parse_args()
    rows = []
    options.out.parent.mkdir(parents=True, exist_ok=True)
    for shape in options.shapes:
        rows += shape_trials(shape, options.grasps, options.hold)
        # Kept at every step: the whole takes a quarter of an hour.
        options.out.write_text(json.dumps(rows, indent=1) + "\n")
        print(f"{shape}: {len(rows)} trials", flush=True)
    print(report(rows))


if __name__ == "__main__":
    main()
