"""The sources of a GraspRequest's object: a row each. To add one, write its function and its row here, and its constant
in `GraspRequest.msg`; nothing else is edited."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from builtin_interfaces.msg import Time
from graspd_msgs.msg import GraspRequest
from jaxtyping import Float
from sensor_msgs.msg import Image

from graspd_core import Scene, Target, load_scene
from graspd_core.runtime.worker_process import run_isolated
from graspd_core.types import Plane
from graspd_ros.inputs.camera_place import CameraPlace, masked_cloud, place_of, seen_by_camera
from graspd_ros.inputs.mesh_path import resolve_mesh
from graspd_ros.inputs.requests import KnownObject, point_of, pose_matrix
from graspd_ros.inputs.sensor_frames import (
    SensorFrame,
    Views,
    cloud_frame,
    nanoseconds,
    scene_of_views,
    trimmed,
    within,
)
from graspd_ros.inputs.support_surface import plane_of, with_support
from graspd_ros.outputs.error_codes import ErrorCode, RequestError
from graspd_ros.parameters import Settings

Lookup = Callable[[str, str, Time], np.ndarray]


@dataclass(frozen=True, eq=False)
class SourceInput:
    """What a source may look at.

    Attributes:
        message: the request; its fields are checked.
        settings: the parameters, with what the request asks for itself.
        newest: the newest frame that a camera sent; None before the first.
        views: the frames that were kept.
        now: the node's clock [ns].
        lookup: `T_target_source` of two frames at a time, without waiting; may raise a TransformError.
        lookup_in_time: the same for the worker's thread; waits for what comes late.
    """

    message: GraspRequest
    settings: Settings
    newest: SensorFrame | None
    views: Views
    now: int
    lookup: Lookup
    lookup_in_time: Lookup


@dataclass(frozen=True, eq=False)
class SourceObject:
    """The object that a source gives.

    Attributes:
        frame: the frame that the object is in.
        stamp: when it was as it was given; zero where the source does not say.
        load: reads the object; slow, may raise a GraspdError.
        T_frame_object: pose of the object's own frame in `frame`; None where they are one.
        key: same for the very same object, as it is or was seen then; empty where nobody can tell.
        known: what a library of grasps may know it by; None: nothing.
        surface: what it stands on, in its own frame; None: nothing, or the cloud shows it.
        shown: reads the points that the request's region_mask shows, in `frame` [m]; None where there is no image.
    """

    frame: str
    stamp: Time
    load: Callable[[], Scene]
    T_frame_object: Float[np.ndarray, "4 4"] | None = None
    key: str = ""
    known: KnownObject | None = None
    surface: Plane | None = None
    shown: Callable[[], Float[np.ndarray, "points 3"]] | None = None


@dataclass(frozen=True)
class Source:
    """One place that objects come from.

    Attributes:
        name: its name in answers; in capitals that of its constant in the message.
        find: gives the object without reading it. Raises GraspdError: it is missing, old or out of reach.
    """

    name: str
    find: Callable[[SourceInput], SourceObject]


def latest_frame(newest: SensorFrame | None, now: int, settings: Settings) -> SensorFrame:
    """The newest frame at `now` [ns]. Raises RequestError: there is none, or it is too old."""
    if newest is None:
        raise RequestError(ErrorCode.NO_CLOUD, "no cloud or depth image has come yet")
    newest.check_age(now, settings.cloud_max_age)
    return newest


def mesh_loader(uri: str, settings: Settings) -> Callable[[], Scene]:
    """A function that reads the mesh at a path or URI. Raises MeshError: it is out of reach."""
    path = resolve_mesh(uri, settings.mesh_roots)
    mass, friction, scale = settings.mass, settings.friction, settings.mesh_scale
    return lambda: run_isolated(load_scene, str(path), mass=mass, friction=friction, scale=scale)


def mesh_key(uri: str, settings: Settings) -> str:
    """Same for the same mesh in the same size, as long as the file is not written again."""
    changed = resolve_mesh(uri, settings.mesh_roots).stat().st_mtime_ns
    return f"mesh {uri} {changed} {settings.mesh_scale} {settings.mass} {settings.friction}"


def known_mesh(uri: str, settings: Settings) -> KnownObject | None:
    """What a library may know a mesh by; None where the node has no library."""
    return KnownObject("", str(resolve_mesh(uri, settings.mesh_roots)), False) if settings.grasp_library else None


def frame_loader(
    frame: SensorFrame,
    settings: Settings,
    place: CameraPlace,
    lookup: Lookup,
    point: Float[np.ndarray, "3"] | None = None,
    mask: Image | None = None,
) -> Callable[[], Scene]:
    """A function that makes a scene of one frame.

    Args:
        frame: what a camera showed.
        settings: workspace, thinning, and whether the object is alone.
        place: where the camera stood.
        lookup: for the worker's thread.
        point: on or near the object meant, in the frame's own frame [m].
        mask: its pixels that show the object meant; checked on loading.
    """

    def load() -> Scene:
        cloud = seen_by_camera(frame, place, lookup, alone=not settings.segment)
        if mask is None:
            target = None if point is None else Target(point=point)
            return scene_of_views((trimmed(cloud, settings),), settings, target)
        cloud, shown = masked_cloud(frame, cloud, mask)
        inside = within(cloud.points, settings)
        return scene_of_views((replace(cloud, points=cloud.points[inside]),), settings, Target(mask=shown[inside]))

    return load


def _from_cloud(given: SourceInput) -> SourceObject:
    frame = cloud_frame(given.message.cloud, given.now)
    frame.check_age(given.now, given.settings.cloud_max_age)
    return _of_frame(given, frame)


def _from_mesh(given: SourceInput) -> SourceObject:
    header = given.message.header
    frame, pose = header.frame_id or given.settings.mesh_frame, pose_matrix(given.message.object_pose)
    uri, settings = given.message.mesh_uri, given.settings
    surface = plane_of(given.message.surface, np.linalg.inv(pose))
    load = with_support(mesh_loader(uri, settings), surface)
    known = known_mesh(uri, settings)
    # Grasps of an earlier run stand for another one where the same things stand about the object.
    stands = "" if surface is None else f" {surface.normal.round(4)} {surface.offset:.4f}"
    key = mesh_key(uri, settings) + stands
    return SourceObject(frame, header.stamp, load, pose, key, known=known, surface=surface)


def _from_known(given: SourceInput) -> SourceObject:
    message, settings = given.message, given.settings
    if not settings.grasp_library:
        raise RequestError(ErrorCode.BAD_REQUEST, "source: KNOWN=4, and the parameter grasp_library names no library")
    if not message.known_object:
        found = _from_mesh(given)
        return replace(found, known=found.known and replace(found.known, required=True))
    # A node without a library imports nothing of it.
    from graspd_ros.known_objects import named_loader

    known = KnownObject(message.known_object, "", True)
    pose, header = pose_matrix(message.object_pose), message.header
    surface = plane_of(message.surface, np.linalg.inv(pose))
    load = with_support(named_loader(known, settings), surface)
    frame, key = header.frame_id or settings.mesh_frame, f"known {message.known_object}"
    return SourceObject(frame, header.stamp, load, pose, key, known=known, surface=surface)


def _from_latest_cloud(given: SourceInput) -> SourceObject:
    return _of_frame(given, latest_frame(given.newest, given.now, given.settings))


def _from_views(given: SourceInput) -> SourceObject:
    views, settings = given.views, given.settings
    if not views.clouds:
        raise RequestError(ErrorCode.NO_CLOUD, "no view is kept: call ~/add_view while clouds come")
    point = _target(given, views.frame)
    target = None if point is None else Target(point=point)
    return SourceObject(views.frame, views.stamp, lambda: scene_of_views(views.clouds, settings, target))


SOURCES: dict[int, Source] = {
    GraspRequest.CLOUD: Source("cloud", _from_cloud),
    GraspRequest.MESH: Source("mesh", _from_mesh),
    GraspRequest.LATEST_CLOUD: Source("latest_cloud", _from_latest_cloud),
    GraspRequest.VIEWS: Source("views", _from_views),
    GraspRequest.KNOWN: Source("known", _from_known),
}


def source_of(message: GraspRequest) -> Source:
    """The row of the source that a request names. Raises RequestError: there is none."""
    if message.source not in SOURCES:
        valid = ", ".join(f"{source.name.upper()}={number}" for number, source in SOURCES.items())
        raise RequestError(ErrorCode.BAD_REQUEST, f"source: {message.source}; valid: {valid}")
    return SOURCES[message.source]


def _of_frame(given: SourceInput, frame: SensorFrame) -> SourceObject:
    message, place = given.message, place_of(given.settings, given.message)
    point, mask = _target(given, frame.frame), message.target_mask if message.target_mask.height else None
    load = frame_loader(frame, given.settings, place, given.lookup_in_time, point, mask)
    meant = "" if mask is not None else f"{point} {place} {given.settings.segment}"
    key = f"{frame.kind} {frame.frame} {nanoseconds(frame.stamp)} {meant}" if nanoseconds(frame.stamp) and meant else ""
    return SourceObject(frame.frame, frame.stamp, load, key=key, shown=lambda: _shown(frame, message.region_mask))


def _shown(frame: SensorFrame, mask: Image) -> Float[np.ndarray, "points 3"]:
    cloud, shown = masked_cloud(frame, frame.read(), mask, "region_mask")
    return cloud.points[shown & np.isfinite(cloud.points).all(1)]


def _target(given: SourceInput, frame: str) -> Float[np.ndarray, "3"] | None:
    """The point that says which object is meant, in the frame of the cloud [m]."""
    message = given.message
    if not message.use_target_point:
        return None
    point, named = point_of(message), message.header.frame_id
    if named in ("", frame):
        return point
    pose = given.lookup(frame, named, message.header.stamp)
    return pose[:3, :3] @ point + pose[:3, 3]
