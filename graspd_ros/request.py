"""Requests for the worker: the object to grasp (or any object seen), and all constraints on the grasps."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np
from builtin_interfaces.msg import Time
from graspd_msgs.msg import Grasp, GraspArray, GraspProgress
from jaxtyping import Float

from graspd_core import PointCloud, Scene, Steering
from graspd_core.types import Plane, TriangleMesh
from graspd_ros.convert import Matrix
from graspd_ros.parameters import Settings

if TYPE_CHECKING:
    from graspd_ros.inputs.solids import SceneObject

MOST_ID = 128
# Function that returns `T_target_source` of two frames. May raise a TransformError.
FrameLookup = Callable[[str, str], Matrix]
# Function that returns clouds in one frame, and warnings about the clouds. May raise a GraspdError.
SeenViews = Callable[[], tuple[tuple[PointCloud, ...], tuple[str, ...]]]


class Listener(Protocol):
    """Receiver of the messages that the node publishes for one request. The publishing thread calls it."""

    def progressed(self, message: GraspProgress) -> None: ...
    def found(self, message: Grasp) -> None: ...
    def ended(self, message: GraspArray) -> None: ...


@dataclass(frozen=True)
class KnownObject:
    """Key of an object in the library: its name or, if `name` is empty, the path of its mesh file.

    If `required` is True, a missing entry is an error.
    """

    name: str = ""
    path: str = ""
    required: bool = False


@dataclass(frozen=True, eq=False)
class Request:
    """Request for grasps of one object, or of any object that the camera sees.

    Attributes:
        source: name of the object's source: cloud, mesh, latest_cloud, views, known or grasp_planning.
        frame: frame of the results if the settings have no `output_frame`.
        stamp: time for which the object's pose is valid.
        settings: the parameters at the time of the request, overridden by the request's own values.
        load: loads the object as a scene. It is slow and may raise a GraspdError.
        T_frame_object: pose of the object's own frame in `frame` [m]. None if both are the same.
        only_newest: if True, a newer `only_newest` request replaces this request while it waits.
        listener: receives the request's messages in addition to the topics. May be None.
        timeless: True if the request has no stamp, so that the newest transforms are used.
        object_key: key of the object and its measurement. Equal keys mean the same object. An empty key matches none.
        exclude: ids of earlier grasps. The answer must contain no grasp similar to them.
        exclude_poses: frames and base-link poses of more grasps to exclude.
        known: key of the object in a grasp library. None if no library is used.
        surface: support plane in the object's frame. None if the request gives none.
        steering: makes the constraints on hand and contacts. Slow, may raise a GraspdError. None without constraints.
        region_points: returns the points inside `region_mask`, in `frame` [m]. None for sources without an image.
        closes_late: True if the hand closes only after it has arrived, so that grasps need an `arrival` posture.
        collision_objects: collision objects of the planning scene by id. Empty if the node has no topic for them.
        views: reads the clouds if the request is for any object. None if it is for one object.
        solids: meshes of `collision_objects` in the object's frame [m]. The worker sets them.
        accepted: time of arrival on the monotonic clock [s].
    """

    id: str
    source: str
    frame: str
    stamp: Time
    settings: Settings
    load: Callable[[], Scene]
    T_frame_object: Matrix | None = None
    only_newest: bool = False
    listener: Listener | None = None
    timeless: bool = False
    object_key: str = ""
    exclude: tuple[str, ...] = ()
    exclude_poses: tuple[tuple[str, Matrix], ...] = ()
    known: KnownObject | None = None
    surface: Plane | None = None
    steering: Callable[[], Steering] | None = None
    region_points: Callable[[], Float[np.ndarray, "points 3"]] | None = None
    closes_late: bool = False
    collision_objects: Mapping[str, SceneObject] = field(default_factory=dict)
    views: SeenViews | None = None
    solids: Mapping[str, Sequence[TriangleMesh]] = field(default_factory=dict)
    accepted: float = field(default_factory=time.monotonic)

    @property
    def frame_out(self) -> str:
        return self.settings.output_frame or self.frame

    def elapsed(self) -> float:
        """Return the time since the request arrived [s]."""
        return time.monotonic() - self.accepted

    def time_left(self) -> float:
        """Return the time until the deadline [s]."""
        return self.settings.deadline - self.elapsed()

    def to_object(self, frame: str, T: Matrix, lookup: FrameLookup) -> Matrix:
        """Transform the pose `T` from `frame` to the object's frame. An empty `frame` means the request's frame.

        `lookup` is called only for other frames. It may raise a TransformError.
        """
        placed = T if frame in ("", self.frame) else lookup(self.frame, frame) @ T
        return placed if self.T_frame_object is None else np.linalg.inv(self.T_frame_object) @ placed
