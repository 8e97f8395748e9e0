"""Study `reach`: inverse kinematics of the arms, and planning with and without the `Reach` restriction.

`Reach` refuses grasps that the arm cannot reach. Objects stand or lie on a table. The arm's base is 40 to 80 cm away,
in a random direction with a random yaw. After a plan without `Reach`, verified grasps in reach are counted.
"""

from __future__ import annotations

import importlib.util
import re
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from graspd_bench.study import PROTOCOL_MASS, Case, ObjectCase, Record, Request, Sections, find_objects
from graspd_core.arms.arm import Arm, arm_links, arm_names, load_arm
from graspd_core.arms.arm_paths import arm_paths
from graspd_core.arms.inverse_kinematics import (
    POSITION_TOLERANCE,
    ROTATION_TOLERANCE,
    nearest_postures,
    random_postures,
    solve,
    start_table,
)
from graspd_core.arms.reach import Reach
from graspd_core.hands.model import HandModel
from graspd_core.optimize.restrictions import BoundRestriction, Refusal
from graspd_core.perception.scene import Scene, build_scene
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.se3 import SE3, axis_rotation
from graspd_core.types import ArmPath, Grasp, Plane, Progress, TriangleMesh
from graspd_dataset.run_records import markdown_table

# Built-in shapes. Each shape is tried in two random scenes for every arm.
SHAPES = ("box", "mug", "hammer", "bottle", "torus", "cylinder", "plate", "l_block", "sphere", "bowl")
POSES = 1000
NEAREST, FARTHEST = 0.4, 0.8
# Poses per batch, maximum number of starts for each pose, and steps of each start. If a start fails, the next is used.
_BATCH, _STARTS, _STEPS = 256, 12, 16
# Starts and steps of pytorch-kinematics. Lower numbers reach fewer poses.
_RETRIES, _ITERATIONS = 20, 50


@dataclass(frozen=True)
class ArmCase(Case):
    """Test of an arm's inverse kinematics on `poses` poses that the arm can reach."""

    arm: str
    poses: int


@dataclass(frozen=True)
class ReachCase(ObjectCase):
    """A request for `count` grasps of an object on a table, with an arm. The seed sets the poses of object and arm."""

    arm: str = ""

    def place(self) -> tuple[HandModel, Scene, Reach]:
        """Return the hand, the scene with the object standing or lying, and the `Reach` of an arm at a random place."""
        rng = np.random.default_rng((self.seed, sum(self.object.encode())))
        hand, scene = self.load()
        side = axis_rotation(np.eye(3)[int(rng.integers(2))], float(rng.choice([0.0, np.pi / 2])))
        vertices = scene.object.mesh.vertices @ side.T
        vertices = vertices - 0.5 * (vertices.min(0) + vertices.max(0))
        support = Plane(np.array([0.0, 0.0, 1.0]), float(vertices[:, 2].min()))
        mesh = TriangleMesh(vertices, scene.object.mesh.faces)
        scene = build_scene(
            mesh, source=self.object, mass=PROTOCOL_MASS, resolution=self.config.resolution, support=support
        )
        away, where, turn = rng.uniform(NEAREST, FARTHEST), *rng.uniform(-np.pi, np.pi, 2)
        base = (float(away * np.cos(where)), float(away * np.sin(where)), support.offset)
        quaternion = (float(np.cos(turn / 2)), 0.0, 0.0, float(np.sin(turn / 2)))
        return hand, scene, Reach(load_arm(self.arm), base, quaternion)


def reach_cases(request: Request) -> tuple[ArmCase | ReachCase, ...]:
    """Return an inverse kinematics case for every arm, and a planning request for every arm, object and seed."""
    arms = [ArmCase(arm, 256 if request.quick else POSES) for arm in arm_names()]
    objects = find_objects(request.objects or [f"shape:{name}" for name in SHAPES])
    seeds = request.seeds or ((0,) if request.objects else (0, 1))
    cases = [
        ReachCase(source, request.preset(), request.hand or "allegro_right", seed, request.count or 4, arm)
        for source in objects
        for seed in seeds
        for arm in arm_names()
    ]
    return (*arms[:1], *cases[:1]) if request.quick else (*arms, *cases)


def run_reach(case: ArmCase | ReachCase) -> Record:
    return measure_arm(load_arm(case.arm), case.poses) if isinstance(case, ArmCase) else _run_request(case)


def _run_request(case: ReachCase) -> Record:
    """Plan without and with `Reach`, after a plan that fills caches. Return counts of grasps, and CPU times [s]."""
    hand, scene, reach = case.place()
    request: dict[str, Any] = {"count": case.count, "seed": case.seed, "preset": case.config, "measure": False}
    plan_grasps(scene, hand, count=1, measure=False, restrictions=[reach])
    timed = _Timed(reach, [])
    plain = _Found([])
    plan_grasps(scene, hand, **request, progress=plain)
    filtered = _Found(timed.seconds)
    result = plan_grasps(scene, hand, **request, progress=filtered, restrictions=[timed])
    task = reach.bind(scene, hand).task
    reached = [isinstance(path, ArmPath) for path in arm_paths(task, [grasp for _, _, grasp in plain.found])]
    return {
        "plain": {
            "verified": len(reached),
            "reached": sum(reached),
            "best": bool(reached and reached[0]),
            "first_s": next((at for (at, *_), good in zip(plain.found, reached, strict=True) if good), None),
        },
        "filtered": {
            "verified": len(filtered.found),
            "first_s": filtered.found[0][0] if filtered.found else None,
            "filter_s": filtered.found[0][1] if filtered.found else sum(timed.seconds),
            "refused": dict(result.refused),
        },
    }


class _Found:
    """Progress hook. At each verified grasp it records the CPU time so far [s]: in total, and of the restriction."""

    def __init__(self, seconds: Sequence[float]) -> None:
        self.found: list[tuple[float, float, Grasp]] = []
        self._seconds, self._began = seconds, time.process_time()

    def __call__(self, progress: Progress) -> None:
        if progress.found is not None:
            self.found.append((time.process_time() - self._began, sum(self._seconds), progress.found))


@dataclass(frozen=True, eq=False)
class _Timed(BoundRestriction):
    """Restriction that calls `reach` and records the CPU time of each call [s]."""

    reach: Any
    seconds: list[float]

    def bind(self, scene: Scene, hand: HandModel) -> _Timed:
        return _Timed(self._timed(self.reach.bind, scene, hand), self.seconds)

    def starts(self, positions: np.ndarray, quaternions: np.ndarray, joints: np.ndarray) -> np.ndarray:
        return self._timed(self.reach.starts, positions, quaternions, joints)

    def admit(self, grasps: Sequence[Grasp]) -> Sequence[Grasp | Refusal]:
        return self._timed(self.reach.admit, grasps)

    def _timed(self, call: Any, *values: Any) -> Any:
        began = time.thread_time()
        try:
            return call(*values)
        finally:
            self.seconds.append(time.thread_time() - began)


def summary(record: Record) -> str:
    """Return the share of reached poses, or the numbers of grasps in reach, in a few words."""
    if "own" in record:
        return f"{record['own']['reached']:.1%} of the poses reached"
    return f"verified in reach: {record['filtered']['verified']} with `Reach`, {record['plain']['reached']} without"


def reach_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return a section on inverse kinematics, and a section on the requests with the reasons of refusals."""
    alone, filtered = ([r for r in records if key in r] for key in ("own", "filtered"))
    return {
        "inverse-kinematics": [_alone_table(alone)] if alone else [],
        "reach": [_filtered_table(filtered), _reasons(filtered)] if filtered else [],
    }


def _alone_table(records: Sequence[Record]) -> str:
    headings = ["arm", "solver", "reached", "CPU ms a pose"]
    rows = [
        [record["arm"], solver, f"{record[key]['reached']:.1%}", f"{record[key]['ms']:.2f}"]
        for record in records
        for key, solver in (("own", "graspd"), ("library", "pytorch-kinematics"))
        if record[key]
    ]
    return markdown_table(headings, rows)


def _filtered_table(records: Sequence[Record]) -> str:
    headings = ["arm", "requests", "filter", "with a verified grasp in reach", "the best one is", "CPU s to the first"]
    headings += ["filter's share of that time"]
    rows: list[list[str]] = []
    for arm in sorted({record["arm"] for record in records}):
        mine = [record for record in records if record["arm"] == arm]
        plain, filtered = ([record[key] for record in mine] for key in ("plain", "filtered"))
        shares = [one["filter_s"] / one["first_s"] for one in filtered if one["verified"]]
        some, best = sum(one["reached"] > 0 for one in plain), sum(one["best"] for one in plain)
        good = sum(one["verified"] > 0 for one in filtered)
        share = f"{median(shares):.1%}, at most {max(shares):.1%}" if shares else "–"
        rows.append([arm, str(len(mine)), "without", str(some), str(best), _seconds(plain), "–"])
        rows.append(["", "", "with", str(good), str(good), _seconds(filtered), share])
    return markdown_table(headings, rows)


def _seconds(ones: Sequence[Record]) -> str:
    known = [one["first_s"] for one in ones if one["first_s"] is not None]
    return f"{median(known):.2f}" if known else "–"


def _reasons(records: Sequence[Record]) -> str:
    """Return a sentence with the number of refused candidates for each kind of reason."""
    kinds = Counter[str]()
    for record in records:
        for reason, count in record["filtered"]["refused"].items():
            kinds[next((kind for word, kind in _KINDS.items() if word in reason), reason)] += count
    counts = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
    return f"Refused before any trial: {counts or 'none'}."


# Kinds of reasons by a word of the reason, whatever link or joint it names. The first word that occurs counts.
_KINDS = {
    "limit on the path": "beyond a joint's limit on the path",
    "limit": "beyond a joint's limit",
    "jump": "with a jump of a joint",
    **{kind: kind for kind in ("in the table", "in the object", "against the hand")},
    "against": "arm against itself",
}


def measure_arm(arm: Arm, poses: int) -> Record:
    """Measure graspd's inverse kinematics, and that of pytorch-kinematics if installed, on the same reachable poses."""
    q = random_postures(arm, poses, torch.Generator().manual_seed(11))
    target = arm_links(arm, q)[:, arm.tip]
    start_table(arm)
    library = _library(arm) if importlib.util.find_spec("pytorch_kinematics") else None
    return {"own": _measured(lambda tip: _own(arm, tip), target), "library": library and _measured(library, target)}


def _measured(solver: Callable[[SE3], Bool[Tensor, "batch"]], target: SE3) -> Record:
    """Return the share of poses reached, and the CPU time per pose [ms]."""
    solver(target[:_BATCH])
    began, reached = time.process_time(), 0
    for first in range(0, len(target.translation), _BATCH):
        reached += int(solver(target[first : first + _BATCH]).sum())
    count = len(target.translation)
    return {"reached": reached / count, "ms": 1e3 * (time.process_time() - began) / count}


def _own(arm: Arm, target: SE3) -> Bool[Tensor, "batch"]:
    reached = torch.zeros(len(target.translation), dtype=torch.bool)
    for starts in nearest_postures(start_table(arm), target, _STARTS).unbind(1):
        rows = torch.nonzero(~reached).flatten()
        if not len(rows):
            break
        reached[rows] = solve(arm, target[rows], starts[rows], _STEPS)[1]
    return reached


def _library(arm: Arm) -> Callable[[SE3], Bool[Tensor, "batch"]]:
    """Return a pytorch-kinematics solver: damped least squares within joint limits, with the tolerances of graspd."""
    import pytorch_kinematics

    # The URDF reader of pytorch-kinematics does not support capsules.
    text = re.sub(r"<collision>.*?</collision>", "", Path(arm.chain.urdf).read_text(), flags=re.DOTALL)
    tip = arm.chain.link_names[arm.tip]
    chain = pytorch_kinematics.build_serial_chain_from_urdf(text.encode(), tip).to(dtype=torch.float64)
    limits = torch.stack([torch.as_tensor(arm.lower), torch.as_tensor(arm.upper)], 1)
    solver = pytorch_kinematics.PseudoInverseIK(
        chain,
        max_iterations=_ITERATIONS,
        num_retries=_RETRIES,
        joint_limits=limits,
        pos_tolerance=POSITION_TOLERANCE,
        rot_tolerance=ROTATION_TOLERANCE,
        early_stopping_any_converged=True,
        early_stopping_no_improvement="all",
    )

    def solved(target: SE3) -> Bool[Tensor, "batch"]:
        matrix = torch.eye(4, dtype=torch.float64).repeat(len(target.translation), 1, 1)
        matrix[:, :3, :3], matrix[:, :3, 3] = target.rotation, target.translation
        found = solver.solve(pytorch_kinematics.Transform3d(matrix=matrix))
        inside = ((found.solutions >= limits[:, 0]) & (found.solutions <= limits[:, 1])).all(-1)
        return (found.converged & inside).any(1)

    return solved
