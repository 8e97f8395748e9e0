"""The front door: a scene and a hand in, ranked and verified grasps out."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch

from graspd_core.config import VERIFICATIONS, PlanConfig, load_preset
from graspd_core.errors import ConfigError
from graspd_core.geometry.camera import PinholeCamera
from graspd_core.geometry.choice import Target
from graspd_core.geometry.cloud import PointCloud, transform_cloud
from graspd_core.geometry.depth import cloud_from_depth
from graspd_core.geometry.load import load_scene
from graspd_core.geometry.memory import give_memory_back, share_arenas
from graspd_core.geometry.mesh import surface_samples
from graspd_core.geometry.own_process import elsewhere, work_elsewhere
from graspd_core.geometry.perceive import scene_from_views
from graspd_core.geometry.scene import Scene, object_parts
from graspd_core.geometry.shapes import make_shape
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.library import hand_names, load_hand
from graspd_core.hands.model import HandModel, Mount, all_joint_names, all_joint_positions
from graspd_core.metrics.judge import make_judge
from graspd_core.metrics.quality import measure
from graspd_core.optimise.effort import at_effort
from graspd_core.optimise.solver import Hooks
from graspd_core.optimise.synthesis import synthesise
from graspd_core.types import (
    Grasp,
    GraspResult,
    Outcome,
    Progress,
    ProgressHook,
    Stage,
    StopHook,
    Timing,
    TriangleMesh,
    Verdict,
)
from graspd_core.verify.lift import lift_trial, retreat_posture
from graspd_core.verify.trial import hold_trial, judge
from graspd_core.verify.world import PROTOCOLS, at_friction, build_world

__all__ = [
    "HandModel",
    "Mount",
    "PinholeCamera",
    "PointCloud",
    "Scene",
    "Target",
    "all_joint_names",
    "all_joint_positions",
    "check_request",
    "cloud_from_depth",
    "elsewhere",
    "give_memory_back",
    "hand_names",
    "link_poses",
    "load_hand",
    "load_scene",
    "plan_grasps",
    "retreat_posture",
    "scene_from_views",
    "share_arenas",
    "transform_cloud",
    "warm_up",
]

T = TypeVar("T")

# How often stop and deadline are looked at while waiting for the collision parts [s].
_POLL = 0.02

# How far apart the seeds of two rounds are.
_SEED_STEP = 1_000_003

# Objects are cut into convex parts one at a time.
_CUTTING = threading.Lock()


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
    """
    config = load_preset(preset) if isinstance(preset, str) else preset
    check_request(count=count, seed=seed, verify=verify, deadline=deadline, device=device)
    run = _Run(scene, time.perf_counter(), deadline, progress or (lambda _: None), stop or (lambda: False))
    # A run that is over before it begins, cancelled while its object was loaded perhaps, begins nothing.
    rounds = [] if run.over() else _rounds(scene, config, verify)
    # The collision parts take about as long as the optimiser: build them beside it.
    parts = _in_background(lambda: _cut(run)) if rounds and verify != "none" else None
    hooks = Hooks(
        report=lambda step, of, loss: run.report(Stage.OPTIMISE, step, of, loss, good),
        # An iterate half-way is no grasp, and could not be verified any more: no time is spent on its postures.
        stop=run.over,
    )
    grasps: tuple[Grasp, ...] = ()
    first, good, optimising = None, 0, 0.0
    # Most objects need one round; where too few grasps held, what is missing is sought again from other starts.
    for attempt, settings in enumerate(rounds):
        began, seeded = time.perf_counter(), seed + _SEED_STEP * attempt
        found = synthesise(scene, hand, count=count - good, seed=seeded, config=settings, hooks=hooks, device=device)
        optimising += time.perf_counter() - began
        if parts is None:
            metrics_judge = make_judge(scene.object, hand)
            new = tuple(replace(g, metrics=measure(metrics_judge, g.grasp)) for g in found.grasps[: count - good])
        else:
            protocol = at_friction(PROTOCOLS[verify], scene.object.friction)
            new, passed_at = _verify(run, scene, hand, found.grasps, parts, protocol, count - good, good)
            first = first or passed_at
        grasps = tuple(sorted((*grasps, *new), key=lambda g: g.verdict is Verdict.FAILED))
        good = sum(g.verdict is not Verdict.FAILED for g in grasps)
        if good >= count or run.over():
            break
    finished = time.perf_counter()
    outcome = _outcome(run, bool(grasps), good, count)
    load, sdf = scene.timing
    timing = Timing(
        load=load,
        sdf=sdf,
        optimise=optimising,
        verify=finished - run.began - optimising,
        first_verified=None if first is None else first - run.began + load + sdf,
        total=finished - run.began + load + sdf,
    )
    run.report(Stage.DONE, 1, 1, 0.0, good)
    return GraspResult(outcome, grasps, timing, seed, config.method, "", scene.object.warnings, scene.support)


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

    For a process that serves: from then on what goes through `elsewhere`, and cutting objects into convex parts, is
    done in a child process, since threads beside would stand still meanwhile.
    """
    work_elsewhere()
    ball = surface_samples(make_shape("sphere"), 2000, seed=0)[0] + np.array([0.0, 0.0, 0.5])
    scene = elsewhere(scene_from_views, [PointCloud(ball, np.zeros(3))], alone=True)
    plan_grasps(scene, hand, count=1, preset="fast", verify="standard", stop=stop)


def _rounds(scene: Scene, config: PlanConfig, verify: str) -> list[PlanConfig]:
    """Settings of every round, each with more effort than the last.

    A cheap first round pays where its failures are found out at little cost: by a hold trial, on an object whose shape
    is known and that has nothing about it.
    """
    rounds = config.rounds
    cheap = verify != "none" and scene.support is None and not scene.neighbours and scene.trust is None
    first = rounds.first_effort if cheap else 1.0
    most = rounds.first_effort * rounds.growth ** (rounds.most - 1)
    efforts = (min(first * rounds.growth**attempt, max(first, most)) for attempt in range(rounds.most))
    return [at_effort(config, effort) for effort in efforts]


def _in_background(work: Callable[[], T]) -> Future[T]:
    """Start work in a thread of its own; nobody waits for it but who asks for its result, and the process's end."""
    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="graspd-parts")
    future = pool.submit(work)
    pool.shutdown(wait=False)
    return future


def _cut(run: _Run) -> tuple[TriangleMesh, ...]:
    """The object's convex parts, one object at a time; none where the run was over before its turn came.

    Runs that are cancelled faster than objects are cut would pile up work that keeps later ones waiting.
    """
    with _CUTTING:
        return () if run.known_over() else object_parts(run.scene.object)


class _Run:
    """Clock, hooks and end of one run."""

    def __init__(
        self, scene: Scene, began: float, deadline: float | None, progress: ProgressHook, stop: StopHook
    ) -> None:
        self.scene, self.began, self.progress = scene, began, progress
        self.end = began + deadline if deadline is not None else float("inf")
        self.cancelled = False
        self._stop = stop

    def stop(self) -> bool:
        self.cancelled = self.cancelled or self._stop()
        return self.cancelled

    def over(self) -> bool:
        return self.stop() or self.known_over()

    def known_over(self) -> bool:
        """As `over`, for other threads: the stop hook is asked by the run's own thread alone."""
        return self.cancelled or time.perf_counter() >= self.end

    def report(self, stage: Stage, step: int, of: int, best: float, verified: int) -> None:
        self.progress(Progress(stage, step, of, best, verified, time.perf_counter() - self.began))


def _verify(
    run: _Run,
    scene: Scene,
    hand: HandModel,
    candidates: tuple[Grasp, ...],
    parts: Future[tuple[TriangleMesh, ...]],
    protocol,
    count: int,
    before: int,
) -> tuple[tuple[Grasp, ...], float | None]:
    """Try candidates in rank order until `count` held (`before` did already); verified ones first, then the failed."""
    verified: list[Grasp] = []
    failed: list[Grasp] = []
    first = None
    while candidates and not run.over() and not wait([parts], timeout=_POLL).done:
        pass
    if not candidates or run.over():
        return (), None
    world = build_world(hand, scene.object, parts.result(), protocol)
    around = None
    if scene.support is not None or scene.neighbours:
        around = build_world(hand, scene.object, parts.result(), protocol, scene.support, scene.neighbours)
    metrics_judge = make_judge(scene.object, hand)
    for index, grasp in enumerate(candidates):
        if len(verified) == count or run.over():
            break
        hold = hold_trial(world, grasp, protocol, stop=run.over)
        lift = lift_trial(around, hand, grasp, protocol, stop=run.over) if around and hold.passed else None
        passed = hold.passed and (lift is None or lift.passed)
        if run.over() and not passed:
            # A trial that was cut short says nothing of the grasp.
            break
        tried = judge(replace(grasp, metrics=measure(metrics_judge, grasp.grasp)), hold, lift)
        if passed:
            first = first or time.perf_counter()
            verified.append(tried)
        else:
            failed.append(tried)
        run.report(Stage.VERIFY, index + 1, len(candidates), 0.0, before + len(verified))
    return (*verified, *failed), first


def _outcome(run: _Run, any_found: bool, good: int, count: int) -> Outcome:
    if good >= count:
        return Outcome.SUCCEEDED
    if run.cancelled:
        return Outcome.CANCELLED
    if time.perf_counter() >= run.end:
        return Outcome.DEADLINE
    return Outcome.TOO_FEW if any_found else Outcome.NO_CANDIDATES
