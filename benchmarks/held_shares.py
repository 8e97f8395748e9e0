"""How often grasps of a single view hold on the true thing, by what they hold under: `HeldShares` of planning_config.

    python benchmarks/held_shares.py --out shares.jsonl [--seeds 12] [--scans FOLDER]

Every thing of `CHOSEN_ON` is seen once a seed, and so are five scans, `SCANS`, of a folder that also has a stats.csv of
masses. Four kinds of cameras take turns, and every other view is crowded. Of the grasps that hold on the likeliest
shape, each is tried under every hypothesis, and on the truth at its own mass and at the mass that planning supposed.
Views that are in the file already are not seen again. A view takes ten CPU seconds.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from graspd_bench.rendering.depth_noise import CAMERAS
from graspd_bench.studies.cameras import CHOSEN_ON, CameraView, view_of
from graspd_core.config import CertaintyConfig
from graspd_core.errors import GraspdError
from graspd_core.hands.library import load_hand
from graspd_core.optimize.plan_config import load_preset
from graspd_core.perception.scene import build_scene, object_parts
from graspd_core.perception.scene_from_views import scene_from_views
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.runtime import disk_cache
from graspd_core.types import Verdict
from graspd_core.verify.hold_trial import hold_trial, out_of_place
from graspd_core.verify.robustness import begin_other_worlds, robustness_checks_of
from graspd_core.verify.run_clock import Run
from graspd_core.verify.trial_registry import build_worlds
from graspd_core.verify.world import PROTOCOLS, altered, build_world

SCANS = ("003_cracker_box", "006_mustard_bottle", "055_baseball", "025_mug", "011_banana")
SURE = CertaintyConfig().probability


def cases(seeds: int, scans: Path | None) -> Iterator[CameraView]:
    """The views that shares are taken from."""
    things = (*CHOSEN_ON, *(str(scans / f"{name}.obj") for name in SCANS if scans))
    for seed in range(seeds):
        for place, thing in enumerate(things):
            camera, crowd = list(CAMERAS)[(seed + place) % 4], (seed // 4 + place) % 2 == 1
            yield CameraView(thing, seed, camera, crowd, "", "allegro_right", "balanced", 8)


def grasps_of_view(case: CameraView) -> list[dict[str, Any]]:
    """What each grasp holds under that holds on the likeliest shape, and on the truth."""
    stage, cloud, mass, target = view_of(case)
    hand, config = load_hand(case.hand), replace(load_preset(case.preset), certainty=CertaintyConfig(0.0))
    disk_cache.forget()
    scene = scene_from_views([cloud], target=target)
    result = plan_grasps(scene, hand, count=case.count, seed=case.seed, preset=config, measure=False)
    tried = scene.object.at_mass(result.mass or scene.object.mass)
    known = replace(scene, object=replace(tried, mass_assumed=False))
    protocol, run = PROTOCOLS["standard"], Run(time.perf_counter(), None, None, None)
    worlds = build_worlds(known, hand, object_parts(known.object), protocol)
    asked = robustness_checks_of(known, begin_other_worlds(run, known, hand, protocol, SURE), worlds, SURE)
    truth = build_scene(stage.truth, source=case.thing, mass=mass)
    own = build_world(hand, truth.object, object_parts(truth.object), protocol)
    as_tried, loose = altered(own, mass=tried.mass), out_of_place(protocol)
    assert asked is not None
    rows = []
    for grasp in (grasp for grasp in result.tried if grasp.verdict is Verdict.VERIFIED):
        holds = [[item.hold(grasp, lambda: False) for item in stage.items] for stage in asked.stages]
        *places, slippery = (hold is not None and hold.passed for hold in holds[0])
        shapes = [hold.passed for hold in holds[1] if hold is not None] if len(holds) > 1 else []
        rows.append({
            "view": case.label, "lowered": result.mass is not None, "places": sum(places), "slippery": slippery,
            "shapes": sum(shapes), "of_shapes": len(shapes), "own": hold_trial(own, grasp, loose).passed,
            "tried": hold_trial(as_tried, grasp, loose).passed,
        })  # fmt: skip
    return rows


def share(rows: list[dict[str, Any]], truth: str) -> str:
    """Of the grasps that hold, and the 90 % interval that resampling the views gives."""
    views: dict[str, list[bool]] = {}
    for row in rows:
        views.setdefault(row["view"], []).append(row[truth])
    counts, rng = (
        np.array([(sum(holds), len(holds)) for holds in views.values()]).reshape(-1, 2),
        np.random.default_rng(0),
    )
    if not len(counts):
        return "none"
    drawn = counts[rng.integers(len(counts), size=(2000, len(counts)))].sum(1)
    low, high = np.quantile(drawn[:, 0] / drawn[:, 1], [0.05, 0.95])
    held, of = counts.sum(0)
    return f"{held / of:.3f} ({low:.3f} to {high:.3f}) of {of} in {len(counts)} views"


def main() -> None:
    """Fill the file, and print the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--scans", type=Path, default=None)
    options = parser.parse_args()
    lines = [json.loads(line) for line in options.out.read_text().splitlines()] if options.out.exists() else []
    with options.out.open("a") as file:
        for case in cases(options.seeds, options.scans):
            if case.label in {line["view"] for line in lines}:
                continue
            try:
                lines.append({"view": case.label, "grasps": grasps_of_view(case)})
            except GraspdError as error:
                lines.append({"view": case.label, "grasps": [], "refused": str(error)})
            file.write(json.dumps(lines[-1]) + "\n")
            file.flush()
    rows = [row for line in lines for row in line["grasps"]]
    full, lowered = ([row for row in rows if row["lowered"] is less] for less in (False, True))
    two = lambda row: row["shapes"] >= min(2, row["of_shapes"])  # noqa: E731
    most = lambda row: row["places"] >= 2  # noqa: E731
    every = lambda row: row["places"] == 3 and row["slippery"]  # noqa: E731
    for name, of, placed, truth in (
        ("mass assumed", full, most, "own"),
        ("mass known", rows, every, "tried"),
        ("mass lowered", lowered, every, "own"),
    ):
        print(f"{name}: likeliest {share(of, truth)}")
        print(f"  out of place {share([r for r in of if placed(r)], truth)}")
        print(f"  and two shapes {share([r for r in of if placed(r) and two(r)], truth)}")
        print(f"  fails out of place {share([r for r in of if not placed(r)], truth)}")
        print(f"  fails on shapes {share([r for r in of if placed(r) and not two(r)], truth)}")


if __name__ == "__main__":
    main()
