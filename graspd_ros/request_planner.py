"""The worker's work on one request: read the object, plan, move the result to the frame asked for."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from builtin_interfaces.msg import Time

from graspd_core import HandModel, Reach, load_preset, plan_grasps, save_result
from graspd_core.types import GraspResult, Outcome, Progress, ProgressHook, Stage, StopHook, Timing
from graspd_ros.inputs.arm_place import reach_of
from graspd_ros.inputs.frames import moved_grasp, moved_result
from graspd_ros.inputs.requests import Request
from graspd_ros.recovery import RecentRuns, without
from graspd_ros.worker import Report, WorkerEnding

PATIENCE = 0.15  # seconds that work gets to end by itself when its request is over
_POLL = 0.02  # seconds between two looks at stop and deadline

T = TypeVar("T")
# `T_target_source` of two frames at a time (0: the newest there is); waits a little, unless the hook says stop; may
# raise a TransformError.
Lookup = Callable[[str, str, Time, StopHook], np.ndarray]


@dataclass(frozen=True)
class Planned:
    """A result in the frame it is told in, where it was written, if it was, and whether there was a run at all."""

    result: GraspResult
    file: str = ""
    worked_on: bool = True


class Planner:
    """Plans for one hand. Used by one thread at a time.

    The work goes on in a thread of its own, since no step of it that reads a mesh or turns a large batch asks whether
    to stop: when a request is over, that thread is left behind after a moment, and the answer goes out. It ends by
    itself soon after, and the next request waits for that, so that cancelled work does not pile up.
    """

    def __init__(self, hand: HandModel, lookup: Lookup, robot_description: str = "") -> None:
        self._hand = hand
        self._robot_description = robot_description
        self._lookup = lookup
        self._behind: Aside[Planned] | None = None
        self._runs = RecentRuns()

    def plan(self, request: Request, stop: StopHook, tell: ProgressHook) -> Planned:
        """Work off one request. Raises what reading, planning and /tf raise."""
        left, telling = threading.Event(), threading.Lock()

        def over() -> bool:
            return stop() or request.time_left() <= -PATIENCE

        def tell_if_wanted(progress: Progress) -> None:
            with telling:  # nothing is told of a request once this has returned
                if not left.is_set():
                    tell(progress)

        tell(Progress(Stage.LOAD, 0, 1, 0.0, 0, 0.0))
        if self._behind and not self._behind.wait(over):
            return _empty(request, stop)
        threads = request.settings.torch_threads
        work = self._behind = Aside(
            lambda: _with_threads(threads, lambda: self._run(request, lambda: left.is_set() or stop(), tell_if_wanted))
        )
        end = None
        while not work.wait(over):
            end = end or time.monotonic() + PATIENCE
            if time.monotonic() > end:
                with telling:
                    left.set()
                return _empty(request, stop)
        self._behind = None
        return work.result()

    def rest(self, timeout: float) -> bool:
        """Wait for work that was left behind; True when it ended within `timeout` seconds."""
        end = time.monotonic() + timeout
        return self._behind is None or self._behind.wait(lambda: time.monotonic() > end)

    def _run(self, request: Request, stop: StopHook, tell: ProgressHook) -> Planned:
        # Looked up before the work, which would be lost where there is no transform.
        run_isolated = request.frame_out != request.frame
        stamp = Time() if request.timeless else request.stamp
        T_out_frame = self._lookup(request.frame_out, request.frame, stamp, stop) if run_isolated else None
        placed = lambda target, source: self._lookup(target, source, stamp, stop)  # noqa: E731
        reach = reach_of(request, placed, self._robot_description)
        if request.things:
            from graspd_ros.inputs.collision_objects import among_things

            request = among_things(request, request.things, placed)
        newest = Time()
        excluded = self._runs.excluded(request, lambda target, source: self._lookup(target, source, newest, stop))
        # What an earlier run found was not asked for these wishes, and an arm or other things may have stood elsewhere.
        # A library has what that run found, and more.
        free = request.steering is None and not reach and not request.things
        known = excluded and free and request.known is None
        result, file = self._runs.next_best(request, excluded) if known else None, ""
        if result is None:
            poses = [pose for pose in (request.T_frame_object, T_out_frame) if pose is not None]
            moved = lambda progress: tell(_placed(progress, poses))  # noqa: E731
            result, file = self._search(request, excluded, reach, stop, moved)
        self._runs.keep(request, result)
        for pose in (request.T_frame_object, T_out_frame):
            result = result if pose is None else moved_result(result, pose)
        return Planned(result, file)

    def _search(
        self,
        request: Request,
        excluded: list[np.ndarray],
        reach: tuple[Reach, ...],
        stop: StopHook,
        tell: ProgressHook,
    ) -> tuple[GraspResult, str]:
        """A run, without grasps like those excluded, and the file that it was written to."""
        settings = request.settings
        config = load_preset(settings.preset)
        steering = () if request.steering is None else (request.steering(),)
        restrictions = (*steering, *reach)
        plan: dict[str, Any] = {"preset": config, "device": settings.device, "progress": tell, "stop": stop}
        # Of those that are planned some may be like those excluded, which other starts make less likely.
        plan["seed"] = settings.seed + len(excluded)
        if settings.grasp_library and request.known is not None:
            from graspd_ros.known_objects import answer_known

            result, scene = answer_known(request, request.known, self._hand, excluded, restrictions, **plan)
        else:
            scene = request.load()
            result = plan_grasps(
                scene,
                self._hand,
                count=settings.num_grasps + len(excluded),
                verify=settings.verify,
                deadline=max(request.time_left(), 1e-3),
                restrictions=restrictions,
                **plan,
            )
        if excluded:
            result = without(result, excluded, settings.num_grasps)
        if not settings.output_dir or stop():
            return result, ""
        path = Path(settings.output_dir) / f"{request.id}.json"
        # As planned: a mesh's grasps in the mesh's own frame, wherever it stands.
        frame = request.frame if request.T_frame_object is None else settings.mesh_frame
        seconds = request.stamp.sec + 1e-9 * request.stamp.nanosec
        scene = scene or request.load()
        save_result(path, result, scene.object, self._hand, config, frame=frame, stamp=seconds)
        return result, str(path)


class Aside(Generic[T]):
    """Work in a daemon thread: nobody has to wait for its end, not even the interpreter."""

    def __init__(self, work: Callable[[], T]) -> None:
        self._value: T
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(work,), name="graspd_planner", daemon=True)
        self._thread.start()

    def wait(self, over: StopHook) -> bool:
        """Wait for the end; False when `over` said so before, and a look later it had not ended."""
        while self._thread.is_alive():
            self._thread.join(_POLL)
            if over():
                return not self._thread.is_alive()
        return True

    def result(self) -> T:
        """What the work gave; raises what it raised."""
        if self._error is not None:
            raise self._error
        return self._value

    def _run(self, work: Callable[[], T]) -> None:
        try:
            self._value = work()
        except BaseException as error:
            self._error = error


def _placed(progress: Progress, poses: list[np.ndarray]) -> Progress:
    """A report whose grasp is in the frame that the results are told in."""
    found = progress.found
    if found is None:
        return progress
    for pose in poses:
        found = moved_grasp(found, pose)
    return replace(progress, found=found)


def _with_threads(count: int, work: Callable[[], T]) -> T:
    torch.set_num_threads(count)  # holds for the calling thread only
    return work()


def _empty(request: Request, stop: StopHook) -> Planned:
    outcome = Outcome.CANCELLED if stop() else Outcome.DEADLINE
    return Planned(GraspResult(outcome, (), Timing(), request.settings.seed, ""))


def overdue() -> Report[Planned]:
    """The end of a request whose deadline passed before its turn came."""
    return Report(WorkerEnding.DONE, value=Planned(GraspResult(Outcome.DEADLINE, (), Timing(), 0, ""), worked_on=False))


def limited(tell: ProgressHook, rate: float, since: float = -float("inf")) -> ProgressHook:
    """A hook that passes on at most `rate` reports a second; the last one before it was at `since` (monotonic)."""
    last = since

    def hook(progress: Progress) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= 1 / rate:
            last = now
            tell(progress)

    return hook
