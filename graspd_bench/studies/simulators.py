"""Study `simulators`: hold and displacement trials of the same grasps in MuJoCo and in PyBullet. Do they agree?

The study uses the first grasps of the optimiser's own ranking. No trial filters them. Each grasp is also tried with the
hand displaced by up to 5 mm along each axis and turned by up to 5°, so that some grasps fail.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from graspd_bench.bullet.bullet_hold import bullet_hold_trial
from graspd_bench.bullet.bullet_world import build_bullet_world, bullet_available, bullet_displacement
from graspd_bench.study import ObjectCase, Record, Request, Sections, all_shapes, object_cases, raw_grasps
from graspd_bench.trials import build_frozen_world, displacement_trial
from graspd_core.errors import ConfigError
from graspd_core.perception.scene import object_parts
from graspd_core.verify.hold_trial import displaced, hold_trial, pose_error
from graspd_core.verify.world import PROTOCOLS, build_world
from graspd_dataset.run_records import markdown_table, object_name

# Duration of each pull in both simulators [s]. MuJoCo also runs the full duration.
PULL = 0.5


def simulator_cases(request: Request) -> tuple[ObjectCase, ...]:
    """Return a case for each shape and seed. Raises ConfigError: PyBullet is not installed."""
    if not bullet_available():
        raise ConfigError("simulators: PyBullet is not installed; run pip install -e '.[bench]' on Python 3.11")
    return object_cases(request, all_shapes(), 4, 1)


def run_simulators(case: ObjectCase) -> Record:
    """Run hold and displacement trials of an object's grasps in both simulators, as planned and displaced."""
    hand, scene = case.load()
    first = raw_grasps(scene, hand, case.config, case.count, case.seed)
    parts, standard = object_parts(scene.object), PROTOCOLS["standard"]
    # PyBullet's trial does not check penetration of the grasp, nor self-penetration. So MuJoCo's trial must not either.
    standard = replace(standard, max_grasp_penetration=np.inf, max_self_penetration=np.inf)
    short = replace(standard, hold_time=PULL)
    world = build_world(hand, scene.object, parts, standard)
    bullet, frozen = build_bullet_world(hand, scene.object, parts), build_frozen_world(hand, scene.object, parts)
    rng = np.random.default_rng(case.seed)
    moved = [(True, displaced(grasp, *pose_error(rng), world.center_of_mass)) for grasp in first]
    trials = [
        {
            "displaced": out_of_place,
            "mujoco": asdict(hold_trial(world, grasp, short)),
            "mujoco_full": asdict(hold_trial(world, grasp, standard)),
            "bullet": asdict(bullet_hold_trial(bullet, grasp, short)),
            "sd_bullet": bullet_displacement(bullet, grasp.grasp),
            "sd_mujoco": displacement_trial(frozen, grasp.grasp),
        }
        for out_of_place, grasp in [*((False, grasp) for grasp in first), *moved]
    ]
    return {"trials": trials}


def simulator_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return a table of verdicts, a list of the trials with different verdicts, and both mean displacements."""
    rows = [(r["object"], trial) for r in records for trial in r["trials"]]
    if not rows:
        return {}
    verdicts = [(t["mujoco"]["passed"], t["bullet"]["passed"]) for _, t in rows]
    agreed = np.mean([a == b for a, b in verdicts])
    same = sum(t["mujoco"]["passed"] == t["mujoco_full"]["passed"] for _, t in rows)
    table = markdown_table(
        ["", "PyBullet holds", "PyBullet drops"],
        [
            [f"**MuJoCo {name}**", *(str(verdicts.count((held, other))) for other in (True, False))]
            for name, held in (("holds", True), ("drops", False))
        ],
    )
    differ = [
        f"* {object_name(thing)}, {'displaced' if t['displaced'] else 'as planned'}: "
        f"MuJoCo {_said(t['mujoco'])}; PyBullet {_said(t['bullet'])}"
        for thing, t in rows
        if t["mujoco"]["passed"] != t["bullet"]["passed"]
    ]
    pairs = np.array([[t["sd_bullet"], t["sd_mujoco"]] for _, t in rows]) * 100
    line = f"**{agreed:.1%}** of {len(rows)} verdicts agree. With full pulls {same} of MuJoCo's verdicts stay the same."
    moved = (
        f"Displacement trial: mean {pairs[:, 0].mean():.2f} cm in PyBullet, {pairs[:, 1].mean():.2f} cm in MuJoCo, "
        f"median {np.median(pairs[:, 0]):.2f} and {np.median(pairs[:, 1]):.2f} cm; within 5 mm of each other on "
        f"{(np.abs(pairs[:, 0] - pairs[:, 1]) < 0.5).mean():.1%}."
    )
    return {"simulators": [line, table, "\n".join(differ), moved]}


def _said(hold: Record) -> str:
    return hold["reason"] or f"holds ({hold['displacement'] * 100:.1f} cm, {hold['rotation'] * 57.3:.0f}°)"
