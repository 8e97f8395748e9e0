"""Settings swept over three decades: how far they can be wrong before a method stops working.

    python benchmarks/sweep.py [--out results/sweep] [--processes 1]     # some ten CPU minutes; resumable

Stiffness and friction, as the methods plan with them: of Grasp'D (`graspd2022_short`) the stiffness of a contact, of
the closed form (`balanced`) the width over which a contact fades, which stands in its place. The trial is the standard
one, at a friction of 0.6, whatever was planned with. Prints a Markdown table of raw grasps held, of those asked for.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from graspd_core.bench.benchmark_workers import run_cells
from graspd_core.bench.measurements.measurement import Cell, code_version
from graspd_core.bench.result_store import read_cells
from graspd_core.bench.suites import find_objects, hand_hash
from graspd_core.bench.tables import markdown_table
from graspd_core.methods.plan_config import load_preset, override

HAND, COUNT = "allegro_right", 8
OBJECTS = ("shape:box", "shape:mug")
# Title, preset, setting and its values; the preset's own is among them.
SWEEPS = (
    (
        "Grasp'D, stiffness [N/m]",
        "graspd2022_short",
        "graspd2022.contact.stiffness",
        (30, 100, 300, 1e3, 3e3, 1e4, 3e4),
    ),
    ("Grasp'D, friction", "graspd2022_short", "graspd2022.contact.friction", (0.02, 0.06, 0.2, 0.8, 2.0, 6.0, 20.0)),
    ("closed form, width [mm]", "balanced", "closed_form.delta_end", (1e-4, 4e-4, 1e-3, 4e-3, 1e-2, 4e-2, 1e-1)),
    ("closed form, friction", "balanced", "problem.friction", (0.02, 0.06, 0.2, 0.4, 2.0, 6.0, 20.0)),
)


def cells() -> dict[tuple[str, float], list[Cell]]:
    """The cells of every sweep and value, one an object."""
    objects, hand = find_objects(OBJECTS), hand_hash(HAND)
    made = {}
    for title, preset, setting, values in SWEEPS:
        base = load_preset(preset)
        for value in values:
            settings = override(base, {setting: value})
            name = f"{preset} {setting}={value:g}"
            made[title, value] = [
                Cell("raw", name, settings, thing.source, thing.sha256, HAND, hand, 0, COUNT, ("standard",))
                for thing in objects
            ]
    return made


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/sweep"), metavar="DIR", help="for finished cells")
    parser.add_argument("--processes", type=int, default=1)
    options = parser.parse_args()
    swept, code = cells(), code_version()
    every = [cell for group in swept.values() for cell in group]
    done = read_cells(options.out, every, code)
    for cell, record in run_cells([cell for cell in every if cell not in done], options.out, code, options.processes):
        done[cell] = record
        print(f"{cell.name}, {cell.object}: {record['error'] or record['held']}", file=sys.stderr, flush=True)
    for title, _, setting, values in SWEEPS:
        scale = 1e3 if "[mm]" in title else 1.0
        share = [f"{sum(done[c].get('held', 0) for c in swept[title, v])}/{COUNT * len(OBJECTS)}" for v in values]
        print(f"\n{markdown_table([title, *(f'{v * scale:g}' for v in values)], [[f'`{setting}`', *share]])}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
