"""Study `cameras`: single views by four kinds of cameras, of objects at rest, alone or crowded.

An object is of a family of irregular shapes (`rendering/families.py`), a built-in shape of a random size, or a scan.
Grasps verified on the view are tried on the true object, at 0.1 kg and at the object's own mass. No setting was fitted
to these views. `HeldShares` (`config/planning_config.py`) come from other objects: `CHOSEN_ON` and five scans.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graspd_bench.rendering.depth_noise import CAMERAS
from graspd_bench.rendering.families import FAMILIES, OTHERS, draw_object
from graspd_bench.rendering.render import render_scene
from graspd_bench.rendering.tabletop import TabletopScene, crowded, moved, on_table, resting_pose, ring_poses, views_of
from graspd_bench.studies.seen_objects import calibration, reconstruction_error
from graspd_bench.study import PROTOCOL_MASS, Case, Record, Request, Sections, find_objects, masses_of
from graspd_core.config import ReconstructionConfig, SceneConfig
from graspd_core.errors import ConfigError, GraspdError
from graspd_core.hands.library import load_hand
from graspd_core.mesh.mesh_files import load_mesh, mass_properties
from graspd_core.mesh.shapes import make_shape, object_hash
from graspd_core.perception.cloud.camera import PinholeCamera
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.scene import build_scene, object_parts
from graspd_core.perception.scene_from_views import scene_from_views
from graspd_core.perception.segment.target_selection import Target
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.runtime import disk_cache
from graspd_core.types import TriangleMesh, Verdict
from graspd_core.verify.hold_trial import hold_trial, out_of_place
from graspd_core.verify.world import PROTOCOLS, altered, build_world
from graspd_dataset.run_records import markdown_table, object_name

# Families and shapes on which thresholds and `HeldShares` were chosen. This study plans no grasp for any of them.
CHOSEN_ON = (
    "pear", "pitcher", "pump", "tool", "plane", "sponge", "jar", "compound", "box", "cylinder", "mug", "l_block",
)  # fmt: skip
FIRST_SEED, SEEDS = 100, 4
SHAPES = ("sphere", "capsule", "bowl", "bottle")
# Ranges of density [kg/m³]: earthenware for the shapes of `_HOLLOW`, and hollow or full objects for all other shapes.
_WARE, _OTHER = (1500.0, 2500.0), (150.0, 1100.0)
_HOLLOW = ("mug", "bowl")
# Range of a camera's elevation [deg] and distance [m]. For a crowd, `_TRIES` camera poses are drawn. The first that
# sees more than the share `_SEEN` of the object is used.
_ELEVATION, _DISTANCE, _SEEN, _TRIES = (30.0, 65.0), (0.5, 1.0), 0.6, 20
# Ways to plan on a view: with or without a given mass, and with graspd's or Open3D's surface reconstruction.
ASSUMED, GIVEN, OPEN3D = "mass not given", "mass given", "mass not given, Open3D's Poisson"
_HEADINGS = [
    "views", "with a verified grasp", "verified grasps", "hold at 0.1 kg", "hold at own mass", "first, median",
    "Chamfer",
]  # fmt: skip


@dataclass(frozen=True)
class CameraView(Case):
    """A request for `count` grasps on one view of an object.

    Attributes:
        thing: name of a family or a shape, or path of a scan. The mass of a scan is in a csv file in the same folder.
        crowd: whether neighbours stand around the object.
        way: how to plan: `ASSUMED` (mass not given), `GIVEN` (mass given), or `OPEN3D` (not given, Open3D's Poisson).
    """

    thing: str
    seed: int
    camera: str
    crowd: bool
    way: str
    hand: str
    preset: str
    count: int

    @property
    def kind(self) -> str:
        """Return the kind of object: "irregular" (a family), "regular" (a shape) or "scan"."""
        return "irregular" if self.thing in FAMILIES | OTHERS else "scan" if Path(self.thing).suffix else "regular"

    def inputs(self) -> Record:
        """Return all inputs except the code. A scan counts by its content and mass, not by its path."""
        scan = self.kind == "scan"
        own = [object_name(self.thing), object_hash(self.thing), scan_mass(self.thing)] if scan else self.thing
        return {**super().inputs(), "thing": own}

    def recorded(self) -> Record:
        return {**super().recorded(), "thing": object_name(self.thing), "kind": self.kind}


def camera_cases(request: Request) -> tuple[CameraView, ...]:
    """Return cases for every object, seed and way to plan. The four cameras alternate. Half of the views have a crowd.

    Raises GraspdError: an object of the request is not a mesh file.
    """
    if shapes := [name for name in request.objects if name.startswith("shape:")]:
        raise ConfigError(f"objects: {shapes[0]}; valid: mesh files in a folder with a csv of masses")
    things = (*(name for name in FAMILIES if name not in CHOSEN_ON), *SHAPES)
    things += tuple(find_objects(request.objects)) if request.objects else ()
    seeds = request.seeds or range(FIRST_SEED, FIRST_SEED + SEEDS)
    if request.quick:
        things, seeds = things[:1], list(seeds)[:1]
    asked = {"hand": request.hand or "allegro_right", "preset": request.preset(), "count": request.count or 4}
    cameras, ways = list(CAMERAS), (ASSUMED, GIVEN, OPEN3D)[: 1 if request.quick else None]
    return tuple(
        CameraView(thing, seed, cameras[(seed + place) % 4], (seed // 4 + seed + place // 2) % 2 == 1, way, **asked)
        for seed in seeds
        for place, thing in enumerate(things)
        for way in ways
    )


def scan_mass(path: str) -> float:
    """Return the mass of a scan from a csv file in its folder [kg]. Raises ConfigError: see `masses_of`."""
    return masses_of([Path(path)])[0]


def object_of(case: CameraView) -> tuple[TriangleMesh, float]:
    """Return the true mesh of the object in its own frame [m], and its mass [kg]."""
    if case.kind == "irregular":
        drawn = draw_object(case.thing, case.seed)
        return drawn.mesh, drawn.mass
    rng = np.random.default_rng([case.seed, len(case.thing)])
    if case.kind == "scan":
        return load_mesh(case.thing), scan_mass(case.thing)
    mesh = make_shape(case.thing)
    mesh = TriangleMesh(mesh.vertices * rng.uniform(0.8, 1.3), mesh.faces)
    return mesh, float(rng.uniform(*(_WARE if case.thing in _HOLLOW else _OTHER)) * mass_properties(mesh)[0])


def view_of(case: CameraView) -> tuple[TabletopScene, PointCloud, float, Target | None]:
    """Return the scene, its view, the object's mass [kg], and the target that selects the object in a crowd."""
    rng = np.random.default_rng([case.seed, sum(map(ord, object_name(case.thing) + case.camera)), case.crowd])
    mesh, mass = object_of(case)
    target = moved(mesh, resting_pose(mesh, rng))
    others: tuple[TriangleMesh, ...] = ()
    if case.crowd:
        names = rng.choice(list(FAMILIES), 2, replace=False)
        drawn = [draw_object(str(name), case.seed + 1000).mesh for name in names]
        others = crowded(target, [*drawn, make_shape(str(rng.choice(["box", "cylinder", "mug"])))], rng)
    scene, camera = on_table(target, others), CAMERAS[case.camera]

    def place() -> np.ndarray:
        elevation, azimuth = np.deg2rad(rng.uniform(*_ELEVATION)), rng.uniform(0, 2 * np.pi)
        return ring_poses(1, elevation=elevation, azimuth=azimuth, distance=rng.uniform(*_DISTANCE))[0]

    poses = [place() for _ in range(_TRIES if others else 1)]
    pose = next((pose for pose in poses if _share_seen(scene, camera.lens, pose) > _SEEN), poses[0])
    (cloud,) = views_of(scene, camera.lens, (pose,), camera.noise, case.seed)
    middle = 0.5 * (target.vertices.min(0) + target.vertices.max(0))
    return scene, cloud, mass, Target(point=middle) if case.crowd else None


def _share_seen(scene: TabletopScene, lens: PinholeCamera, pose: np.ndarray) -> float:
    """Return the fraction of the object's pixels that its neighbours do not hide, as seen from a camera pose."""
    pixels = [(render_scene(some.meshes, lens, pose)[1] == 0).sum() for some in (scene, on_table(scene.truth))]
    return float(pixels[0] / max(pixels[1], 1))


def run_view(case: CameraView) -> Record:
    """Plan on the view. Try verified grasps on the true object. A GraspdError ends the case as `refused`."""
    stage, cloud, mass, target = view_of(case)
    hand = load_hand(case.hand)
    surface = ReconstructionConfig(poisson="open3d" if case.way == OPEN3D else "grid")
    disk_cache.forget()
    began = time.perf_counter()
    given = mass if case.way == GIVEN else None
    try:
        scene = scene_from_views([cloud], target=target, settings=SceneConfig(reconstruction=surface), mass=given)
        scene_s = time.perf_counter() - began
        result = plan_grasps(scene, hand, count=case.count, seed=case.seed, preset=case.preset)
    except GraspdError as error:
        return {"refused": str(error), "own_mass": mass, "verified": 0, "tenth": 0, "held": 0, "told": []}
    protocol = out_of_place(PROTOCOLS["standard"])
    truth = build_scene(stage.truth, source=case.thing, mass=mass)
    own = build_world(hand, truth.object, object_parts(truth.object), protocol)
    tenth = altered(own, mass=PROTOCOL_MASS)
    verified = [grasp for grasp in result.tried if grasp.verdict is Verdict.VERIFIED]
    sure = [grasp for grasp in result.tried if grasp.probability is not None]
    holds = {id(grasp): hold_trial(own, grasp, protocol) for grasp in (*verified, *sure)}
    first = result.timing.first_verified
    return {
        "own_mass": mass,
        "scene_s": scene_s,
        "first_s": None if first is None else scene_s + first - result.timing.load - result.timing.sdf,
        "verified": len(verified),
        "tenth": sum(hold_trial(tenth, grasp, protocol).passed for grasp in verified),
        "held": sum(holds[id(grasp)].passed for grasp in verified),
        "told": [(grasp.probability, holds[id(grasp)].passed) for grasp in sure],
        "reasons": [holds[id(grasp)].reason for grasp in verified if not holds[id(grasp)].passed],
        "chamfer_mm": reconstruction_error(scene, stage)["chamfer_mm"],
    }


def camera_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return a table with rows by way to plan, camera, crowd and kind of object, and the probability's calibration."""
    usual = [r for r in records if r["way"] == ASSUMED]
    rows = [(way, [r for r in records if r["way"] == way]) for way in (ASSUMED, GIVEN, OPEN3D)]
    for name, told in (("camera", str), ("crowd", lambda some: "crowded" if some else "alone"), ("kind", str)):
        values = sorted({r[name] for r in usual})
        rows += [(f"{told(value)}, {ASSUMED}", [r for r in usual if r[name] == value]) for value in values]
    body = [[name, *_row(own)] for name, own in rows if own]
    calibrations = [
        part
        for way in (ASSUMED, GIVEN)
        for part in calibration([tuple(pair) for r in records if r["way"] == way for pair in r["told"]], way)
    ]
    return {"cameras": [markdown_table(["planned on", *_HEADINGS], body), *calibrations]}


def _row(own: Sequence[Record]) -> list[str]:
    firsts = [r["first_s"] for r in own if r.get("first_s") is not None]
    errors = [r["chamfer_mm"] for r in own if "chamfer_mm" in r]
    some = sum(r["verified"] > 0 for r in own)
    return [
        str(len(own)),
        f"{some} ({some / len(own):.0%})",
        str(sum(r["verified"] for r in own)),
        _share(own, "tenth"),
        _share(own, "held"),
        f"{np.median(firsts):.1f} s" if firsts else "–",
        f"{np.mean(errors):.1f} mm" if errors else "–",
    ]


def _share(own: Sequence[Record], name: str) -> str:
    """Describe how many verified grasps held. Resample views for the 90 % interval, as errors in a view correlate."""
    pairs = np.array([(r[name], r["verified"]) for r in own])
    if not pairs[:, 1].sum():
        return "–"
    drawn = np.random.default_rng(0).integers(len(pairs), size=(2000, len(pairs)))
    shares = pairs[drawn, 0].sum(1) / np.maximum(pairs[drawn, 1].sum(1), 1)
    low, high = np.quantile(shares, [0.05, 0.95])
    held, of = pairs.sum(0)
    return f"{held}/{of}, {held / of:.1%} ({low:.0%} to {high:.0%})"
