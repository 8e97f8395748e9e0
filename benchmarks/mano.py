"""Human grasps in the units of the Grasp'D paper: contact area, intersection volume, displacement. Not a test.

    python benchmarks/mano.py MANO_RIGHT.pkl [--objects shape:sphere shape:mug scan.obj] [--betas 0.5 -1] [--out FILE]
    python benchmarks/mano.py --synthetic

Plans grasps of a human hand with the model that the user brings (https://mano.is.tue.mpg.de; never shipped), tries all
in the hold trial, and measures the two best ranked of every object, as the paper does. Area and volume are those of the
skinned mesh; the hold trial and the displacement trial use the convex hulls that stand for it. The paper's row is of 57
ShapeNet objects: these are other objects.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from tempfile import TemporaryDirectory

COUNT, BEST = 8, 2
# Turpin et al. 2022, table 1, MANO: mean over 57 ShapeNet objects of the two best grasps each.
PAPER = {"Grasp'D": (43.0, 5.70, 7.55, 0.59), "ObMan / GraspIt!": (9.4, 1.28, 7.37, 1.95)}
HEAD = (
    "| object | held, raw | contact area cm² within 2 mm (5, 10) | intersection cm³ | CA/IV 1/cm | displacement cm "
    "| penetration mm |\n|---|---|---|---|---|---|---|"
)


def case(model: Path, source: str, betas: list[float], preset: str, seed: int) -> dict:
    """Plan on one object, try every grasp, measure the best."""
    import torch

    from graspd_core.bench.bullet.bullet_displacement import bullet_displacement
    from graspd_core.bench.bullet.bullet_world import build_bullet_world, bullet_available
    from graspd_core.hands.mano.mano_hand import load_mano
    from graspd_core.mesh.mesh_distance import make_distance_query
    from graspd_core.methods.candidates import find_candidates
    from graspd_core.methods.loop import Hooks
    from graspd_core.methods.plan_config import load_preset
    from graspd_core.metrics.skin_metrics import measure_skin
    from graspd_core.scene.load_scene import load_scene
    from graspd_core.scene.scene import object_parts
    from graspd_core.trials.hold_trial import hold_trial
    from graspd_core.trials.world import PROTOCOLS, build_world

    torch.set_num_threads(1)
    config = load_preset(preset)
    mano = load_mano(model, betas, candidates=config.problem.fine_candidates)
    scene = load_scene(source, resolution=config.resolution)
    began = time.process_time()
    found = find_candidates(scene, mano.model, count=COUNT, seed=seed, config=config, hooks=Hooks())
    seconds = (time.process_time() - began) / COUNT
    parts = object_parts(scene.object)
    world = build_world(mano.model, scene.object, parts, PROTOCOLS["standard"])
    holds = [hold_trial(world, grasp, PROTOCOLS["standard"]) for grasp in found.grasps[:COUNT]]
    query = make_distance_query(scene.object.mesh)
    skins = [measure_skin(query, mano.skinned_mesh(grasp.grasp)) for grasp in found.grasps[:BEST]]
    bullet = build_bullet_world(mano.model, scene.object, parts) if bullet_available() else None
    moved = [bullet_displacement(bullet, grasp.grasp) for grasp in found.grasps[:BEST]] if bullet else []
    return {
        "object": source,
        "held": sum(hold.passed for hold in holds),
        "of": COUNT,
        "reasons": [hold.reason for hold in holds if not hold.passed],
        "contact_area_cm2": [[area * 1e4 for area in skin.contact_area] for skin in skins],
        "intersection_volume_cm3": [skin.intersection_volume * 1e6 for skin in skins],
        "penetration_mm": [skin.penetration * 1e3 for skin in skins],
        "displacement_cm": [d * 100 for d in moved],
        "cpu_seconds_per_grasp": seconds,
    }


def table(cases: list[dict]) -> str:
    """The cases, their mean, and the paper's rows, as Markdown."""
    import numpy as np

    def row(name: str, held: str, figures: list[dict]) -> str:
        area = np.mean([a for c in figures for a in c["contact_area_cm2"]], axis=0)
        volume, depth = (
            float(np.mean([x for c in figures for x in c[key]]))
            for key in ("intersection_volume_cm3", "penetration_mm")
        )
        moved = [x for c in figures for x in c["displacement_cm"]]
        shown = f"{np.mean(moved):.2f}" if moved else "no pybullet"
        ratio = f"{area[0] / volume:.2f}" if volume > 0 else "none"
        return (
            f"| {name} | {held} | {area[0]:.1f} ({area[1]:.1f}, {area[2]:.1f}) | {volume:.2f} | {ratio} | {shown} "
            f"| {depth:.1f} |"
        )

    measured = [c for c in cases if c["contact_area_cm2"]]
    lines = [HEAD, *(row(c["object"], f"{c['held']}/{c['of']}", [c]) for c in measured)]
    lines += [f"| {c['object']} | no grasp found | | | | | |" for c in cases if c not in measured]
    if measured:
        share = float(np.mean([c["held"] / c["of"] for c in cases]))
        lines.append(row("**mean**", f"{share:.0%}", measured))
    for name, (area, volume, ratio, moved) in PAPER.items():
        lines.append(f"| {name}, as published | | {area} | {volume:.2f} | {ratio} | {moved} | |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, nargs="?", help="MANO_RIGHT.pkl or MANO_LEFT.pkl")
    parser.add_argument("--synthetic", action="store_true", help="a made-up hand of the same format instead")
    parser.add_argument("--objects", nargs="+", default=["shape:sphere", "shape:cylinder", "shape:box"])
    parser.add_argument("--betas", type=float, nargs="*", default=[])
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=None, help="JSON file")
    options = parser.parse_args()
    if (options.model is None) != options.synthetic:
        parser.error("give either a MANO file or --synthetic")
    with TemporaryDirectory() as folder:
        model = options.model
        if options.synthetic:
            from mano_synthetic import write_synthetic

            model = Path(folder) / "synthetic.pkl"
            write_synthetic(model)
        cases = []
        for source in options.objects:
            cases.append(case(model, source, options.betas, options.preset, options.seed))
            print(f"{source}: {cases[-1]['cpu_seconds_per_grasp']:.2f} s of CPU a grasp", flush=True)
    print(table(cases))
    if options.out:
        options.out.write_text(json.dumps(cases, indent=1) + "\n")


if __name__ == "__main__":
    main()
