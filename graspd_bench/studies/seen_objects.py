"""Study `rgbd`: grasps planned on camera views of an object on a table, and tried on the true object.

The views are rendered with the sensor noise of a D415. Like a user's clouds, they go through segmentation,
reconstruction and `plan_grasps`. Every grasp that is verified on the reconstruction is tried again on the true mesh.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from graspd_bench.rendering.depth_noise import DEFAULT
from graspd_bench.rendering.tabletop import CAMERA, TabletopScene, ring_poses, tabletop, views_of
from graspd_bench.study import PROTOCOL_MASS, ObjectCase, Record, Request, Sections, object_cases
from graspd_core.errors import GraspdError
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import HandModel
from graspd_core.mesh.mesh_files import load_mesh, surface_samples
from graspd_core.mesh.sdf import build_sdf
from graspd_core.mesh.surface_queries import make_surface, surface_distance, winding_inside
from graspd_core.mesh.topology import is_closed
from graspd_core.perception.scene import Obstacle, Scene, build_scene, object_parts
from graspd_core.perception.scene_from_views import scene_from_views
from graspd_core.perception.segment.target_selection import Target
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.runtime import disk_cache
from graspd_core.types import Grasp, GraspResult, Verdict
from graspd_core.verify.hold_trial import hold_trial, out_of_place
from graspd_core.verify.lift_trial import lift_trial
from graspd_core.verify.world import PROTOCOLS, build_world
from graspd_dataset.run_records import markdown_table, object_name

SHAPES = ("sphere", "box", "cylinder", "capsule", "torus", "mug", "bowl", "bottle", "l_block", "hammer")
# Numbers of cameras. 0 means that grasps are planned on the true mesh.
VIEWS = (0, 1, 3, 15)
# Elevations [deg] of a camera beside the robot, and of a wrist camera, which looks from above. The seed chooses one.
ELEVATIONS, ABOVE = (40.0, 50.0, 30.0), (75.0, 88.0, 60.0)
YAW = 0.3
# Gap between the object and each neighbour [m].
CLEAR = 0.04
# A point of the true surface counts as found within `FOUND` [m] of the reconstruction. Number of sampled points.
FOUND, SAMPLES = 0.005, 20_000
# Values of `Seen.sight`: alone, with neighbours, seen from above. `NAMES` has row names by number of views and sight.
PLAIN, CROWDED, FROM_ABOVE = "plain", "crowded", "from above"
NAMES = {
    (1, PLAIN): "1 view", (1, CROWDED): "1 view, crowded", (1, FROM_ABOVE): "1 view, from above", (3, PLAIN): "3 views",
    (15, PLAIN): "15 views", (0, PLAIN): "full mesh",
}  # fmt: skip
_HEADINGS = [
    "planned on", "first grasp holds on the truth", "of the full mesh's figure", "verified grasps that hold",
    "that lift too", "cases without a grasp", "first verified grasp, median (worst)", "Chamfer", "within 5 mm",
    "beyond 10 mm", "closed",
]  # fmt: skip


@dataclass(frozen=True)
class Seen(ObjectCase):
    """Grasps of an object seen by `views` cameras, or of the true mesh if `views` is 0.

    The seed sets the noise, the plan, and the place of the first camera. If `sight` is `CROWDED`, two neighbours stand
    beside the object. If it is `FROM_ABOVE`, the camera is higher.
    """

    views: int = 1
    sight: str = PLAIN


def seen_cases(request: Request) -> tuple[Seen, ...]:
    """Return cases of each object: all numbers of `VIEWS`, one view crowded, one from above. Default: two seeds."""
    request = request if request.seeds else replace(request, seeds=(0,) if request.quick else (0, 1))
    cases = object_cases(request, [f"shape:{name}" for name in SHAPES], 4)
    seen = [(views, PLAIN) for views in VIEWS[: 2 if request.quick else None]] + [(1, CROWDED), (1, FROM_ABOVE)]
    return tuple(Seen(**vars(case), views=views, sight=sight) for case in cases for views, sight in seen)


def run_seen(case: Seen) -> Record:
    """Reconstruct, plan and try grasps. If no scene can be built, the record holds the error message as `refused`."""
    hand = load_hand(case.hand, candidates=case.config.problem.fine_candidates)
    stage = _stage(case)
    clouds = views_of(stage, CAMERA, camera_poses(case), DEFAULT, 1000 * case.seed) if case.views else []
    _load_libraries()
    # The SDF grid of a full mesh must not come from the cache, where an earlier case may have stored the grid.
    disk_cache.forget()
    began = time.perf_counter()
    try:
        middle = Target(point=0.5 * (stage.truth.vertices.min(0) + stage.truth.vertices.max(0)))
        target = middle if case.sight == CROWDED else None
        scene = (
            scene_from_views(clouds, target=target, mass=PROTOCOL_MASS)
            if case.views
            else _true_scene(stage, case.object)
        )
    except GraspdError as error:
        return {"refused": str(error), "scene_s": time.perf_counter() - began, "verified": 0, "held": 0}
    scene_s = time.perf_counter() - began
    return {"scene_s": scene_s, **reconstruction_error(scene, stage), **_grasps(case, scene, stage, hand)}


def held_on_truth(record: Record) -> str:
    """Return how many verified grasps hold on the true object, or why the view was refused, in a few words."""
    return record.get("refused") or f"{record['held']} of {record['verified']} hold on the truth"


def _stage(case: Seen) -> TabletopScene:
    """Return the object on a table. A crowded scene has one neighbour at its +x side and one at its -y side."""
    thing = case.object.removeprefix("shape:") if case.object.startswith("shape:") else load_mesh(case.object)
    alone = tabletop(thing, yaw=YAW)
    if case.sight != CROWDED:
        return alone
    low, high = alone.truth.vertices.min(0), alone.truth.vertices.max(0)
    beside = (("box", float(high[0]) + CLEAR + 0.03, 0.02), ("cylinder", -0.03, float(low[1]) - CLEAR - 0.033))
    return tabletop(thing, yaw=YAW, obstacles=beside)


def camera_poses(case: Seen) -> tuple[np.ndarray, ...]:
    """Return `T_world_camera` of up to three cameras on one ring, or of fifteen cameras on two rings."""
    azimuth = np.deg2rad(20.0 + 120.0 * case.seed)
    places = ABOVE if case.sight == FROM_ABOVE else ELEVATIONS
    elevation = np.deg2rad(places[case.seed % len(places)])
    if case.views <= 3:
        return ring_poses(case.views, elevation=elevation, azimuth=azimuth)
    upper = ring_poses(case.views // 2, elevation=np.deg2rad(60.0), azimuth=azimuth + 0.2)
    return (*ring_poses(case.views - case.views // 2, elevation=np.deg2rad(30.0), azimuth=azimuth), *upper)


@lru_cache(maxsize=1)
def _load_libraries() -> None:
    scene_from_views(views_of(tabletop("sphere"), CAMERA, ring_poses(1, elevation=0.8)))


def _true_scene(stage: TabletopScene, source: str) -> Scene:
    obstacles = tuple(Obstacle(mesh, build_sdf(mesh, resolution=32, padding=0.02)) for mesh in stage.obstacles)
    return replace(
        build_scene(stage.truth, source=source, mass=PROTOCOL_MASS), support=stage.support, obstacles=obstacles
    )


def _grasps(case: Seen, scene: Scene, stage: TabletopScene, hand: HandModel) -> Record:
    """Time a plan for one grasp, then plan `count`. Try grasps on the true object if verified or with a probability."""
    first = plan_grasps(scene, hand, count=1, seed=case.seed, preset=case.preset)
    many = plan_grasps(scene, hand, count=case.count, seed=case.seed, preset=case.preset)
    protocol, truth = PROTOCOLS["standard"], _true_scene(stage, case.object)
    parts = object_parts(truth.object)
    world = build_world(hand, truth.object, parts, protocol)
    table = build_world(hand, truth.object, parts, protocol, stage.support, truth.obstacles)
    # The trial tolerates penetration, because a planner cannot know the true surface.
    protocol = out_of_place(protocol)
    one = [hold_trial(world, grasp, protocol) for grasp in _verified(first)]
    holds = [(grasp, hold_trial(world, grasp, protocol)) for grasp in _verified(many)]
    lifts = [lift_trial(table, hand, grasp, protocol) for grasp, hold in holds if hold.passed]
    # Unverified grasps with a probability are tried as well, to calibrate the probability.
    guessed = [grasp for grasp in many.tried if grasp.probability is not None]
    stated = [(grasp.probability, hold_trial(world, grasp, protocol).passed) for grasp in guessed]
    timing = first.timing
    return {
        "first_s": None if timing.first_verified is None else timing.first_verified - timing.load - timing.sdf,
        "outcome": many.outcome.name,
        "first_held": bool(one and one[0].passed),
        "verified": len(holds),
        "held": sum(hold.passed for _, hold in holds),
        "lifted": sum(lift.passed for lift in lifts),
        "reasons": [trial.reason for trial in (*(hold for _, hold in holds), *lifts) if not trial.passed],
        "warnings": list(many.warnings),
        "told": stated,
    }


def _verified(result: GraspResult) -> list[Grasp]:
    return [grasp for grasp in result.tried if grasp.verdict is Verdict.VERIFIED]


def reconstruction_error(scene: Scene, stage: TabletopScene) -> dict[str, Any]:
    """Return distances between the reconstructed and the true surface, and whether the reconstruction is closed.

    `chamfer_mm` is the mean of the mean distances in both directions [mm]. `completeness` is the share of the true
    surface within 5 mm of the reconstruction. `beyond_10mm` is the share of the reconstruction farther than 10 mm from
    the true surface.
    """
    points, normals = surface_samples(stage.truth, SAMPLES, 0)
    # Where bodies of the true mesh overlap, their inner surfaces are invisible and do not count.
    outer = points[~winding_inside(stage.truth, points + 1e-4 * normals)]
    found = surface_samples(scene.object.mesh, SAMPLES, 0)[0]
    missing = surface_distance(make_surface(scene.object.mesh), outer)
    stray = surface_distance(make_surface(stage.truth), found)
    return {
        "chamfer_mm": 500 * float(missing.mean() + stray.mean()),
        "completeness": float((missing < FOUND).mean()),
        "beyond_10mm": float((stray > 0.01).mean()),
        "watertight": bool(is_closed(scene.object.mesh)),
    }


def rgbd_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return a table by number of views and sight, a table by object, and the calibration of the stated probability."""
    rows = {row: own for row in NAMES if (own := [r for r in records if (r["views"], r["sight"]) == row])}
    full = _share(rows[0, PLAIN], "first_held") if (0, PLAIN) in rows else 0.0
    body = [[NAMES[views], *_row(own, full)] for views, own in rows.items()]
    shown = [views for views in NAMES if views in rows]
    objects = [
        [object_name(thing), *(_marks([r for r in rows[views] if r["object"] == thing]) for views in shown)]
        for thing in dict.fromkeys(r["object"] for r in records)
    ]
    heading = "Verified grasps that hold on the truth, by object (* first grasp holds, one mark a case):"
    return {
        "rgbd": [
            markdown_table(_HEADINGS, body),
            heading,
            markdown_table(["object", *(NAMES[views] for views in shown)], objects),
            *calibration([pair for r in records for pair in r.get("told", ())]),
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


def calibration(stated: Sequence[tuple[float, bool]], where: str = "") -> list[str]:
    """Return the Brier score, and a table of the fraction held by tenth of probability. `stated`: probability, held."""
    if not stated:
        return []
    body = []
    for tenth in range(9, -1, -1):
        some = [pair for pair in stated if min(int(10 * pair[0]), 9) == tenth]
        if some:
            mean, held = np.mean(some, 0)
            body.append([f"{10 * tenth} to {10 * tenth + 10}%", f"{mean:.0%}", f"{held:.0%} of {len(some)}"])
    brier = float(np.mean([(probability - hold) ** 2 for probability, hold in stated]))
    return [
        f"Stated probability{where and f', {where}'}, and the share that held on the true object, "
        f"unverified grasps included. Brier score {brier:.3f}:",
        markdown_table(["stated", "mean", "held"], body),
    ]
