"""What the worker works off, and the checks that a GraspRequest message must pass to become one."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose
from graspd_msgs.msg import Grasp, GraspArray, GraspProgress, GraspRequest
from jaxtyping import Float

from graspd_core import Scene, Steering, preset_names
from graspd_core.types import Plane
from graspd_ros.inputs.frames import matrix_of_pose
from graspd_ros.outputs.error_codes import ErrorCode, RequestError
from graspd_ros.parameters import BUDGETS, MOST_GRASPS, SCALES, Settings

if TYPE_CHECKING:
    from graspd_ros.inputs.collision_objects import Thing

MOST_ID = 128
MOST_EXCLUDED = 256
MOST_CLOUD_BYTES = 2**27  # 128 MiB: 4 million points of 32 bytes
_ID = re.compile(rf"[A-Za-z0-9_.:@+-]{{1,{MOST_ID}}}")
_FARTHEST = 1e3  # metres; what is farther away is a mistake, and costs precision


class Listener(Protocol):
    """One more who wants to know of one request, beside the topics; called in the thread that publishes."""

    def progressed(self, message: GraspProgress) -> None: ...
    def found(self, message: Grasp) -> None: ...
    def ended(self, message: GraspArray) -> None: ...


@dataclass(frozen=True)
class KnownObject:
    """An object as a request names it.

    Attributes:
        name: what the library calls it; empty: `path` is meant.
        path: of its mesh file.
        required: whether a library must know it.
    """

    name: str
    path: str
    required: bool


@dataclass(frozen=True, eq=False)
class Request:
    """One object to grasp.

    Attributes:
        id: names the request in every answer.
        source: name of its source (`source_registry`): mesh, cloud, latest_cloud, views or known.
        frame: the frame that the results are told in, unless the settings name an output_frame.
        stamp: when the object was as it was given.
        settings: the parameters at the time of the request, with what the request itself asks for.
        load: reads the object; slow, may raise a GraspdError.
        T_frame_object: pose of the object's own frame in `frame`; None where they are one.
        only_newest: whether a newer request of this kind takes its place while it waits.
        listener: who is told of it beside the topics; None where nobody is.
        timeless: whether it came without a time of its own: then the newest transforms are meant.
        object_key: same for requests of the very same object, as it is or was seen then; empty: none is the same.
        exclude: ids of grasps that the answer must not be like.
        exclude_poses: the same by frame and pose of the base link in it.
        known: what a library of grasps may know the object by; None: nothing.
        surface: what the object stands on, in its own frame; None: nothing.
        steering: makes of the frames that were seen what is asked of a grasp's place and direction; slow, may raise a
            GraspdError. None where nothing is asked.
        things: what stood in the planning scene by then, by id, wherever it is; empty where no such topic is heard.
        accepted: when the request came, by the monotonic clock [s].
    """

    id: str
    source: str
    frame: str
    stamp: Time
    settings: Settings
    load: Callable[[], Scene]
    T_frame_object: Float[np.ndarray, "4 4"] | None = None
    only_newest: bool = False
    listener: Listener | None = None
    timeless: bool = False
    object_key: str = ""
    exclude: tuple[str, ...] = ()
    exclude_poses: tuple[tuple[str, Float[np.ndarray, "4 4"]], ...] = ()
    known: KnownObject | None = None
    surface: Plane | None = None
    steering: Callable[[], Steering] | None = None
    things: Mapping[str, Thing] = field(default_factory=dict)
    accepted: float = field(default_factory=time.monotonic)

    @property
    def frame_out(self) -> str:
        """The frame that the results are told in."""
        return self.settings.output_frame or self.frame

    def elapsed(self) -> float:
        """Seconds since the request came."""
        return time.monotonic() - self.accepted

    def time_left(self) -> float:
        """Seconds until its deadline."""
        return self.settings.deadline - self.elapsed()


def check_request(message: GraspRequest, hand: str) -> None:
    """Refuse what no settings can make good. The source is checked where its row is looked up (`source_of`).

    Raises:
        RequestError: the field, what it holds and what is valid.
    """
    if message.id and not _ID.fullmatch(message.id):
        shown = message.id[:MOST_ID]
        raise _bad(f"id: {shown!r} may hold letters, digits and _.:@+- only, at most {MOST_ID} of them")
    if message.hand not in ("", hand):
        raise RequestError(
            ErrorCode.WRONG_HAND, f"hand: {message.hand[:MOST_ID]!r} is not loaded; this node plans for {hand}"
        )
    if message.num_grasps > MOST_GRASPS:
        raise _bad(f"num_grasps: {message.num_grasps}; valid: 1 to {MOST_GRASPS}, 0 for the parameter")
    # Presets by path are for the node's owner: a message must not have files read.
    if message.preset not in ("", *preset_names()):
        raise _bad(f"preset: {message.preset[:MOST_ID]!r}; valid: {', '.join(preset_names())}, empty for the parameter")
    if message.seed < -1:
        raise _bad(f"seed: {message.seed}; valid: 0 or more, -1 for the parameter")
    _check_range("time_budget", message.time_budget, BUDGETS, "s, 0 for the parameter")
    _check_range("mesh_scale", message.mesh_scale, SCALES, "m, 0 for 1")
    if len(message.cloud.data) > MOST_CLOUD_BYTES:
        raise _bad(f"cloud: {len(message.cloud.data)} bytes; at most {MOST_CLOUD_BYTES} are taken")
    if message.use_target_point:
        point_of(message)
    check_camera_and_mask(message)
    if message.source not in (GraspRequest.MESH, GraspRequest.KNOWN) and any(message.surface.coef):
        raise _bad(f"surface: with source {message.source}, whose cloud shows it; valid with MESH=1 and KNOWN=4")
    if message.known_object and (message.source != GraspRequest.KNOWN or message.mesh_uri):
        told = f"source {message.source}" if message.source != GraspRequest.KNOWN else "mesh_uri too"
        raise _bad(
            f"known_object: {message.known_object[:MOST_ID]!r} with {told}; valid with KNOWN=4, without mesh_uri"
        )
    if len(message.exclude) + len(message.exclude_poses) > MOST_EXCLUDED:
        raise _bad(f"exclude: {len(message.exclude)} ids, {len(message.exclude_poses)} poses; valid: {MOST_EXCLUDED}")


def check_camera_and_mask(message: GraspRequest) -> None:
    """Refuse a view point that is no place, and a mask beside another wish. Raises RequestError."""
    place = [message.view_point.x, message.view_point.y, message.view_point.z]
    if message.use_view_point and not (np.abs(place) <= _FARTHEST).all():
        raise _bad(f"view_point: {place}; it must be finite, within {_FARTHEST:g} m")
    if message.target_mask.height and (message.use_target_point or message.alone):
        other = "target_point" if message.use_target_point else "alone"
        raise _bad(f"target_mask: {other} is given too; give one of target_point, target_mask and alone")
    if message.target_mask.height and message.source not in (GraspRequest.CLOUD, GraspRequest.LATEST_CLOUD):
        raise _bad(f"target_mask: with source {message.source}; valid with CLOUD=0 and LATEST_CLOUD=2")


def settings_of(message: GraspRequest, settings: Settings) -> Settings:
    """The settings with what a checked request asks for itself."""
    return replace(
        settings,
        num_grasps=message.num_grasps or settings.num_grasps,
        preset=message.preset or settings.preset,
        seed=settings.seed if message.seed < 0 else message.seed,
        deadline=message.time_budget or settings.deadline,
        mesh_scale=message.mesh_scale or 1.0,
        segment=settings.segment and not message.alone,
    )


def point_of(message: GraspRequest) -> Float[np.ndarray, "3"]:
    """The target point, in the request's own frame [m]. Raises RequestError: not a place within 1 km."""
    point = np.array([message.target_point.x, message.target_point.y, message.target_point.z])
    if not (np.abs(point) <= _FARTHEST).all():
        raise _bad(f"target_point: {point.tolist()}; it must be finite, within {_FARTHEST:g} m")
    return point


def pose_matrix(pose: Pose, name: str = "object_pose") -> Float[np.ndarray, "4 4"]:
    """A pose as a matrix; an all-zero quaternion turns nothing. Raises RequestError: no pose within 1 km."""
    position = np.array([pose.position.x, pose.position.y, pose.position.z])
    if not (np.abs(position) <= _FARTHEST).all():
        raise _bad(f"{name}: position {position.tolist()}; it must be finite, within {_FARTHEST:g} m")
    turn = pose.orientation
    length = float(np.linalg.norm([turn.w, turn.x, turn.y, turn.z]))
    if length == 0:
        pose = Pose(position=pose.position)
    elif not abs(length - 1) < 0.01:
        raise _bad(f"{name}: a quaternion of length {length:.3g}; it must be 1 (or 0, for no turn)")
    return matrix_of_pose(pose)


def _check_range(name: str, value: float, limits: tuple[float, float], unit: str) -> None:
    low, high = limits
    if not (value == 0 or low <= value <= high):
        raise _bad(f"{name}: {value!r}; valid: {low:g} to {high:g} {unit}")


def _bad(message: str) -> RequestError:
    return RequestError(ErrorCode.BAD_REQUEST, message)
