"""The front door: a scene and a hand in, ranked and verified grasps out."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import torch

from graspd_core.config import VERIFICATIONS
from graspd_core.errors import ConfigError
from graspd_core.hands.model import HandModel
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.shapes import make_shape
from graspd_core.methods.candidates import find_candidates
from graspd_core.methods.loop import Hooks
from graspd_core.methods.plan_config import PlanConfig, load_preset
from graspd_core.metrics.measure import measure
from graspd_core.metrics.metrics_context import make_metrics_context
from graspd_core.planning.feasibility import out_of_reach
from graspd_core.planning.memory_errors import enough_memory
from graspd_core.planning.planning_scene import planning_scene
from graspd_core.planning.rounds import rounds_of
from graspd_core.planning.run_clock import Run
from graspd_core.planning.verification import make_trial_context, parts_in_background, rank_by_robustness, run_trials
from graspd_core.pointcloud.point_cloud import PointCloud
from graspd_core.runtime.worker_process import run_isolated, start_worker_process
from graspd_core.scene.far_objects import moved_grasp
from graspd_core.scene.scene import Scene
from graspd_core.scene.scene_from_views import scene_from_views
from graspd_core.types import Grasp, GraspResult, ProgressHook, Stage, StopHook, Timing, Verdict

# How far apart the seeds of two rounds are.
_SEED_STEP = 1_000_003


def plan_grasps(
    scene: Scene,
    hand: HandModel,
    *,
    count: int = 16,
    seed: int = 0,
    preset: str | PlanConfig = "balanced",
    verify: str = "standard",
    deadline: float | None = None,
    device: str = "cpu",
    progress: ProgressHook | None = None,
    stop: StopHook | None = None,
) -> GraspResult:
    """Plan grasps and try them in MuJoCo in rank order until `count` of them hold.

    Args:
        scene: from `load_scene` or `scene_from_views`.
        hand: from `load_hand`.
        count: verified grasps wanted (with verify="none": grasps wanted).
        seed: same seed, same machine, same grasps.
        preset: a preset's name, a preset file, or the settings themselves.
        verify: "standard" or "hard" hold trial, or "none". Where the object stands on something or among things, a
            lift trial of the same physics follows, and a grasp is verified when it passes both.
        deadline: seconds from now after which the run ends with what it has.
        device: of the optimiser's tensors.
        progress: called from this thread with `Progress` values.
        stop: polled; true ends the run within one optimiser step or a tenth of a simulated second.

    Returns:
        Always a result; `outcome` says how it went. Grasps that failed their trial follow the verified ones.

    Raises:
        ConfigError: count, seed, verify, deadline, device or preset is not valid.
        ResourceError: the machine has too little memory for so many grasps.
    """
    config = load_preset(preset) if isinstance(preset, str) else preset
    check_request(count=count, seed=seed, verify=verify, deadline=deadline, device=device)
    run = Run(time.perf_counter(), deadline, progress, stop)
    support, message, far = scene.support, "", np.zeros(3)
    # A run that is over before it begins, cancelled while its object was loaded perhaps, begins nothing; and no search
    # finds what cannot be.
    if not run.over():
        scene, far = planning_scene(scene, config.resolution)
        message = out_of_reach(scene, hand)
    rounds = [] if run.over() or message else rounds_of(scene, config, verify)
    parts = parts_in_background(run, scene) if rounds and verify != "none" else None
    hooks = Hooks(
        report=lambda step, of, loss: run.report(Stage.OPTIMISE, step, of, loss, good),
        # An iterate half-way is no grasp, and could not be verified any more: no time is spent on its postures.
        stop=run.over,
    )
    grasps: tuple[Grasp, ...] = ()
    trial_context = first = None
    good, optimising = 0, time.perf_counter() - run.began
    # Most objects need one round; where too few grasps held, what is missing is sought again from other starts.
    for attempt, settings in enumerate(rounds):
        began, seeded = time.perf_counter(), seed + _SEED_STEP * attempt
        wanted = count - good
        with enough_memory(f"{wanted} grasps at once"):
            found = find_candidates(scene, hand, count=wanted, seed=seeded, config=settings, hooks=hooks, device=device)
        optimising += time.perf_counter() - began
        if parts is None:
            metrics_context = make_metrics_context(scene.object, hand)
            new = tuple(replace(g, metrics=measure(metrics_context, g.grasp)) for g in found.grasps[:wanted])
        else:
            if trial_context is None and found.grasps:
                trial_context = make_trial_context(run, scene, hand, parts, verify)
            new, passed_at = run_trials(run, trial_context, found.grasps, wanted, good) if trial_context else ((), None)
            first = first or passed_at
        grasps = tuple(sorted((*grasps, *new), key=lambda g: g.verdict is Verdict.FAILED))
        good = sum(g.verdict is not Verdict.FAILED for g in grasps)
        if good >= count or run.over():
            break
    if trial_context and config.robust.rank:
        grasps = rank_by_robustness(run, trial_context, grasps, config.robust, seed)
    finished = time.perf_counter()
    load, sdf = scene.timing
    timing = Timing(
        load=load,
        sdf=sdf,
        optimise=optimising,
        verify=finished - run.began - optimising,
        first_verified=None if first is None else first - run.began + load + sdf,
        total=finished - run.began + load + sdf,
    )
    outcome = run.outcome(bool(grasps), good, count)
    run.report(Stage.DONE, 1, 1, 0.0, good)
    grasps = tuple(moved_grasp(grasp, far) for grasp in grasps)
    return GraspResult(outcome, grasps, timing, seed, config.method, message, scene.object.warnings, support)


def check_request(*, count: int, seed: int, verify: str, deadline: float | None, device: str) -> None:
    """Refuse what `plan_grasps` would refuse, without a scene. Raises ConfigError: what is valid."""
    if not 1 <= count <= 1024:
        raise ConfigError(f"count: {count} grasps; valid: 1 to 1024")
    if not 0 <= seed < 2**63:
        raise ConfigError(f"seed: {seed}; valid: 0 to 2^63 - 1")
    if verify not in VERIFICATIONS:
        raise ConfigError(f"verify: {verify!r}; valid: {', '.join(VERIFICATIONS)}")
    if deadline is not None and not deadline > 0:
        raise ConfigError(f"deadline: {deadline} s; it must be positive")
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    devices += [f"cuda:{index}" for index in range(torch.cuda.device_count())]
    if device not in devices:
        raise ConfigError(f"device: {device!r}; valid on this machine: {', '.join(devices)}")


def warm_up(hand: HandModel, stop: StopHook | None = None) -> None:
    """Do the first-use work of all libraries on a small sphere, so that the first request is as fast as others.

    For a process that serves: from then on what goes through `run_isolated`, and cutting objects into convex parts, is
    done in a child process, since threads beside would stand still meanwhile.
    """
    start_worker_process()
    ball = surface_samples(make_shape("sphere"), 2000, seed=0)[0] + np.array([0.0, 0.0, 0.5])
    scene = run_isolated(scene_from_views, [PointCloud(ball, np.zeros(3))], alone=True)
    plan_grasps(scene, hand, count=1, preset="fast", verify="standard", stop=stop)
