"""Measure grasps per second of large requests: `python benchmarks/many_at_once.py [--device cuda] [--counts 64,1024]`.

Raw grasps are candidates without trials. A sample is tried in MuJoCo, outside the timed part. With `--threads`, the
program also plans verified grasps on CPU threads, with and without metrics. Amdahl's law gives the serial fraction.
"""

from __future__ import annotations

import argparse
import time

import torch

import graspd_core

SHAPES = ("mug", "box", "bowl")


def raw_rates(device: str, name: str, preset: str, count: int, sample: int) -> None:
    """Print raw grasps per second of each shape, for requests of `count`, and the share of a sample that holds."""
    hand, rates, shares = graspd_core.load_hand(name), [], []
    for shape in SHAPES:
        scene = graspd_core.load_scene(f"shape:{shape}")
        if shape == SHAPES[0]:
            # Warm up the device.
            graspd_core.plan_grasps(scene, hand, count=16, preset="fast", verify="none", measure=False, device=device)
        began = time.perf_counter()
        result = graspd_core.plan_grasps(
            scene, hand, count=count, preset=preset, verify="none", measure=False, device=device
        )
        seconds = time.perf_counter() - began
        rates.append(len(result.grasps) / seconds)
        tried = result.grasps[:: max(1, len(result.grasps) // sample)][:sample]
        held = graspd_core.verify_grasps(scene, hand, tried, measure=False)
        shares.append(sum(grasp.trials[0].passed for grasp in held) / len(tried))
        print(f"  {shape}: {rates[-1]:.0f} grasps/s, {100 * shares[-1]:.0f} % of {len(tried)} hold", flush=True)
    mean, held = sum(rates) / len(rates), sum(shares) / len(shares)
    print(f"{count} at once: {mean:.0f} raw grasps a second in the mean, {100 * held:.0f} % hold", flush=True)


def verified_rate(name: str, preset: str, count: int, measure: bool) -> float:
    """Return verified grasps per second over all shapes, on torch's number of threads."""
    hand, found, seconds = graspd_core.load_hand(name), 0, 0.0
    for shape in SHAPES:
        scene = graspd_core.load_scene(f"shape:{shape}")
        began = time.perf_counter()
        result = graspd_core.plan_grasps(scene, hand, count=count, preset=preset, measure=measure)
        seconds += time.perf_counter() - began
        found += sum(grasp.usable for grasp in result.grasps)
    return found / seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--hand", default="allegro_right")
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--counts", default="64,256,1024")
    parser.add_argument("--sample", type=int, default=32)
    parser.add_argument("--threads", default="")
    given = parser.parse_args()
    device = torch.cuda.get_device_name() if given.device.startswith("cuda") else given.device
    print(f"{device}, torch {torch.__version__}, {given.hand}, {given.preset}")
    for count in [int(word) for word in given.counts.split(",") if word]:
        raw_rates(given.device, given.hand, given.preset, count, given.sample)
    rates: dict[bool, dict[int, float]] = {False: {}, True: {}}
    for threads in [int(word) for word in given.threads.split(",") if word]:
        torch.set_num_threads(threads)
        for measure, row in rates.items():
            row[threads] = verified_rate(given.hand, given.preset, 32, measure)
            most, one = row[threads], row[min(row)]
            # Amdahl's law: if n threads have the speed-up s, the serial fraction is (n/s - 1)/(n - 1).
            serial = (threads * one / most - 1) / (threads - 1) if threads > 1 else 0.0
            kind = "with metrics" if measure else "without"
            print(f"{threads} threads: {most:.1f} verified a second {kind}, {100 * serial:.0f} % serial", flush=True)


if __name__ == "__main__":
    main()
