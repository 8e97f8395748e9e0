"""Do trials that stop early give the verdict of the full length, and what do they save? Not a test.

    python benchmarks/early_stop.py --out results/early_stop.jsonl [--hands allegro_right ...] [--objects mug sheet ...]
                                    [--scans DIR] [--seeds 0 1] [--count 4] [--preset balanced]
    python benchmarks/early_stop.py --out results/early_stop.jsonl --report    runs nothing

Of every hand, object and seed: the first grasps of the method's own ranking, none filtered by a trial. Each is tried as
it is and out of place, at standard and lower friction, hard, lifted, with the short pulls of the ranking by robustness,
and under gravity; each trial twice, early and at full length. What the file has already is not run again.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

HANDS = ("allegro_right", "leap_right", "barrett_like", "parallel_gripper", "allegro_left")
# Thin things: an authored shape, and factors on its three extents.
THIN = {"sheet": ("plate", (1.0, 1.0, 0.3)), "rod": ("box", (0.2, 0.2, 2.0)), "strip": ("box", (0.1, 0.5, 2.0))}
ERROR_SEED = 4711


def load_object(name: str, scans: Path | None, resolution: int) -> Any:
    """The scene of a thin thing, of a scan, or of an authored shape, by name."""
    from graspd_core.mesh.shapes import make_shape
    from graspd_core.scene.load_scene import load_scene
    from graspd_core.types import TriangleMesh

    if name in THIN:
        shape, factors = THIN[name]
        mesh = make_shape(shape)
        return load_scene(TriangleMesh(mesh.vertices * factors, mesh.faces), resolution=resolution)
    scan = scans and scans / f"{name}.obj"
    return load_scene(scan if scan and scan.exists() else f"shape:{name}", resolution=resolution)


def trials_of(hand: Any, scene: Any) -> Mapping[str, Callable[[Any, bool, Any], Any]]:
    """Trials by group: each takes a grasp, whether the trial lasts its full length, and the hand's error."""
    import numpy as np

    from graspd_core.config import RobustConfig
    from graspd_core.scene.scene import object_parts
    from graspd_core.trials.gravity_trial import gravity_trial
    from graspd_core.trials.hold_trial import hold_trial
    from graspd_core.trials.lift_trial import lift_trial
    from graspd_core.trials.noisy_trial import displaced
    from graspd_core.trials.world import PROTOCOLS, at_friction, build_world
    from graspd_core.types import Plane

    parts, center = object_parts(scene.object), scene.object.center_of_mass

    def moved(grasp: Any, error: Any) -> Any:
        return displaced(grasp, error[0], error[1], center)

    standard, hard = PROTOCOLS["standard"], PROTOCOLS["hard"]
    slippery, brief = at_friction(standard, 0.3), replace(standard, hold_time=RobustConfig().hold_time)
    usual, low, harder = (build_world(hand, scene.object, parts, p) for p in (standard, slippery, hard))
    # Too far below for the hand; the object rests on a plane of its own.
    table = Plane(np.array([0.0, 0.0, 1.0]), float(scene.object.mesh.vertices[:, 2].min()) - 1.0)
    around = build_world(hand, scene.object, parts, standard, table)

    def long(protocol: Any, full: bool) -> Any:
        return replace(protocol, full_length=full)

    return {
        "standard": lambda g, full, error: hold_trial(usual, g, long(standard, full)),
        "displaced": lambda g, full, error: hold_trial(usual, moved(g, error), long(standard, full)),
        "slippery": lambda g, full, error: hold_trial(low, g, long(slippery, full)),
        "hard": lambda g, full, error: hold_trial(harder, g, long(hard, full)),
        "lift": lambda g, full, error: lift_trial(around, hand, g, long(standard, full)),
        "noisy": lambda g, full, error: hold_trial(usual, moved(g, error), long(brief, full)),
        "gravity": lambda g, full, error: gravity_trial(usual, g, long(standard, full)),
    }


def cell_rows(hand_name: str, thing: str, seed: int, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Both lengths of every trial of the grasps of one hand, object and seed."""
    import torch

    from graspd_core.hands.library import load_hand
    from graspd_core.methods.candidates import find_candidates
    from graspd_core.methods.loop import Hooks
    from graspd_core.methods.plan_config import load_preset
    from graspd_core.trials.noisy_trial import pose_errors

    torch.set_num_threads(1)
    config = load_preset(options.preset)
    hand = load_hand(hand_name, candidates=config.problem.fine_candidates)
    scene = load_object(thing, options.scans, config.resolution)
    found = find_candidates(scene, hand, count=options.count, seed=seed, config=config, hooks=Hooks())
    grasps = found.grasps[: options.count]
    if not grasps:
        return []
    trials, errors = trials_of(hand, scene), pose_errors((ERROR_SEED, seed), len(grasps))
    return [
        {
            "group": group,
            "index": index,
            "early": run(trial, grasp, False, error),
            "late": run(trial, grasp, True, error),
        }
        for index, (grasp, error) in enumerate(zip(grasps, errors, strict=True))
        for group, trial in trials.items()
        if group in options.groups
    ]


def run(trial: Callable[[Any, bool, Any], Any], grasp: Any, full: bool, error: Any) -> dict[str, Any]:
    """One trial: what it said, and its CPU time [ms]."""
    began = time.thread_time()
    result = trial(grasp, full, error)
    said = {"figure": result} if isinstance(result, float) else {"passed": result.passed, "reason": result.reason}
    return {**said, "ms": (time.thread_time() - began) * 1e3}


def report(cells: list[dict[str, Any]]) -> str:
    """Disagreements and CPU time by group as Markdown."""
    from scipy.stats import beta

    groups: dict[str, list[dict[str, Any]]] = {}
    for cell in cells:
        for row in cell["rows"]:
            groups.setdefault(row["group"], []).append(row)
            if row["group"] == "standard" and cell["object"] in THIN:
                groups.setdefault("of standard, thin", []).append(row)
            if row["group"] == "standard" and cell["object"][:3].isdigit():
                groups.setdefault("of standard, scans", []).append(row)
    lines = [
        "| group | trials | passed | wrongly verified | at most (95 %) | wrongly failed | CPU ms, all: full, early "
        "| passing: full, early |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, rows in groups.items():
        if name == "gravity":
            worst = max(abs(row["early"]["figure"] - row["late"]["figure"]) for row in rows)
            lines.append(
                f"| gravity | {len(rows)} | – | at most {worst * 1e3:.3f} mm off | – | – | {_costs(rows)} | – |"
            )
            continue
        said = [row for row in rows if row["early"]["passed"]]
        wrong = sum(not row["late"]["passed"] for row in said)
        missed = sum(row["late"]["passed"] and not row["early"]["passed"] for row in rows)
        bound = float(beta.ppf(0.95, wrong + 1, len(said) - wrong)) if wrong < len(said) else 1.0
        passing = [row for row in said if row["late"]["passed"]]
        counts = f"{len(rows)} | {len(said)} | {wrong} | {bound:.2%} | {missed}"
        lines.append(f"| {name} | {counts} | {_costs(rows)} | {_costs(passing)} |")
    return "\n".join([*lines, "", *_disagreements(cells)])


def _costs(rows: list[dict[str, Any]]) -> str:
    means = (sum(row[way]["ms"] for row in rows) / max(len(rows), 1) for way in ("late", "early"))
    return ", ".join(f"{mean:.1f}" for mean in means)


def _disagreements(cells: list[dict[str, Any]]) -> Iterator[str]:
    for cell in cells:
        for row in cell["rows"]:
            if row["early"].get("passed") != row["late"].get("passed"):
                place = f"{cell['hand']}, {cell['object']}, seed {cell['seed']}, grasp {row['index']}, {row['group']}"
                yield f"- {place}: early {row['early']}, full {row['late']}"


def main() -> None:
    from graspd_core.mesh.shapes import SHAPES

    groups = ("standard", "displaced", "slippery", "hard", "lift", "noisy", "gravity")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/early_stop.jsonl"))
    parser.add_argument("--hands", nargs="+", default=list(HANDS), metavar="NAME")
    parser.add_argument("--objects", nargs="*", default=[*SHAPES, *THIN], metavar="NAME")
    parser.add_argument("--scans", type=Path, default=None, metavar="DIR", help="of .obj files, all of them tried too")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--count", type=int, default=4, help="grasps of each hand, object and seed")
    parser.add_argument("--groups", nargs="+", choices=groups, default=list(groups), metavar="NAME")
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--report", action="store_true", help="run nothing")
    options = parser.parse_args()
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    cells = [json.loads(line) for line in lines]
    known = {(cell["hand"], cell["object"], cell["seed"]) for cell in cells}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    scans = sorted(options.scans.glob("*.obj")) if options.scans else []
    objects = dict.fromkeys([*options.objects, *(path.stem for path in scans)])
    for seed in [] if options.report else options.seeds:
        for thing in objects:
            for hand in options.hands:
                if (hand, thing, seed) not in known:
                    rows = cell_rows(hand, thing, seed, options)
                    cells.append({"hand": hand, "object": thing, "seed": seed, "rows": rows})
                    with options.out.open("a") as file:
                        file.write(json.dumps(cells[-1]) + "\n")
                    print(f"{hand}, {thing}, seed {seed}: {len(rows)} trials", flush=True)
    print(report(cells))


if __name__ == "__main__":
    main()
