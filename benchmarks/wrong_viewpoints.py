"""Measure what graspd does with clouds whose stated camera position is wrong.

    python benchmarks/wrong_viewpoints.py [--count 500] [--frames FOLDER]

Clouds come from ten rendered scenes (objects of `graspd bench cameras` on which no threshold was chosen, seeds from
100), and from the depth frames in a folder (`NAME/camera.json` as in docs/clouds.md, `NAME/depth_mm.png`). Points are
unordered, so that no pixel shows where the camera stood. Each cloud has three forms: all points, points thinned to 8
mm, and only the object's points. A wrong position is a robot's base, the true position mirrored, 5 m away, or anywhere
at the true distance. The line of sight turns by more than 20°. Verified grasps are tried on the true object, if known.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graspd_bench.rendering.depth_noise import CAMERAS
from graspd_bench.studies.cameras import ASSUMED, FIRST_SEED, SHAPES, CameraView, view_of
from graspd_bench.study import PROTOCOL_MASS
from graspd_core.errors import GraspdError
from graspd_core.hands.library import load_hand
from graspd_core.perception.cloud.depth_files import load_depth_view
from graspd_core.perception.cloud.point_cloud import PointCloud, Points, Vector
from graspd_core.perception.scene import build_scene, object_parts
from graspd_core.perception.scene_from_views import scene_from_views
from graspd_core.perception.segment.segment import segment
from graspd_core.perception.segment.target_selection import Target
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.se3 import perpendicular
from graspd_core.types import TriangleMesh, Verdict
from graspd_core.verify.hold_trial import hold_trial, out_of_place
from graspd_core.verify.world import PROTOCOLS, build_world

THINGS = ("banana", "spray", "detergent", "drill", "animal", "pan", *SHAPES)
LEAST_TURN = np.radians(20.0)


@dataclass(frozen=True)
class Seen:
    """Points of a cloud [m], the true camera position [m], a point of the object [m], up, and the true mesh or None."""

    name: str
    points: Points
    place: Vector
    target: Vector
    up: Vector
    truth: TriangleMesh | None = None


def rendered() -> Iterator[Seen]:
    for k, thing in enumerate(THINGS):
        case = CameraView(thing, FIRST_SEED + k, list(CAMERAS)[k % 4], k % 2 == 1, ASSUMED, "", "", 0)
        stage, cloud, _, _ = view_of(case)
        corners = stage.truth.vertices
        middle = 0.5 * (corners.min(0) + corners.max(0))
        yield Seen(thing, cloud.points, cloud.viewpoint, middle, np.array([0.0, 0.0, 1.0]), stage.truth)


def frames(folder: Path) -> Iterator[Seen]:
    for path in sorted(folder.glob("*/camera.json")):
        cloud = load_depth_view(path.with_name("depth_mm.png"), path)
        seen = segment([cloud])
        if seen.support is None:
            continue
        target = np.median(seen.views[0].points, axis=0)
        yield Seen(path.parent.name, cloud.points, np.zeros(3), target, np.asarray(seen.support.normal))


def wrong_place(seen: Seen, rng: np.random.Generator) -> tuple[str, Vector]:
    """Draw a wrong camera position that sees the target from another direction. Return the kind and position [m]."""
    first = perpendicular(seen.up)
    away, said = seen.place - seen.target, np.zeros(3)
    while True:
        kind = str(rng.choice(["base", "mirror", "far", "round"]))
        elevation, turn = np.radians(rng.uniform(5, 85)), rng.uniform(0, 2 * np.pi)
        distance = float(np.linalg.norm(away))
        if kind == "base":
            elevation, distance = np.radians(rng.uniform(-5, 20)), rng.uniform(0.3, 0.8)
        if kind == "far":
            distance = 5.0
        level = np.cos(turn) * first + np.sin(turn) * np.cross(seen.up, first)
        said = distance * (np.cos(elevation) * level + np.sin(elevation) * seen.up)
        if kind == "mirror":
            said = -away
        if said @ away < np.cos(LEAST_TURN) * np.linalg.norm(said) * np.linalg.norm(away):
            return kind, seen.target + said


def forms(seen: Seen, rng: np.random.Generator) -> dict[str, PointCloud]:
    whole = PointCloud(seen.points[rng.permutation(len(seen.points))], seen.place)
    (thing,) = segment([whole], target=Target(point=seen.target)).views
    return {"all": whole, "thinned": whole.thinned(0.008), "alone": thing}


def outcome(seen: Seen, form: str, cloud: PointCloud, place: Vector) -> str:
    """Return graspd's answer: refused, doubted (a warning), none verified, or verified and whether all of them hold."""
    hand, protocol = load_hand("allegro_right"), out_of_place(PROTOCOLS["standard"])
    target = None if form == "alone" else Target(point=seen.target)
    try:
        said = PointCloud(cloud.points, place)
        scene = scene_from_views([said], target=target, alone=target is None, mass=PROTOCOL_MASS)
        if scene.evidence is not None and scene.evidence.doubts:
            return "doubted"
        result = plan_grasps(scene, hand, count=2, measure=False)
    except GraspdError as error:
        return "refused as seen from elsewhere" if "did not stand at" in str(error) else "refused otherwise"
    verified = [grasp for grasp in result.tried if grasp.verdict is Verdict.VERIFIED]
    if not verified or seen.truth is None:
        return "verified, truth unknown" if verified else "none verified"
    truth = build_scene(seen.truth, mass=PROTOCOL_MASS)
    world = build_world(hand, truth.object, object_parts(truth.object), protocol)
    held = all(hold_trial(world, grasp, protocol).passed for grasp in verified)
    return "verified, all hold on the truth" if held else "VERIFIED, AND ONE DOES NOT HOLD"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--frames", type=Path, default=None)
    options = parser.parse_args()
    rng, told = np.random.default_rng(7), {"true": Counter[str](), "wrong": Counter[str]()}
    scenes = [*rendered(), *(frames(options.frames) if options.frames else ())]
    clouds = [(seen, form, cloud) for seen in scenes for form, cloud in forms(seen, rng).items()]
    for seen, form, cloud in clouds:
        told["true"][outcome(seen, form, cloud, seen.place)] += 1
    for number in range(options.count):
        seen, form, cloud = clouds[number % len(clouds)]
        kind, place = wrong_place(seen, rng)
        found = outcome(seen, form, cloud, place)
        told["wrong"][found] += 1
        if found.startswith(("verified", "VERIFIED")):
            print(f"{seen.name} {form} {kind}: {found}", flush=True)
    for said, counts in told.items():
        print(f"{said} place: " + ", ".join(f"{many} {what}" for what, many in counts.most_common()))


if __name__ == "__main__":
    main()
