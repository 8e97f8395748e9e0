"""Study `mano`: human grasps in the units of the Grasp'D paper: contact area, intersection volume, displacement.

    graspd bench mano --hand MANO_RIGHT.pkl

The user provides the MANO model (https://mano.is.tue.mpg.de), because graspd does not ship it. Grasps are planned with
rigid flesh and with flesh that yields by 1 mm. All grasps go through the hold trial, in which convex hulls form the
hand. As in the paper, the two best ranked grasps per object are measured, on the skinned mesh (docs/metrics.md).
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from graspd_bench.bullet.bullet_world import build_bullet_world, bullet_available, bullet_displacement
from graspd_bench.study import PROTOCOL_MASS, ObjectCase, Record, Request, Sections, object_cases, raw_grasps
from graspd_core.errors import ConfigError
from graspd_core.hands.mano.mano_hand import load_mano
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.shapes import object_hash
from graspd_core.mesh.surface_queries import DistanceQuery, is_inside, make_distance_query, signed_distance
from graspd_core.mesh.topology import scaled_normals
from graspd_core.optimize.plan_config import PlanConfig, load_preset, override, to_mapping
from graspd_core.perception.load_scene import load_scene
from graspd_core.perception.scene import object_parts
from graspd_core.types import TriangleMesh
from graspd_core.verify.hold_trial import hold_trial
from graspd_core.verify.world import PROTOCOLS, build_world
from graspd_dataset.run_records import markdown_table, object_name

# Distances within which skin counts as touching [m]: ours, and two that other projects use.
CONTACT_DISTANCES = (0.002, 0.005, 0.010)
VOXEL = 0.001
# Number of points sampled on the skin, about 1 mm apart on an adult's hand, and their random seed.
_SAMPLES, _SEED = 40_000, 7


@dataclass(frozen=True)
class SkinMetrics:
    """Metrics of a skinned hand mesh on an object.

    Attributes:
        contact_area: area of the skin that is near the object's surface [m²], one for each of `CONTACT_DISTANCES`.
        intersection_volume: volume inside both meshes, counted in voxels of 1 mm [m³].
        penetration: greatest depth of the skin in the object [m].
    """

    contact_area: tuple[float, ...]
    intersection_volume: float
    penetration: float


def measure_skin(query: DistanceQuery, skin: TriangleMesh) -> SkinMetrics:
    """Measure how a closed skin mesh touches an object, object frame [m]. `query` gives distances to the object."""
    points, _ = surface_samples(skin, _SAMPLES, _SEED)
    distance = signed_distance(query, points, reach=2 * CONTACT_DISTANCES[-1])
    each = 0.5 * float(np.linalg.norm(scaled_normals(skin.vertices, skin.faces), axis=1).sum()) / len(points)
    return SkinMetrics(
        contact_area=tuple(float((np.abs(distance) <= within).sum()) * each for within in CONTACT_DISTANCES),
        intersection_volume=_shared_volume(query, skin),
        penetration=float(max(0.0, -distance.min())),
    )


def _shared_volume(query: DistanceQuery, skin: TriangleMesh) -> float:
    """Return the volume inside both object and skin [m³], by counting centres of 1 mm voxels."""
    low = np.maximum(query.tree.low, skin.vertices.min(0))
    high = np.minimum(query.tree.high, skin.vertices.max(0))
    if (high <= low).any():
        return 0.0
    ends = zip(np.floor(low / VOXEL), np.ceil(high / VOXEL), strict=True)
    axes = [(np.arange(first, last) + 0.5) * VOXEL for first, last in ends]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    cells = cells[is_inside(query.tree, cells)]
    if len(cells) == 0:
        return 0.0
    return float(is_inside(make_distance_query(skin).tree, cells).sum()) * VOXEL**3


SHAPES = ("shape:sphere", "shape:cylinder", "shape:box")
BEST = 2
# Turpin et al. 2022, table 1, MANO: mean over 57 ShapeNet objects, two best grasps each. The values are contact area
# [cm²], intersection volume [cm³], their ratio [1/cm] and displacement [cm].
PAPER = {"Grasp'D": (43.0, 5.70, 7.55, 0.59), "ObMan / GraspIt!": (9.4, 1.28, 7.37, 1.95)}
# Depths by which flesh yields in planning [m]: 0 as in the paper, and 1 mm, which is less than a finger pad yields.
SOFTNESS = (0.0, 0.001)
# Default preset and seeds.
_PRESET, _SEEDS = "contact_rich", (0, 1, 2)
_HEADINGS = [
    "object, flesh gives", "held, raw", "contact area cm² within 2 mm (5, 10)", "intersection cm³", "CA/IV 1/cm",
    "displacement cm", "penetration mm", "CPU s per grasp",
]  # fmt: skip


@dataclass(frozen=True)
class HumanGrasps(ObjectCase):
    """Grasps of an object with a MANO file. `content` is the file's hash. The flesh yields by `softness` [m]."""

    content: str = ""
    softness: float = 0.0

    @property
    def config(self) -> PlanConfig:
        return override(load_preset(self.preset), {"problem.softness": self.softness})

    def inputs(self) -> Record:
        return {**asdict(self), "hand": "", "object": object_hash(self.object), "settings": to_mapping(self.config)}


def mano_cases(request: Request) -> tuple[HumanGrasps, ...]:
    """Return a case for each object, seed and softness. Raises ConfigError: the hand is not a file."""
    model = Path(request.hand)
    if not model.is_file():
        raise ConfigError(f"hand: {request.hand or 'none given'}; valid: the path of MANO_RIGHT.pkl or MANO_LEFT.pkl")
    content = hashlib.sha256(model.read_bytes()).hexdigest()
    request = replace(request, presets=request.presets or (_PRESET,), seeds=request.seeds or _SEEDS)
    cases = object_cases(request, SHAPES, 8)
    return tuple(HumanGrasps(**vars(case), content=content, softness=soft) for soft in SOFTNESS for case in cases)


def run_mano(case: HumanGrasps) -> Record:
    """Plan on one object, run the hold trial of every grasp, and measure the two best ranked grasps."""
    config = case.config
    mano = load_mano(Path(case.hand), [], candidates=config.problem.fine_candidates)
    scene = load_scene(case.object, mass=PROTOCOL_MASS, resolution=config.resolution)
    began = time.process_time()
    grasps = raw_grasps(scene, mano.model, config, case.count, case.seed)
    seconds = (time.process_time() - began) / case.count
    parts = object_parts(scene.object)
    world = build_world(mano.model, scene.object, parts, PROTOCOLS["standard"])
    holds = [hold_trial(world, grasp, PROTOCOLS["standard"]) for grasp in grasps]
    query = make_distance_query(scene.object.mesh)
    skins = [measure_skin(query, mano.skinned_mesh(grasp.grasp)) for grasp in grasps[:BEST]]
    bullet = build_bullet_world(mano.model, scene.object, parts) if bullet_available() else None
    return {
        "held": sum(hold.passed for hold in holds),
        "reasons": [hold.reason for hold in holds if not hold.passed],
        "contact_area_cm2": [[area * 1e4 for area in skin.contact_area] for skin in skins],
        "intersection_volume_cm3": [skin.intersection_volume * 1e6 for skin in skins],
        "penetration_mm": [skin.penetration * 1e3 for skin in skins],
        "displacement_cm": [bullet_displacement(bullet, g.grasp) * 100 for g in grasps[:BEST]] if bullet else [],
        "cpu_seconds_per_grasp": seconds,
    }


def mano_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return a table with rows for each softness of the flesh (by object, then the mean) and the paper's results."""
    body = []
    for softness in dict.fromkeys(r["softness"] for r in records):
        alike = [r for r in records if r["softness"] == softness]
        for thing in dict.fromkeys(r["object"] for r in alike):
            body.append(_row(object_name(thing), softness, [r for r in alike if r["object"] == thing]))
        body.append(_row("**mean**", softness, alike))
    for name, (area, volume, ratio, moved) in PAPER.items():
        body.append([f"{name}, as published", "", f"{area}", f"{volume:.2f}", f"{ratio}", f"{moved}", "", ""])
    return {"mano": [markdown_table(_HEADINGS, body)]}


def _row(name: str, softness: float, records: Sequence[Record]) -> list[str]:
    """Return a table row with means over the measured grasps. If no grasp was measured, the cells are empty."""
    name = f"{name}, {1e3 * softness:g} mm" if softness else f"{name}, rigid"
    held = f"{sum(r['held'] for r in records)}/{sum(r['count'] for r in records)}"
    if not any(r["contact_area_cm2"] for r in records):
        return [name, "no grasp found", *[""] * 6]

    def mean(key: str) -> float | None:
        values = [value for record in records for value in record[key]]
        return float(np.mean(values)) if values else None

    area = np.mean([areas for record in records for areas in record["contact_area_cm2"]], axis=0)
    volume, moved, depth = (mean(k) for k in ("intersection_volume_cm3", "displacement_cm", "penetration_mm"))
    return [
        name,
        held,
        f"{area[0]:.1f} ({area[1]:.1f}, {area[2]:.1f})",
        f"{volume:.2f}",
        f"{area[0] / volume:.2f}" if volume else "none",
        "no pybullet" if moved is None else f"{moved:.2f}",
        f"{depth:.1f}",
        f"{np.mean([record['cpu_seconds_per_grasp'] for record in records]):.3f}",
    ]
