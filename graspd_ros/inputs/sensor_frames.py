"""Clouds and depth images that came from cameras, the views kept of one scene, and where the cameras stood.

A cloud message does not say where its camera stood. The request or the parameters say it. If neither does, the origin
of the cloud's frame is assumed and checked against the cloud. With a wrong place the table is not found, the object
gets a wrong shape, and grasps are verified on a shape that is not there.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
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
from graspd_core.io.messages import (
    ORIGIN,
    CameraPlace,
    depth_and_camera,
    frame_doubt,
    image_size,
    no_lookup,
    pixels_from_message,
)
from graspd_core.perception.cloud.camera import camera_rays
from graspd_core.perception.cloud.point_cloud import transform_cloud
from graspd_core.perception.cloud.voxel_downsample import unit_hint
from graspd_core.verify.robustness import begin_other_shapes
from graspd_ros.convert import Matrix, array_of, nanoseconds
from graspd_ros.error_codes import ErrorCode, RequestError, bad_request
from graspd_ros.parameters import WORKSPACE, Settings

CLOUD = "cloud"  # the kind of frame whose camera the message does not name
Pixels = Float[np.ndarray, "height width 3"]
# `T_target_source` of two frames at a time. May raise a TransformError.
Lookup = Callable[[str, str, Time], Matrix]

DepthMessage = Image | CompressedImage
_Kind = tuple[str, int, int]  # frame, width and height of an image, packed or not, or of what a CameraInfo is of

MOST_CALIBRATIONS = 8  # kept of one topic. Cameras that share it have one each
AHEAD = 0.5  # seconds in the future that a stamp is taken without a word
UNPAIRED = 2.0  # seconds that images may come without a calibration before that is told
MOST_CLOUD_BYTES = 2**27  # 128 MiB: 4 million points of 32 bytes
MOST_VIEWS = 64
MOST_VIEW_POINTS = 200_000  # kept of each view: 64 views take 300 MB at most


@dataclass(frozen=True)
class SensorFrame:
    """One cloud or depth image as it came.

    Attributes:
        kind: cloud or depth.
        frame: the frame it was seen in.
        stamp: when it was seen, by the sensor's clock. Zero where it has none.
        arrived: when it came, by the node's clock [ns].
        read: reads its points, in its frame, and where its camera stood. It is given the camera's place, where one is
            known for a cloud, and a function that looks frames up. It takes some milliseconds and may raise a
            CloudError or TransformError.
        pixels: returns all of its points by pixel, NaN where nothing was seen. May raise a CloudError.
    """

    kind: str
    frame: str
    stamp: Time
    arrived: int
    read: Callable[..., PointCloud]
    pixels: Callable[[], Pixels] | None = None

    def check(self, now: int, limit: float) -> None:
        """Refuse a message without a frame, or with a stamp more than `limit` seconds (0: no limit) from `now` [ns].

        Raises RequestError, which says what is wrong.
        """
        if not self.frame.strip("/"):
            told = f"the {self.kind} names no frame: its header.frame_id is empty, so that its grasps could be anywhere"
            raise RequestError(ErrorCode.BAD_CLOUD, f"{told}; have its publisher set one")
        age = (now - (nanoseconds(self.stamp) or self.arrived)) * 1e-9
        if not limit or -limit <= age <= limit:
            return
        told, hint = f"is {age:.1f} s old", "a bag's needs use_sim_time, or cloud_max_age 0"
        if age < 0:
            told = f"has a stamp {-age:.1f} s in the future"
            hint = "its clock is not the node's, or use_sim_time is set for one of them only"
        more = f"more than cloud_max_age={limit:g} s ({hint})"
        raise RequestError(ErrorCode.STALE_CLOUD, f"the {self.kind} in {self.frame!r} {told}, {more}")

    def doubts(self, cloud: PointCloud) -> tuple[str, ...]:
        """Return what is odd about the message of a cloud, one sentence each."""
        ahead = (nanoseconds(self.stamp) - self.arrived) * 1e-9
        told = f"the {self.kind} came {ahead:.1f} s before its stamp: its clock is ahead of the node's"
        # Where the camera stood elsewhere, its direction is not the frame's.
        turned = "" if cloud.viewpoint.any() else frame_doubt(self.frame, cloud.points)
        return tuple(said for said in (told if ahead > AHEAD else "", turned) if said)


def cloud_frame(message: PointCloud2, arrived: int) -> SensorFrame:
    """Return a cloud message as a frame, which is read only when it is used. Raises RequestError if it is too large."""
    if len(message.data) > MOST_CLOUD_BYTES:
        told = f"a cloud of {len(message.data)} bytes; at most {MOST_CLOUD_BYTES} are taken"
        raise RequestError(ErrorCode.BAD_CLOUD, told)
    header = message.header
    read = lambda place=ORIGIN, lookup=no_lookup: place.cloud(message, lookup)  # noqa: E731
    return SensorFrame(CLOUD, header.frame_id, header.stamp, arrived, read, lambda: pixels_from_message(message))


def depth_sensor_frame(image: DepthMessage, info: CameraInfo, arrived: int) -> SensorFrame:
    """Return a depth image with its calibration as a frame, which is read only when it is used."""

    def read(place: CameraPlace = ORIGIN, lookup: object = None) -> PointCloud:
        # A depth image knows by itself.
        return cloud_from_depth(*depth_and_camera(image, info, rectified=True))

    def pixels() -> Pixels:
        depth, camera = depth_and_camera(image, info, rectified=True)
        return camera_rays(camera) * np.where(depth > 0, depth, np.nan)[..., None]

    return SensorFrame("depth image", image.header.frame_id, image.header.stamp, arrived, read, pixels)


class ImagePairs:
    """Pairs of each depth image and the last calibration of its frame and size. Not for several threads.

    The newest image that comes before any such calibration waits for it. A CameraInfo without a frame fits every frame.
    `clock` returns seconds that only rise.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._infos: OrderedDict[_Kind, CameraInfo] = OrderedDict()
        self._waiting: DepthMessage | None = None
        self._images = self._calibrations = 0  # since the last pair
        self._alone_since = 0.0

    def add(self, message: DepthMessage | CameraInfo) -> tuple[DepthMessage, CameraInfo] | None:
        """Take an image or a calibration and return the pair it completes, if any. Raises CloudError: no image."""
        if isinstance(message, CameraInfo):
            self._calibrations += 1
            kind = _kind(message)
            self._infos[kind] = message
            self._infos.move_to_end(kind)
            while len(self._infos) > MOST_CALIBRATIONS:
                self._infos.popitem(last=False)
            image, self._waiting = self._waiting, None
        else:
            if not self._images:
                self._alone_since = self._clock()
            self._images += 1
            image = message
        if image is None:
            return None
        kind = _kind(image)
        info = self._infos.get(kind) or self._infos.get(("", *kind[1:]))
        if info is None:
            self._waiting = image
            return None
        self._images = self._calibrations = 0
        self._waiting = None
        return image, info

    def doubt(self) -> str:
        """Return why images find no calibration, in one line, empty if they do or have waited less than `UNPAIRED`."""
        if self._waiting is None or self._clock() - self._alone_since < UNPAIRED:
            return ""
        last = next(reversed(self._infos.values()), None)
        of = "none has come" if last is None else f"the last one is {_shown_kind(last)}"
        return (
            f"depth images: {self._images} and {self._calibrations} CameraInfos came, and none of them pairs; the last "
            f"image is {_shown_kind(self._waiting)}, a CameraInfo of its frame and size is needed, and {of}"
        )


def _kind(message: Any) -> _Kind:
    return (message.header.frame_id.removeprefix("/"), *image_size(message))


def _shown_kind(message: Any) -> str:
    frame, width, height = _kind(message)
    return f"{width} x {height} in {frame[:64]!r}"


def place_of(settings: Settings, message: GraspRequest | None = None) -> CameraPlace:
    """Return the camera's place of the request or, where it has none, of the parameters."""
    if message is not None and message.use_view_point:
        x, y, z = array_of(message.view_point).tolist()
        return CameraPlace((x, y, z))
    if message is not None and message.sensor_frame:
        return CameraPlace(sensor_frame=message.sensor_frame)
    x, y, z = settings.view_point
    return CameraPlace((x, y, z) if any(settings.view_point) else None, settings.sensor_frame)


def seen_by_camera(frame: SensorFrame, place: CameraPlace, lookup: Lookup) -> PointCloud:
    """Return the cloud of a frame, with where its camera stood.

    Raises:
        CloudError: the cloud cannot be read, or its pixels show that its camera stood elsewhere.
        TransformError: /tf does not know the camera's frame.
    """
    return frame.read(place, lambda target, source: lookup(target, source, frame.stamp))


def masked_points(
    frame: SensorFrame, mask: Image, name: str = "target_mask"
) -> tuple[Float[np.ndarray, "points 3"], Bool[np.ndarray, "points"]]:
    """Return one point for each pixel, NaN where nothing was seen, and which of them the mask named `name` shows.

    Raises:
        RequestError: the mask is no mono8 image of the cloud's size.
        CloudError: the cloud cannot be read.
    """
    pixels = np.empty((0, 0, 3)) if frame.pixels is None else frame.pixels()
    height, width = pixels.shape[:2]
    if mask.encoding not in ("mono8", "8UC1") or (mask.height, mask.width) != (height, width):
        raise bad_request(
            f"{name}: {mask.width} x {mask.height} {mask.encoding[:16]!r}; valid: mono8 of {width} x {height} "
            f"pixels, as the {frame.kind} has"
        )
    if mask.step < width or len(mask.data) < (height - 1) * mask.step + width:
        told = f"{name}: {len(mask.data)} bytes, step {mask.step}, are too few for {width} x {height} pixels"
        raise bad_request(told)
    shown = np.ndarray((height, width), np.uint8, memoryview(mask.data), 0, (mask.step, 1)) > 0
    return np.where(np.isfinite(pixels), pixels, np.nan).reshape(-1, 3), shown.reshape(-1)


@dataclass(frozen=True)
class Views:
    """Clouds of one scene, all in one frame. Immutable, so `add` returns new ones."""

    frame: str = ""
    stamp: Time = field(default_factory=Time)
    clouds: tuple[PointCloud, ...] = ()

    def add(self, sensor_frame: SensorFrame, cloud: PointCloud, settings: Settings, lookup: Lookup) -> Views:
        """Add a cloud, moved to the frame of the other views (the settings' fixed_frame, or the first's).

        Raises GraspdError if there are as many views as are allowed, or this one cannot be trimmed or moved.
        """
        if len(self.clouds) >= MOST_VIEWS:
            raise bad_request(f"{MOST_VIEWS} views are kept already; call ~/reset_views first")
        frame = self.frame or settings.fixed_frame or sensor_frame.frame
        cloud = trimmed(cloud, settings)
        if len(cloud.points) > MOST_VIEW_POINTS:
            every = -(-len(cloud.points) // MOST_VIEW_POINTS)
            cloud = replace(cloud, points=cloud.points[::every])
        if frame != sensor_frame.frame:
            cloud = transform_cloud(cloud, lookup(frame, sensor_frame.frame, sensor_frame.stamp))
        return Views(frame, sensor_frame.stamp, (*self.clouds, cloud))


def scene_of_views(
    views: tuple[PointCloud, ...], settings: Settings, target: Target | None, doubts: tuple[str, ...] = ()
) -> Scene:
    """Return the scene of clouds that are in one frame. `target` says which object is meant, in that frame.

    `doubts` become warnings of its object. Raises GraspdError if the clouds show no usable object, or the file of the
    settings has changed and cannot be used.
    """
    # Beside its distance grid, if grasps will have to hold on it.
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
    return replace(scene, object=replace(scene.object, warnings=(*doubts, *scene.object.warnings)))


def trimmed(cloud: PointCloud, settings: Settings) -> PointCloud:
    """Return the points inside the workspace, one for each voxel where the settings give a voxel size."""
    inside = replace(cloud, points=cloud.points[within(cloud, settings)])
    return inside.thinned(settings.voxel_size) if settings.voxel_size > 0 else inside


def within(cloud: PointCloud, settings: Settings) -> Bool[np.ndarray, "n"]:
    """Return which points lie in the workspace (NaN does not). Raises RequestError with their place if none does."""
    points, low, high = cloud.points, np.array(settings.roi_min), np.array(settings.roi_max)
    inside = np.asarray(((points >= low) & (points <= high)).all(1))
    if inside.any():
        return inside
    seen = points[np.isfinite(points).all(1)]
    span = f", they lie from {seen.min(0).round(3).tolist()} to {seen.max(0).round(3).tolist()}" if len(seen) else ""
    told = (
        f"none of {len(points)} points lies in the workspace, roi_min={settings.roi_min} to roi_max={settings.roi_max}"
    )
    unit = unit_hint((cloud,), WORKSPACE) if len(seen) else ""
    raise RequestError(ErrorCode.BAD_CLOUD, f"{told}{span}{unit}")
