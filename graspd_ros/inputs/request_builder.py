"""Conversion of messages to requests: mesh paths, clouds, depth images, and GraspRequest with its checks.

Each row of `SOURCES` is one way in which a GraspRequest gives its object. A new source needs a function and a row here,
and a constant in `GraspRequest.msg`. No other file changes.
"""

from __future__ import annotations

import itertools
import re
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose
from graspd_msgs.msg import GraspRequest
from jaxtyping import Float
from sensor_msgs.msg import Image
from shape_msgs.msg import SolidPrimitive

from graspd_core import Box, NearPoints, PointCloud, Scene, Sphere, Steering, Target, load_scene, preset_names
from graspd_core.errors import MeshError
from graspd_core.io.messages import CameraPlace
from graspd_core.perception.cloud.viewpoint_check import check_scene
from graspd_core.perception.scene import MASSES
from graspd_core.planning.regions import unit_vector
from graspd_core.planning.steering import zero_of_roll
from graspd_core.runtime.worker_process import run_isolated
from graspd_ros.convert import Matrix, moved_points, nanoseconds, near, pose_matrix, wxyz_of_matrix
from graspd_ros.error_codes import ErrorCode, RequestError, bad_request
from graspd_ros.inputs import sensor_frames as seen
from graspd_ros.inputs.sensor_frames import Lookup, SensorFrame, Views, cloud_frame, place_of
from graspd_ros.inputs.solids import plane_of, with_support
from graspd_ros.parameters import BUDGETS, MOST_GRASPS, SCALES, Settings
from graspd_ros.request import MOST_ID, KnownObject, Request, SeenViews

MOST_EXCLUDED = 256
MOST_BOXES = 64
MOST_MESH_BYTES = 10**8  # an OBJ file of about 1.5 million faces. Reading a larger one takes minutes and gigabytes
MOST_PATH = 4096
_FORMS = "a path, file:///path or package://package/path"
_ID = re.compile(rf"[A-Za-z0-9_.:@+-]{{1,{MOST_ID}}}")
Load = Callable[[], Scene]
_OF_ONE_CLOUD = (GraspRequest.CLOUD, GraspRequest.LATEST_CLOUD)
# An angle of 0 in a message means the default of `Steering`.
_DEFAULTS = Steering()


class RequestBuilder:
    """Builder of requests. It stores the newest sensor frame (a cloud or depth image) and the views (stored clouds).

    `missing` maps the name of each sensor topic without messages to the reason. Only the executor's thread uses a
    builder. Requests may keep sensor frames and views, because both are immutable.

    Args:
        lookup: function that returns `T_target_source` at a time. It never waits, and may raise a TransformError.
        lookup_in_time: like `lookup`, but waits for late transforms in the worker's thread. If None, `lookup` is used.
    """

    def __init__(
        self, hand: str, now: Callable[[], Time], lookup: Lookup, lookup_in_time: Lookup | None = None
    ) -> None:
        self.newest: SensorFrame | None = None
        self.missing: Mapping[str, str] = {}
        self.views = Views()
        self.hand = hand
        self.now = now
        self.lookup = lookup
        self.lookup_in_time = lookup_in_time or lookup
        self._numbers = itertools.count(1)
        self._started = time.strftime("%Y%m%dT%H%M%S")

    def new_id(self, kind: str) -> str:
        """Return a new id that begins with `kind`. Ids name output files, so they stay unique after a restart."""
        return f"{kind}-{self._started}-{next(self._numbers)}"

    def drop_views(self) -> int:
        """Delete the views. Return their number."""
        dropped, self.views = len(self.views.clouds), Views()
        return dropped

    def latest(self, settings: Settings) -> SensorFrame:
        """Return the newest sensor frame. Raises RequestError: no frame has arrived, or the newest frame is too old."""
        if self.newest is None:
            why = "".join(f"; {reason}" for reason in self.missing.values())
            raise RequestError(ErrorCode.NO_CLOUD, f"no cloud or depth image has arrived yet{why}")
        self.newest.check(nanoseconds(self.now()), settings.cloud_max_age)
        return self.newest

    def add_view(self, settings: Settings) -> None:
        """Store the newest sensor frame as a view. Raises GraspdError: no sensor frame, or the newest is unusable."""
        frame = self.latest(settings)
        cloud = seen.seen_by_camera(frame, place_of(settings), self.lookup)
        if settings.segment:
            check_scene([cloud])
        self.views = self.views.add(frame, cloud, settings, self.lookup)

    def from_mesh(self, request_id: str, settings: Settings, uri: str) -> Request:
        """Return the request for a mesh given only by its path. Raises MeshError: the path is not usable."""
        load, known = mesh_source(resolve_mesh(uri, settings.mesh_roots), settings)
        return self.request(request_id, "mesh", settings.mesh_frame, Time(), settings, load, known=known)

    def from_sensor_frame(self, request_id: str, settings: Settings, sensor_frame: SensorFrame) -> Request:
        """Return the request for a sensor frame without a GraspRequest. Raises RequestError: the frame is unusable."""
        load = self.loader_of(settings, sensor_frame)
        newest = settings.cloud_policy == "newest"
        return Request(request_id, "cloud", sensor_frame.frame, sensor_frame.stamp, settings, load, only_newest=newest)

    def from_message(self, request_id: str, settings: Settings, message: GraspRequest) -> Request:
        """Return the request that a GraspRequest describes.

        Raises GraspdError: a field is invalid, the mesh or cloud is missing or unusable, or a frame is not in /tf.
        """
        check_request(message, self.hand)
        if message.any_object and not settings.segment:
            raise bad_request("any_object: the parameter segment is false; set segment to true to see several objects")
        settings = settings_of(message, settings)
        source = source_of(message)
        request = source.find(SourceInput(request_id, source.name, message, settings, self))
        request = replace(request, steering=self._steering(message, request), closes_late=message.closes_late)
        lost = [(pose.header.frame_id, pose_matrix(pose.pose, "exclude_poses")) for pose in message.exclude_poses]
        return replace(request, exclude=tuple(message.exclude), exclude_poses=tuple(lost))

    def _steering(self, message: GraspRequest, request: Request) -> Callable[[], Steering] | None:
        """Check the constraint fields. Return a function that makes the constraints, or None without constraints."""
        if not _has_constraints(message):
            return None

        def made(lookup: Lookup, stamp: Time) -> Steering:
            to_frame = lambda target, source: lookup(target, source, stamp)  # noqa: E731
            return steering_of(message, request.to_object(message.header.frame_id, np.eye(4), to_frame))

        # Check fields and frames. The header's stamp is often newer than /tf, so check at the newest time.
        steering, region_points = made(self.lookup, Time()), request.region_points
        stamp = message.header.stamp
        if region_points is not None:  # the camera may have moved since it saw the cloud
            stamp = Time() if request.timeless else request.stamp
        elif not nanoseconds(stamp):
            return lambda: steering
        seen = lambda: made(self.lookup_in_time, stamp)  # noqa: E731  the transforms may still be on the way
        if region_points is None or not message.region_mask.height:
            return seen
        return lambda: replace(seen(), region=NearPoints(region_points()))

    def request(
        self, request_id: str, source: str, frame: str, stamp: Time, settings: Settings, load: Load, **fields: Any
    ) -> Request:
        """Return a request in the coordinate frame `frame`. A zero stamp means now. `fields`: other fields."""
        timeless = nanoseconds(stamp) == 0
        stamp = self.now() if timeless else stamp
        return Request(request_id, source, frame, stamp, settings, load, timeless=timeless, **fields)

    def loader_of(self, settings: Settings, frame: SensorFrame) -> Load:
        """Return a function that makes a scene from a sensor frame. Raises RequestError: the frame is unusable."""
        frame.check(nanoseconds(self.now()), settings.cloud_max_age)
        return frame_loader(frame, settings, place_of(settings), self.lookup_in_time)


def check_request(message: GraspRequest, hand: str) -> None:
    """Raise RequestError if a field is invalid or contradicts another field. `source_of` checks the field `source`."""
    if message.id and not _ID.fullmatch(message.id):
        start = message.id[:MOST_ID]
        raise bad_request(f"id: {start!r}; valid: at most {MOST_ID} letters, digits and _.:@+-")
    if message.hand not in ("", hand):
        fault = f"hand: {message.hand[:MOST_ID]!r} is not loaded; this node plans for {hand}"
        raise RequestError(ErrorCode.WRONG_HAND, fault)
    if message.num_grasps > MOST_GRASPS:
        raise bad_request(f"num_grasps: {message.num_grasps}; valid: 1 to {MOST_GRASPS}, 0 for the parameter")
    # Only the node's owner may set a preset by path. A message must not make the node read files.
    if message.preset not in ("", *preset_names()):
        valid = f"{', '.join(preset_names())}, empty for the parameter"
        raise bad_request(f"preset: {message.preset[:MOST_ID]!r}; valid: {valid}")
    if message.seed < -1:
        raise bad_request(f"seed: {message.seed}; valid: 0 or more, -1 for the parameter")
    _check_range("time_budget", message.time_budget, BUDGETS, "s, 0 for the parameter")
    _check_range("mass", message.mass, MASSES, "kg, 0 for the parameter")
    _check_range("mesh_scale", message.mesh_scale, SCALES, "m, 0 for 1")
    if len(message.cloud.data) > seen.MOST_CLOUD_BYTES:
        raise bad_request(f"cloud: {len(message.cloud.data)} bytes; valid: at most {seen.MOST_CLOUD_BYTES}")
    if message.use_target_point:
        near(message.target_point, "target_point")
        if message.source in (GraspRequest.MESH, GraspRequest.KNOWN):
            given = (message.mesh_uri or message.known_object)[:MOST_PATH]
            fault = f"given with {given}, a mesh; valid with CLOUD=0, LATEST_CLOUD=2 and VIEWS=3"
            raise bad_request(f"target_point: {fault}")
    if message.use_view_point:
        near(message.view_point, "view_point")
    if message.target_mask.height and (message.use_target_point or message.alone):
        other = "target_point" if message.use_target_point else "alone"
        raise bad_request(f"target_mask: cannot be combined with {other}; remove one of them")
    _check_mask_source(message, "target_mask")
    _check_any_object(message)
    if message.source not in (GraspRequest.MESH, GraspRequest.KNOWN) and any(message.surface.coef):
        raise bad_request(f"surface: source is {message.source}, a cloud; valid sources: MESH=1, KNOWN=4")
    if message.known_object and (message.source != GraspRequest.KNOWN or message.mesh_uri):
        fault = f"source {message.source}" if message.source != GraspRequest.KNOWN else "mesh_uri too"
        name = message.known_object[:MOST_ID]
        raise bad_request(f"known_object: {name!r} with {fault}; valid: source KNOWN=4, no mesh_uri")
    if message.known_object and message.mesh_scale not in (0.0, 1.0):
        raise bad_request(f"mesh_scale: {message.mesh_scale:g} with known_object; the library has its scale; valid: 0")
    if len(message.exclude) + len(message.exclude_poses) > MOST_EXCLUDED:
        counts = f"{len(message.exclude)} ids, {len(message.exclude_poses)} poses"
        raise bad_request(f"exclude: {counts}; valid: at most {MOST_EXCLUDED} together")


def _check_any_object(message: GraspRequest) -> None:
    if not message.any_object:
        return
    masked = message.target_mask.height > 0
    given = {"use_target_point": message.use_target_point, "alone": message.alone, "target_mask": masked}
    for other in (name for name, value in given.items() if value):
        raise bad_request(f"any_object: {other} is given too and selects an object; remove one of them")
    if message.source in (GraspRequest.MESH, GraspRequest.KNOWN):
        raise bad_request(f"any_object: source is {message.source}; valid sources: CLOUD=0, LATEST_CLOUD=2, VIEWS=3")


def _check_mask_source(message: GraspRequest, name: str) -> None:
    if getattr(message, name).height and message.source not in _OF_ONE_CLOUD:
        raise bad_request(f"{name}: source is {message.source}; valid sources: CLOUD=0, LATEST_CLOUD=2")


def settings_of(message: GraspRequest, settings: Settings) -> Settings:
    """Return the settings with a checked request's values in place of the parameters. Mesh scale 0 means 1."""
    return replace(
        settings,
        num_grasps=message.num_grasps or settings.num_grasps,
        preset=message.preset or settings.preset,
        seed=settings.seed if message.seed < 0 else message.seed,
        deadline=message.time_budget or settings.deadline,
        mass=message.mass or settings.mass,
        mesh_scale=message.mesh_scale or 1.0,
        segment=settings.segment and not message.alone,
    )


def _check_range(name: str, value: float, limits: tuple[float, float], unit: str) -> None:
    low, high = limits
    if not (value == 0 or low <= value <= high):
        raise bad_request(f"{name}: {value!r}; valid: {low:g} to {high:g} {unit}")


def _has_constraints(message: GraspRequest) -> bool:
    angles = message.approach_angle, message.roll, message.roll_tolerance
    masked, boxes = message.region_mask.height > 0, message.avoid or message.avoid_poses
    return any((_direction(message), message.use_roll, *angles, message.region.dimensions, masked, boxes))


def steering_of(message: GraspRequest, T_object_header: Matrix) -> Steering:
    """Return the constraints on a request's grasps, in the object's frame. `region_mask` is left out.

    Raises GraspdError: a field is invalid. The error names field, value and valid values.
    """
    _check(message)
    rotation = T_object_header[:3, :3]
    region, given = _region(message, T_object_header), _direction(message)
    boxes = zip(message.avoid, message.avoid_poses, strict=True)
    avoid = [_box("avoid", solid, pose, T_object_header) for solid, pose in boxes]
    direction = np.array(unit_vector("approach_direction", given)) if given else None
    zero = rotation @ zero_of_roll(direction) if message.use_roll and direction is not None else None
    return Steering(
        approach_direction=None if direction is None else rotation @ direction,
        approach_angle=message.approach_angle or _DEFAULTS.approach_angle,
        region=region,
        avoid=avoid,
        roll=message.roll if message.use_roll else None,
        roll_tolerance=message.roll_tolerance or _DEFAULTS.roll_tolerance,
        roll_zero=zero,
    )


def _check(message: GraspRequest) -> None:
    """Raise RequestError if a constraint is given twice, lacks a field that it needs, or has too many boxes."""
    if message.approach_angle and not _direction(message):
        raise bad_request("approach_angle: needs approach_direction; give both or neither")
    if (message.roll or message.roll_tolerance) and not message.use_roll:
        raise bad_request("roll: use_roll is false; set use_roll to true")
    if message.region_mask.height and message.region.dimensions:
        raise bad_request("region_mask: region is given too; remove one of them")
    _check_mask_source(message, "region_mask")
    if len(message.avoid) != len(message.avoid_poses) or len(message.avoid) > MOST_BOXES:
        counts = f"{len(message.avoid)} boxes, {len(message.avoid_poses)} poses"
        raise bad_request(f"avoid: {counts}; valid: one pose for each box, at most {MOST_BOXES} boxes")


def _direction(message: GraspRequest) -> tuple[float, ...]:
    """Return the approach direction of a request, or an empty tuple if all its components are 0."""
    given = message.approach_direction.x, message.approach_direction.y, message.approach_direction.z
    return given if any(given) else ()


def _region(message: GraspRequest, T_object_header: Matrix) -> Box | Sphere | None:
    solid = message.region
    if not solid.dimensions:
        return None
    if solid.type == SolidPrimitive.SPHERE:
        if len(solid.dimensions) != 1:
            raise bad_request(f"region: {len(solid.dimensions)} dimensions; valid for a SPHERE: 1, the radius [m]")
        pose = T_object_header @ pose_matrix(message.region_pose, "region_pose")
        return Sphere(pose[:3, 3], float(solid.dimensions[0]))
    return _box("region", solid, message.region_pose, T_object_header)


def _box(name: str, solid: SolidPrimitive, pose: Pose, T_object_header: Matrix) -> Box:
    valid = "BOX=1 or SPHERE=2" if name == "region" else "BOX=1"
    if solid.type != SolidPrimitive.BOX or len(solid.dimensions) != 3:
        given = f"type {solid.type} of {len(solid.dimensions)} dimensions"
        raise bad_request(f"{name}: {given}; valid: {valid}; a BOX has 3 dimensions")
    placed = T_object_header @ pose_matrix(pose, f"{name}_pose{'s' * (name == 'avoid')}")
    return Box(placed[:3, 3], list(solid.dimensions), wxyz_of_matrix(placed))


@dataclass(frozen=True, eq=False)
class SourceInput:
    """Input of `Source.find`: the checked message, its settings, and the builder with its sensor frame and views.

    The values of the message have replaced the parameters in `settings`.
    """

    request_id: str
    source: str
    message: GraspRequest
    settings: Settings
    builder: RequestBuilder

    def request(self, frame: str, stamp: Time, load: Load, **fields: Any) -> Request:
        """Return `RequestBuilder.request` of this input."""
        return self.builder.request(self.request_id, self.source, frame, stamp, self.settings, load, **fields)


@dataclass(frozen=True)
class Source:
    """Source of objects. The source's constant in GraspRequest is `name` in capitals.

    `find` builds a Request, which reads the object later. Raises GraspdError: data are missing, stale or not allowed.
    """

    name: str
    find: Callable[[SourceInput], Request]


def mesh_source(path: Path, settings: Settings, *, required: bool = False) -> tuple[Load, KnownObject | None]:
    """Return a function that loads a mesh as a scene, and the mesh's library key, which is None without a library."""
    mass, friction, scale = settings.mass or None, settings.friction, settings.mesh_scale
    load = lambda: run_isolated(load_scene, str(path), mass=mass, friction=friction, scale=scale)  # noqa: E731
    return load, KnownObject(path=str(path), required=required) if settings.grasp_library else None


def frame_loader(
    frame: SensorFrame,
    settings: Settings,
    place: CameraPlace,
    lookup: Lookup,
    point: Callable[[], Float[np.ndarray, "3"] | None] = lambda: None,
    mask: Image | None = None,
) -> Load:
    """Return a function that makes a scene from one sensor frame. The worker's thread calls `lookup` and `point`.

    `point` returns a point [m] on or near the target object, in the frame of the points, or None. If `mask` is
    given, it marks the target's pixels, and `point` is not used.
    """

    def load() -> Scene:
        if mask is None:
            views, warnings = frame_views(frame, settings, place, lookup)()
            near_it = point()
            return seen.scene_of_views(views, settings, None if near_it is None else Target(point=near_it), warnings)
        cloud = seen.seen_by_camera(frame, place, lookup)
        warnings = frame.warnings(cloud)
        points, marks = seen.masked_points(frame, mask)
        marked, inside = seen.cropped(replace(cloud, points=points), settings)
        return seen.scene_of_views((marked,), settings, Target(mask=marks[inside]), warnings)

    return load


def frame_views(frame: SensorFrame, settings: Settings, place: CameraPlace, lookup: Lookup) -> SeenViews:
    """Return a function that reads a sensor frame as one view, with warnings. The worker's thread calls `lookup`."""

    def read() -> tuple[tuple[PointCloud, ...], tuple[str, ...]]:
        cloud = seen.seen_by_camera(frame, place, lookup)
        return (seen.trimmed(cloud, settings),), frame.warnings(cloud)

    return read


def _from_cloud(given: SourceInput) -> Request:
    now = nanoseconds(given.builder.now())
    frame = cloud_frame(given.message.cloud, now)
    if given.message.cloud.data:  # an empty cloud gets a more specific error later
        frame.check(now, given.settings.cloud_max_age)
    return _of_frame(given, frame)


def _from_mesh(given: SourceInput) -> Request:
    settings, required = given.settings, given.message.source == GraspRequest.KNOWN
    path = resolve_mesh(given.message.mesh_uri, settings.mesh_roots)
    # Equal keys mean: same unchanged file, scale, mass and friction.
    about = path.stat()
    file = f"{path} {about.st_mtime_ns} {about.st_size}"
    key = f"mesh {file} {settings.mesh_scale} {settings.mass} {settings.friction}"
    found = _placed(given, key, *mesh_source(path, settings, required=required))
    if found.surface is None:
        return found
    # Grasps of an earlier run are reused only on the same support surface.
    stands = f" {found.surface.normal.round(4)} {found.surface.offset:.4f}"
    return replace(found, object_key=found.object_key + stands)


def _from_known(given: SourceInput) -> Request:
    message, settings = given.message, given.settings
    if not settings.grasp_library:
        raise bad_request("source: KNOWN=4 needs a library; set the parameter grasp_library")
    if not message.known_object:
        return _from_mesh(given)
    # Import here, so that a node without a library does not load this module.
    from graspd_ros.known_objects import named_loader

    known = KnownObject(message.known_object, required=True)
    return _placed(given, f"known {message.known_object}", named_loader(known, settings), known)


def _placed(given: SourceInput, key: str, load: Load, known: KnownObject | None) -> Request:
    message = given.message
    header, pose = message.header, pose_matrix(message.object_pose)
    surface = plane_of(message.surface, np.linalg.inv(pose))
    frame, load = header.frame_id or given.settings.mesh_frame, with_support(load, surface)
    about = {"T_frame_object": pose, "object_key": key, "known": known, "surface": surface}
    return given.request(frame, header.stamp, load, **about)


def _from_latest_cloud(given: SourceInput) -> Request:
    return _of_frame(given, given.builder.latest(given.settings))


def _from_views(given: SourceInput) -> Request:
    views, settings = given.builder.views, given.settings
    if not views.clouds:
        raise RequestError(ErrorCode.NO_CLOUD, "no view is stored; call ~/add_view while clouds arrive")
    newest, stamp = _target(given, views.frame, Time(), given.builder.lookup), given.message.header.stamp

    def load() -> Scene:
        # The transforms at the header's stamp may still be on the way.
        late = nanoseconds(stamp) > 0
        point = _target(given, views.frame, stamp, given.builder.lookup_in_time) if late else newest
        return seen.scene_of_views(views.clouds, settings, None if point is None else Target(point=point))

    more = {"views": lambda: (views.clouds, ())} if given.message.any_object else {}
    return given.request(views.frame, views.stamp, load, **more)


SOURCES: dict[int, Source] = {
    GraspRequest.CLOUD: Source("cloud", _from_cloud),
    GraspRequest.MESH: Source("mesh", _from_mesh),
    GraspRequest.LATEST_CLOUD: Source("latest_cloud", _from_latest_cloud),
    GraspRequest.VIEWS: Source("views", _from_views),
    GraspRequest.KNOWN: Source("known", _from_known),
}


def source_of(message: GraspRequest) -> Source:
    """Return the row of `SOURCES` for a request. Raises RequestError: the source is unknown."""
    if message.source not in SOURCES:
        valid = ", ".join(f"{source.name.upper()}={number}" for number, source in SOURCES.items())
        raise bad_request(f"source: {message.source}; valid: {valid}")
    return SOURCES[message.source]


def _of_frame(given: SourceInput, frame: SensorFrame) -> Request:
    message, place = given.message, place_of(given.settings, given.message)
    mask, lookup = message.target_mask if message.target_mask.height else None, given.builder.lookup_in_time
    _target(given, frame.frame, Time(), given.builder.lookup)  # refuses frames that /tf does not connect
    # The camera may have moved since. Its transforms at the cloud's time may still be on the way.
    point = partial(_target, given, frame.frame, frame.stamp, lookup)
    load = frame_loader(frame, given.settings, place, lookup, point, mask)
    region_points = lambda: _region_points(frame, message.region_mask)  # noqa: E731
    if message.any_object:
        views = frame_views(frame, given.settings, place, lookup)
        return given.request(frame.frame, frame.stamp, load, region_points=region_points, views=views)
    key = ""
    if mask is None:
        aim = f"{message.header.frame_id} {message.target_point}" if message.use_target_point else ""
        key = f"{frame.kind} {frame.frame} {nanoseconds(frame.stamp)} {frame.content()} {aim} {place}"
        used = given.settings  # these settings decide which object a cloud shows
        key += f" {used.segment} {used.mass} {used.friction} {used.roi_min} {used.roi_max} {used.voxel_size}"
        key += f" {used.scene_config}"
    return given.request(frame.frame, frame.stamp, load, object_key=key, region_points=region_points)


def _region_points(frame: SensorFrame, mask: Image) -> Float[np.ndarray, "points 3"]:
    points, marked = seen.masked_points(frame, mask, "region_mask")
    return points[marked & np.isfinite(points).all(1)]


def _target(given: SourceInput, frame: str, stamp: Time, lookup: Lookup) -> Float[np.ndarray, "3"] | None:
    """Return the target point in `frame` at the time `stamp` [m]. None if the request has no target point."""
    message = given.message
    if not message.use_target_point:
        return None
    point, named = near(message.target_point, "target_point"), message.header.frame_id
    if named in ("", frame):
        return point
    return moved_points(point[None], lookup(frame, named, stamp))[0]


def resolve_mesh(uri: str, roots: Sequence[str]) -> Path:
    """Return the mesh file at `uri`: a path, a `file://` or a `package://` URI. Relative paths start at the first root.

    Symbolic links are resolved before the path is compared with the roots, so that no link leads out of a root. A root
    may be a `package://` name. Roots whose package is not installed are ignored.
    Raises MeshError: the form or package is unknown, or the file is outside every root, missing or too large.
    """
    uri = uri.strip()
    if len(uri) > MOST_PATH:
        raise MeshError(f"the mesh path is {len(uri)} characters long; at most {MOST_PATH} are allowed")
    if not uri:
        raise MeshError(f"the mesh path is empty; give {_FORMS}")
    allowed = _allowed_roots(roots)
    if not allowed:
        raise MeshError(f"{uri}: the parameter mesh_roots {list(roots)} names no existing directory; give one")
    try:
        path = (allowed[0] / _local_path(uri)).resolve()
        if not any(path.is_relative_to(root) for root in allowed):
            raise MeshError(f"{uri}: the file is outside mesh_roots; valid: files below {', '.join(map(str, allowed))}")
        if not path.is_file():
            kind = "a directory, not a mesh file" if path.is_dir() else "no such file"
            raise MeshError(f"{uri}: {kind} (looked at {path})")
        if (size := path.stat().st_size) > MOST_MESH_BYTES:
            raise MeshError(f"{uri}: {size / 1e6:.0f} MB; valid: at most {MOST_MESH_BYTES / 1e6:.0f} MB")
    except (OSError, ValueError) as error:
        raise MeshError(f"{uri!r}: not a usable path: {error}") from None
    return path


def _allowed_roots(roots: Sequence[str]) -> list[Path]:
    """Return the existing directories of `mesh_roots`, with symbolic links resolved."""
    found = []
    for root in roots:
        with suppress(MeshError):  # the package is not installed
            found.append(_local_path(root).expanduser().resolve())
    return [path for path in found if path.is_dir()]


def _local_path(uri: str) -> Path:
    if "://" not in uri:
        return Path(uri)
    parts = urlsplit(uri)
    if parts.scheme == "file" and parts.netloc in ("", "localhost"):
        return Path(unquote(parts.path))
    if parts.scheme == "package":
        return _package_share(parts.netloc, uri) / unquote(parts.path).lstrip("/")
    raise MeshError(f"{uri}: unknown form; valid: {_FORMS}")


def _package_share(package: str, uri: str) -> Path:
    from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

    try:
        return Path(get_package_share_directory(package))
    except (PackageNotFoundError, ValueError, OSError):  # ValueError: malformed name. OSError: no AMENT_PREFIX_PATH
        raise MeshError(f"{uri}: package {package!r} is not installed") from None
