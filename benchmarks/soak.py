"""A node under mixed load for minutes: does its memory stay flat, does it answer in time, does each request end once?

    python benchmarks/soak.py --minutes 10 [--out results/soak.json]

Three processes besides this one's client: the node (with a timer of its own to measure by), a camera of 640×480 at
30 Hz, and a control that only ticks: how late that comes is the machine's doing. Nothing is mocked. Prints a Markdown
table, and what of the targets is met.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

PARTS = Path(__file__).with_name("soak_parts.py")
SAMPLE_PERIOD = 5.0  # seconds between two looks at the node's memory
SETTLED = 0.2  # share of the time after which memory is expected to be flat
GROWTH = 0.05  # most that memory may grow after that
# Most that the 99th percentile of a wait may be [ms]; of those whose names begin so, the longest counts.
LIMITS = {
    "timer lateness in the node": 50.0,
    "trivial service": 50.0,
    "request to first progress": 200.0,
    "cancel to answer": 300.0,
}


def main() -> int:
    """Run, print the table and the targets; 1 when one of them is not met."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--out", type=Path, help="figures as JSON")
    options = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from graspd_core.paths import config_dir

    with tempfile.TemporaryDirectory() as folder:
        os.environ |= {
            "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "FASTRTPS_DEFAULT_PROFILES_FILE": str(config_dir() / "fastdds.xml"),
            "XDG_CACHE_HOME": folder,
            "ROS_LOG_DIR": folder,
        }
        figures = soak(Path(folder), options.minutes * 60)
    figures["targets"] = targets(figures)
    print(table(figures))
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(figures, indent=1) + "\n")
    return int(not all(figures["targets"].values()))


def soak(folder: Path, seconds: float) -> dict[str, Any]:
    """Start the processes, keep them busy, gather the figures."""
    from soak_client import SCENES, Client  # it imports ROS, which reads the environment set above

    from graspd_core.mesh.mesh_files import save_mesh
    from graspd_core.mesh.shapes import make_shape

    for shape in ("sphere", "mug", "box"):
        save_mesh(make_shape(shape), folder / f"{shape}.obj")
    notes = folder / "node.jsonl"
    parameters = ["--ros-args", "-p", "cloud_policy:=off", "-p", "queue_size:=4"]
    log = (folder / "node.log").open("w")
    run_node = [sys.executable, str(PARTS), "node", str(notes), *parameters]
    node = subprocess.Popen(run_node, cwd=folder, stdout=log, stderr=log)
    camera = control = None
    try:
        client = Client()
        client.wait(lambda: client.ready or node.poll() is not None, "the node to be ready")
        if not client.ready:
            sys.exit(f"soak: the node did not start:\n{(folder / 'node.log').read_text()}")
        camera, control = [
            subprocess.Popen([sys.executable, str(PARTS), part, str(seconds)], stdout=subprocess.PIPE, text=True)
            for part in ("camera", "control")
        ]
        memory = Memory(node.pid)
        end = time.monotonic() + seconds
        script = random.Random(0)
        while time.monotonic() < end and node.poll() is None:
            script.choice(SCENES)(client, script)
        alive = node.poll() is None
        client.settle()
        sent = int(camera.communicate(timeout=60)[0] or 0)
        ticks = json.loads(control.communicate(timeout=60)[0] or "[]")
        time.sleep(6.0)  # the node's last notes
        memory.stop()
        node.terminate()
        node.wait(10)
    finally:
        for process in (node, camera, control):
            if process is not None and process.poll() is None:
                process.kill()
    noted: dict[str, list[float]] = {"late": [], "ages": []}
    for line in notes.read_text().splitlines():
        for key, values in json.loads(line).items():
            noted[key] += values
    cache = sum(path.stat().st_size for path in (folder / "graspd").glob("*")) / 1e6
    figures = client.figures()
    waits = {name: spread(values) for name, values in sorted(figures.pop("waits").items())}
    return figures | memory.figures() | {
        "seconds": seconds,
        "alive": alive,
        "waits": {
            "timer lateness in the node": spread(noted["late"]),
            "lateness of a process that only ticks": spread(ticks),
            **waits,
            "cloud age": spread(noted["ages"]),
        },
        "clouds sent": sent,
        "clouds received": len(noted["ages"]),
        "cloud age, medians of the first and last tenth [ms]": tenths(noted["ages"]),
        "disk cache [MB]": cache,
    }  # fmt: skip


class Memory:
    """Samples the resident memory of the node and its children."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._samples: list[float] = []
        self._over = threading.Event()
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        from graspd_ros.diagnostics import resident_memory

        while not self._over.wait(SAMPLE_PERIOD) and (memory := resident_memory(self._pid)):
            self._samples.append(memory / 1e6)

    def stop(self) -> None:
        self._over.set()

    def figures(self) -> dict[str, Any]:
        """Growth: the median of the last fifth over that of the first fifth after settling; None: unknown."""
        flat = self._samples[int(SETTLED * len(self._samples)) :]
        fifth = max(len(flat) // 5, 1)
        growth = float(np.median(flat[-fifth:]) / np.median(flat[:fifth]) - 1) if len(flat) > 1 else None
        return {"memory [MB]": [round(value) for value in self._samples], "growth": growth}


def targets(figures: dict[str, Any]) -> dict[str, bool]:
    """What is expected of the node, and whether it did so; what was not measured is not met."""
    growth = figures["growth"]
    met = {
        "the node is alive at the end": figures["alive"],
        "no request is lost": figures["requests"] > 0 and not figures["lost"],
        "none is answered twice": not figures["twice"],
        "the client waits for nothing in vain": not figures["timeouts"],
        f"memory grows by {GROWTH:.0%} at most": growth is not None and growth <= GROWTH,
    }
    for begin, limit in LIMITS.items():
        found = [s["p99"] for name, s in figures["waits"].items() if name.startswith(begin) and s]
        met[f"{begin}: p99 below {limit:.0f} ms"] = bool(found) and max(found) < limit
    return met


def spread(values: list[float]) -> dict[str, float]:
    """Median, 99th percentile and greatest [ms]."""
    if not values:
        return {}
    median, p99 = np.percentile(values, [50, 99]) * 1e3
    return {"n": len(values), "p50": float(median), "p99": float(p99), "max": max(values) * 1e3}


def tenths(values: list[float]) -> list[float]:
    """Medians of the first and the last tenth [ms]: whether a delay grows."""
    part = max(len(values) // 10, 1)
    return [float(np.median(values[:part]) * 1e3), float(np.median(values[-part:]) * 1e3)] if values else []


def table(figures: dict[str, Any]) -> str:
    """The figures as Markdown."""
    memory = figures["memory [MB]"] or [0]
    first, last = [f"{value:.1f}" for value in figures["cloud age, medians of the first and last tenth [ms]"]] or "--"
    growth = figures["growth"]
    rows = [
        "| what | n | median [ms] | p99 [ms] | max [ms] |",
        "|---|---|---|---|---|",
        *(
            f"| {name} | {s['n']} | {s['p50']:.1f} | {s['p99']:.1f} | {s['max']:.1f} |"
            for name, s in figures["waits"].items()
            if s
        ),
        "",
        "| what | figure |",
        "|---|---|",
        f"| time | {figures['seconds'] / 60:.1f} min; node alive at the end: {'yes' if figures['alive'] else 'no'} |",
        f"| memory | {memory[0]} MB at first, {memory[-1]} MB at last, {max(memory)} MB at most; "
        f"grown {'by nobody knows what' if growth is None else f'{growth:+.1%}'} after the first fifth |",
        f"| requests | {figures['requests']}: {figures['lost']} lost, {figures['twice']} answered twice; "
        f"{figures['timeouts']} waits in vain |",
        f"| answers | {', '.join(f'{count} {name}' for name, count in figures['statuses'].items())} |",
        f"| codes | {', '.join(f'{count} {name}' for name, count in figures['codes'].items())} |",
        f"| clouds of 9.8 MB | {figures['clouds received']} of {figures['clouds sent']} received; "
        f"age {first} ms in the first tenth, {last} ms in the last |",
        f"| disk cache | {figures['disk cache [MB]']:.0f} MB |",
        "",
        "| target | |",
        "|---|---|",
        *(f"| {name} | {'met' if met else 'NOT met'} |" for name, met in figures["targets"].items()),
    ]
    return "\n".join(rows)


if __name__ == "__main__":
    sys.exit(main())
