"""Where methods stop working: success over two things that make grasping hard, in four pictures. Not a test.

    python benchmarks/maps.py [--maps friction_mass size view wall] [--figures docs/figures] [--out results/maps]

Every cell is the share of 8 raw grasps that pass the standard hold trial: the first of a method's own ranking, none
filtered, no second round. Finished plannings are kept in --out, a file each, and are not run again by the same code:
Ctrl-C loses one. The reasons of all failures are printed at the end.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

# One thread, said before torch is imported; and nothing on disk: scaled and reconstructed objects are never met again.
os.environ.update(GRASPD_CACHE="off", OMP_NUM_THREADS="1")


def main() -> None:
    import torch

    from graspd_core.bench.charts.failure_map_chart import draw_map
    from graspd_core.bench.failure_maps.map_registry import MAPS, METHODS, jobs_of
    from graspd_core.bench.failure_maps.run_map_jobs import finished, report, run_missing, shares
    from graspd_core.bench.measurements.measurement import code_version

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--maps", nargs="+", choices=MAPS, default=list(MAPS), metavar="MAP", help=", ".join(MAPS))
    parser.add_argument("--out", type=Path, default=Path("results/maps"))
    parser.add_argument("--figures", type=Path, default=Path("docs/figures"), help="map_NAME.png and .svg go there")
    parser.add_argument("--any-code", action="store_true", help="take finished plannings of other code, too")
    parser.add_argument("--no-run", action="store_true", help="draw what has finished, under whatever code")
    options = parser.parse_args()
    torch.set_num_threads(1)
    code, failed = code_version(), 0
    for name in options.maps:
        # Both methods on one object after the other: what is built of it is remembered.
        pairs = zip(*(jobs_of(name, method) for method in METHODS), strict=True)
        jobs = [job for pair in pairs for job in pair]
        began = time.process_time()
        for record in run_missing([] if options.no_run else jobs, options.out, code, any_code=options.any_code):
            held = "/".join(str(cell["held"]) for cell in record.get("cells", ()))
            said = f"error: {record['error']}" if record["error"] else f"{held} of {record['count']} held"
            failed += bool(record["error"])
            print(f"{name} {record['preset']} {record['thing']} {record['across']} {record['up']}: {said}", flush=True)
        known = None if options.no_run or options.any_code else code
        panels = {
            f"{method} (preset {METHODS[method]})": shares(finished(options.out, name, method, known))
            for method in METHODS
        }
        picture = draw_map(MAPS[name], panels, options.figures / f"map_{name}")
        print(f"{picture}: {time.process_time() - began:.0f} CPU s", flush=True)
    print(report(options.out))
    raise SystemExit(f"{failed} plannings raised: see {options.out}" if failed else 0)


if __name__ == "__main__":
    main()
