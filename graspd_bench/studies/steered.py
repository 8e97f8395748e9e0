"""Study `steered`: requests with and without a steering constraint. Do grasps obey, and what does the constraint cost?

Constraints are drawn at random from the case's seed, object and hand. Some cannot be met, such as an approach cone from
a side where the object is too wide for the hand. This module computes obedience from postures and contacts.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from graspd_bench.study import ObjectCase, Record, Request, Sections, find_objects
from graspd_core.hands.model import HandModel
from graspd_core.perception.scene import Scene, object_parts
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.planning.regions import Box, entered
from graspd_core.planning.steering import Steering
from graspd_core.types import Grasp, Verdict
from graspd_dataset.run_records import markdown_table, object_name

SHAPES = ("box", "bottle", "mug", "hammer", "torus", "plate", "cylinder", "l_block", "bowl", "capsule")
HANDS = ("allegro_right", "leap_right", "barrett_like", "parallel_gripper")
CONSTRAINTS = ("cone", "cone and roll", "region", "cone and region", "avoid")
# Ranges of a cone's half-angle [rad] and of a region's share of the object's length. Least length of this share [m].
_ANGLES, _SHARES, _BREADTH = (0.35, 0.8), (0.4, 0.7), 0.05
_ROLL_TOLERANCE = 0.35
# Share of the object's length in a box to avoid, and how far the box extends beyond the object [m].
_END, _BEYOND = 0.25, 0.03


@dataclass(frozen=True)
class SteeredCase(ObjectCase):
    """Two plans of the same request: one with a steering constraint (a kind of `CONSTRAINTS`), one without."""

    constraint: str = "cone"


def steered_cases(request: Request) -> tuple[SteeredCase, ...]:
    """Return a case for each object, hand, kind of constraint (`CONSTRAINTS`) and seed."""
    things = find_objects(request.objects or tuple(f"shape:{s}" for s in SHAPES[: 1 if request.quick else None]))
    hands = (request.hand,) if request.hand else HANDS[: 1 if request.quick else None]
    count, preset = request.count or (2 if request.quick else 4), request.preset()
    return tuple(
        SteeredCase(thing, preset, hand, seed, count, constraint)
        for seed in request.seeds or (0,)
        for hand in hands
        for thing in things
        for constraint in CONSTRAINTS
    )


def drawn_constraint(case: SteeredCase, scene: Scene) -> Steering:
    """Draw the steering constraint of a case. The constraint depends only on seed, object, hand and kind."""
    rng = np.random.default_rng([case.seed, zlib.crc32(f"{case.object} {case.hand} {case.constraint}".encode())])
    direction, angle = rng.normal(size=3), float(rng.uniform(*_ANGLES))
    vertices = scene.object.mesh.vertices
    cone = {"approach_direction": direction / np.linalg.norm(direction), "approach_angle": angle}
    if case.constraint == "cone":
        return Steering(**cone)
    if case.constraint == "cone and roll":
        return Steering(**cone, roll=float(rng.uniform(-np.pi, np.pi)), roll_tolerance=_ROLL_TOLERANCE)
    if case.constraint == "avoid":
        return Steering(avoid=[_end_of(vertices, rng, _END, _BEYOND)])
    region = _end_of(vertices, rng, float(rng.uniform(*_SHARES)), 0.01)
    return Steering(**(cone if case.constraint == "cone and region" else {}), region=region)


def _end_of(vertices: Float[np.ndarray, "n 3"], rng: np.random.Generator, share: float, beyond: float) -> Box:
    """Draw a box around an end of the object. The box's faces, except the inner one, are `beyond` [m] off the object.

    The end is `share` of the object's length on a random axis. For `beyond` under 3 cm, it is at least 5 cm.
    """
    low, high = vertices.min(0), vertices.max(0)
    axis, side = int(rng.integers(3)), int(rng.integers(2))
    breadth = max(share * (high - low)[axis], _BREADTH if beyond < _BEYOND else 0.0)
    low, high = low - beyond, high + beyond
    if side:
        low[axis] = high[axis] - breadth - beyond
    else:
        high[axis] = low[axis] + breadth + beyond
    return Box((low + high) / 2, high - low)


def run_steered(case: SteeredCase) -> Record:
    """Plan with and without the constraint. Return CPU times, counts of verified grasps, and greatest violations."""
    hand, scene = case.load()
    object_parts(scene.object)
    steering = drawn_constraint(case, scene)
    plain, plain_s = _timed(case, scene, hand, ())
    found, steered_s = _timed(case, scene, hand, (steering,))
    good = [grasp for grasp in found.tried if grasp.verdict is Verdict.VERIFIED]
    return {
        "shape": object_name(case.object),
        "plain_cpu_s": plain_s,
        "steered_cpu_s": steered_s,
        "plain": sum(grasp.verdict is Verdict.VERIFIED for grasp in plain.tried),
        "held": len(good),
        "tried": len(found.tried),
        "refused": dict(found.refused),
        "message": found.message,
        # Greatest violation of each constraint. It is negative if all grasps obey.
        "beyond_cone_rad": max((beyond_cone(hand, grasp, steering) for grasp in good), default=None),
        "beyond_region_m": max((beyond_region(grasp, steering) for grasp in good), default=None),
        "in_boxes": sum(bool(entered(hand, [g.pregrasp, g.grasp, g.squeeze], steering.avoid).any()) for g in good),
    }


def _timed(case: SteeredCase, scene: Scene, hand: HandModel, restrictions: Sequence[Steering]):
    began = time.process_time()
    found = plan_grasps(
        scene, hand, count=case.count, seed=case.seed, preset=case.config, measure=False, restrictions=restrictions
    )
    return found, time.process_time() - began


def beyond_cone(hand: HandModel, grasp: Grasp, goal: Steering) -> float:
    """Return by which angle a grasp's approach is outside the cone [rad]. Negative if inside, or if no cone is set."""
    if goal.approach_direction is None:
        return -np.pi
    w, x, y, z = grasp.grasp.quaternion_wxyz
    approach = Rotation.from_quat([x, y, z, w]).apply(hand.approach)
    return float(np.arccos(np.clip(approach @ np.asarray(goal.approach_direction), -1, 1))) - goal.approach_angle


def beyond_region(grasp: Grasp, goal: Steering) -> float:
    """Return how far the farthest contact is outside the region [m]. Negative if all are inside or no region is set."""
    if not isinstance(goal.region, Box):
        return -1.0
    beyond = (
        np.abs(np.array([c.position for c in grasp.contacts]) - goal.region.center) - np.array(goal.region.size) / 2
    )
    return float(beyond.max())


def steered_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return a table with a row for each kind of constraint: success and CPU time with and without it, violations."""
    headings = ["constraint", "requests", "with a verified grasp", "without it", "grasps of those asked for"]
    headings += ["without it", "CPU s, median", "without it", "beyond cone, at worst", "beyond region", "in boxes"]
    kinds = (*CONSTRAINTS, "all")
    body = [_row(kind, [record for record in records if kind in ("all", record["constraint"])]) for kind in kinds]
    return {"steered": [markdown_table(headings, [row for row in body if row])]}


def _row(constraint: str, here: Sequence[Record]) -> list[str]:
    if not here:
        return []
    share = lambda key: f"{np.mean([r[key] > 0 for r in here]):.1%}"  # noqa: E731
    count = sum(r["count"] for r in here)
    grasps = lambda key: f"{sum(r[key] for r in here) / count:.1%}"  # noqa: E731
    seconds = lambda key: f"{np.median([r[key] for r in here]):.2f}"  # noqa: E731
    cones = [r["beyond_cone_rad"] for r in here if r["beyond_cone_rad"] is not None and "cone" in r["constraint"]]
    regions = [r["beyond_region_m"] for r in here if r["beyond_region_m"] is not None and "region" in r["constraint"]]
    return [
        constraint,
        str(len(here)),
        share("held"),
        share("plain"),
        grasps("held"),
        grasps("plain"),
        seconds("steered_cpu_s"),
        seconds("plain_cpu_s"),
        f"{max(0.0, np.degrees(max(cones))):.2f}°" if cones else "",
        f"{max(0.0, 1e3 * max(regions)):.1f} mm" if regions else "",
        str(sum(r["in_boxes"] for r in here)) if constraint in ("avoid", "all") else "",
    ]
