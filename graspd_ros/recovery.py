"""Grasps that differ from those that were tried and lost: the next best of the same run, or a new run without them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from graspd_core.types import Grasp, GraspResult, Outcome, Timing, Verdict
from graspd_ros.inputs.frames import matrix_of_pose
from graspd_ros.inputs.requests import Request
from graspd_ros.outputs.error_codes import ErrorCode, RequestError
from graspd_ros.outputs.status_json import pose_of

MOST_RUNS = 16
# A grasp is like one that was lost where its base is this near to it and turned by less [m], [rad].
LIKE_DISTANCE, LIKE_TURN = 0.015, 0.26

Pose = Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class _Run:
    object_key: str
    frame: str
    T_frame_object: Pose | None
    grasps: tuple[Grasp, ...]


class RecentRuns:
    """The grasps of the last runs, by the id of their request. Used by one thread at a time."""

    def __init__(self) -> None:
        self._runs: OrderedDict[str, _Run] = OrderedDict()

    def keep(self, request: Request, result: GraspResult) -> None:
        """Remember a result, in the frame that it was planned in."""
        self._runs[request.id] = _Run(request.object_key, request.frame, request.T_frame_object, result.grasps)
        while len(self._runs) > MOST_RUNS:
            self._runs.popitem(last=False)

    def excluded(self, request: Request, lookup: Callable[[str, str], Pose]) -> list[Pose]:
        """Poses of the base link that the request excludes, in the frame that it is planned in.

        Args:
            request: names them by id or pose.
            lookup: `T_target_source` of two frames; may raise a TransformError.

        Raises:
            RequestError: an id that no grasp of the last runs has.
        """
        poses = []
        for name in request.exclude:
            run, grasp = self._grasp(name)
            pose = _base(grasp)
            if run.object_key != request.object_key or not request.object_key:
                placed = pose if run.T_frame_object is None else run.T_frame_object @ pose
                pose = _to_object(request, run.frame, placed, lookup)
            poses.append(pose)
        return poses + [_to_object(request, frame, pose, lookup) for frame, pose in request.exclude_poses]

    def _grasp(self, name: str) -> tuple[_Run, Grasp]:
        run_id, _, rank = name.rpartition("/")
        run = self._runs.get(run_id)
        if run is None or not rank.isdecimal() or int(rank) >= len(run.grasps):
            kept = ", ".join(self._runs) or "none"
            told = f"exclude: no grasp {name[:128]!r} in the last {MOST_RUNS} runs; kept: {kept}"
            raise RequestError(ErrorCode.BAD_REQUEST, told)
        return run, run.grasps[int(rank)]

    def next_best(self, request: Request, excluded: Sequence[Pose]) -> GraspResult | None:
        """What is left of the runs on the very same object; None where nothing good is."""
        runs = [run for run in self._runs.values() if run.object_key == request.object_key and request.object_key]
        known = {id(grasp): grasp for run in runs for grasp in run.grasps}
        wanted = Verdict.UNVERIFIED if request.settings.verify == "none" else Verdict.VERIFIED
        left = [grasp for grasp in unlike(known.values(), excluded) if grasp.verdict is wanted]
        count = request.settings.num_grasps
        if not left:
            return None
        outcome = Outcome.SUCCEEDED if len(left) >= count else Outcome.TOO_FEW
        told = f"{min(count, len(left))} grasps of an earlier run, none like the {len(excluded)} excluded"
        return GraspResult(outcome, tuple(left[:count]), Timing(), request.settings.seed, "", told)


def unlike(grasps: Iterable[Grasp], excluded: Sequence[Pose]) -> list[Grasp]:
    """Those of the grasps that are not like any of the poses."""
    return [grasp for grasp in grasps if not any(_alike(_base(grasp), pose) for pose in excluded)]


def without(result: GraspResult, excluded: Sequence[Pose], count: int) -> GraspResult:
    """A run's result without grasps like those excluded, at most `count` of the good ones."""
    left = unlike(result.grasps, excluded)
    good = [grasp for grasp in left if grasp.verdict is not Verdict.FAILED]
    failed = [grasp for grasp in left if grasp.verdict is Verdict.FAILED]
    outcome = result.outcome
    if outcome in (Outcome.SUCCEEDED, Outcome.TOO_FEW):
        outcome = Outcome.SUCCEEDED if len(good) >= count else Outcome.TOO_FEW
    return replace(result, outcome=outcome, grasps=(*good[:count], *failed))


def _alike(a: Pose, b: Pose) -> bool:
    cosine = (np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2
    near = np.linalg.norm(a[:3, 3] - b[:3, 3]) < LIKE_DISTANCE
    return bool(near and np.arccos(np.clip(cosine, -1.0, 1.0)) < LIKE_TURN)


def _base(grasp: Grasp) -> Pose:
    return matrix_of_pose(pose_of(grasp.grasp))


def _to_object(request: Request, frame: str, pose: Pose, lookup: Callable[[str, str], Pose]) -> Pose:
    """A pose in another frame, in the frame that the request is planned in."""
    placed = pose if frame in ("", request.frame) else lookup(request.frame, frame) @ pose
    return placed if request.T_frame_object is None else np.linalg.inv(request.T_frame_object) @ placed
