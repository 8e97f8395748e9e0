"""Plan for a folder of objects: python examples/many_objects.py OUT OBJECT ... (files, folders or shape:NAME).

The program writes a JSON file for each object, and a table. An unusable object gets a line and does not end the run.
The same command resumes a stopped run. Several processes, each on one core, share the work.
"""

from __future__ import annotations

import csv
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path

import torch

import graspd_core as graspd

ENDINGS = (".obj", ".stl", ".ply", ".off", ".glb", ".dae")
HAND, PRESET, COUNT = "allegro_right", "fast", 4


@cache
def hand() -> graspd.HandModel:
    """Load the hand once per process. Use one thread, because the processes fill the cores."""
    torch.set_num_threads(1)
    return graspd.load_hand(HAND)


def objects(arguments: Sequence[str]) -> Iterator[str]:
    """Yield every object that the arguments name."""
    for argument in arguments:
        folder = Path(argument)
        if folder.is_dir():
            yield from sorted(str(path) for path in folder.rglob("*") if path.suffix in ENDINGS)
        else:
            yield argument


def verified(grasps: Sequence[graspd.Grasp]) -> int:
    """Return how many grasps held."""
    return sum(grasp.verdict is graspd.Verdict.VERIFIED for grasp in grasps)


def plan(out: Path, source: str) -> tuple[str, int, str]:
    """Plan for an object. Return the object, its number of verified grasps, and the outcome."""
    path = out / f"{source.replace('shape:', '').replace('/', '_')}.json"
    try:
        if path.exists():
            return source, verified(graspd.load_grasps(path)), "done before"
        scene, preset = graspd.load_scene(source), graspd.load_preset(PRESET)
        result = graspd.plan_grasps(scene, hand(), count=COUNT, preset=preset, deadline=60.0)
        graspd.save_result(path, result, scene.object, hand(), preset)
    except graspd.GraspdError as error:
        return source, 0, str(error)
    return source, verified(result.grasps), result.outcome.name.lower()


def main(arguments: Sequence[str], processes: int | None = None) -> int:
    """Plan for all objects, write the table, and return the number of objects without a verified grasp."""
    out, *named = arguments or ["grasps"]
    out, sources = Path(out), list(objects(named or ["shape:mug", "shape:box"]))
    with ProcessPoolExecutor(processes or os.cpu_count(), mp_context=get_context("spawn")) as pool:
        rows = list(pool.map(partial(plan, out), sources))
    out.mkdir(exist_ok=True)
    with (out / "objects.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("object", "verified", "ending"), *rows])
    for source, count, ending in rows:
        print(f"{count:>3} verified  {source}: {ending}")
    return sum(count == 0 for _, count, _ in rows)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
