"""Clouds and depth images from cameras, stored views of one scene, and camera positions.

A cloud message does not contain its camera's position. The request or the parameters give the position. If they do not,
the camera is assumed at the origin of the cloud's frame, and the cloud is checked against this assumption. With a wrong
position the table is not found, the object's shape is wrong, and grasps are verified on the wrong shape.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from graspd_msgs.msg import GraspRequest
from jaxtyping import Bool, Float
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from graspd_core import PointCloud, Scene, Target, cloud_from_depth, load_preset, scene_from_views
from graspd_core.config import load_scene_config
from graspd_core.errors import TransformError
from graspd_core.io.messages import CameraPlace, depth_and_camera, frame_fault, image_size, pixels_from_message
from graspd_core.perception.cloud.camera import camera_rays
from graspd_core.perception.cloud.point_cloud import crop, transform_cloud
from graspd_core.perception.cloud.voxel_downsample import unit_hint
from graspd_core.runtime.disk_cache import digest
from graspd_core.transforms import ROOT, refuse_motion
from graspd_core.verify.robustness import begin_other_shapes
from graspd_ros.convert import Matrix, array_of, nanoseconds, set_nanoseconds
from graspd_ros.error_codes import ErrorCode, RequestError, bad_request
from graspd_ros.parameters import WORKSPACE, Settings

Pixels = Float[np.ndarray, "height width 3"]
# Function that returns `T_target_source` at a time. May raise a TransformError.
Lookup = Callable[[str, str, Time], Matrix]

DepthMessage = Image | CompressedImage
_Kind = tuple[str, int, int]  # frame, width and height of an image (compressed or not) or of a CameraInfo

MOST_CALIBRATIONS = 8  # CameraInfos stored per topic, because several cameras may share a topic
AHEAD = 0.5  # seconds that a stamp may lie in the future without a warning
UNPAIRED = 2.0  # seconds without a matching CameraInfo before images cause a warning
MOST_CLOUD_BYTES = 2**27  # 128 MiB: 4 million points of 32 bytes
MOST_VIEWS = 64
MOST_VIEW_POINTS = 200_000  # points stored per view, so that 64 views take at most 300 MB


@dataclass(frozen=True)
class SensorFrame:
    """One received cloud or depth image.

    Attributes:
        kind: `cloud` or `depth image`.
        frame: coordinate frame of the points.
        stamp: capture time on the sensor's clock. If the message has no stamp, the time of arrival.
        arrived: time of arrival on the node's clock [ns].
        read: returns the points in `frame` [m] and the camera's position. Its arguments are the configured camera
            position and a frame lookup. It takes some milliseconds and may raise a CloudError or TransformError.
        pixels: returns one point per pixel in `frame` [m], NaN without a measurement. May raise a CloudError.
        content: returns a digest of the measured data. Two clouds cut out of one image may differ only in this digest.
    """

    kind: str
    frame: str
    stamp: Time
    arrived: int
    read: Callable[..., PointCloud]
    pixels: Callable[[], Pixels] | None = None
    content: Callable[[], str] = str

    def check(self, now: int, limit: float) -> None:
        """Check frame id and age. Raises RequestError: no frame id, or a stamp over `limit` [s] away from `now` [ns].

        A `limit` of 0 means no limit.
        """
        if not self.frame.strip("/"):
            text = f"the {self.kind} has an empty header.frame_id, so the place of its grasps is unknown"
            raise RequestError(ErrorCode.BAD_CLOUD, f"{text}; let its publisher set the frame")
        age = (now - nanoseconds(self.stamp)) * 1e-9
        if not limit or -limit <= age <= limit:
            return
        text, hint = f"is {age:.1f} s old", "for a bag, set use_sim_time, or cloud_max_age to 0"
        if age < 0:
            text = f"has a stamp {-age:.1f} s in the future"
            hint = "its publisher and the node use different clocks, or only one of the two has use_sim_time"
        more = f"more than cloud_max_age={limit:g} s ({hint})"
        raise RequestError(ErrorCode.STALE_CLOUD, f"the {self.kind} in {self.frame!r} {text}, {more}")

    def warnings(self, cloud: PointCloud) -> tuple[str, ...]:
        """Return a sentence for each fault: a stamp in the future, a frame name that contradicts the view direction."""
        ahead = (nanoseconds(self.stamp) - self.arrived) * 1e-9
        early = f"the {self.kind} came {ahead:.1f} s before its stamp: the sensor's clock is ahead of the node's"
        # The orientation is checked only if the camera is at the frame's origin.
        turned = "" if cloud.viewpoint.any() else frame_fault(self.frame, cloud.points)
        return tuple(said for said in (early if ahead > AHEAD else "", turned) if said)


def cloud_frame(message: PointCloud2, arrived: int) -> SensorFrame:
    """Return a cloud message that came at `arrived` [ns] as a `SensorFrame`. Raises RequestError: cloud too big."""
    if len(message.data) > MOST_CLOUD_BYTES:
        fault = f"the cloud has {len(message.data)} bytes; valid: at most {MOST_CLOUD_BYTES}"
        raise RequestError(ErrorCode.BAD_CLOUD, fault)
    header = message.header
    read = lambda place, lookup: place.cloud(message, lookup)  # noqa: E731
    pixels, content = partial(pixels_from_message, message), partial(_content, message, message.fields)
    return SensorFrame("cloud", header.frame_id, _seen_at(header.stamp, arrived), arrived, read, pixels, content)


def depth_sensor_frame(image: DepthMessage, info: CameraInfo, arrived: int) -> SensorFrame:
    """Return a depth image and its calibration, which came at `arrived` [ns], as a `SensorFrame`."""
    # The camera of a depth image is at the origin of its frame.
    read = lambda *_: cloud_from_depth(*depth_and_camera(image, info, rectified=True))  # noqa: E731

    def pixels() -> Pixels:
        depth, camera = depth_and_camera(image, info, rectified=True)
        return camera_rays(camera) * np.where(depth > 0, depth, np.nan)[..., None]

    header, content = image.header, partial(_content, image, info)
    return SensorFrame("depth image", header.frame_id, _seen_at(header.stamp, arrived), arrived, read, pixels, content)


def _seen_at(stamp: Time, arrived: int) -> Time:
    if nanoseconds(stamp):
        return stamp
    # The camera may move until a plan needs its pose, so the newest transform would be wrong.
    set_nanoseconds(time := Time(), arrived)
    return time


def _content(message: PointCloud2 | DepthMessage, layout: object) -> str:
    return digest([np.frombuffer(message.data, np.uint8), layout])


class ImagePairs:
    """Matcher of depth images with the last CameraInfo of the same frame and size. It is not thread-safe.

    The newest image waits until a CameraInfo matches it. A CameraInfo without a frame matches every frame. `clock`
    returns monotonic time [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._infos: OrderedDict[_Kind, CameraInfo] = OrderedDict()
        self._waiting: DepthMessage | None = None
        self._images = self._calibrations = 0  # counts of messages since the last pair
        self._alone_since = 0.0

    def add(self, message: DepthMessage | CameraInfo) -> tuple[DepthMessage, CameraInfo] | None:
        """Add an image or a CameraInfo. Return the completed pair, or None. Raises CloudError for a broken image."""
        if isinstance(message, CameraInfo):
            self._calibrations += 1
            kind = _kind(message)
            self._infos[kind] = message
            self._infos.move_to_end(kind)
            while len(self._infos) > MOST_CALIBRATIONS:
                self._infos.popitem(last=False)
            if self._waiting is None:
                return None
            message = self._waiting
        else:
            if not self._images:
                self._alone_since = self._clock()
            self._images += 1
        kind = _kind(message)
        self._waiting = message
        info = self._infos.get(kind) or self._infos.get(("", *kind[1:]))
        if info is None:
            return None
        self.forget()
        return message, info

    def forget(self) -> None:
        """Delete the image that waits. Calibrations stay, because many cameras send them only once."""
        self._waiting, self._images, self._calibrations = None, 0, 0

    def unpaired(self) -> str:
        """Return a line about images that wait longer than `UNPAIRED` [s] for a matching CameraInfo, or ""."""
        if self._waiting is None or self._clock() - self._alone_since < UNPAIRED:
            return ""
        last = next(reversed(self._infos.values()), None)
        of = "none" if last is None else _kind_text(last)
        return (
            f"depth images: {self._images} images and {self._calibrations} CameraInfos received, but no pair matches; "
            f"last image: {_kind_text(self._waiting)}, last CameraInfo: {of}; "
            "valid: a CameraInfo of the same frame and size"
        )


def _kind(message: Any) -> _Kind:
    return (message.header.frame_id.removeprefix("/"), *image_size(message))


def _kind_text(message: Any) -> str:
    frame, width, height = _kind(message)
    return f"{width} x {height} in {frame[:64]!r}"


def place_of(settings: Settings, message: GraspRequest | None = None) -> CameraPlace:
    """Return the camera position from the request, or from the parameters if the request has none."""
    if message is not None and message.use_view_point:
        x, y, z = array_of(message.view_point).tolist()
        return CameraPlace((x, y, z))
    if message is not None and message.sensor_frame:
        return CameraPlace(sensor_frame=message.sensor_frame)
    x, y, z = settings.view_point
    return CameraPlace((x, y, z) if any(settings.view_point) else None, settings.sensor_frame)


def seen_by_camera(frame: SensorFrame, place: CameraPlace, lookup: Lookup) -> PointCloud:
    """Return the cloud of a sensor frame, with the camera's position.

    Raises:
        CloudError: the cloud cannot be read, or its pixels contradict the camera position.
        TransformError: the camera's frame is not in /tf.
    """
    return frame.read(place, lambda target, source: lookup(target, source, frame.stamp))


def masked_points(
    frame: SensorFrame, mask: Image, name: str = "target_mask"
) -> tuple[Float[np.ndarray, "points 3"], Bool[np.ndarray, "points"]]:
    """Return a point for each pixel (NaN if not measured), and whether each pixel is inside the mask.

    Raises:
        RequestError: the mask is not a mono8 image of the cloud's size. The error names the field `name`.
        CloudError: the cloud cannot be read.
    """
    pixels = np.empty((0, 0, 3)) if frame.pixels is None else frame.pixels()
    height, width = pixels.shape[:2]
    if mask.encoding not in ("mono8", "8UC1") or (mask.height, mask.width) != (height, width):
        raise bad_request(
            f"{name}: {mask.width} x {mask.height} {mask.encoding[:16]!r}; valid: mono8, {width} x {height} "
            f"pixels like the {frame.kind}"
        )
    if mask.step < width or len(mask.data) < (height - 1) * mask.step + width:
        fault = f"{name}: {len(mask.data)} bytes, step {mask.step}, are too few for {width} x {height} pixels"
        raise bad_request(fault)
    marked = np.ndarray((height, width), np.uint8, memoryview(mask.data), 0, (mask.step, 1)) > 0
    return np.where(np.isfinite(pixels), pixels, np.nan).reshape(-1, 3), marked.reshape(-1)


@dataclass(frozen=True)
class Views:
    """Clouds of one scene in a common frame. Views are immutable, and `add` returns a new object.

    `places` has the pose of the camera's frame at each view, in the root frame of /tf [m]. It may be empty.
    """

    frame: str = ""
    stamp: Time = field(default_factory=Time)
    clouds: tuple[PointCloud, ...] = ()
    places: tuple[Matrix, ...] = ()

    def add(self, sensor_frame: SensorFrame, cloud: PointCloud, settings: Settings, lookup: Lookup) -> Views:
        """Return the views with a new cloud in the common frame: parameter `fixed_frame`, or the first view's frame.

        Raises GraspdError if `MOST_VIEWS` views are stored already, the cloud cannot be cropped or transformed, or the
        camera moved and no fixed frame is known.
        """
        if len(self.clouds) >= MOST_VIEWS:
            raise bad_request(f"{MOST_VIEWS} views are stored, which is the limit; call ~/reset_views first")
        frame = self.frame or settings.fixed_frame or sensor_frame.frame
        cloud = trimmed(cloud, settings)
        if len(cloud.points) > MOST_VIEW_POINTS:
            every = -(-len(cloud.points) // MOST_VIEW_POINTS)
            cloud = replace(cloud, points=cloud.points[::every])
        places, own = self.places, not (*self.clouds, cloud)[0].viewpoint.any()
        if frame != sensor_frame.frame:
            cloud = transform_cloud(cloud, _pose_at_rest(frame, sensor_frame, lookup))
        if own and not settings.fixed_frame:
            # The frame is the camera's own, not that of a turntable, say. Without /tf nobody can tell if it moved.
            with suppress(TransformError):
                places = (*places, lookup(ROOT, frame, Time()))
            refuse_motion(frame, places)
        return Views(frame, sensor_frame.stamp, (*self.clouds, cloud), places)


def _pose_at_rest(target: str, sensor_frame: SensorFrame, lookup: Lookup) -> Matrix:
    try:
        return lookup(target, sensor_frame.frame, sensor_frame.stamp)
    except TransformError:
        if nanoseconds(sensor_frame.stamp) != sensor_frame.arrived:
            raise
        # The cloud has no stamp, and the transform of its arrival is still on the way. The camera rests at each view.
        return lookup(target, sensor_frame.frame, Time())


def scene_of_views(
    views: tuple[PointCloud, ...], settings: Settings, target: Target | None, warnings: tuple[str, ...] = ()
) -> Scene:
    """Return the scene that clouds in a common frame show. `target`, in the same frame, selects the object.

    `warnings` become warnings of the object. Raises GraspdError if the clouds show no usable object, or the
    `scene_config` file is no longer valid.
    """
    # If grasps are verified, build the other likely shapes in parallel with the likeliest shape's distance grid.
    certainty = load_preset(settings.preset).certainty
    ahead = None if settings.verify == "none" else partial(begin_other_shapes, certainty.probability)
    scene = scene_from_views(
        views,
        target=target,
        alone=not settings.segment,
        settings=load_scene_config(settings.scene_config) if settings.scene_config else None,
        mass=settings.mass or None,
        friction=settings.friction,
        ahead=ahead,
    )
    return replace(scene, object=replace(scene.object, warnings=(*warnings, *scene.object.warnings)))


def trimmed(cloud: PointCloud, settings: Settings) -> PointCloud:
    """Return the points inside the workspace, downsampled to one per voxel if `voxel_size` is set."""
    inside, _ = cropped(cloud, settings)
    return inside.thinned(settings.voxel_size) if settings.voxel_size > 0 else inside


def cropped(cloud: PointCloud, settings: Settings) -> tuple[PointCloud, Bool[np.ndarray, "n"]]:
    """Return the points inside the workspace, and which these are. Raises RequestError if no point is inside."""
    kept, inside = crop(cloud, settings.roi_min, settings.roi_max)
    if len(kept.points):
        return kept, inside
    points = cloud.points
    seen = points[np.isfinite(points).all(1)]
    span = f"; they lie from {seen.min(0).round(3).tolist()} to {seen.max(0).round(3).tolist()}" if len(seen) else ""
    fault = (
        f"none of {len(points)} points lies in the workspace, roi_min={settings.roi_min} to roi_max={settings.roi_max}"
    )
    unit = unit_hint((cloud,), WORKSPACE) if len(seen) else ""
    raise RequestError(ErrorCode.BAD_CLOUD, f"{fault}{span}{unit}")
