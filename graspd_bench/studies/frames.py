"""Study `frames`: segmentation, reconstruction and grasps on frames of a real depth camera.

    graspd bench frames --objects DIR ...

Every subfolder of DIR with a depth_mm.png is a frame. The subfolder also holds camera.json (K, width, height) and
object_cloud.xyz, the reference cloud of the object in the camera frame [m].
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graspd_bench.study import Case, Record, Request, Sections
from graspd_core.errors import ConfigError, GraspdError
from graspd_core.hands.library import load_hand
from graspd_core.mesh.topology import is_closed
from graspd_core.perception.cloud.depth_files import load_depth_view
from graspd_core.perception.scene_from_views import scene_from_views
from graspd_core.perception.segment.segment import Target, segment
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.types import Verdict
from graspd_dataset.run_records import markdown_table

# Edge length of the voxels by which clouds are compared [m].
CUBE = 0.005


@dataclass(frozen=True)
class Frame(Case):
    """A folder with one frame, and the request for its grasps. `content` is a hash of the files in the folder."""

    folder: str
    content: str
    count: int
    preset: str
    hand: str

    @property
    def label(self) -> str:
        return f"{Path(self.folder).name} {self.preset}"

    def inputs(self) -> Record:
        return {**super().inputs(), "folder": Path(self.folder).name}


def frame_cases(request: Request) -> tuple[Frame, ...]:
    """Return a case for every frame in the folders `request.objects`, sorted by path. Raises ConfigError: no frame."""
    found = sorted(path.parent for folder in request.objects for path in Path(folder).glob("*/depth_mm.png"))
    if not found:
        folders = ", ".join(request.objects) or "any folder"
        raise ConfigError(f"objects: no */depth_mm.png in {folders}; give --objects DIR (docs/clouds.md)")
    count, hand = request.count or 8, request.hand or "allegro_right"
    return tuple(Frame(str(folder), _content(folder), count, request.preset(), hand) for folder in found)


def run_frame(case: Frame) -> Record:
    """Plan for the object on the view axis. If its IoU is at most 0.5, plan at the reference cloud's median instead."""
    folder = Path(case.folder)
    cloud = load_depth_view(folder / "depth_mm.png", folder / "camera.json")
    reference = np.loadtxt(folder / "object_cloud.xyz")
    hand = load_hand(case.hand)
    target, found = None, {}
    try:
        for picked in ("view axis", "point"):
            target = Target(point=np.median(reference, axis=0)) if picked == "point" else None
            seen = np.vstack([view.points for view in segment([cloud], target=target).views])
            found = {"picked_by": picked, "object_points": len(seen), "iou": overlap(seen, reference)}
            if found["iou"] > 0.5:
                break
        began = time.perf_counter()
        scene = scene_from_views([cloud], target=target, source=folder.name)
        scene_s = time.perf_counter() - began
        result = plan_grasps(scene, hand, count=case.count, preset=case.preset)
    except GraspdError as error:
        return {**found, "refused": str(error)}
    timing = result.timing
    first = None if timing.first_verified is None else scene_s + timing.first_verified - timing.load - timing.sdf
    return {
        **found,
        "watertight": bool(is_closed(scene.object.mesh)),
        "scene_s": scene_s,
        "first_s": first,
        "verified": sum(grasp.verdict is Verdict.VERIFIED for grasp in result.tried),
        "outcome": result.outcome.name,
        "warnings": list(result.warnings),
    }


def overlap(found: np.ndarray, reference: np.ndarray) -> float:
    """Return the intersection over union (IoU) of the 5 mm voxels that two clouds [m] occupy."""
    a, b = ({tuple(c) for c in np.floor(points / CUBE).astype(int)} for points in (found, reference))
    return len(a & b) / max(len(a | b), 1)


def frame_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return a table with a row for each frame."""
    headings = ["frame", "object picked by", "points", "IoU with the reference", "closed", "verified grasps", "scene"]
    return {"frames": [markdown_table([*headings, "first verified grasp"], [_line(r) for r in records])]}


def _line(r: Record) -> list[str]:
    name = Path(r["folder"]).name
    if "verified" not in r:
        return [name, r.get("picked_by", "–"), r["error"] or r["refused"], *[""] * 5]
    first = f"{r['first_s']:.1f} s" if r["first_s"] is not None else "none"
    closed = "yes" if r["watertight"] else "no"
    return [
        name, r["picked_by"], str(r["object_points"]), f"{r['iou']:.2f}", closed, f"{r['verified']} of {r['count']}",
        f"{r['scene_s']:.1f} s", first,
    ]  # fmt: skip


def _content(folder: Path) -> str:
    files = [path for path in sorted(folder.iterdir()) if path.is_file()]
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()
