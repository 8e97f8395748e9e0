"""What came of piles: a row for each number of things, why attempts failed, and a film strip of one scene."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from graspd_core.bench.piles.clear_pile import BLOCKED, CLEARED, DROPPED, NO_GRASP, NO_SCENE
from graspd_core.bench.piles.pile_case import PileCase, drawn_things
from graspd_core.bench.report import markdown_table
from graspd_core.bench.study import Picture, Record, Sections
from graspd_core.errors import GraspdError
from graspd_core.hands.hand_mesh import hand_mesh
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import HandModel
from graspd_core.rendering.render import look_at, render_shaded, save_png
from graspd_core.rendering.tabletop import moved, tabletop
from graspd_core.scene.load_scene import load_scene
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import TriangleMesh

_HEADINGS = [
    "things", "taken out", "scenes emptied", "attempts", "no scene", "no verified grasp", "hand blocked", "dropped",
    "two taken for one", "came along", "moved others", "verified grasps that held",
    "segmentation and reconstruction, a thing", "planning, a thing",
]  # fmt: skip
# The scene of this many things is drawn, if there is one; frames of this size, so many in a row.
_DRAWN, _WIDTH, _HEIGHT, _ROW = 8, 320, 240, 4
_BORDER = 4
_COLOURS = (
    (0.84, 0.37, 0.30), (0.36, 0.58, 0.80), (0.95, 0.72, 0.28), (0.45, 0.70, 0.45), (0.62, 0.48, 0.72),
    (0.55, 0.44, 0.36), (0.88, 0.56, 0.70), (0.30, 0.65, 0.68), (0.70, 0.70, 0.32), (0.90, 0.52, 0.22),
    (0.42, 0.44, 0.62), (0.66, 0.74, 0.80),
)  # fmt: skip
_HAND, _TABLE = (0.35, 0.38, 0.42), (0.93, 0.92, 0.89)


def pile_came(record: Record) -> str:
    """What came of a scene, in a few words."""
    return f"{record['cleared']} of {record['size']} taken out in {len(record['attempts'])} attempts"


def pile_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """The table, the causes and the film strip."""
    sizes = {size: [r for r in records if r["size"] == size] for size in sorted({r["size"] for r in records})}
    body = [_row(str(size), own) for size, own in sizes.items()]
    if len(sizes) > 1:
        body.append(_row("all", records))
    picture = None
    if chart is not None:
        picture = film_picture(max(records, key=lambda r: (r["size"] == _DRAWN, r["size"], -r["seed"])), chart)
    return {"piles": [picture, markdown_table(_HEADINGS, body), _by_segment(records), *_causes(records)]}


def _row(name: str, own: Sequence[Record]) -> list[str]:
    attempts = [attempt for record in own for attempt in record["attempts"]]
    ended = Counter(attempt["ended"] for attempt in attempts)
    cleared, lifts = sum(r["cleared"] for r in own), [attempt for attempt in attempts if "lift" in attempt]
    seeing = sum(a["scene_s"] for a in attempts) + sum(sum(r["look_s"]) for r in own)
    planning = sum(a.get("plan_s", 0.0) for a in attempts)
    return [
        name,
        f"{cleared} of {sum(r['size'] for r in own)}",
        f"{sum(not r['left'] for r in own)} of {len(own)}",
        str(len(attempts)),
        *(str(ended[name]) for name in (NO_SCENE, NO_GRASP, BLOCKED, DROPPED)),
        str(sum(a["merged"] for a in attempts)),
        str(sum(len(a["along"]) for a in lifts)),
        str(sum(a["moved"] > 0 for a in lifts)),
        f"{ended[CLEARED]}/{len(lifts)}",
        *(f"{seconds / cleared:.1f} s" if cleared else "–" for seconds in (seeing, planning)),
    ]


def _by_segment(records: Sequence[Record]) -> str:
    """How many verified grasps held where a segment was of one thing, and where it was of two."""
    lifts = [a for r in records for a in r["attempts"] if "lift" in a]
    held = {merged: [a["ended"] == CLEARED for a in lifts if a["merged"] == merged] for merged in (False, True)}
    one, two = (f"{sum(own)} of {len(own)}" for own in held.values())
    return f"Verified grasps that held: {one} where the segment was of one thing, {two} where two were taken for one."


def _causes(records: Sequence[Record]) -> list[str]:
    """What attempts failed of, most often first, and of how many of them a segment was of two things."""
    failed = [a for r in records for a in r["attempts"] if a["ended"] != CLEARED]
    if not failed:
        return []
    causes: dict[tuple[str, str], list[bool]] = {}
    for attempt in failed:
        causes.setdefault((attempt["ended"], _plain(attempt["reason"])), []).append(attempt["merged"])
    rows = sorted(causes.items(), key=lambda item: -len(item[1]))
    body = [[ended, reason, str(len(merged)), str(sum(merged))] for (ended, reason), merged in rows]
    return ["What attempts failed of:", markdown_table(["ended", "most often of", "attempts", "two for one"], body)]


def _plain(reason: str) -> str:
    """A reason without its figures, and of several only the first."""
    return re.sub(r"-?\d+(\.\d+)?", "…", re.sub(r": \d+$", "", reason.split(";")[0])).replace("|", "/")


def film_picture(record: Record, chart: Path) -> Picture | None:
    """The film strip of a scene as a file; none where its meshes are not here any more."""
    try:
        image = film_strip(record)
    except GraspdError:
        return None
    path = chart.with_name("piles.png")
    path.parent.mkdir(parents=True, exist_ok=True)
    save_png(image, path)
    return Picture(f"A pile of {record['size']} things is cleared, one frame a lift", path)


def film_strip(record: Record) -> UInt8[np.ndarray, "height width 3"]:
    """A frame as the pile fell, and one at the end of every lift, in rows.

    Raises:
        GraspdError: an object or the hand cannot be loaded.
    """
    names = ("size", "preset", "hand", "seed", "views")
    case = PileCase(tuple(record["objects"]), **{name: record[name] for name in names})
    meshes = [load_scene(thing).object.mesh for thing in drawn_things(case)]
    hand = load_hand(case.hand, candidates=1)
    frames = [_drawn(frame, meshes, hand) for frame in record["frames"]]
    frames += [np.full_like(frames[0], 255)] * (-len(frames) % min(_ROW, len(frames)))
    rows = [np.concatenate(frames[k : k + _ROW], axis=1) for k in range(0, len(frames), _ROW)]
    return np.concatenate(rows, axis=0)


def _drawn(frame: Record, meshes: Sequence[TriangleMesh], hand: HandModel) -> UInt8[np.ndarray, "height width 3"]:
    parts = [(tabletop("sphere").table, _TABLE)]
    for number, rows in frame["poses"].items():
        pose = np.vstack([np.array(rows), [0.0, 0.0, 0.0, 1.0]])
        parts.append((moved(meshes[int(number)], pose), _COLOURS[int(number) % len(_COLOURS)]))
    if frame["hand"] is not None:
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_quaternion(torch.tensor(frame["hand"]["quaternion_wxyz"], dtype=torch.float64))
        pose[:3, 3] = frame["hand"]["position"]
        parts.append((moved(hand_mesh(hand, np.array(frame["hand"]["joint_positions"])), pose), _HAND))
    camera = look_at((0.6, -0.52, 0.5), (0.0, 0.0, 0.15))
    image = render_shaded(parts, T_world_camera=camera, width=_WIDTH, height=_HEIGHT)
    image[:_BORDER], image[-_BORDER:], image[:, :_BORDER], image[:, -_BORDER:] = 255, 255, 255, 255
    return image
