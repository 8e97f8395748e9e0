"""Study `early`: whether trials that stop early give the verdict of full-length trials, and how much time they save.

The study uses the first grasps of the method's own ranking. No trial filters them. Each grasp goes through the trials
of `trials_of`, once with early stopping and once at full length.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from graspd_bench.study import PROTOCOL_MASS, ObjectCase, Record, Request, Sections, find_objects, raw_grasps
from graspd_bench.trials import gravity_trial
from graspd_core.config import RobustConfig
from graspd_core.hands.library import hand_names
from graspd_core.hands.model import HandModel
from graspd_core.perception.load_scene import load_scene
from graspd_core.perception.scene import Scene, object_parts
from graspd_core.types import Grasp, Plane, TriangleMesh
from graspd_core.verify.hold_trial import displaced, hold_trial, out_of_place, pose_errors
from graspd_core.verify.lift_trial import lift_trial
from graspd_core.verify.world import PROTOCOLS, at_friction, build_world
from graspd_dataset.run_records import markdown_table

# Thin objects: a built-in shape, and the factors on its extents along x, y and z.
THIN = (("shape:plate", (1.0, 1.0, 0.3)), ("shape:box", (0.2, 0.2, 2.0)), ("shape:box", (0.1, 0.5, 2.0)))
SHAPES = ("shape:mug", "shape:hammer", "shape:torus")
ERROR_SEED = 4711
# Runs a trial of a grasp. Arguments: the grasp, whether to run the full length, and the error of the hand's pose.
Trial = Callable[[Grasp, bool, Any], Any]


@dataclass(frozen=True)
class EarlyEnds(ObjectCase):
    """Grasps of an object. `factors` scale the object along x, y and z. Without factors, the object keeps its size."""

    factors: tuple[float, ...] = ()

    def load(self, friction: float = 0.6) -> tuple[HandModel, Scene]:
        hand, scene = super().load(friction)
        if not self.factors:
            return hand, scene
        mesh = scene.object.mesh
        return hand, load_scene(TriangleMesh(mesh.vertices * self.factors, mesh.faces), mass=PROTOCOL_MASS)


def early_cases(request: Request) -> tuple[EarlyEnds, ...]:
    """Return a case for each hand and object. Default: all built-in hands, a few shapes, and thin objects."""
    things = [(thing, ()) for thing in find_objects(request.objects or SHAPES)]
    hands = (request.hand,) if request.hand else hand_names()
    cases = tuple(
        EarlyEnds(thing, request.preset(), hand, seed, request.count or 4, factors)
        for seed in request.seeds or (0,)
        for thing, factors in (*things, *(() if request.objects else THIN))
        for hand in hands
    )
    return cases[:1] if request.quick else cases


def run_early(case: EarlyEnds) -> Record:
    """Run every trial of every grasp twice: early (may stop early) and late (full length). Return one row per trial."""
    hand, scene = case.load()
    grasps = raw_grasps(scene, hand, case.config, case.count, case.seed)
    errors = pose_errors((ERROR_SEED, case.seed), max(len(grasps), 1))
    trials = trials_of(hand, scene) if grasps else {}
    return {
        "rows": [
            {
                "group": group,
                "index": index,
                **{way: _run(trial, grasp, way == "late", error) for way in ("early", "late")},
            }
            for index, (grasp, error) in enumerate(zip(grasps, errors, strict=False))
            for group, trial in trials.items()
        ]
    }


def trials_of(hand: HandModel, scene: Scene) -> Mapping[str, Trial]:
    """Return the trials by name. "noisy" is "displaced" with shorter pulls, as in the ranking by noisy trials."""
    parts, center = object_parts(scene.object), scene.object.center_of_mass
    standard, hard = PROTOCOLS["standard"], PROTOCOLS["hard"]
    slippery, brief = at_friction(standard, 0.3), replace(standard, hold_time=RobustConfig().hold_time)
    usual, low, harder = (build_world(hand, scene.object, parts, p) for p in (standard, slippery, hard))
    # The hand cannot reach this table, 1 m below the object. In the lift the object rests on a plane of its own.
    table = Plane(np.array([0.0, 0.0, 1.0]), float(scene.object.mesh.vertices[:, 2].min()) - 1.0)
    around = build_world(hand, scene.object, parts, standard, table)

    def hold(world: Any, protocol: Any, moved: bool = False) -> Trial:
        def trial(grasp: Grasp, full: bool, error: Any) -> Any:
            grasp = displaced(grasp, error[0], error[1], center) if moved else grasp
            physics = out_of_place(protocol) if moved else protocol
            return hold_trial(world, grasp, replace(physics, full_length=full))

        return trial

    return {
        "standard": hold(usual, standard),
        "displaced": hold(usual, standard, True),
        "slippery": hold(low, slippery),
        "hard": hold(harder, hard),
        "lift": lambda g, full, error: lift_trial(around, hand, g, replace(standard, full_length=full)),
        "noisy": hold(usual, brief, True),
        "gravity": lambda g, full, error: gravity_trial(usual, g, replace(standard, full_length=full)),
    }


def early_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return a table of disagreements and CPU time by trial, and a list of all cases that disagree."""
    groups: dict[str, list[Record]] = {}
    text = []
    for record in records:
        for row in record["rows"]:
            names = [row["group"]]
            if record["factors"] and row["group"] == "standard":
                names.append("of standard, thin")
            for name in names:
                groups.setdefault(name, []).append(row)
            if row["early"].get("passed") != row["late"].get("passed"):
                early, late = (row[way]["reason"] or "holds" for way in ("early", "late"))
                text.append(
                    f"* {record['label']}, grasp {row['index']}, {row['group']}: early: {early}; full length: {late}"
                )
    headings = ["group", "trials", "passed", "wrongly verified", "at most (95 %)", "wrongly failed"]
    headings += ["CPU ms, all: full, early", "passing: full, early"]
    body = [[name, str(len(rows)), *_figures(rows)] for name, rows in groups.items()]
    return {"early-ends": [markdown_table(headings, body), "\n".join(text)] if body else []}


def _run(trial: Trial, grasp: Grasp, full: bool, error: Any) -> Record:
    began = time.thread_time()
    result = trial(grasp, full, error)
    said = {"figure": result} if isinstance(result, float) else {"passed": result.passed, "reason": result.reason}
    return {**said, "ms": (time.thread_time() - began) * 1e3}


def _figures(rows: Sequence[Record]) -> list[str]:
    """Return a trial's table cells. If the trial measures a length, they show the greatest change by stopping early."""
    from scipy.stats import beta

    if "figure" in rows[0]["early"]:
        worst = max(abs(row["early"]["figure"] - row["late"]["figure"]) for row in rows)
        return ["–", f"at most {worst * 1e3:.3f} mm off", "–", "–", _costs(rows), "–"]
    said = [row for row in rows if row["early"]["passed"]]
    wrong = sum(not row["late"]["passed"] for row in said)
    missed = sum(row["late"]["passed"] and not row["early"]["passed"] for row in rows)
    bound = float(beta.ppf(0.95, wrong + 1, len(said) - wrong)) if wrong < len(said) else 1.0
    return [str(len(said)), str(wrong), f"{bound:.2%}", str(missed), _costs(rows), _costs(said)]


def _costs(rows: Sequence[Record]) -> str:
    means = (sum(row[way]["ms"] for row in rows) / max(len(rows), 1) for way in ("late", "early"))
    return ", ".join(f"{mean:.1f}" for mean in means)
