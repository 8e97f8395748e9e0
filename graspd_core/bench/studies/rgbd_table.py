"""Records of the study `rgbd` as Markdown: a row for each number of views, then hold counts by object."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from graspd_core.bench.report import markdown_table
from graspd_core.bench.study import Record, Sections, thing_name

NAMES = {0: "full mesh", 1: "1 view", 3: "3 views", 15: "15 views"}
_HEADINGS = [
    "planned on", "first grasp holds on the truth", "of the full mesh's figure", "verified grasps that hold",
    "that lift too", "cases without a grasp", "first verified grasp, median (worst)", "Chamfer", "within 5 mm",
    "beyond 10 mm", "closed",
]  # fmt: skip


def rgbd_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Both tables."""
    good = [record for record in records if not record["error"]]
    rows = {views: own for views in (1, 3, 15, 0) if (own := [r for r in good if r["views"] == views])}
    if not rows:
        return {}
    full = _share(rows[0], "first_held") if 0 in rows else 0.0
    body = [[NAMES[views], *_row(own, full)] for views, own in rows.items()]
    shown = [views for views in NAMES if views in rows]
    objects = [
        [thing_name(thing), *(_marks([r for r in rows[views] if r["object"] == thing]) for views in shown)]
        for thing in dict.fromkeys(r["object"] for r in good)
    ]
    told = "Verified grasps that hold on the truth, by object (* first grasp holds, one mark a case):"
    return {
        "rgbd": [
            markdown_table(_HEADINGS, body),
            told,
            markdown_table(["object", *(NAMES[views] for views in shown)], objects),
        ]
    }


def _row(own: Sequence[Record], full: float) -> list[str]:
    seconds = [r["scene_s"] + r["first_s"] for r in own if r.get("first_s") is not None]
    verified, held = sum(r["verified"] for r in own), sum(r["held"] for r in own)
    first, scene = _share(own, "first_held"), np.median([r["scene_s"] for r in own])
    times = f"{np.median(seconds):.1f} s ({max(seconds):.1f} s), of it scene {scene:.1f} s" if seconds else "–"
    solids = [r for r in own if "chamfer_mm" in r]
    errors = [
        np.mean([r[name] for r in solids]) for name in ("chamfer_mm", "completeness", "beyond_10mm", "watertight")
    ]
    return [
        f"{first:.0%} of {len(own)}",
        f"{first / full:.0%}" if full else "–",
        f"{held}/{verified} ({held / max(verified, 1):.0%})",
        str(sum(r.get("lifted", 0) for r in own)),
        str(sum(not r["verified"] for r in own)),
        times,
        *((f"{errors[0]:.1f} mm", *(f"{share:.0%}" for share in errors[1:])) if solids else "––––"),
    ]


def _share(own: Sequence[Record], name: str) -> float:
    return float(np.mean([r.get(name, False) for r in own]))


def _marks(own: Sequence[Record]) -> str:
    marks = "".join("\\*" if r.get("first_held") else "." for r in own)
    return f"{sum(r['held'] for r in own)}/{sum(r['verified'] for r in own)} {marks}"
