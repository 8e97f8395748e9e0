"""Plan grasps: find, verify and rank grasps of a scene's object by a hand."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from numbers import Integral
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.config import VERIFICATIONS
from graspd_core.config.planning_config import LEAST_LIGHT, light_end
from graspd_core.errors import ConfigError
from graspd_core.hands.model import HandModel
from graspd_core.hands.surface_points import with_candidates
from graspd_core.mesh.sdf import grid_layout
from graspd_core.mesh.surface_queries import make_surface, pressed_points
from graspd_core.optimize.plan_config import PlanConfig, load_preset
from graspd_core.optimize.restrictions import BoundRestrictions, Restriction, restrictions_in_words
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.scene import Scene, moved_grasp, near_scene, object_sdf, sample_confidence
from graspd_core.planning.feasibility import out_of_reach, why_trials_failed
from graspd_core.planning.rounds import RoundsResult, rounds_of, run_rounds
from graspd_core.runtime.worker_process import start_planning_worker
from graspd_core.types import (
    Grasp,
    GraspResult,
    Outcome,
    ProgressHook,
    Stage,
    StopHook,
    Timing,
    Verdict,
    WatchHook,
)
from graspd_core.verify.limits import LEAST_PAYLOAD
from graspd_core.verify.run_clock import Run, outcome_of
from graspd_core.verify.verification import payloads, prefetch, rank_by_robustness

# Greatest number of grasps of a request, and number of valid seeds.
MOST_GRASPS, SEEDS = 1024, 2**63
# Number of grasps whose payload is measured if no grasp is verified.
_WEIGHED = 8


def planning_scene(scene: Scene, resolution: int) -> tuple[Scene, Float[np.ndarray, "3"]]:
    """Move the scene near the origin (`near_scene`) for planning. Return the moved scene and the new origin [m].

    The distance grid is rebuilt if it has another resolution. It is also rebuilt after a move, because float32 had
    rounded node positions far from the origin. Raises ConfigError: the resolution is out of range.
    """
    if not 8 <= resolution <= 256:
        raise ConfigError(f"resolution: {resolution} nodes; valid: 8 to 256")
    scene, far = near_scene(scene)
    counts, _, _ = grid_layout(scene.object.mesh, resolution)
    same_grid = tuple(scene.sdf.field.shape[1:]) == counts
    if same_grid and not far.any():
        return scene, far
    sdf = object_sdf(scene.object, resolution).to(scene.sdf.field.device, scene.sdf.field.dtype)
    confidence = scene.confidence
    if confidence is not None and not same_grid:
        nodes = torch.cartesian_prod(*map(torch.arange, sdf.field.shape[1:])).to(sdf.field)
        places = (sdf.origin + sdf.spacing * nodes)[None]
        confidence = sample_confidence(confidence, scene.sdf, places).reshape(sdf.field.shape[1:])
    return replace(scene, sdf=sdf, confidence=confidence), far


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
    restrictions: Sequence[Restriction] = (),
    measure: bool = True,
    progress: ProgressHook | None = None,
    stop: StopHook | None = None,
    watch: WatchHook | None = None,
) -> GraspResult:
    """Plan grasps and try them in rank order until `count` pass all trials of the scene.

    Args:
        scene: scene from `load_scene` or `scene_from_views`. `planning_scene` adapts it to the preset's resolution.
        hand: hand from `load_hand`. Planning uses the number of contact candidates that the preset asks for.
        count: number of verified grasps to find.
        seed: random seed. On one machine, equal seeds give equal grasps.
        preset: name of a preset, path of a preset file, or the settings.
        verify: "standard" or "hard" trials, "full" or "hard_full" for the same trials without early stop, or "none".
        deadline: time after which the run ends with the grasps found so far [s]. None for no limit.
        device: torch device of the optimiser.
        restrictions: further conditions on grasps. The result's `refused` counts the refused candidates.
        measure: whether to measure the metrics of grasps that did not fail. Measuring takes longer than a trial.
        progress: hook that gets `Progress` values. The calling thread runs it.
        watch: hook that gets `Snapshot` values, with the hands that the run is working on. The calling thread runs it.
        stop: polled function. If it returns true, the run ends within one optimiser step or 0.1 s of simulated time.

    Raises:
        ConfigError: count, seed, verify, deadline, device, preset or a restriction is not valid.
        ResourceError: the machine has too little memory for this number of grasps.
    """
    config = load_preset(preset) if isinstance(preset, str) else preset
    request: dict[str, Any] = {"count": count, "seed": seed, "device": device}
    check_request(verify=verify, deadline=deadline, **request)
    run = Run(time.perf_counter(), deadline, progress, stop, watch)
    support, bound = scene.support, BoundRestrictions(tuple(one.bind(scene, hand) for one in restrictions))
    scene, hand, message, rounds = _prepared(run, scene, hand, config, verify, bound)
    prefetched = prefetch(run, scene, hand, verify, config.certainty) if rounds and verify != "none" else None
    moved = replace(bound, origin=run.origin)
    found = run_rounds(run, scene, hand, rounds, prefetched, moved, measure=measure, **request)
    tried = tuple(moved_grasp(grasp, run.origin) for grasp in on_surface(scene, _ranked(run, found, config, seed)))
    warnings = (*scene.object.warnings, *hand.named_warnings, *_lifted_less(scene, found.mass))
    masses = {"mass": found.mass, "tried_mass": found.mass or scene.object.mass}
    about: dict[str, Any] = {"support": support, "refused": found.refused, "count": count, **masses}
    outcome, timing = outcome_of(tried, count, run.ended_early), _timing(run, scene, found)
    result = GraspResult(outcome, tried, timing, seed, config.method, warnings=warnings, **about)
    reason = "" if run.over() else _why_few(run, scene, bound, found, result)
    result = replace(result, message=message or reason or result.outcome.value)
    run.report(Stage.DONE, 1, 1, 0.0, found.good)
    return result if found.good else _less_sure(scene, run.origin, result)


def _prepared(
    run: Run, scene: Scene, hand: HandModel, config: PlanConfig, verify: str, bound: BoundRestrictions
) -> tuple[Scene, HandModel, str, list[PlanConfig]]:
    """Return scene and hand for planning, why no grasp can exist ("" if unknown), and the settings of the rounds."""
    if run.over():
        return scene, hand, "", []
    scene, run.origin = planning_scene(scene, config.resolution)
    hand = with_candidates(hand, config.problem.fine_candidates)
    message = bound.impossible or out_of_reach(scene, hand)
    return scene, hand, message, [] if message else rounds_of(scene, config, verify)


def _ranked(run: Run, found: RoundsResult, config: PlanConfig, seed: int) -> tuple[Grasp, ...]:
    if found.context is None or not config.robust.rank:
        return found.grasps
    return rank_by_robustness(run, found.context, found.grasps, config.robust, seed)


def on_surface(scene: Scene, grasps: Sequence[Grasp]) -> tuple[Grasp, ...]:
    """Return the grasps with contact points and normals on the object's mesh, instead of on the distance grid."""
    contacts = [contact for grasp in grasps for contact in grasp.contacts]
    if not contacts:
        return tuple(grasps)
    rows = (np.array([getattr(contact, key) for contact in contacts]) for key in ("position", "normal"))
    places, normals = (map(tuple, part.tolist()) for part in pressed_points(make_surface(scene.object.mesh), *rows))
    exact = iter([replace(c, position=p, normal=n) for c, p, n in zip(contacts, places, normals, strict=True)])
    return tuple(replace(grasp, contacts=tuple(next(exact) for _ in grasp.contacts)) for grasp in grasps)


def _lifted_less(scene: Scene, mass: float | None) -> tuple[str, ...]:
    if mass is None:
        return ()
    why = f"the hand cannot hold the {scene.object.mass:.2g} kg that were assumed"
    if scene.evidence is not None and mass >= light_end(scene.object.mass):
        why = f"{LEAST_LIGHT:.0%} of objects of this volume weigh no more"
    return (f"{scene.object.source}: grasps were tried at {mass:.2g} kg, because {why}",)


def _why_few(run: Run, scene: Scene, bound: BoundRestrictions, found: RoundsResult, result: GraspResult) -> str:
    reason = restrictions_in_words(bound, found.refused, found.good, len(found.grasps))
    if reason or result.outcome is not Outcome.TOO_FEW:
        return reason
    if bare := sum(not grasp.trials and not grasp.contacts for grasp in result.tried):
        return f"{bare} of {len(result.tried)} untried candidates do not touch the object"
    reason = why_trials_failed(scene, result.tried)
    if found.good or found.context is None:
        return reason
    most = max(payloads(found.context, result.tried[:_WEIGHED], run.over), default=0.0)
    best = f"the strongest grasp would hold {most:.2g} kg" if most else f"none would hold {LEAST_PAYLOAD:g} kg"
    return reason if run.over() else "; ".join(filter(None, (reason, best)))


def _less_sure(scene: Scene, far: Float[np.ndarray, "3"], result: GraspResult) -> GraspResult:
    """Say in the result that no grasp is robust. Add the next view if possible. `far`: origin of the planning frame."""
    held = sum(grasp.verdict is Verdict.UNVERIFIED for grasp in result.tried)
    if scene.evidence is None and held and result.mass is not None:
        told = f"{held} grasps hold {result.mass:.2g} kg, but the object may weigh {scene.object.mass:.2g} kg"
        return replace(result, message=f"{told}; {result.message}")
    if scene.evidence is None or not held:
        return result
    message, view = f"{held} grasps hold on the likeliest shape, but none is robust enough", None
    if scene.evidence.doubts:
        message += f": {scene.evidence.doubts[0]}"
    elif scene.evidence.hidden:
        from graspd_core.perception.reconstruct.hidden_side import next_view

        message += ", because a part of the object was guessed"
        view = next_view(scene.evidence, scene.object.mesh, far)
    if view is not None:
        message += "; one more view, from next_view, would show most of that part"
    return replace(result, message="; ".join(filter(None, (message, result.message))), next_view=view)


def _timing(run: Run, scene: Scene, found: RoundsResult) -> Timing:
    """Return the time of each stage [s]. Add the times of loading the scene, which was loaded before the run began."""
    elapsed, (load, sdf) = time.perf_counter() - run.began, scene.timing
    optimise = found.began - run.began + found.optimise_time
    return Timing(
        load=load,
        sdf=sdf,
        optimise=optimise,
        verify=elapsed - optimise,
        first_verified=None if found.first is None else found.first - run.began + load + sdf,
        total=elapsed + load + sdf,
    )


def check_request(*, count: int, seed: int, verify: str, deadline: float | None, device: str) -> None:
    """Check those arguments of `plan_grasps` that need no scene. Raises ConfigError: a value is not valid."""
    if not (isinstance(count, Integral) and 1 <= count <= MOST_GRASPS):
        raise ConfigError(f"count: {count} grasps; valid: 1 to {MOST_GRASPS}")
    if not (isinstance(seed, Integral) and 0 <= seed < SEEDS):
        raise ConfigError(f"seed: {seed}; valid: 0 to 2^63 - 1")
    if verify not in VERIFICATIONS:
        raise ConfigError(f"verify: {verify!r}; valid: {', '.join(VERIFICATIONS)}")
    if deadline is not None and not deadline > 0:
        raise ConfigError(f"deadline: {deadline} s; valid: above 0")
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    devices += [f"cuda:{index}" for index in range(torch.cuda.device_count())]
    if device not in devices:
        raise ConfigError(f"device: {device!r}; valid on this machine: {', '.join(devices)}")


def warm_up(hand: HandModel, stop: StopHook | None = None) -> None:
    """Plan once on a small sphere. This loads all libraries, so that the first request is as fast as later requests.

    Servers call `warm_up` at start. The call also starts the child process of `run_isolated`, which cuts objects into
    convex parts while other threads go on.
    """
    from graspd_core.perception.scene_from_views import scene_from_views

    start_planning_worker()
    # Draw the sphere here, because `make_shape` would import trimesh, which planning on clouds does not need.
    ways = np.random.default_rng(0).normal(size=(2000, 3))
    ball = 0.04 * ways / np.linalg.norm(ways, axis=1, keepdims=True) + np.array([0.0, 0.0, 0.5])
    scene = scene_from_views([PointCloud(ball, np.zeros(3))], alone=True)
    plan_grasps(scene, hand, count=1, preset="fast", verify="standard", stop=stop)
