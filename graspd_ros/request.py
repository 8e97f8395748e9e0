"""Requests as the worker gets them: one object to grasp, and everything asked of its grasps."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np
from builtin_interfaces.msg import Time
from graspd_msgs.msg import Grasp, GraspArray, GraspProgress
from jaxtyping import Float

from graspd_core import Scene, Steering
from graspd_core.types import Plane
from graspd_ros.convert import Matrix
from graspd_ros.parameters import Settings

if TYPE_CHECKING:
    from graspd_ros.inputs.solids import Thing

MOST_ID = 128
# `T_target_source` of two frames. May raise a TransformError.
FrameLookup = Callable[[str, str], Matrix]


class Listener(Protocol):
    """A receiver of one request's outcome, beside the topics. It is called in the thread that publishes."""

    def progressed(self, message: GraspProgress) -> None: ...
    def found(self, message: Grasp) -> None: ...
    def ended(self, message: GraspArray) -> None: ...


@dataclass(frozen=True)
class KnownObject:
    """An object by its name in the library or, where that is empty, by the path of its mesh file.

    `required` is whether the library must have it.
    """

    name: str
    path: str
    required: bool


@dataclass(frozen=True, eq=False)
class Request:
    """One object to grasp.

    Attributes:
        source: name of its source (`SOURCES`): mesh, cloud, latest_cloud, views or known.
        frame: the frame of the results, unless the settings name an output_frame.
        stamp: the time at which the object was as it was given.
        settings: the parameters at the time of the request, with those of the request itself.
        load: reads the object. It is slow and may raise a GraspdError.
        T_frame_object: pose of the object's own frame in `frame`. None where they are one.
        only_newest: whether a newer request of this kind takes its place while it waits.
        listener: informed of it beside the topics. None where there is none.
        timeless: whether it came without a time of its own, so that the newest transforms are used.
        object_key: equal for requests of the very same object, as it is or was seen then. Empty: equal to no other.
        exclude: ids of grasps that the answer must not be like.
        exclude_poses: the same by frame and pose of the base link in it.
        known: how a library of grasps may know the object. None: not at all.
        surface: the plane the object stands on, in its own frame. None: none.
        steering: makes the restrictions on a grasp's place and direction from the frames that were seen. It is slow and
            may raise a GraspdError. None where nothing is asked.
        shown: reads the points that the request's region_mask shows, in `frame` [m]. None where there is no image.
        closes_late: whether the hand closes only when it has arrived, so that grasps need their `arrival`.
        things: all things of the planning scene at that time, by id. Empty where the node has no such topic.
        accepted: when the request came, by the monotonic clock [s].
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
    shown: Callable[[], Float[np.ndarray, "points 3"]] | None = None
    closes_late: bool = False
    things: Mapping[str, Thing] = field(default_factory=dict)
    accepted: float = field(default_factory=time.monotonic)

    @property
    def frame_out(self) -> str:
        return self.settings.output_frame or self.frame

    def elapsed(self) -> float:
        """Return the seconds since the request came."""
        return time.monotonic() - self.accepted

    def time_left(self) -> float:
        """Return the seconds until its deadline."""
        return self.settings.deadline - self.elapsed()

    def to_object(self, frame: str, T: Matrix, lookup: FrameLookup) -> Matrix:
        """Return a pose of another frame (empty: the request's) in the object's own. May raise TransformError.

        `lookup` is called only if the frame is not the request's.
        """
        placed = T if frame in ("", self.frame) else lookup(self.frame, frame) @ T
        return placed if self.T_frame_object is None else np.linalg.inv(self.T_frame_object) @ placed
