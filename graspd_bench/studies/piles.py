"""Study `piles`: clear a pile of objects. Look, choose an object, plan, and lift it, until nothing can be grasped.

The planner knows only the camera's view. The lifts are simulated with the true objects.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from scipy.spatial import KDTree

from graspd_bench.rendering.depth_noise import DEFAULT
from graspd_bench.rendering.render import look_at, render_shaded, save_png
from graspd_bench.rendering.tabletop import CAMERA, TabletopScene, depth_views, moved, ring_poses, tabletop
from graspd_bench.study import Case, Picture, Record, Request, Sections, find_objects
from graspd_bench.trials import Lifted, dropped, lift_out, posed, settle
from graspd_core.errors import ConfigError, GraspdError
from graspd_core.hands.kinematics import hand_mesh
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import HandModel
from graspd_core.mesh.shapes import SHAPES, object_hash
from graspd_core.optimize.plan_config import PlanConfig, load_preset
from graspd_core.perception.cloud.camera import cloud_from_depth
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.load_scene import load_scene
from graspd_core.perception.scene_from_views import scene_from_views
from graspd_core.perception.segment.segment import find_things
from graspd_core.perception.segment.target_selection import Target
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import Grasp, GraspResult, Posture, TriangleMesh, Verdict
from graspd_core.verify.lift_trial import LiftSettings
from graspd_core.verify.world import PROTOCOLS, FreeBody
from graspd_dataset.run_records import markdown_table, object_name

# Numbers of objects in a scene, and their limit.
SIZES, MOST_THINGS = (3, 5, 8, 12), 24
MASS = 0.1
# Side of the fence for one object [m]. For n objects it is multiplied by the square root of n.
_FENCE = 0.12
# Elevation [rad] and distance [m] of the camera. It is far enough to see objects that roll away.
_ELEVATION, _DISTANCE = np.deg2rad(55.0), 0.7


@dataclass(frozen=True)
class PileCase(Case):
    """A pile of `size` objects drawn from `objects`, seen by `views` cameras."""

    objects: tuple[str, ...]
    size: int
    preset: str
    hand: str
    seed: int
    views: int = 1

    @property
    def label(self) -> str:
        return f"{self.size} things {self.preset} {self.hand} {self.seed} {self.views}"

    @property
    def config(self) -> PlanConfig:
        return load_preset(self.preset)

    def inputs(self) -> Record:
        return {**super().inputs(), "objects": [[object_name(thing), object_hash(thing)] for thing in self.objects]}


def pile_cases(request: Request) -> tuple[PileCase, ...]:
    """Return a case for each size and seed. Raises GraspdError: unknown object, or a size out of range."""
    sizes = tuple(map(_size, request.cases)) or (SIZES[:1] if request.quick else SIZES)
    objects = find_objects(request.objects or [f"shape:{name}" for name in SHAPES])
    preset, hand = request.preset(), request.hand or "allegro_right"
    return tuple(PileCase(objects, size, preset, hand, seed) for seed in request.seeds or (0,) for size in sizes)


def _size(text: str) -> int:
    if not text.isdigit() or not 1 <= int(text) <= MOST_THINGS:
        raise ConfigError(f"cases: {text!r}; valid: a number of objects from 1 to {MOST_THINGS}")
    return int(text)


def pile_seconds(case: PileCase) -> float:
    """Return the estimated CPU time of a case [s]. With more neighbours, each plan takes longer."""
    return 4.0 * case.size + 0.3 * case.size**2


def drawn_objects(case: PileCase) -> list[str]:
    """Return the objects of a scene: all in random order, repeated if there are fewer than `case.size`."""
    rng = np.random.default_rng((case.seed, case.size))
    order: list[str] = []
    while len(order) < case.size:
        order += [case.objects[k] for k in rng.permutation(len(case.objects))]
    return order[: case.size]


def dropped_pile(case: PileCase) -> tuple[FreeBody, ...]:
    """Return the pile: objects that were dropped into a fence and are at rest after its removal."""
    things = drawn_objects(case)
    models = {thing: load_scene(thing, mass=MASS).object for thing in set(things)}
    wall = 0.5 * _FENCE * float(np.sqrt(case.size)) + 0.05
    return dropped([models[thing] for thing in things], 1000 * case.seed + case.size, wall)


def seen_pile(case: PileCase, bodies: Sequence[FreeBody], look: int) -> tuple[list[PointCloud], Any]:
    """Return the views of look number `look`, and the label of each point: an index in `bodies`, or the table."""
    meshes = [moved(body.model.mesh, body.pose) for body in bodies]
    table = tabletop("sphere")
    stage = TabletopScene(meshes[0], np.eye(4), tuple(meshes[1:]), table.table, table.support)
    poses = ring_poses(case.views, elevation=_ELEVATION, distance=_DISTANCE, azimuth=np.deg2rad(20.0 + 120 * case.seed))
    images = depth_views(stage, CAMERA, poses, DEFAULT, 100_000 * case.seed + 10 * look)
    views = [cloud_from_depth(depth, CAMERA, pose) for (depth, _), pose in zip(images, poses, strict=True)]
    return views, np.concatenate([label[depth > 0] for depth, label in images])


# A segment this close to the place of a failed attempt counts as the same object [m]. Limit of attempts per object.
_SAME_PLACE, _TRIES = 0.03, 2
# If more than this share of a segment belongs to a second object, two objects were segmented as one.
_MERGED = 0.15
# An object that shifts more than this while another is lifted counts as moved [m].
MOVED = 0.02
# The lifted object may slip and turn in the hand, as long as it rises.
_PROTOCOL = replace(PROTOCOLS["standard"], max_displacement=0.1, max_rotation=2 * np.pi)
_LIFT = LiftSettings(hold_time=1.0)
# Outcomes of an attempt.
CLEARED, DROPPED, BLOCKED, NO_GRASP, NO_SCENE = "cleared", "dropped", "blocked", "no verified grasp", "no scene"


@dataclass
class _Run:
    """State of clearing a pile.

    Attributes:
        present: numbers of the remaining objects, in the order of `bodies`.
        bodies: the remaining objects at their current poses.
        failures: centres of the segments of failed attempts [m].
        attempts: records of all attempts.
        frames: poses of objects and hand for the film strip.
    """

    present: list[int]
    bodies: tuple[FreeBody, ...]
    failures: list[Float[np.ndarray, "3"]] = field(default_factory=list)
    attempts: list[Record] = field(default_factory=list)
    frames: list[Record] = field(default_factory=list)

    def failed_before(self, place: Float[np.ndarray, "3"]) -> int:
        return sum(float(np.linalg.norm(place - failed)) < _SAME_PLACE for failed in self.failures)


def run_pile(case: PileCase) -> Record:
    """Clear one pile. Return its record."""
    hand = load_hand(case.hand, candidates=case.config.problem.fine_candidates)
    things, bodies = drawn_objects(case), dropped_pile(case)
    run, look_s, looks = _Run(list(range(case.size)), bodies), [], 0
    run.frames.append(_frame(run))
    while run.present and looks < 3 * case.size:
        views, truth = seen_pile(case, run.bodies, looks)
        looks += 1
        began = time.process_time()
        seen = _seen(views)
        look_s.append(time.process_time() - began)
        if not _take_one(case, hand, run, views, truth, seen):
            break
    lifts = [attempt for attempt in run.attempts if "lift" in attempt]
    return {
        "things": [object_name(thing) for thing in things],
        "cleared": case.size - len(run.present),
        "left": [object_name(things[k]) for k in run.present],
        "attempts": run.attempts,
        "looks": looks,
        "look_s": look_s,
        "lifts": len(lifts),
        "held": sum(attempt["ended"] == CLEARED for attempt in lifts),
        "frames": run.frames,
    }


def _seen(views: Sequence[PointCloud]) -> list[Float[np.ndarray, "_ 3"]]:
    try:
        return list(find_things(views))
    except GraspdError:
        return []


def _take_one(
    case: PileCase,
    hand: HandModel,
    run: _Run,
    views: Sequence[PointCloud],
    truth: Int[np.ndarray, "points"],
    seen: Sequence[Float[np.ndarray, "_ 3"]],
) -> bool:
    """Plan for the segments `seen`, fewest failures first. Execute one verified grasp. Return False without one."""
    cloud = KDTree(np.vstack([view.points for view in views]))
    order = sorted(seen, key=lambda points: (run.failed_before(points.mean(0)), -float(points[:, 2].max())))
    for points in order:
        if run.failed_before(points.mean(0)) >= _TRIES:
            continue
        attempt = _truth_of(points, cloud, truth, run)
        run.attempts.append(attempt)
        grasp = _planned(case, hand, views, points, attempt, seed=1000 * case.seed + len(run.attempts))
        if grasp is not None:
            _execute(hand, run, grasp, attempt)
        if attempt["ended"] != CLEARED:
            run.failures.append(points.mean(0))
        if grasp is not None:
            return True
    return False


def _truth_of(
    points: Float[np.ndarray, "_ 3"], cloud: KDTree, truth: Int[np.ndarray, "points"], run: _Run
) -> dict[str, Any]:
    labels = truth[cloud.query(points)[1]]
    of_things = np.bincount(labels[(labels >= 0) & (labels < len(run.present))], minlength=len(run.present))
    order = np.argsort(-of_things, kind="stable")
    second = float(of_things[order[1]] / max(of_things.sum(), 1)) if len(order) > 1 else 0.0
    return {"thing": run.present[int(order[0])], "second_share": second, "merged": second > _MERGED}


def _planned(
    case: PileCase,
    hand: HandModel,
    views: Sequence[PointCloud],
    points: Float[np.ndarray, "_ 3"],
    attempt: Record,
    seed: int,
) -> Grasp | None:
    """Return the first verified grasp of a segment. If there is none, note the reason in `attempt` and return None."""
    began = time.process_time()
    # The target must be a point of the segment, because the centre of a ring is empty.
    middle = points[np.linalg.norm(points - points.mean(0), axis=1).argmin()]
    try:
        scene = scene_from_views(views, target=Target(point=middle))
    except GraspdError as error:
        attempt |= {"ended": NO_SCENE, "reason": str(error), "scene_s": time.process_time() - began}
        return None
    attempt["scene_s"] = time.process_time() - began
    began = time.process_time()
    result = plan_grasps(scene, hand, count=1, seed=seed, preset=case.preset, measure=False)
    attempt |= {"plan_s": time.process_time() - began, "neighbours": len(scene.obstacles)}
    best = result.tried[0] if result.tried else None
    if best is not None and best.verdict is Verdict.VERIFIED:
        attempt["probability"] = best.probability
        return best
    attempt |= {"ended": NO_GRASP, "reason": _why_none(result), "tried": len(result.tried)}
    return None


def _why_none(result: GraspResult) -> str:
    reasons = Counter(re.sub(r"-?\d+(\.\d+)?", "…", grasp.reason.split(" (")[0]) for grasp in result.tried)
    counts = "; ".join(f"{reason}: {count}" for reason, count in reasons.most_common(3))
    return counts or result.message or str(result.outcome.value)


def _execute(hand: HandModel, run: _Run, grasp: Grasp, attempt: Record) -> None:
    """Lift the true object. Remove all objects that rose, and let the others come to rest. Complete `attempt`."""
    index = run.present.index(attempt["thing"])
    before = [body.pose for body in run.bodies]
    lifted = lift_out(hand, run.bodies, index, grasp, _PROTOCOL, _LIFT)
    shift = [float(np.linalg.norm(a[:3, 3] - b[:3, 3])) for a, b in zip(lifted.poses, before, strict=True)]
    up = _risen(lifted, before, index)
    standard = PROTOCOLS["standard"]
    result = lifted.result
    firm = result.displacement <= standard.max_displacement and result.rotation <= standard.max_rotation
    attempt |= {
        "ended": CLEARED if result.passed else DROPPED if lifted.hand else BLOCKED,
        "reason": result.reason,
        "lift": {"slipped": result.displacement, "turned": result.rotation, "firm": result.passed and firm},
        "along": [run.present[k] for k in up if k != index],
        "moved": sum(s > MOVED for k, s in enumerate(shift) if k not in up and k != index),
    }
    run.bodies = posed(run.bodies, lifted.poses)
    run.frames.append(_frame(run, lifted.hand))
    stay = [k for k in range(len(run.present)) if k not in up]
    run.present = [run.present[k] for k in stay]
    run.bodies = tuple(run.bodies[k] for k in stay)
    run.bodies = posed(run.bodies, settle(run.bodies))


def _risen(lifted: Lifted, before: Sequence[Float[np.ndarray, "4 4"]], index: int) -> list[int]:
    if not lifted.result.passed:
        return []
    rise = 0.5 * _LIFT.lift_height
    return [k for k, pose in enumerate(lifted.poses) if k == index or pose[2, 3] - before[k][2, 3] > rise]


def _frame(run: _Run, hand: Posture | None = None) -> Record:
    poses = {str(k): np.round(body.pose[:3], 5).tolist() for k, body in zip(run.present, run.bodies, strict=True)}
    posture = None
    if hand is not None:
        posture = {name: np.round(value, 5).tolist() for name, value in vars(hand).items()}
    return {"poses": poses, "hand": posture}


_HEADINGS = [
    "things", "taken out", "scenes emptied", "attempts", "no scene", "no verified grasp", "hand blocked", "dropped",
    "two taken for one", "came along", "moved others", "verified grasps that held",
    "segmentation and reconstruction, a thing", "planning, a thing",
]  # fmt: skip
# Size of the pile that the film strip shows, if there is one. Size of a frame [pixels], and frames per row.
_DRAWN, _WIDTH, _HEIGHT, _ROW = 8, 320, 240, 4
_BORDER = 4
_COLOURS = (
    (0.84, 0.37, 0.30), (0.36, 0.58, 0.80), (0.95, 0.72, 0.28), (0.45, 0.70, 0.45), (0.62, 0.48, 0.72),
    (0.55, 0.44, 0.36), (0.88, 0.56, 0.70), (0.30, 0.65, 0.68), (0.70, 0.70, 0.32), (0.90, 0.52, 0.22),
    (0.42, 0.44, 0.62), (0.66, 0.74, 0.80),
)  # fmt: skip
_HAND, _TABLE = (0.35, 0.38, 0.42), (0.93, 0.92, 0.89)


def pile_summary(record: Record) -> str:
    """Return the result of a pile, in a few words."""
    return f"{record['cleared']} of {record['size']} taken out in {len(record['attempts'])} attempts"


def pile_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return the film strip, the table by pile size, the share held by segment quality, and the causes of failure."""
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
    lifts = [a for r in records for a in r["attempts"] if "lift" in a]
    held = {merged: [a["ended"] == CLEARED for a in lifts if a["merged"] == merged] for merged in (False, True)}
    one, two = (f"{sum(own)} of {len(own)}" for own in held.values())
    return f"Verified grasps that held: {one} where the segment was of one thing, {two} where two were taken for one."


def _causes(records: Sequence[Record]) -> list[str]:
    """Return a table of failed attempts by cause, most frequent first, with the number of merged segments."""
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
    return re.sub(r"-?\d+(\.\d+)?", "…", re.sub(r": \d+$", "", reason.split(";")[0])).replace("|", "/")


def film_picture(record: Record, chart: Path) -> Picture | None:
    """Save the film strip of a pile as piles.png beside `chart`. Return None if a mesh or the hand is missing."""
    try:
        image = film_strip(record)
    except GraspdError:
        return None
    path = chart.with_name("piles.png")
    path.parent.mkdir(parents=True, exist_ok=True)
    save_png(path, image)
    return Picture(f"A pile of {record['size']} things is cleared, one frame a lift", path)


def film_strip(record: Record) -> UInt8[np.ndarray, "height width 3"]:
    """Return an image with one frame of the initial pile, and one at the end of every lift.

    Raises GraspdError: an object or the hand cannot be loaded.
    """
    names = ("size", "preset", "hand", "seed", "views")
    case = PileCase(tuple(record["objects"]), **{name: record[name] for name in names})
    meshes = [load_scene(thing, mass=MASS).object.mesh for thing in drawn_objects(case)]
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
