"""Processing of one request: load the object, plan, and transform the result to the output frame.

If a request excludes grasps, its answer may come from earlier runs on the same object. Otherwise, grasps are planned.
No grasp of the answer is similar to an excluded grasp.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from builtin_interfaces.msg import Time
from jaxtyping import Float

from graspd_core import Grasp, GraspResult, HandModel, Outcome, Scene, Verdict, load_preset, plan_grasps, save_result
from graspd_core.config import load_scene_config
from graspd_core.perception.obstacles import held_hull
from graspd_core.planning.any_thing import Failure, plan_any_thing, result_of_things
from graspd_core.planning.any_thing import unlike as unlike_postures
from graspd_core.planning.plan_grasps import SEEDS
from graspd_core.types import Posture, Progress, ProgressHook, Stage, StopHook, Timing, TriangleMesh
from graspd_core.verify.prepared_grasp import arrival, make_metrics_context
from graspd_core.verify.robustness import begin_in_thread
from graspd_ros.convert import (
    Matrix,
    matrix_of_posture,
    moved_grasp,
    moved_points,
    moved_result,
    nanoseconds,
    wxyz_of_matrix,
)
from graspd_ros.error_codes import bad_request
from graspd_ros.inputs.solids import with_collision_objects
from graspd_ros.inputs.tf_listener import reach_of
from graspd_ros.request import FrameLookup, Request
from graspd_ros.worker import Report, WorkerEnding

if TYPE_CHECKING:
    from graspd_core import Reach

PATIENCE = 0.15  # seconds that `plan` waits for a run to end by itself after its request has ended
_POLL = 0.02  # seconds between two checks of stop and deadline
MOST_RUNS = 16

# Function that returns `T_target_source` at a time (0 for the newest). It waits for late transforms until the stop hook
# returns True, and may raise a TransformError.
Lookup = Callable[[str, str, Time, StopHook], Matrix]


@dataclass(frozen=True)
class Planned:
    """Result of a request. Grasps and positions are in the answer's frame.

    Attributes:
        result: the grasps.
        file: path of the result file. Empty if none was written.
        worked_on: False if the deadline passed while the request waited in the queue.
        mass: object's mass for planning and trials [kg]. 0 if unknown.
        mass_assumed: True if neither the request nor the library's entry of a named object gave a mass.
        objects: if the request allows any object: each object's position [m], and why it has no verified grasp. The
            grasps belong to the first object.
        surface: the object's mesh in its own frame [m]. None if it was not loaded.
        held: the object's hull in the hand's base frame at the first grasp [m]. None without a usable grasp or mesh.
    """

    result: GraspResult
    file: str = ""
    worked_on: bool = True
    mass: float = 0.0
    mass_assumed: bool = False
    objects: tuple[tuple[Float[np.ndarray, "3"], str], ...] = ()
    surface: TriangleMesh | None = None
    held: TriangleMesh | None = None


@dataclass(frozen=True)
class _Run:
    object_key: str
    frame: str
    T_frame_object: Matrix
    terms: tuple[str, str, bool]
    planned: Planned

    @property
    def grasps(self) -> tuple[Grasp, ...]:
        return self.planned.result.tried


class RecentRuns:
    """Store of the grasps of the last runs by request id. One thread may use it at a time."""

    def __init__(self) -> None:
        self._runs: OrderedDict[str, _Run] = OrderedDict()

    def keep(self, request: Request, planned: Planned, T_out_object: Matrix) -> None:
        """Store a result under the id of its request, so that later requests can exclude its grasps.

        `T_out_object` [m] is the object's pose in the answer's frame. A camera's frame may move later.
        """
        about = request.object_key, request.frame_out, T_out_object, _terms(request)
        # Only requests without an arm reuse a run. The arm may be elsewhere or switched off by then.
        tried = tuple(replace(grasp, arm=None) if grasp.arm else grasp for grasp in planned.result.tried)
        self._runs[request.id] = _Run(*about, replace(planned, result=replace(planned.result, tried=tried)))
        self._runs.move_to_end(request.id)
        while len(self._runs) > MOST_RUNS:
            self._runs.popitem(last=False)

    def excluded(self, request: Request, lookup: FrameLookup) -> list[Matrix]:
        """Return the base-link poses that the request excludes by id or pose, in the object's frame [m].

        Raises RequestError for an id that is not among the last runs, and the errors of `lookup`.
        """
        poses = []
        for name in request.exclude:
            run, grasp = self._grasp(name)
            pose = matrix_of_posture(grasp.grasp)
            if run.object_key != request.object_key or not request.object_key:
                pose = request.to_object(run.frame, run.T_frame_object @ pose, lookup)
            poses.append(pose)
        return poses + [request.to_object(frame, pose, lookup) for frame, pose in request.exclude_poses]

    def failures(self, request: Request, excluded: Sequence[Matrix], lookup: FrameLookup) -> list[Failure]:
        """Return the excluded grasps as `Failure` values, with the positions [m] of all objects seen, if known.

        `excluded` is the result of the method `excluded`. Raises the errors of `lookup`.
        """
        seen: list[Any] = [None] * len(excluded)
        for row, name in enumerate(request.exclude):
            run = self._grasp(name)[0]
            if run.planned.objects:
                T_object_run = request.to_object(run.frame, run.T_frame_object, lookup)
                seen[row] = moved_points(np.array([place for place, _ in run.planned.objects]), T_object_run)
        rows = zip(seen, _postures(excluded), strict=True)
        return [Failure(None if places is None else places[0], posture, seen=places) for places, posture in rows]

    def _grasp(self, name: str) -> tuple[_Run, Grasp]:
        run_id, _, rank = name.rpartition("/")
        run = self._runs.get(run_id)
        found = {} if run is None else {str(row): grasp for row, grasp in enumerate(run.grasps)}
        if run is None or rank not in found:
            kept = ", ".join(self._runs) or "none"
            raise bad_request(f"exclude: no grasp {name[:128]!r} in the last {MOST_RUNS} runs; stored runs: {kept}")
        return run, found[rank]

    def next_best(self, request: Request, excluded: Sequence[Matrix]) -> Planned | None:
        """Return earlier grasps of the same object that are not similar to `excluded`. None if too few are left.

        Use only runs with the trials, preset and `closes_late` of the request. Of these, use the runs that tried the
        greatest mass. Of their grasps, use those that passed all requested trials.
        """
        same = [run for run in self._runs.values() if run.object_key == request.object_key and request.object_key]
        same = [run for run in same if run.terms == _terms(request) and run.grasps]
        # A run may have tried its grasps at less than the assumed mass, e.g. because its constraints left weak grasps.
        most = max((run.planned.mass for run in same), default=0.0)
        runs = [run for run in same if run.planned.mass == most]
        known = {id(grasp): grasp for run in runs for grasp in run.grasps}
        wanted = Verdict.UNVERIFIED if request.settings.verify == "none" else Verdict.VERIFIED
        count = request.settings.num_grasps
        left = [grasp for grasp in unlike(known.values(), excluded) if grasp.verdict is wanted][:count]
        if len(left) < count:
            return None
        message = f"{count} grasps of an earlier run, none similar to the {len(excluded)} excluded"
        warnings = runs[-1].planned.result.warnings
        result = GraspResult(Outcome.SUCCEEDED, tuple(left), Timing(), request.settings.seed, "", message, warnings)
        return replace(runs[-1].planned, result=result, file="")


def _terms(request: Request) -> tuple[str, str, bool]:
    """Return the settings that must be equal, so that a request can reuse the grasps of an earlier run."""
    return request.settings.verify, request.settings.preset, request.closes_late


def unlike(grasps: Iterable[Grasp], excluded: Sequence[Matrix]) -> list[Grasp]:
    """Return the grasps that are not similar to any of the `excluded` base-link poses."""
    return unlike_postures(list(grasps), _postures(excluded))


def without(result: GraspResult, excluded: Sequence[Matrix], count: int) -> GraspResult:
    """Drop grasps similar to `excluded`. Of the rest, keep all failed grasps, and at most `count` others."""
    left = unlike(result.tried, excluded)
    good = [grasp for grasp in left if grasp.verdict is not Verdict.FAILED]
    failed = [grasp for grasp in left if grasp.verdict is Verdict.FAILED]
    outcome = result.outcome
    if outcome in (Outcome.SUCCEEDED, Outcome.TOO_FEW):
        outcome = Outcome.SUCCEEDED if len(good) >= count else Outcome.TOO_FEW
    return replace(result, outcome=outcome, tried=(*good[:count], *failed))


def _postures(poses: Sequence[Matrix]) -> list[Posture]:
    return [Posture(pose[:3, 3], wxyz_of_matrix(pose), np.zeros(0)) for pose in poses]


class Planner:
    """Planner for one hand. One thread may use it at a time.

    A background thread does the work, because reading a mesh or computing a large batch cannot be stopped. When a
    request ends early, `plan` waits for the thread only `PATIENCE` seconds. The thread ends by itself soon after. The
    next request waits for that end, so that cancelled work does not pile up.
    """

    def __init__(self, hand: HandModel, lookup: Lookup, robot_description: str = "") -> None:
        self._hand = hand
        self._robot_description = robot_description
        self._lookup = lookup
        self._behind: Future[Planned] | None = None
        self._runs = RecentRuns()

    def plan(self, request: Request, stop: StopHook, report: ProgressHook) -> Planned:
        """Process one request and return its result. Raises the errors of loading, planning and transforms."""
        left, reporting = threading.Event(), threading.Lock()

        def over() -> bool:
            return stop() or request.time_left() <= -PATIENCE

        def report_if_wanted(progress: Progress) -> None:
            with reporting:  # no progress of a request is reported after `plan` has returned
                if not left.is_set():
                    report(progress)

        report(Progress(Stage.LOAD, 0, 1, 0.0, 0, 0.0))
        if self._behind and not _ended(self._behind, over):
            return _empty(request, stop)

        def run() -> Planned:
            torch.set_num_threads(request.settings.torch_threads)  # affects the calling thread only
            return self._run(request, lambda: left.is_set() or stop(), report_if_wanted)

        work = self._behind = begin_in_thread("graspd_planner", run)
        end = None
        while not _ended(work, over):
            end = end or time.monotonic() + PATIENCE
            if time.monotonic() > end:
                with reporting:
                    left.set()
                return _empty(request, stop)
        self._behind = None
        return work.result()

    def rest(self, timeout: float) -> bool:
        """Wait for a background thread that still runs. Return True if it ended within `timeout` seconds."""
        end = time.monotonic() + timeout
        return self._behind is None or _ended(self._behind, lambda: time.monotonic() > end)

    def _run(self, request: Request, stop: StopHook, report: ProgressHook) -> Planned:
        # Look up the transform first. Without it the grasps of a run would be useless.
        seen = self._lookup_at(Time() if request.timeless else request.stamp, stop)
        T_out_object = request.T_frame_object
        if request.frame_out != request.frame:
            T_out_frame = seen(request.frame_out, request.frame)
            T_out_object = T_out_frame if T_out_object is None else T_out_frame @ T_out_object
        reach: tuple[Reach, ...] = ()
        if request.settings.arm:
            reach = (reach_of(request, seen, self._robot_description),)
        if request.collision_objects:
            request = with_collision_objects(request, seen)
        excluded = self._runs.excluded(request, self._placing(request, stop))
        # Do not reuse an earlier run if its constraints, arm pose or obstacles may differ. With a library do not reuse
        # a run either, because the library contains its grasps.
        free = request.steering is None and not reach and not request.collision_objects
        known = excluded and free and request.known is None
        planned = self._runs.next_best(request, excluded) if known else None
        if planned is None:
            place = lambda grasp: grasp if T_out_object is None else moved_grasp(grasp, T_out_object)  # noqa: E731
            moved = lambda progress: report(_with_found(progress, place))  # noqa: E731
            planned = self._search(request, excluded, reach, stop, moved)
        self._runs.keep(request, planned, np.eye(4) if T_out_object is None else T_out_object)
        best, surface = next(iter(planned.result.tried), None), planned.surface
        held = None if surface is None or best is None or not best.usable else held_hull(surface, best.grasp)
        planned = replace(planned, held=held)
        if T_out_object is None:
            return planned
        objects = tuple((moved_points(place[None], T_out_object)[0], reason) for place, reason in planned.objects)
        return replace(planned, result=moved_result(planned.result, T_out_object), objects=objects)

    def _lookup_at(self, stamp: Time, stop: StopHook) -> FrameLookup:
        return lambda target, source: self._lookup(target, source, stamp, stop)

    def _placing(self, request: Request, stop: StopHook) -> FrameLookup:
        """Return the lookup for excluded poses. For a single cloud, it uses the cloud's time: the camera may move."""
        one_cloud = request.region_points is not None and not request.timeless
        return self._lookup_at(request.stamp if one_cloud else Time(), stop)

    def _search(
        self, request: Request, excluded: list[Matrix], reach: tuple[Reach, ...], stop: StopHook, report: ProgressHook
    ) -> Planned:
        """Plan grasps, drop those similar to `excluded`, and write the rest to a file if `output_dir` is set."""
        settings, objects, arrived, assumed = request.settings, (), None, False
        config = load_preset(settings.preset)
        steering = () if request.steering is None else (request.steering(),)
        plan: dict[str, Any] = {"preset": config, "device": settings.device, "progress": report, "stop": stop}
        # Another seed makes grasps similar to the excluded grasps less likely.
        plan["seed"] = (settings.seed + len(excluded)) % SEEDS
        plan |= {"restrictions": (*steering, *reach), "verify": settings.verify}
        if request.views is not None:
            failures = self._runs.failures(request, excluded, self._placing(request, stop))
            result, scene, objects = _any_object(request, self._hand, failures, **plan)
        elif settings.grasp_library and request.known is not None:
            from graspd_ros.known_objects import answer_known

            result, scene, assumed = answer_known(request, request.known, self._hand, excluded, **plan)
        else:
            scene = request.load()
            if request.closes_late:
                arrived = _arrivals(scene, self._hand)
                plan["progress"] = lambda progress, arrived=arrived: report(_with_found(progress, arrived))
            plan |= {"deadline": max(request.time_left(), 1e-3), "count": settings.num_grasps + len(excluded)}
            result = plan_grasps(scene, self._hand, **plan)
        if request.closes_late and result.tried:
            scene = scene or request.load()
            result = replace(result, tried=tuple(map(arrived or _arrivals(scene, self._hand), result.tried)))
        if excluded:
            result = without(result, excluded, settings.num_grasps)
        mass = result.mass or 0.0
        if scene is not None:
            mass, assumed = result.mass or scene.object.mass, scene.object.mass_assumed
        planned = Planned(result, mass=mass, mass_assumed=assumed, objects=objects, surface=scene and scene.object.mesh)
        if not settings.output_dir or stop():
            return planned
        path = Path(settings.output_dir) / f"{request.id}.json"
        # Grasps in the file are in the planning frame. For a mesh this is the mesh's own frame.
        frame = request.frame if request.T_frame_object is None else settings.mesh_frame
        seconds, scene = 1e-9 * nanoseconds(request.stamp), scene or request.load()
        try:
            save_result(path, result, scene.object, self._hand, config, frame=frame, stamp=seconds)
        except OSError as error:  # the grasps are good although the disk is full or output_dir is read-only
            told = f"output_dir: {path} is not written ({error.strerror or error}); valid: a directory for files"
            return replace(planned, result=replace(result, warnings=(*result.warnings, told)))
        return replace(planned, file=str(path))


def _any_object(
    request: Request, hand: HandModel, failures: Sequence[Failure], **plan: Any
) -> tuple[GraspResult, Scene | None, tuple[tuple[Float[np.ndarray, "3"], str], ...]]:
    """Plan for any object seen. Return result, scene, and per object its position [m] and why it has no grasp."""
    assert request.views is not None
    (views, told), settings = request.views(), request.settings
    about = {"settings": load_scene_config(settings.scene_config) if settings.scene_config else None}
    about |= {"solids": request.solids, "mass": settings.mass or None, "friction": settings.friction}
    plan |= {"count": settings.num_grasps, "seed": settings.seed, "deadline": max(request.time_left(), 1e-3)}
    things = plan_any_thing(views, hand, failures=failures, **about, **plan)
    result = result_of_things(things, settings.seed)
    scene = next((thing.scene for thing in things if thing.scene is not None), None)
    result = replace(result, warnings=(*told, *result.warnings))
    return result, scene, tuple((thing.place, thing.reason) for thing in things)


def _ended(work: Future[Any], over: StopHook) -> bool:
    while not wait([work], timeout=_POLL).done:
        if over():
            return work.done()
    return True


def _with_found(progress: Progress, change: Callable[[Grasp], Grasp]) -> Progress:
    return progress if progress.found is None else replace(progress, found=change(progress.found))


def _arrivals(scene: Scene, hand: HandModel) -> Callable[[Grasp], Grasp]:
    """Return a function that adds the `arrival` posture to grasps that failed no trial. It caches the results."""
    context, known = make_metrics_context(scene.object, hand), dict[bytes, Posture | None]()

    def arrived(grasp: Grasp) -> Grasp:
        if grasp.verdict is Verdict.FAILED:
            return grasp
        key = b"".join(part.tobytes() for part in vars(grasp.grasp).values())
        if key not in known:
            known[key] = arrival(context, grasp, scene.support, scene.obstacles)
        return replace(grasp, arrival=known[key])

    return arrived


def _empty(request: Request, stop: StopHook) -> Planned:
    outcome = Outcome.CANCELLED if stop() else Outcome.DEADLINE
    return Planned(GraspResult(outcome, (), Timing(), request.settings.seed, ""))


def overdue() -> Report[Planned]:
    """Return the report of a request whose deadline passed while it waited."""
    return Report(WorkerEnding.DONE, value=Planned(GraspResult(Outcome.DEADLINE, (), Timing(), 0, ""), worked_on=False))
