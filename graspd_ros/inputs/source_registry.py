"""The sources of a GraspRequest's object: a row each. To add one, write its function and its row here, and its constant
in `GraspRequest.msg`; nothing else is edited."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
from builtin_interfaces.msg import Time
from graspd_msgs.msg import GraspRequest
from jaxtyping import Float
from sensor_msgs.msg import Image

from graspd_core import Scene, Target, load_scene
from graspd_core.errors import MeshError
from graspd_core.runtime.worker_process import run_isolated
from graspd_ros.convert import moved_points, nanoseconds, near, pose_matrix
from graspd_ros.error_codes import ErrorCode, RequestError, bad_request
from graspd_ros.inputs.sensor_frames import (
    CameraPlace,
    Lookup,
    SensorFrame,
    Views,
    cloud_frame,
    masked_cloud,
    place_of,
    scene_of_views,
    seen_by_camera,
    trimmed,
    within,
)
from graspd_ros.inputs.solids import plane_of, with_support
from graspd_ros.parameters import Settings
from graspd_ros.request import KnownObject, Listener, Request

MOST_MESH_BYTES = 10**8  # an OBJ of some 1.5 million faces; reading more takes minutes and gigabytes
MOST_PATH = 4096
_FORMS = "a path, file:///path or package://package/path"


@dataclass(frozen=True, eq=False, kw_only=True)
class SourceInput:
    """What a source may look at.

    Attributes:
        request_id: what the request goes by.
        source: name of the source.
        message: the request; its fields are checked.
        settings: the parameters, with what the request asks for itself.
        listener: who is told of it beside the topics; None where nobody is.
        newest: the newest frame that a camera sent; None before the first.
        views: the frames that were kept.
        now: by the node's clock.
        lookup: `T_target_source` of two frames at a time, without waiting; may raise a TransformError.
        lookup_in_time: the same for the worker's thread; waits for what comes late.
    """

    request_id: str
    source: str
    message: GraspRequest
    settings: Settings
    listener: Listener | None = None
    newest: SensorFrame | None
    views: Views
    now: Time
    lookup: Lookup
    lookup_in_time: Lookup

    def request(self, frame: str, stamp: Time, load: Callable[[], Scene], **fields: Any) -> Request:
        """Return the request for an object in a frame; a stamp of zero is that of now. `fields` are more of Request."""
        timeless = nanoseconds(stamp) == 0
        fields |= {"listener": self.listener, "timeless": timeless}
        return Request(
            self.request_id, self.source, frame, self.now if timeless else stamp, self.settings, load, **fields
        )


@dataclass(frozen=True)
class Source:
    """One place that objects come from.

    Attributes:
        name: its name in answers; in capitals that of its constant in the message.
        find: gives the object without reading it. Raises GraspdError: it is missing, old or out of reach.
    """

    name: str
    find: Callable[[SourceInput], Request]


def latest_frame(newest: SensorFrame | None, now: int, settings: Settings) -> SensorFrame:
    """The newest frame at `now` [ns]. Raises RequestError: there is none, or it is too old."""
    if newest is None:
        raise RequestError(ErrorCode.NO_CLOUD, "no cloud or depth image has come yet")
    newest.check_age(now, settings.cloud_max_age)
    return newest


def mesh_loader(path: Path, settings: Settings) -> Callable[[], Scene]:
    """Return a function that reads a mesh."""
    mass, friction, scale = settings.mass, settings.friction, settings.mesh_scale
    return lambda: run_isolated(load_scene, str(path), mass=mass, friction=friction, scale=scale)


def known_mesh(path: Path, settings: Settings) -> KnownObject | None:
    """Return what a library may know a mesh by; None if the node has no library."""
    return KnownObject("", str(path), False) if settings.grasp_library else None


def frame_loader(
    frame: SensorFrame,
    settings: Settings,
    place: CameraPlace,
    lookup: Lookup,
    point: Float[np.ndarray, "3"] | None = None,
    mask: Image | None = None,
) -> Callable[[], Scene]:
    """Return a function that makes a scene of what one camera showed; `lookup` is for the worker's thread.

    A `point` on or near the object, in the frame's own frame [m], or a `mask` of its pixels says which one is meant.
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


def _from_cloud(given: SourceInput) -> Request:
    frame = cloud_frame(given.message.cloud, nanoseconds(given.now))
    frame.check_age(nanoseconds(given.now), given.settings.cloud_max_age)
    return _of_frame(given, frame)


def _from_mesh(given: SourceInput) -> Request:
    settings, uri = given.settings, given.message.mesh_uri
    path = resolve_mesh(uri, settings.mesh_roots)
    # Same for the same mesh in the same size, as long as the file is not written again.
    key = f"mesh {uri} {path.stat().st_mtime_ns} {settings.mesh_scale} {settings.mass} {settings.friction}"
    found = _placed(given, mesh_loader(path, settings), key, known_mesh(path, settings))
    if found.surface is None:
        return found
    # Grasps of an earlier run stand for another one where the same things stand about the object.
    stands = f" {found.surface.normal.round(4)} {found.surface.offset:.4f}"
    return replace(found, object_key=found.object_key + stands)


def _from_known(given: SourceInput) -> Request:
    message, settings = given.message, given.settings
    if not settings.grasp_library:
        raise bad_request("source: KNOWN=4, and the parameter grasp_library names no library")
    if not message.known_object:
        found = _from_mesh(given)
        return replace(found, known=found.known and replace(found.known, required=True))
    # A node without a library imports nothing of it.
    from graspd_ros.known_objects import named_loader

    known = KnownObject(message.known_object, "", True)
    return _placed(given, named_loader(known, settings), f"known {message.known_object}", known)


def _placed(given: SourceInput, load: Callable[[], Scene], key: str, known: KnownObject | None) -> Request:
    """An object that is known whole, where the request says that it stands."""
    message = given.message
    header, pose = message.header, pose_matrix(message.object_pose)
    surface = plane_of(message.surface, np.linalg.inv(pose))
    frame, load = header.frame_id or given.settings.mesh_frame, with_support(load, surface)
    about = {"T_frame_object": pose, "object_key": key, "known": known, "surface": surface}
    return given.request(frame, header.stamp, load, **about)


def _from_latest_cloud(given: SourceInput) -> Request:
    return _of_frame(given, latest_frame(given.newest, nanoseconds(given.now), given.settings))


def _from_views(given: SourceInput) -> Request:
    views, settings = given.views, given.settings
    if not views.clouds:
        raise RequestError(ErrorCode.NO_CLOUD, "no view is kept: call ~/add_view while clouds come")
    point = _target(given, views.frame)
    target = None if point is None else Target(point=point)
    return given.request(views.frame, views.stamp, lambda: scene_of_views(views.clouds, settings, target))


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
        raise bad_request(f"source: {message.source}; valid: {valid}")
    return SOURCES[message.source]


def _of_frame(given: SourceInput, frame: SensorFrame) -> Request:
    message, place = given.message, place_of(given.settings, given.message)
    point, mask = _target(given, frame.frame), message.target_mask if message.target_mask.height else None
    load = frame_loader(frame, given.settings, place, given.lookup_in_time, point, mask)
    meant = "" if mask is not None else f"{point} {place} {given.settings.segment}"
    key = f"{frame.kind} {frame.frame} {nanoseconds(frame.stamp)} {meant}" if nanoseconds(frame.stamp) and meant else ""
    shown = lambda: _shown(frame, message.region_mask)  # noqa: E731
    return given.request(frame.frame, frame.stamp, load, object_key=key, shown=shown)


def _shown(frame: SensorFrame, mask: Image) -> Float[np.ndarray, "points 3"]:
    cloud, shown = masked_cloud(frame, frame.read(), mask, "region_mask")
    return cloud.points[shown & np.isfinite(cloud.points).all(1)]


def _target(given: SourceInput, frame: str) -> Float[np.ndarray, "3"] | None:
    """The point that says which object is meant, in the frame of the cloud [m]."""
    message = given.message
    if not message.use_target_point:
        return None
    point, named = near(message.target_point, "target_point"), message.header.frame_id
    if named in ("", frame):
        return point
    return moved_points(point[None], given.lookup(frame, named, message.header.stamp))[0]


def resolve_mesh(uri: str, roots: Sequence[str]) -> Path:
    """Return the file that `uri` names: a path, `file://` or `package://`; relative paths start at the first root.

    Links are followed before the file is compared with the roots, so a link inside a root does not lead out of it.
    A root may itself be a `package://` name; one whose package is not installed is left out.
    Raises MeshError: an unknown form or package, a path outside every root, no such file, a file too large.
    """
    uri = uri.strip()
    if len(uri) > MOST_PATH:
        raise MeshError(f"the mesh path is {len(uri)} characters long; at most {MOST_PATH} are looked at")
    if not uri:
        raise MeshError(f"the mesh path is empty; give {_FORMS}")
    allowed = allowed_roots(roots)
    if not allowed:
        raise MeshError(f"{uri}: no mesh may be read, since mesh_roots {list(roots)} names no directory")
    try:
        path = (allowed[0] / _local_path(uri)).resolve()
        if not any(path.is_relative_to(root) for root in allowed):
            raise MeshError(f"{uri}: outside the allowed mesh_roots: {', '.join(map(str, allowed))}")
        if not path.is_file():
            kind = "a directory, not a mesh file" if path.is_dir() else "no such file"
            raise MeshError(f"{uri}: {kind} (looked at {path})")
        if (size := path.stat().st_size) > MOST_MESH_BYTES:
            raise MeshError(f"{uri}: {size / 1e6:.0f} MB; at most {MOST_MESH_BYTES / 1e6:.0f} MB are read")
    except (OSError, ValueError) as error:
        raise MeshError(f"{uri!r}: not a usable path: {error}") from None
    return path


def allowed_roots(roots: Sequence[str]) -> list[Path]:
    """The directories behind `mesh_roots`, links followed; those that do not exist are left out."""
    found = []
    for root in roots:
        try:
            path = _local_path(root).expanduser().resolve()
        except MeshError:
            continue  # a package that is not installed holds nothing to read
        if path.is_dir():
            found.append(path)
    return found


def _local_path(uri: str) -> Path:
    if "://" not in uri:
        return Path(uri)
    parts = urlsplit(uri)
    if parts.scheme == "file" and parts.netloc in ("", "localhost"):
        return Path(unquote(parts.path))
    if parts.scheme == "package":
        return _package_share(parts.netloc, uri) / unquote(parts.path).lstrip("/")
    raise MeshError(f"{uri}: unknown form; give {_FORMS}")


def _package_share(package: str, uri: str) -> Path:
    from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

    try:
        return Path(get_package_share_directory(package))
    except (PackageNotFoundError, ValueError, OSError):  # ValueError: a malformed name; OSError: no AMENT_PREFIX_PATH
        raise MeshError(f"{uri}: package {package!r} is not installed") from None
