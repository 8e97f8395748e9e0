"""Measure the cost of a library of grasps: cold and warm look-ups, a node's answers, and memory. Not a test.

    python benchmarks/known_objects.py [--objects 1000] [--grasps 8] [--node]

Grasps are planned once for each built-in shape. An object is a randomly scaled shape, but the object's record holds the
grasps of the unscaled shape. This is enough, because only time and memory are measured. `--node` also times a node in
another process over DDS, from the request to the answer.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

# One thread. The variable must be set before torch is imported.
os.environ.update(OMP_NUM_THREADS="1")

import numpy as np

from graspd_core import Grasp, GraspLibrary, Scene, load_hand, load_preset, load_scene, plan_grasps
from graspd_core.library.grasp_library import entry_of
from graspd_core.library.known_grasps import Physics, entry_by_name, library_result
from graspd_core.mesh.shapes import SHAPES
from graspd_core.runtime.worker_process import resident_mb

PHYSICS = Physics(mass=0.1, friction=0.6)
STEPS = (100, 1000)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", type=int, default=1000)
    parser.add_argument("--grasps", type=int, default=8, help="grasps per object")
    parser.add_argument("--hand", default="allegro_right")
    parser.add_argument("--node", action="store_true", help="ask a node too")
    parser.add_argument("--cold", type=Path, default=None, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.cold:
        print(cold_look_up(options.cold, options.hand, options.grasps))
        return
    with tempfile.TemporaryDirectory() as directory:
        library = GraspLibrary(Path(directory) / "known.grasps")
        for step in (*(step for step in STEPS if step < options.objects), options.objects):
            began = time.process_time()
            fill(library, step, options.hand, options.grasps)
            print(
                f"{step} objects: {library.path.stat().st_size / 1e6:.1f} MB, {time.process_time() - began:.1f} CPU s"
            )
            measure_look_ups(library, options.hand, options.grasps)
            if options.node:
                measure_node(library, options.hand, options.grasps)


def fill(library: GraspLibrary, objects: int, hand_name: str, count: int) -> None:
    """Add scaled copies of planned records until the library has `objects` objects."""
    library.create()
    hand, config, random = load_hand(hand_name), load_preset("fast"), np.random.default_rng(objects)
    there = library.names()
    shapes = sorted(SHAPES)
    for number in range(len(there), objects):
        scene, grasps = planned(shapes[number % len(shapes)], hand_name, count)
        scale = float(random.uniform(0.7, 1.3))
        copy = {"name": f"object{number}", "scale": scale, "mesh_sha256": f"{number:064}"}
        entry = replace(entry_of(scene.object, hand, "standard"), **copy)
        library.add(entry, scene.object, hand, config, grasps)


@cache
def planned(shape: str, hand_name: str, count: int) -> tuple[Scene, Sequence[Grasp]]:
    """Return a shape's scene, and the grasps that are planned for it."""
    scene = load_scene(f"shape:{shape}")
    return scene, plan_grasps(scene, load_hand(hand_name), count=count, preset="fast").tried


def measure_look_ups(library: GraspLibrary, hand_name: str, count: int) -> None:
    """Print the time from an object's name to a GraspResult, cold and warm, and the memory."""
    command = [sys.executable, __file__, "--cold", str(library.path), "--hand", hand_name, "--grasps", str(count)]
    cold = [float(subprocess.run(command, capture_output=True, text=True, check=True).stdout) for _ in range(10)]
    tell("look-up, cold: first of a process", cold)
    hand, names = load_hand(hand_name), library.names()
    drawn = np.random.default_rng(0).choice(names, 1000)
    tell("look-up, warm", [timed(lambda name=name: look_up(library, hand, name, count)) for name in drawn])
    print(f"  memory of this process afterwards: {resident_mb(os.getpid()):.0f} MB")


def look_up(library: GraspLibrary, hand, name: str, count: int):
    entry = entry_by_name(library, hand, str(name), PHYSICS)
    return library_result(library, library.grasps(entry, hand)[:count], count, 0.0)


def cold_look_up(path: Path, hand_name: str, count: int) -> float:
    hand, library = load_hand(hand_name), GraspLibrary(path)
    return timed(lambda: look_up(library, hand, "object7", count))


def timed(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def tell(what: str, seconds: Sequence[float]) -> None:
    p50, p99 = np.percentile(seconds, [50, 99]) * 1e3
    print(f"  {what}: p50 {p50:.1f} ms, p99 {p99:.1f} ms ({len(seconds)} times)", flush=True)


def measure_node(library: GraspLibrary, hand_name: str, count: int) -> None:
    """Print the time from a request on ~/request to its answer on ~/grasps, and the memory of the node."""
    import rclpy
    from graspd_msgs.msg import GraspArray, GraspRequest

    parameters = {"grasp_library": library.path, "hand": hand_name, "num_grasps": count}
    arguments = [part for name, value in parameters.items() for part in ("-p", f"{name}:={value}")]
    command = [sys.executable, "-m", "graspd_ros.node", "--ros-args", *arguments]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    rclpy.init()
    node = rclpy.create_node("asks")
    answers: dict[str, GraspArray] = {}

    def keep(message: GraspArray) -> None:
        answers[message.request_id] = message

    node.create_subscription(GraspArray, "/graspd/grasps", keep, 100)
    publisher = node.create_publisher(GraspRequest, "/graspd/request", 100)

    def ask(request_id: str, name: str) -> None:
        publisher.publish(GraspRequest(id=request_id, source=GraspRequest.KNOWN, known_object=name))
        while request_id not in answers:
            rclpy.spin_once(node, timeout_sec=0.001)
        answer = answers.pop(request_id)
        if len(answer.grasps) < count:
            raise RuntimeError(answer.message)

    try:
        while not (publisher.get_subscription_count() and node.count_publishers("/graspd/grasps")):
            rclpy.spin_once(node, timeout_sec=0.1)
        # While the node warms up its hand, it accepts requests but does not answer them.
        time.sleep(30.0)
        print(f"  node, cold: first request {timed(lambda: ask('first', 'object7')) * 1e3:.1f} ms")
        drawn = np.random.default_rng(1).choice(library.names(), 500)
        tell("node, warm", [timed(lambda i=i, name=name: ask(f"r{i}", str(name))) for i, name in enumerate(drawn)])
        print(f"  memory of the node afterwards: {resident_mb(process.pid):.0f} MB")
    finally:
        node.destroy_node()
        rclpy.shutdown()
        process.terminate()
        process.wait()


if __name__ == "__main__":
    main()
