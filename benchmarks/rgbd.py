"""From depth images to grasps that hold on the truth: shapes on a table, one, three and fifteen views. Not a test.

    python benchmarks/rgbd.py --readme docs/clouds.md [--shapes mug box] [--views 1 3] [--quick] [--compare OLD.json]
    python benchmarks/rgbd.py --frames DIR [--pictures OUT]

Every case is rendered with the sensor noise of a D415, goes through segmentation, reconstruction and `plan_grasps` as a
user's clouds do, and every grasp that was verified on the reconstruction is tried again on the true mesh (standard hold
trial). The row `full mesh` plans on the true mesh with the same settings. Cases already in the results file are not run
again: remove it for a fresh run. DIR holds real frames: */depth_mm.png, camera.json, object_cloud.xyz.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from rgbd_cases import Case, run_case
from rgbd_frames import frames_table, run_frames

SHAPES = ("sphere", "box", "cylinder", "capsule", "torus", "mug", "bowl", "bottle", "l_block", "hammer")
STARTS, VIEWS = (0, 1, 2), (1, 3, 15)
NAMES = {0: "full mesh", 1: "1 view", 3: "3 views", 15: "15 views"}
BEGIN, END = "<!-- rgbd:begin -->", "<!-- rgbd:end -->"


def summary(cases: list[dict]) -> dict:
    """Figures of the cases of one row."""
    import numpy as np

    def middle(name: str) -> float:
        values = [c[name] for c in cases if c.get(name) is not None]
        return float(np.mean(values)) if values else float("nan")

    seconds = [c["scene_s"] + c["first_s"] for c in cases if c.get("first_s") is not None]
    verified = sum(c["verified"] for c in cases)
    return {
        "cases": len(cases),
        "first_held": float(np.mean([c.get("first_held", False) for c in cases])),
        "best_held": float(np.mean([c.get("best_held", False) for c in cases])),
        "verified": verified,
        "held": sum(c.get("held", 0) for c in cases),
        "lifted": sum(c.get("lifted", 0) for c in cases),
        "none": sum(c["verified"] == 0 for c in cases),
        "errors": sum("error" in c for c in cases),
        "median_s": float(np.median(seconds)) if seconds else float("nan"),
        "worst_s": max(seconds, default=float("nan")),
        "scene_s": float(np.median([c["scene_s"] for c in cases])),
        **{name: middle(name) for name in ("chamfer_mm", "completeness", "beyond_10mm", "watertight")},
    }


def table(cases: list[dict]) -> str:
    """The results as Markdown: a row for each number of views, then hold counts by shape."""
    rows = {views: [c for c in cases if c["views"] == views] for views in sorted({c["views"] for c in cases})}
    full = summary(rows[0])["first_held"] if 0 in rows else float("nan")
    lines = [
        "| planned on | first grasp holds on the truth | of the full mesh's figure | verified grasps that hold "
        "| that lift too | cases without a grasp | first verified grasp, median (worst) | Chamfer | within 5 mm "
        "| beyond 10 mm | closed |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for views, own in sorted(rows.items(), key=lambda row: row[0] or 99):
        s = summary(own)
        share = s["held"] / max(s["verified"], 1)
        relative = f"{s['first_held'] / full:.0%}" if full > 0 else "–"
        lines.append(
            f"| {NAMES.get(views, f'{views} views')} | {s['first_held']:.0%} of {s['cases']} | {relative} "
            f"| {s['held']}/{s['verified']} ({share:.0%}) | {s['lifted']} | {s['none']} "
            f"| {s['median_s']:.1f} s ({s['worst_s']:.1f} s), of it scene {s['scene_s']:.1f} s "
            f"| {s['chamfer_mm']:.1f} mm | {s['completeness']:.0%} | {s['beyond_10mm']:.0%} | {s['watertight']:.0%} |"
        )
    lines += ["", "Verified grasps that hold on the truth, by shape (* first grasp holds, one mark a case):", ""]
    lines += ["| shape | " + " | ".join(NAMES.get(v, f"{v} views") for v in rows) + " |", "|---|" + "---|" * len(rows)]
    for shape in dict.fromkeys(c["shape"] for c in cases):
        cells = []
        for own in rows.values():
            mine = [c for c in own if c["shape"] == shape]
            marks = "".join("*" if c.get("first_held") else "." for c in mine).replace("*", "\\*")
            cells.append(f"{sum(c.get('held', 0) for c in mine)}/{sum(c['verified'] for c in mine)} {marks}")
        lines.append(f"| {Path(shape).stem} | " + " | ".join(cells) + " |")
    return "\n".join(lines).replace("nan s", "–").replace("nan mm", "–").replace("nan%", "–")


def wanted(options: argparse.Namespace) -> Iterator[Case]:
    starts = STARTS[:1] if options.quick else STARTS
    for views in dict.fromkeys((*options.views, 0)):
        for shape in options.things:
            for start in starts:
                yield Case(
                    shape, start, views, options.count, options.preset, options.noise, options.clutter, options.front
                )


def run_missing(cases: list[Case], path: Path, processes: int) -> list[dict]:
    """Run what is not in the file yet, adding a line for each; returns the results of `cases` in order."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = path.read_text().splitlines() if path.exists() else []
    done = {entry["key"]: entry for entry in map(json.loads, lines)}
    missing = [case for case in cases if case.key not in done]
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool, path.open("a") as file:
        for case, found in zip(missing, pool.map(run_case, missing), strict=True):
            done[case.key] = {"key": case.key, **found}
            print(json.dumps(done[case.key]), file=file, flush=True)
            note = found.get("error") or f"{found['held']} of {found['verified']} hold"
            print(
                f"{Path(case.shape).stem:20} {NAMES.get(case.views, case.views)!s:9} {case.start}: {note}", flush=True
            )
    return [done[case.key] for case in cases]


def rewrite(path: Path, text: str) -> None:
    """Put `text` between the markers of a file."""
    whole = path.read_text()
    path.write_text(f"{whole.split(BEGIN)[0]}{BEGIN}\n{text}\n{END}{whole.split(END)[1]}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/rgbd.jsonl"), help="results, one case a line")
    parser.add_argument("--readme", type=Path, default=None, help="file whose results section is rewritten")
    parser.add_argument("--shapes", nargs="+", default=list(SHAPES))
    parser.add_argument("--meshes", type=Path, default=None, help="folder of meshes in metres, in place of the shapes")
    parser.add_argument("--views", nargs="+", type=int, default=list(VIEWS))
    parser.add_argument("--quick", action="store_true", help="one start in place of three")
    parser.add_argument("--count", type=int, default=8, help="verified grasps asked for in each case")
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--noise", default="default", choices=("none", "low", "default", "high"))
    parser.add_argument("--clutter", action="store_true", help="two other things stand beside the object")
    parser.add_argument("--front", default=Case.front, help="module:function that makes a scene of views")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--compare", type=Path, default=None, help="results file of an earlier run")
    parser.add_argument("--frames", type=Path, default=None, help="folder of real frames: run these instead")
    parser.add_argument("--pictures", type=Path, default=Path("results/frames"))
    options = parser.parse_args()
    # A new scan of the same scene has a mesh of its own: nothing of it is on disk.
    os.environ.update(GRASPD_CACHE="off", OMP_NUM_THREADS="1")
    if options.frames:
        frames = run_frames(options.frames, options.pictures, count=options.count, preset=options.preset)
        (options.pictures / "frames.json").write_text(json.dumps(frames, indent=1) + "\n")
        print(frames_table(frames))
        return
    meshes = sorted(map(str, options.meshes.glob("*.obj"))) if options.meshes else []
    options.things = meshes or options.shapes
    results = run_missing(list(wanted(options)), options.out, options.processes)
    head = (
        f"{len(options.things)} {'scans' if meshes else 'shapes'} × {1 if options.quick else len(STARTS)} viewpoints "
        f"on a table, noise `{options.noise}`{', two obstacles' if options.clutter else ''}, "
        f"preset `{options.preset}`, {options.count} grasps asked for, {options.processes} at a time on "
        f"{os.cpu_count()} cores, Python {platform.python_version()}.\n\n"
    )
    print(head + table(results))
    if options.readme:
        rewrite(options.readme, head + table(results))
    if options.compare:
        old = {e["key"]: e for e in map(json.loads, options.compare.read_text().splitlines())}
        for new in results:
            before = old.get(new["key"], {}).get("held")
            if before is not None and before != new.get("held", 0):
                print(f"{new['key']}: {before} -> {new.get('held', 0)} of {new['verified']} hold")


if __name__ == "__main__":
    main()
