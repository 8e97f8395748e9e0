"""The foundation's figures: raw hold success, penetration, speed, first verified grasp, memory. Not a test.

    python benchmarks/foundation.py --out results/foundation.json --readme README.md [--meshes DIR] [--compare OLD.json]

Raw means: the first `count` grasps of the optimiser's own ranking, each tried, none filtered by a trial. DIR holds
mesh files in metres (scans, say); without it only the authored shapes run.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

COUNT, BATCH, SEED = 16, 32, 0
BEGIN, END = "<!-- results:begin -->", "<!-- results:end -->"


def raw_trials(source: str, preset: str, seed: int = SEED) -> dict:
    """Hold success and static metrics of the raw grasps of one object."""
    import numpy as np
    import torch

    from graspd_core.config import load_preset
    from graspd_core.geometry.scene import object_parts
    from graspd_core.metrics.judge import make_judge
    from graspd_core.metrics.quality import measure
    from graspd_core.optimise.solver import Hooks
    from graspd_core.optimise.synthesis import synthesise
    from graspd_core.pipeline import load_hand, load_scene
    from graspd_core.verify.trial import hold_trial
    from graspd_core.verify.world import PROTOCOLS, build_world

    torch.set_num_threads(1)
    config = load_preset(preset)
    hand = load_hand("allegro_right", candidates=config.closed_form.fine_candidates)
    scene = load_scene(source, resolution=config.resolution)
    began = time.perf_counter()
    found = synthesise(scene, hand, count=COUNT, seed=seed, config=config, hooks=Hooks())
    optimise = time.perf_counter() - began
    began = time.perf_counter()
    parts = object_parts(scene.object)
    decompose = time.perf_counter() - began
    protocol = PROTOCOLS["standard"]
    world, judge = build_world(hand, scene.object, parts, protocol), make_judge(scene.object, hand)
    began = time.perf_counter()
    holds = [hold_trial(world, grasp, protocol) for grasp in found.grasps[:COUNT]]
    trials = time.perf_counter() - began
    metrics = [measure(judge, grasp.grasp) for grasp in found.grasps[:COUNT]]
    postures = [p for g in found.grasps[:COUNT] for p in (g.pregrasp, g.grasp, g.squeeze)]
    broken = max(
        float(np.maximum(hand.lower - p.joint_positions, p.joint_positions - hand.upper).max()) for p in postures
    )
    return {
        "object": Path(source).stem if os.sep in source else source,
        "held": sum(h.passed for h in holds),
        "of": COUNT,
        "penetration_mm": [m.penetration * 1e3 for m in metrics],
        "self_penetration_mm": [m.self_penetration * 1e3 for m in metrics],
        "contact_area_cm2": [m.contact_area * 1e4 for m in metrics],
        "contact_links": [m.contact_links for m in metrics],
        "epsilon": [m.epsilon for m in metrics],
        "limit_excess_rad": broken,
        "reasons": [h.reason for h in holds if not h.passed],
        "seconds": {"optimise": optimise, "parts": decompose, "trials": trials},
        "parts": len(parts),
    }


def speed(preset: str, threads: int) -> dict:
    """Raw grasps at one batch, after a first run that is not counted: seconds per grasp, best and median of three."""
    import torch

    from graspd_core.config import load_preset
    from graspd_core.optimise.solver import Hooks
    from graspd_core.optimise.synthesis import synthesise
    from graspd_core.pipeline import load_hand, load_scene

    torch.set_num_threads(threads)
    config = load_preset(preset)
    hand = load_hand("allegro_right", candidates=config.closed_form.fine_candidates)
    scene = load_scene("shape:cylinder")
    seconds = []
    for run in range(4):
        began = time.perf_counter()
        synthesise(scene, hand, count=BATCH, seed=run, config=config, hooks=Hooks())
        seconds.append((time.perf_counter() - began) / BATCH)
    return {"threads": threads, "batch": BATCH, "best": min(seconds[1:]), "median": sorted(seconds[1:])[1]}


def memory(preset: str, batch: int = 64) -> dict:
    """Peak memory of this process [MB] after a batch, the imports included."""
    import torch

    from graspd_core.pipeline import load_hand, load_scene, plan_grasps

    torch.set_num_threads(1)
    plan_grasps(load_scene("shape:mug"), load_hand("allegro_right"), count=batch, preset=preset, verify="none")
    return {"batch": batch, "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}


def first_verified(source: str, preset: str) -> dict:
    """Seconds from the request to the first verified grasp: a fresh process without a cache, and one that is warm."""
    environment = {**os.environ, "GRASPD_CACHE": "off", "OMP_NUM_THREADS": "1"}
    code = (
        "import sys, time\n"
        "import torch; torch.set_num_threads(1)\n"
        "from graspd_core.pipeline import load_hand, load_scene, plan_grasps, warm_up\n"
        "source, preset, warm = sys.argv[1:]\n"
        "hand = load_hand('allegro_right')\n"
        "if warm == 'warm': warm_up(hand)\n"
        "began = time.perf_counter()\n"
        "result = plan_grasps(load_scene(source), hand, count=1, preset=preset)\n"
        "print(time.perf_counter() - began, [str(g.verdict) for g in result.grasps][:1] == ['verified'])\n"
    )

    def run(kind: str) -> tuple[float, float, bool]:
        began = time.perf_counter()
        out = subprocess.run(
            [sys.executable, "-c", code, source, preset, kind],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        inside, verified = out.stdout.split()
        return time.perf_counter() - began, float(inside), verified == "True"

    whole, _, verified = run("fresh")
    _, warm, again = run("warm")
    return {"object": Path(source).stem, "fresh_process_s": whole, "warm_s": warm, "verified": verified and again}


def table(results: dict) -> str:
    """The results as Markdown."""
    import numpy as np

    def rows(cases: list[dict]) -> list[str]:
        lines = []
        for case in cases:
            median = {k: float(np.median(case[k])) for k in ("penetration_mm", "contact_area_cm2", "contact_links")}
            lines.append(
                f"| {case['object']} | {case['held']}/{case['of']} | {median['penetration_mm']:.2f} "
                f"| {max(case['self_penetration_mm']):.2f} | {median['contact_area_cm2']:.1f} "
                f"| {median['contact_links']:.0f} | {float(np.median(case['epsilon'])):.3f} |"
            )
        share = float(np.mean([c["held"] / c["of"] for c in cases]))
        depth = float(np.median(np.concatenate([c["penetration_mm"] for c in cases])))
        worst = max(max(c["self_penetration_mm"]) for c in cases)
        return [*lines, f"| **mean** | **{share:.1%}** | {depth:.2f} | {worst:.2f} | | | |"]

    head = (
        "| object | held, raw | penetration mm, median | self-penetration mm, worst | contact area cm² | links | ε |\n"
        "|---|---|---|---|---|---|---|"
    )
    lines = [f"Preset `{results['preset']}`, seed {SEED}, {results['machine']}.", "", "Authored shapes:", "", head]
    lines += rows(results["shapes"])
    if results["meshes"]:
        lines += ["", "Scanned YCB objects (not shipped):", "", head, *rows(results["meshes"])]
    lines += ["", "| speed and size | |", "|---|---|"]
    for case in results["speed"]:
        lines.append(
            f"| raw grasps, batch {case['batch']}, {case['threads']} torch thread(s) "
            f"| {case['median']:.3f} s each (best run {case['best']:.3f}) |"
        )
    for case in results["first_verified"]:
        lines.append(
            f"| first verified grasp, {case['object']}, no cache | {case['fresh_process_s']:.1f} s in a fresh process, "
            f"{case['warm_s']:.1f} s in a warm one |"
        )
    lines.append(f"| peak memory, batch {results['memory']['batch']} | {results['memory']['peak_mb']:.0f} MB |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/foundation.json"))
    parser.add_argument("--readme", type=Path, default=None, help="file whose results section is rewritten")
    parser.add_argument("--meshes", type=Path, default=None, help="folder of meshes in metres")
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--compare", type=Path, default=None, help="results of an earlier run")
    parser.add_argument("--processes", type=int, default=max(1, min(2, os.cpu_count() or 1)))
    options = parser.parse_args()
    from graspd_core.geometry.shapes import SHAPES

    meshes = sorted(options.meshes.glob("*.obj")) if options.meshes else []
    sources = [f"shape:{name}" for name in SHAPES] + [str(m) for m in meshes]
    # Speed first, alone on the machine; every figure that a process can spoil gets a process of its own.
    fresh = {"max_workers": 1, "mp_context": get_context("spawn"), "max_tasks_per_child": 1}
    with ProcessPoolExecutor(**fresh) as alone:
        speeds = [alone.submit(speed, options.preset, threads).result() for threads in (1, 2)]
        peak = alone.submit(memory, options.preset).result()
    timed = [str(m) for m in meshes if any(k in m.stem for k in ("mug", "mustard", "drill"))] or ["shape:mug"]
    firsts = [first_verified(source, options.preset) for source in timed]
    with ProcessPoolExecutor(options.processes, mp_context=get_context("spawn")) as pool:
        cases = list(pool.map(raw_trials, sources, [options.preset] * len(sources)))
    results = {
        "preset": options.preset,
        "machine": f"{os.cpu_count()} cores, Python {platform.python_version()}",
        "shapes": cases[: len(SHAPES)],
        "meshes": cases[len(SHAPES) :],
        "speed": speeds,
        "first_verified": firsts,
        "memory": peak,
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(results, indent=1) + "\n")
    print(table(results))
    if options.readme:
        text = options.readme.read_text()
        before, after = text.split(BEGIN)[0], text.split(END)[1]
        options.readme.write_text(f"{before}{BEGIN}\n{table(results)}\n{END}{after}")
    if options.compare:
        old = {
            c["object"]: c["held"] for key in ("shapes", "meshes") for c in json.loads(options.compare.read_text())[key]
        }
        for case in cases:
            if case["object"] in old and old[case["object"]] != case["held"]:
                print(f"{case['object']}: {old[case['object']]} -> {case['held']} of {case['of']} held")


if __name__ == "__main__":
    main()
