"""Messages to requests: from a mesh path, from what a camera showed, and from a GraspRequest."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from builtin_interfaces.msg import Time
from graspd_msgs.msg import GraspRequest
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from graspd_core import Scene, Steering
from graspd_ros.inputs.camera_place import place_of, seen_by_camera
from graspd_ros.inputs.requests import Listener, Request, check_request, pose_matrix, settings_of
from graspd_ros.inputs.sensor_frames import SensorFrame, Views, cloud_frame, nanoseconds
from graspd_ros.inputs.source_registry import (
    Lookup,
    SourceInput,
    SourceObject,
    frame_loader,
    known_mesh,
    latest_frame,
    mesh_loader,
    source_of,
)
from graspd_ros.inputs.steering_wishes import asks_for_any, steering_of
from graspd_ros.parameters import Settings


class RequestBuilder:
    """Makes requests, and holds what they may be made of: the newest frame and the kept views.

    Used by the executor's thread only. Frames and views are immutable, so that requests may hold on to them.

    Args:
        hand: name of the hand that the node plans for.
        now: the node's clock.
        lookup: `T_target_source` of two frames at a time, without waiting; may raise a TransformError.
        lookup_in_time: the same for the worker's thread; waits for what comes late. None: as `lookup`.
    """

    def __init__(
        self, hand: str, now: Callable[[], Time], lookup: Lookup, lookup_in_time: Lookup | None = None
    ) -> None:
        self.newest: SensorFrame | None = None
        self.views = Views()
        self._hand = hand
        self._now = now
        self._lookup = lookup
        self._lookup_in_time = lookup_in_time or lookup
        self._numbers = itertools.count(1)
        self._started = time.strftime("%Y%m%dT%H%M%S")

    def new_id(self, kind: str) -> str:
        """A name that no request had before, not before a restart either: files are called by it."""
        return f"{kind}-{self._started}-{next(self._numbers)}"

    def forget(self) -> None:
        """Drop the newest frame and the views."""
        self.newest = None
        self.forget_views()

    def forget_views(self) -> None:
        """Drop the views."""
        self.views = Views()

    def add_view(self, settings: Settings) -> None:
        """Keep the newest frame as one more view. Raises GraspdError: none has come, or it cannot be used."""
        frame = latest_frame(self.newest, nanoseconds(self._now()), settings)
        cloud = seen_by_camera(frame, place_of(settings), self._lookup, alone=not settings.segment)
        self.views = self.views.add(frame, cloud, settings, self._lookup)

    def from_mesh(self, request_id: str, settings: Settings, uri: str) -> Request:
        """A mesh named by its path alone. Raises MeshError."""
        load, known = mesh_loader(uri, settings), known_mesh(uri, settings)
        return Request(request_id, "mesh", settings.mesh_frame, self._now(), settings, load, timeless=True, known=known)

    def from_sensor_frame(self, request_id: str, settings: Settings, sensor_frame: SensorFrame) -> Request:
        """What a camera showed unasked. Raises RequestError: it is too old."""
        sensor_frame.check_age(nanoseconds(self._now()), settings.cloud_max_age)
        load = frame_loader(sensor_frame, settings, place_of(settings), self._lookup_in_time)
        newest = settings.cloud_policy == "newest"
        return Request(request_id, "cloud", sensor_frame.frame, sensor_frame.stamp, settings, load, only_newest=newest)

    def from_message(
        self, request_id: str, settings: Settings, message: GraspRequest, listener: Listener | None = None
    ) -> Request:
        """What a client asks for.

        Raises:
            GraspdError: a field is out of range, the mesh is out of reach, or the cloud is missing, old or elsewhere.
        """
        check_request(message, self._hand)
        settings = settings_of(message, settings)
        source, now = source_of(message), self._now()
        given = SourceInput(
            message, settings, self.newest, self.views, nanoseconds(now), self._lookup, self._lookup_in_time
        )
        found = source.find(given)
        steering = self._steering(message, found)
        timeless = nanoseconds(found.stamp) == 0
        return Request(
            request_id,
            source.name,
            found.frame,
            now if timeless else found.stamp,
            settings,
            found.load,
            T_frame_object=found.T_frame_object,
            listener=listener,
            timeless=timeless,
            object_key=found.key,
            known=found.known,
            surface=found.surface,
            exclude=tuple(message.exclude),
            exclude_poses=tuple(
                (stamped.header.frame_id, pose_matrix(stamped.pose, "exclude_poses"))
                for stamped in message.exclude_poses
            ),
            steering=steering,
        )

    def _steering(self, message: GraspRequest, found: SourceObject) -> Callable[[], Steering] | None:
        """What the request asks of a grasp's place and direction, checked but for its mask. Raises GraspdError."""
        if not asks_for_any(message):
            return None
        named = message.header.frame_id
        T = np.eye(4) if named in ("", found.frame) else self._lookup(found.frame, named, message.header.stamp)
        if found.T_frame_object is not None:
            T = np.linalg.inv(found.T_frame_object) @ T
        steering = steering_of(message, T)
        return (lambda: steering_of(message, T, found.shown)) if message.region_mask.height else (lambda: steering)

    def from_loader(
        self,
        request_id: str,
        source: str,
        header: Header,
        settings: Settings,
        load: Callable[[], Scene],
        listener: Listener | None,
    ) -> Request:
        """An object that is read already, in the frame of a header; an empty one is `mesh_frame`."""
        timeless = nanoseconds(header.stamp) == 0
        stamp = self._now() if timeless else header.stamp
        frame = header.frame_id or settings.mesh_frame
        return Request(request_id, source, frame, stamp, settings, load, listener=listener, timeless=timeless)

    def from_cluster(
        self, request_id: str, settings: Settings, cloud: PointCloud2, header: Header, listener: Listener | None
    ) -> Request:
        """A cloud that shows one object, in the frame of a header. Raises RequestError: it is too large or too old."""
        seen = replace(cloud_frame(cloud, nanoseconds(self._now())), frame=header.frame_id, stamp=header.stamp)
        seen.check_age(nanoseconds(self._now()), settings.cloud_max_age)
        load = frame_loader(seen, settings, place_of(settings), self._lookup_in_time)
        return self.from_loader(request_id, "grasp_planning", header, settings, load, listener)
