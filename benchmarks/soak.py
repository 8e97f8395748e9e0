"""Test a node under mixed load for minutes: memory growth, waiting times, and whether each request ends exactly once.

    python benchmarks/soak.py [--minutes 10] [--out results/soak] [--readme docs/reference/node_load.md]

This process is the client. It starts three processes: the node with a timer that measures delays, a camera of 640×480
at 30 Hz, and a control that only sleeps. The control wakes late only because of the machine. Nothing is mocked. Code of
`graspd bench` writes the record, a line on the record's origin, and the pages.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from graspd_bench.result_store import write_record
from graspd_bench.run_studies import Job, run_job
from graspd_bench.study import Case, Record, Sections
from graspd_bench.tables import fill, sourced, written
from graspd_dataset.run_records import code_version, markdown_table

PARTS = Path(__file__).with_name("soak_parts.py")
SAMPLE_PERIOD = 5.0  # seconds between two measurements of the node's memory
SETTLED = 0.2  # fraction of the run after which memory should be flat
GROWTH = 0.05  # greatest allowed growth of memory after `SETTLED`
# Limits on the 99th percentile of waits [ms]. A limit applies to all waits whose names begin with its key.
LIMITS = {
    "timer lateness in the node": 50.0,
    "trivial service": 50.0,
    "request to first progress": 200.0,
    "cancel to answer": 300.0,
}


@dataclass(frozen=True)
class Soak(Case):
    """A run of the given number of minutes."""

    minutes: float


def run_soak(case: Soak) -> Record:
    """Run once, in a separate ROS domain and with a separate cache. Return the results."""
    from graspd_core.paths import config_dir

    with tempfile.TemporaryDirectory() as folder:
        os.environ |= {
            "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "FASTRTPS_DEFAULT_PROFILES_FILE": str(config_dir() / "fastdds.xml"),
            "XDG_CACHE_HOME": folder,
            "ROS_LOG_DIR": folder,
        }
        return soak(Path(folder), case.minutes * 60)


def soak(folder: Path, seconds: float) -> Record:
    """Start the processes, send requests for `seconds`, and return the results."""
    from soak_client import SCENES, Client  # soak_client imports ROS, which reads the environment of `run_soak`

    from graspd_core.mesh.mesh_files import save_mesh
    from graspd_core.mesh.shapes import make_shape

    for shape in ("sphere", "mug", "box"):
        save_mesh(folder / f"{shape}.obj", make_shape(shape))
    notes, log = folder / "node.jsonl", (folder / "node.log").open("w")
    parameters = ["--ros-args", "-p", "cloud_policy:=off", "-p", "queue_size:=4"]
    run_node = [sys.executable, str(PARTS), "node", str(notes), *parameters]
    node = subprocess.Popen(run_node, cwd=folder, stdout=log, stderr=log)
    others: list[subprocess.Popen[str]] = []
    memory: list[float] = []
    try:
        client = Client(lambda: memory.append(_memory(node.pid)), SAMPLE_PERIOD)
        client.wait(lambda: client.ready or node.poll() is not None, "the node to be ready")
        if not client.ready:
            raise RuntimeError(f"the node did not start:\n{(folder / 'node.log').read_text()}")
        for part in ("camera", "control"):
            command = [sys.executable, str(PARTS), part, str(seconds)]
            others.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        end, script = time.monotonic() + seconds, random.Random(0)
        while time.monotonic() < end and node.poll() is None:
            script.choice(SCENES)(client, script)
        alive = node.poll() is None
        client.settle()
        sent, ticks = (json.loads(process.communicate(timeout=60)[0] or "[]") for process in others)
        time.sleep(6.0)  # until the node has written its last delays
        node.terminate()
        node.wait(10)
    finally:
        for process in (node, *others):
            if process.poll() is None:
                process.kill()
    lines = [json.loads(line) for line in notes.read_text().splitlines()]
    late, ages = ([value for line in lines for value in line[key]] for key in ("late", "ages"))
    figures = client.figures()
    waits = {"timer lateness in the node": late, "lateness of a process that only ticks": ticks, "cloud age": ages}
    tenth = max(len(ages) // 10, 1)
    return {
        **figures,
        "waits": {name: spread(values) for name, values in (waits | figures["waits"]).items() if values},
        "alive": alive,
        "memory_mb": memory,
        "clouds": [len(ages), sent],
        "ages_ms": [float(np.median(part) * 1e3) for part in (ages[:tenth], ages[-tenth:])] if ages else [],
        "cache_mb": sum(path.stat().st_size for path in (folder / "graspd").glob("*")) / 1e6,
    }


def _memory(pid: int) -> float:
    from graspd_ros.outputs.responses import resident_memory

    return resident_memory(pid) / 1e6


def spread(values: Sequence[float]) -> dict[str, float]:
    """Return the number of values [s], and their median, 99th percentile and maximum [ms]."""
    median, p99 = np.percentile(values, [50, 99]) * 1e3
    return {"n": len(values), "p50": float(median), "p99": float(p99), "max": max(values) * 1e3}


def growth(memory: Sequence[float]) -> float | None:
    """Return the relative growth of memory after `SETTLED`, from the first to the last fifth. None if unknown."""
    flat = memory[int(SETTLED * len(memory)) :]
    fifth = max(len(flat) // 5, 1)
    return float(np.median(flat[-fifth:]) / np.median(flat[:fifth]) - 1) if len(flat) > 1 else None


def targets(record: Record) -> dict[str, bool]:
    """Return for each target whether the node met it. A target without measurements is not met."""
    grown = growth(record["memory_mb"])
    met = {
        "the node is alive at the end": record["alive"],
        "no request is lost": record["requests"] > 0 and not record["lost"],
        "none is answered twice": not record["twice"],
        "the client waits for nothing in vain": not record["timeouts"],
        f"memory grows by {GROWTH:.0%} at most": grown is not None and grown <= GROWTH,
    }
    for begin, limit in LIMITS.items():
        found = [s["p99"] for name, s in record["waits"].items() if name.startswith(begin)]
        met[f"{begin}: p99 below {limit:.0f} ms"] = bool(found) and max(found) < limit
    return met


def soak_sections(record: Record) -> Sections:
    """Return the tables of waits, counts and targets."""
    waits = [[name, *(f"{s[key]:.{int(key != 'n')}f}" for key in s)] for name, s in record["waits"].items()]
    memory, grown = record["memory_mb"] or [0.0], growth(record["memory_mb"])
    first, last = (f"{age:.1f}" for age in record["ages_ms"] or [float("nan")] * 2)
    got, sent = record["clouds"]
    counts = [
        ["memory [MB]", f"{memory[0]:.0f} at first, {memory[-1]:.0f} at last, {max(memory):.0f} at most"],
        ["growth after the first fifth", "unknown" if grown is None else f"{grown:+.1%}"],
        ["requests", ", ".join(f"{record[key]} {key}" for key in ("requests", "lost", "twice", "timeouts"))],
        ["answers", ", ".join(f"{count} {name}" for name, count in (record["statuses"] | record["codes"]).items())],
        ["clouds of 9.8 MB", f"{got} of {sent} received; age {first} ms at first, {last} ms at last"],
        ["disk cache", f"{record['cache_mb']:.0f} MB"],
    ]
    met = [[name, "met" if good else "NOT met"] for name, good in targets(record).items()]
    told = f"{record['minutes']:g} minutes: clouds at 30 Hz, requests of every kind, cancels."
    heads = (["what", "n", "median [ms]", "p99 [ms]", "max [ms]"], ["what", "figure"], ["target", ""])
    tables = (markdown_table(head, body) for head, body in zip(heads, (waits, counts, met), strict=True))
    return {"faults": [told, *tables]}


def main() -> int:
    """Run, and print the tables. Return 1 if a target is not met or the run failed, otherwise 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--out", type=Path, default=Path("results/soak"), metavar="DIR")
    parser.add_argument("--readme", type=Path, help="page whose section `faults` to fill")
    options = parser.parse_args()
    case = Soak(options.minutes)
    record: dict[str, Any] = run_job(Job("soak", case, run_soak, code_version()))
    write_record(options.out, "soak", case, record)
    if record["error"]:
        print(record["error"], file=sys.stderr)
        return 1
    sections = sourced("make soak", [record], soak_sections(record))
    print(written(sections["faults"]))
    if options.readme:
        fill(options.readme, sections)
    return int(not all(targets(record).values()))


if __name__ == "__main__":
    sys.exit(main())
