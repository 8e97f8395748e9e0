"""Registry of all studies. `graspd bench NAME` runs a study. To add a study, write its file and add it to `STUDIES`.

Other packages add studies through entry points of the group `graspd.studies`.
"""

from __future__ import annotations

from importlib.metadata import entry_points

from graspd_bench import failure_maps, suites, tables
from graspd_bench.bullet.bullet_world import bullet_available
from graspd_bench.measurement import run_cell
from graspd_bench.stress import stress_cases
from graspd_bench.studies import (
    arm_reach,
    cameras,
    dexgraspbench,
    early_ends,
    frames,
    human_hand,
    imported,
    robust_ranking,
    seen_objects,
    simulators,
    steered,
    throughput,
)
from graspd_bench.study import Study

_CELLS = ("measurement.py", "bullet/*.py")
_RAW = ("objects", "seeds", "count", "hand", "trials", "quick")
_PLANS = ("presets", "objects", "seeds", "count", "hand", "quick")

STUDIES: dict[str, Study] = {
    "main": Study(
        "every preset on every object: raw, planned, pace and start cells",
        suites.main_suite, run_cell, tables.main_sections,
        _CELLS, ("presets", *_RAW), suites.cell_seconds, failures=True,
    ),
    "ladder": Study(
        "settings from poor to rich, one at a time",
        suites.sweep_suite, run_cell, tables.ladder_sections, _CELLS, _RAW, suites.cell_seconds,
    ),
    "decades": Study(
        "stiffness and friction over three decades",
        suites.decades_suite, run_cell, tables.decades_sections, _CELLS, _RAW, suites.cell_seconds,
    ),
    "hands": Study(
        "every built-in hand with one preset",
        suites.hands_suite, run_cell, tables.hands_sections,
        _CELLS, tuple(name for name in _RAW if name != "hand"), suites.cell_seconds,
    ),
    "rgbd": Study(
        "grasps planned on camera views of objects on a table, and tried on the true objects",
        seen_objects.seen_cases, seen_objects.run_seen, seen_objects.rgbd_sections,
        ("studies/seen_objects.py",), _PLANS, lambda case: 4.0 + 0.4 * case.count + 0.6 * case.views,
        summary=seen_objects.held_on_truth,
    ),
    "cameras": Study(
        "grasps on views by four kinds of cameras, tried on the true objects at their own mass",
        cameras.camera_cases, cameras.run_view, cameras.camera_sections,
        ("studies/cameras.py", "studies/seen_objects.py", "rendering/*.py"), _PLANS, lambda case: 10.0,
        summary=seen_objects.held_on_truth, usual=False,
    ),
    "robust": Study(
        "benefit and cost of ranking by noisy trials",
        robust_ranking.robust_cases, robust_ranking.run_robust, robust_ranking.robust_sections,
        ("studies/robust_ranking.py",), _PLANS, lambda case: 2.0 + 2.5 * case.count,
    ),
    "maps": Study(
        "where methods stop working: friction and mass, size, view, wall",
        failure_maps.map_cases, failure_maps.run_map, failure_maps.map_sections,
        ("failure_maps.py",), ("cases", "quick"), failure_maps.map_seconds,
    ),
    "stress": Study(
        "faulty and extreme inputs, each in its own process",
        stress_cases.stress_runs, stress_cases.run_stress, stress_cases.stress_sections,
        ("stress/*.py",), ("presets", "cases", "quick"), lambda case: 6.0,
        stress_cases.stress_faults, stress_cases.stress_summary,
        alone=True, patience=stress_cases.stress_patience, failures=True,
    ),
    "early": Study(
        "trials that stop early, compared with trials of full length",
        early_ends.early_cases, early_ends.run_early, early_ends.early_sections,
        ("studies/early_ends.py",), _PLANS, lambda case: 2.0 + 1.2 * case.count,
    ),
    "simulators": Study(
        "the hold and displacement trials in MuJoCo and PyBullet",
        simulators.simulator_cases, simulators.run_simulators, simulators.simulator_sections,
        ("studies/simulators.py", "bullet/*.py"), _PLANS, lambda case: 2.0 + 2.5 * case.count,
        usual=bullet_available(),
    ),
    "steered": Study(
        "requests with and without constraints on direction, place and roll",
        steered.steered_cases, steered.run_steered, steered.steered_sections,
        ("studies/steered.py",), _PLANS, lambda case: 1.2,
    ),
    "reach": Study(
        "inverse kinematics of the arms, and requests with and without an arm",
        arm_reach.reach_cases, arm_reach.run_reach, arm_reach.reach_sections,
        ("studies/arm_reach.py",), _PLANS, lambda case: 3.0, summary=arm_reach.summary,
    ),
    "throughput": Study(
        "verified grasps a second of a known object, on one thread and two (quiet cores, --processes 1)",
        throughput.throughput_cases, throughput.run_throughput, throughput.throughput_sections,
        ("studies/throughput.py",), _PLANS, lambda case: 3.0 + 0.06 * case.count, usual=False,
    ),
    "imported": Study(
        "imported grasps compared with ours on the same objects and hand (--import FOLDER --hand NAME)",
        imported.imported_cases, imported.run_imported, imported.imported_sections,
        ("studies/imported.py", *_CELLS, "../graspd_dataset/*_grasps.py"),
        (*_PLANS, "trials", "imported", "joint_order"), lambda case: 10.0 + 18.0 * case.count, usual=False,
    ),
    "dexgraspbench": Study(
        "our grasps evaluated by DexGraspBench's own code (dexgraspbench FOLDER --python PATH)",
        dexgraspbench.bench_cases, dexgraspbench.run_bench, dexgraspbench.bench_sections,
        ("studies/dexgraspbench.py", "../graspd_dataset/*_grasps.py"),
        (*_PLANS, "checkout", "python", "armature", "grasps"),
        lambda case: 10.0 + 4.0 * case.count * (1 + case.armature),
        summary=dexgraspbench.bench_summary, usual=False,
    ),
    "mano": Study(
        "grasps of the user's MANO hand, in the units of the Grasp'D paper",
        human_hand.mano_cases, human_hand.run_mano, human_hand.mano_sections,
        ("studies/human_hand.py", "bullet/*.py"), _PLANS, usual=False,
    ),
    "frames": Study(
        "grasps on the user's frames of a real depth camera",
        frames.frame_cases, frames.run_frame, frames.frame_sections,
        ("studies/frames.py",), _PLANS, usual=False, failures=True,
    ),
}  # fmt: skip

STUDIES |= {point.name: point.load() for point in entry_points(group="graspd.studies")}
