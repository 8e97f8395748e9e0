"""Raw grasps a second on a device: `python benchmarks/cuda.py [--device cuda] [--counts 64,1024] [--out FOLDER]`.

Search alone, no trial and no metric. With `--out` the grasps of each row are written, for `--judge FOLDER` to try a
sample of them in MuJoCo, on a machine that has it.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch

import graspd_core

SHAPES = ("mug", "box", "bowl", "sphere", "cylinder")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--hand", default="allegro_right")
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--counts", default="64,256,1024")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--judge", type=Path)
    parser.add_argument("--sample", type=int, default=64)
    given = parser.parse_args()
    if given.judge:
        judge(given.judge, given.hand, given.sample)
        return
    hand = graspd_core.load_hand(given.hand)
    name = torch.cuda.get_device_name() if given.device.startswith("cuda") else given.device
    print(f"{name}, torch {torch.__version__}, {torch.get_num_threads()} threads, {given.hand}, {given.preset}")
    for count in map(int, given.counts.split(",")):
        rates = []
        for shape in SHAPES:
            scene = graspd_core.load_scene(f"shape:{shape}")
            seconds = []
            for seed in range(given.repeats):
                began = time.perf_counter()
                result = graspd_core.plan_grasps(
                    scene, hand, count=count, seed=seed, preset=given.preset, verify="none", measure=False,
                    device=given.device,
                )  # fmt: skip
                seconds.append((time.perf_counter() - began) / len(result.grasps))
            # The first run warms the device up.
            rates.append(1 / min(seconds[1:] or seconds))
            if given.out:
                given.out.mkdir(parents=True, exist_ok=True)
                graspd_core.save_result(given.out / f"{shape}-{count}.json", result, scene, hand)
            print(f"  {shape} {count}: {rates[-1]:.0f} grasps/s, {result.timing.optimise:.2f} s of search", flush=True)
        print(f"{count} grasps at once: mean {sum(rates) / len(rates):.0f} raw grasps a second", flush=True)


def judge(folder: Path, name: str, sample: int) -> None:
    hand = graspd_core.load_hand(name)
    for path in sorted(folder.glob("*.json")):
        scene = graspd_core.load_scene(f"shape:{path.stem.split('-')[0]}")
        grasps = graspd_core.load_grasps(path)
        grasps = grasps[:: max(1, len(grasps) // sample)][:sample]
        held = sum(bool(g.trials and g.trials[0].passed) for g in graspd_core.verify_grasps(scene, hand, grasps, measure=False))
        print(f"{path.stem}: {held} of {len(grasps)} hold")


if __name__ == "__main__":
    main()
