"""Messages to requests: from a mesh path, from what a camera showed, and from a GraspRequest."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable

import numpy as np
from builtin_interfaces.msg import Time
from graspd_msgs.msg import GraspRequest
from jaxtyping import Float

from graspd_core import PointCloud, Scene, load_scene, run_isolated
from graspd_ros.inputs.mesh_path import resolve_mesh
from graspd_ros.inputs.requests import Listener, Request, check_request, point_of, pose_matrix, settings_of
from graspd_ros.inputs.sensor_frames import SensorFrame, Views, cloud_frame, nanoseconds, scene_of_views, trimmed
from graspd_ros.outputs.error_codes import ErrorCode, RequestError
from graspd_ros.parameters import Settings

SOURCES = {
    GraspRequest.CLOUD: "cloud",
    GraspRequest.MESH: "mesh",
    GraspRequest.LATEST_CLOUD: "latest_cloud",
    GraspRequest.VIEWS: "views",
}


class RequestBuilder:
    """Makes requests, and holds what they may be made of: the newest frame and the kept views.

    Used by the executor's thread only. Frames and views are immutable, so that requests may hold on to them.

    Args:
        hand: name of the hand that the node plans for.
        now: the node's clock.
        lookup: `T_target_source` of two frames at a time, without waiting; may raise a TransformError.
    """

    def __init__(self, hand: str, now: Callable[[], Time], lookup: Callable[[str, str, Time], np.ndarray]) -> None:
        self.newest: SensorFrame | None = None
        self.views = Views()
        self._hand = hand
        self._now = now
        self._lookup = lookup
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
        self.views = self.views.add(self._newest(settings), settings, self._lookup)

    def from_mesh(self, request_id: str, settings: Settings, uri: str) -> Request:
        """A mesh named by its path alone. Raises MeshError."""
        load = self._mesh_loader(uri, settings)
        return Request(request_id, "mesh", settings.mesh_frame, self._now(), settings, load, timeless=True)

    def from_sensor_frame(self, request_id: str, settings: Settings, sensor_frame: SensorFrame) -> Request:
        """What a camera showed unasked. Raises RequestError: it is too old."""
        sensor_frame.check_age(nanoseconds(self._now()), settings.cloud_max_age)
        load = _loader(lambda: (trimmed(sensor_frame.read(), settings),), settings, None)
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
        pose = None
        match message.source:
            case GraspRequest.MESH:
                frame, stamp = message.header.frame_id or settings.mesh_frame, message.header.stamp
                load, pose = self._mesh_loader(message.mesh_uri, settings), pose_matrix(message.object_pose)
            case GraspRequest.VIEWS:
                views = self.views
                if not views.clouds:
                    raise RequestError(ErrorCode.NO_CLOUD, "no view is kept: call ~/add_view while clouds come")
                frame, stamp = views.frame, views.stamp
                load = _loader(lambda: views.clouds, settings, self._target(message, frame))
            case _:
                sensor_frame = self._sensor_frame(message, settings)
                frame, stamp = sensor_frame.frame, sensor_frame.stamp
                load = _loader(
                    lambda: (trimmed(sensor_frame.read(), settings),), settings, self._target(message, frame)
                )
        timeless = nanoseconds(stamp) == 0
        return Request(
            request_id,
            SOURCES[message.source],
            frame,
            self._now() if timeless else stamp,
            settings,
            load,
            T_frame_object=pose,
            listener=listener,
            timeless=timeless,
        )

    def _sensor_frame(self, message: GraspRequest, settings: Settings) -> SensorFrame:
        if message.source == GraspRequest.LATEST_CLOUD:
            return self._newest(settings)
        sensor_frame = cloud_frame(message.cloud, nanoseconds(self._now()))
        sensor_frame.check_age(nanoseconds(self._now()), settings.cloud_max_age)
        return sensor_frame

    def _newest(self, settings: Settings) -> SensorFrame:
        if self.newest is None:
            raise RequestError(ErrorCode.NO_CLOUD, "no cloud or depth image has come yet")
        self.newest.check_age(nanoseconds(self._now()), settings.cloud_max_age)
        return self.newest

    def _target(self, message: GraspRequest, frame: str) -> Float[np.ndarray, "3"] | None:
        """The point that says which object is meant, in the frame of the cloud [m]."""
        if not message.use_target_point:
            return None
        point, given = point_of(message), message.header.frame_id
        if given in ("", frame):
            return point
        pose = self._lookup(frame, given, message.header.stamp)
        return pose[:3, :3] @ point + pose[:3, 3]

    def _mesh_loader(self, uri: str, settings: Settings) -> Callable[[], Scene]:
        path = resolve_mesh(uri, settings.mesh_roots)
        mass, friction, scale = settings.mass, settings.friction, settings.mesh_scale
        return lambda: run_isolated(load_scene, str(path), mass=mass, friction=friction, scale=scale)


def _loader(
    read: Callable[[], tuple[PointCloud, ...]], settings: Settings, target: Float[np.ndarray, "3"] | None
) -> Callable[[], Scene]:
    return lambda: scene_of_views(read(), settings, target)
