"""Measure how often grasps planned on one view hold on the true object (`HeldShares` in planning_config).

    python benchmarks/held_shares.py --out shares.jsonl [--seeds 62:69] [--scans FOLDER]

Each seed gives one view of every object in `CHOSEN_ON` (three of `compound`), and of the five scans `SCANS` if FOLDER
has them and a stats.csv of masses. Four kinds of cameras take turns. Half of the views show neighbours. Each view is
planned without a mass and with the object's own mass. Doubted views give no grasps. A grasp that holds on the likeliest
shape runs every robustness check, and is tried on the true object at its own mass. Views in the file are skipped. A
view takes 15 CPU s.
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
from graspd_bench.studies.cameras import ASSUMED, CHOSEN_ON, GIVEN, CameraView, view_of
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
from graspd_core.verify.world import PROTOCOLS, build_world

SCANS = ("003_cracker_box", "006_mustard_bottle", "055_baseball", "025_mug", "011_banana")
SURE = CertaintyConfig().probability


def cases(seeds: range, scans: Path | None) -> Iterator[CameraView]:
    """Yield each view twice: without a given mass, and with the object's own mass."""
    things = [(thing, 0) for thing in (*CHOSEN_ON, *(str(scans / f"{name}.obj") for name in SCANS if scans))]
    things += [("compound", 100), ("compound", 200)]
    for seed in seeds:
        for place, (thing, other) in enumerate(things):
            camera, crowd = list(CAMERAS)[(seed + place) % 4], (seed // 4 + place) % 2 == 1
            for way in (ASSUMED, GIVEN):
                yield CameraView(thing, seed + other, camera, crowd, way, "allegro_right", "balanced", 8)


def grasps_of_view(case: CameraView) -> list[dict[str, Any]]:
    """Return a row per grasp that holds on the likeliest shape: passed checks, and if it holds on the true object."""
    stage, cloud, mass, target = view_of(case)
    hand, config = load_hand(case.hand), replace(load_preset(case.preset), certainty=CertaintyConfig(0.0))
    disk_cache.forget()
    scene = scene_from_views([cloud], target=target, mass=mass if case.way == GIVEN else None)
    assert scene.evidence is not None
    if scene.evidence.doubts:
        return []
    result = plan_grasps(scene, hand, count=case.count, seed=case.seed, preset=config, measure=False)
    tried = scene.object.at_mass(result.mass or scene.object.mass)
    known = replace(scene, object=replace(tried, mass_assumed=False))
    protocol, run = PROTOCOLS["standard"], Run(time.perf_counter(), None, None, None)
    worlds = build_worlds(known, hand, object_parts(known.object), protocol)
    asked = robustness_checks_of(known, begin_other_worlds(run, known, hand, protocol, SURE), worlds, SURE)
    truth = build_scene(stage.truth, source=case.thing, mass=mass)
    own = build_world(hand, truth.object, object_parts(truth.object), protocol)
    assert asked is not None
    rows = []
    for grasp in (grasp for grasp in result.tried if grasp.verdict is Verdict.VERIFIED):
        *others, of_places = [(item.hold(grasp, lambda: False) for item in stage.items) for stage in asked.stages]
        slippery, *places = (hold is not None and hold.passed for hold in of_places)
        shapes = [hold.passed for hold in others[0] if hold is not None] if others else []
        rows.append({
            "view": case.label, "way": case.way, "places": sum(places), "slippery": slippery,
            "shapes": sum(shapes), "of_shapes": len(shapes),
            "own": hold_trial(own, grasp, out_of_place(protocol)).passed,
        })  # fmt: skip
    return rows


def share(rows: list[dict[str, Any]]) -> str:
    """Return as text the fraction that holds on the true object, with the 90 % interval over resampled views."""
    views: dict[str, list[bool]] = {}
    for row in rows:
        views.setdefault(row["view"], []).append(row["own"])
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
    """Measure the views that the file lacks, add them to the file, and print the shares of grasps that hold."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", default="62:69")
    parser.add_argument("--scans", type=Path, default=None)
    options = parser.parse_args()
    lines = [json.loads(line) for line in options.out.read_text().splitlines()] if options.out.exists() else []
    with options.out.open("a") as file:
        for case in cases(range(*map(int, options.seeds.split(":"))), options.scans):
            if case.label in {line["view"] for line in lines}:
                continue
            try:
                lines.append({"view": case.label, "grasps": grasps_of_view(case)})
            except GraspdError as error:
                lines.append({"view": case.label, "grasps": [], "refused": str(error)})
            file.write(json.dumps(lines[-1]) + "\n")
            file.flush()
    rows = [row for line in lines for row in line["grasps"]]
    shaped = lambda row: row["shapes"] == row["of_shapes"]  # noqa: E731
    placed = lambda row: row["places"] == 3 and (row["way"] == ASSUMED or row["slippery"])  # noqa: E731
    for way in (ASSUMED, GIVEN):
        of = [row for row in rows if row["way"] == way]
        print(f"{way}: likeliest {share(of)}")
        print(f"  out of place {share([r for r in of if placed(r)])}")
        print(f"  and other shapes {share([r for r in of if placed(r) and shaped(r)])}")
        print(f"  fails out of place {share([r for r in of if shaped(r) and not placed(r)])}")
        print(f"  fails on other shapes {share([r for r in of if not shaped(r)])}")


if __name__ == "__main__":
    main()
