"""What cameras showed the node: clouds and depth images, the views kept of one scene, and where the cameras stood.

A cloud message does not tell where its camera stood: the request or the parameters do, else it stood at the origin of
the cloud's frame. What nobody said is checked against the cloud itself: taken from a wrong place, its table is lost and
its object has the wrong shape, and grasps are verified on what is not there.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from graspd_msgs.msg import GraspRequest
from jaxtyping import Bool, Float
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from graspd_core import PinholeCamera, PointCloud, Scene, Target, cloud_from_depth, load_preset, scene_from_views
from graspd_core.config import load_scene_config
from graspd_core.errors import CloudError
from graspd_core.io.messages import (
    ORIGIN,
    CameraPlace,
    camera_from_message,
    depth_from_message,
    no_lookup,
    pixels_from_message,
)
from graspd_core.perception.cloud.camera import camera_rays
from graspd_core.perception.cloud.point_cloud import transform_cloud
from graspd_core.transforms import SECOND
from graspd_core.verify.robustness import begin_other_shapes
from graspd_ros.convert import Matrix, array_of, nanoseconds
from graspd_ros.error_codes import ErrorCode, RequestError, bad_request
from graspd_ros.parameters import Settings

CLOUD = "cloud"  # the kind of frame whose camera the message does not name
Pixels = Float[np.ndarray, "height width 3"]
# `T_target_source` of two frames at a time; may raise a TransformError.
Lookup = Callable[[str, str, Time], Matrix]

MOST_CLOUD_BYTES = 2**27  # 128 MiB: 4 million points of 32 bytes
MOST_VIEWS = 64
MOST_VIEW_POINTS = 200_000  # kept of each view: 64 views take 300 MB at most


@dataclass(frozen=True)
class SensorFrame:
    """One cloud or depth image as it came.

    Attributes:
        kind: cloud or depth.
        frame: the frame it was seen in.
        stamp: when it was seen, by the sensor's word; zero where it has none.
        arrived: when it came, by the node's clock [ns].
        read: its points, in its frame, and where its camera stood, given the place that is said of a cloud's, and how
            to look frames up. It takes some milliseconds and may raise a CloudError or TransformError.
        pixels: all of its points in their pixels, NaN where nothing was seen; may raise a CloudError.
    """

    kind: str
    frame: str
    stamp: Time
    arrived: int
    read: Callable[..., PointCloud]
    pixels: Callable[[], Pixels] | None = None

    def check_age(self, now: int, limit: float) -> None:
        """Refuse what is older than `limit` seconds at `now` [ns]; 0 is no limit. Raises RequestError."""
        age = (now - (nanoseconds(self.stamp) or self.arrived)) * 1e-9
        if limit and age > limit:
            raise RequestError(
                ErrorCode.STALE_CLOUD,
                f"the {self.kind} in {self.frame!r} is {age:.1f} s old, more than cloud_max_age={limit:g} s "
                "(a bag's needs use_sim_time, or cloud_max_age 0)",
            )


def cloud_frame(message: PointCloud2, arrived: int) -> SensorFrame:
    """Return a cloud message as a frame; it is read only when it is used. Raises RequestError: too large to keep."""
    if len(message.data) > MOST_CLOUD_BYTES:
        told = f"a cloud of {len(message.data)} bytes; at most {MOST_CLOUD_BYTES} are taken"
        raise RequestError(ErrorCode.BAD_CLOUD, told)
    header = message.header
    read = lambda place=ORIGIN, lookup=no_lookup: place.cloud(message, lookup)  # noqa: E731
    return SensorFrame(CLOUD, header.frame_id, header.stamp, arrived, read, lambda: pixels_from_message(message))


def depth_sensor_frame(image: Image, info: CameraInfo, arrived: int) -> SensorFrame:
    """Return a depth image with its calibration as a frame; it is read only when it is used."""

    def read(place: CameraPlace = ORIGIN, lookup: object = None) -> PointCloud:
        # A depth image knows by itself.
        return cloud_from_depth(*depth_and_camera(image, info))

    def pixels() -> Pixels:
        depth, camera = depth_and_camera(image, info)
        return camera_rays(camera) * np.where(depth > 0, depth, np.nan)[..., None]

    return SensorFrame("depth image", image.header.frame_id, image.header.stamp, arrived, read, pixels)


def depth_and_camera(image: Image, info: CameraInfo) -> tuple[Float[np.ndarray, "height width"], PinholeCamera]:
    """Return a depth image [m], 0 where there is none, and its camera, which is that of P: the image is rectified.

    Raises CloudError: no depth encoding, sizes that contradict each other, another frame, or no calibration.
    """
    if info.header.frame_id and info.header.frame_id != image.header.frame_id:
        raise CloudError(f"depth image in {image.header.frame_id!r}, but its camera_info in {info.header.frame_id!r}")
    camera = camera_from_message(info, rectified=True)
    return depth_from_message(image), camera


class ImagePairs:
    """Finds the CameraInfo of each depth image by its stamp. Not for several threads.

    Each image is given out once, with the nearest calibration in time; what is older than the last pair is dropped.
    Stamps of a pair differ by `slop` [s] at most. Of each kind `capacity` messages wait for their partner.
    """

    def __init__(self, slop: float = 0.01, capacity: int = 4) -> None:
        self._slop = round(slop * SECOND)
        self._capacity = capacity
        self._images: OrderedDict[int, Any] = OrderedDict()
        self._infos: OrderedDict[int, Any] = OrderedDict()

    def add(self, message: Image | CameraInfo) -> tuple[Image, CameraInfo] | None:
        """Take an image or a calibration; return the pair that it completes, if it does."""
        is_image, stamp = isinstance(message, Image), nanoseconds(message.header.stamp)
        own, others = (self._images, self._infos) if is_image else (self._infos, self._images)
        own[stamp] = message
        own.move_to_end(stamp)
        while len(own) > self._capacity:
            own.popitem(last=False)
        partner = min(others, key=lambda other: abs(other - stamp), default=None)
        if partner is None or abs(partner - stamp) > self._slop:
            return None
        return self._pair(stamp, partner) if is_image else self._pair(partner, stamp)

    def __len__(self) -> int:
        """Messages that wait."""
        return len(self._images) + len(self._infos)

    def _pair(self, image_stamp: int, info_stamp: int) -> tuple[Image, CameraInfo]:
        # The calibration stays: a second image within the slop may need it.
        pair = self._images.pop(image_stamp), self._infos[info_stamp]
        for kept, newest in ((self._images, image_stamp), (self._infos, info_stamp)):
            for stamp in [stamp for stamp in kept if stamp < newest]:
                del kept[stamp]
        return pair


def place_of(settings: Settings, message: GraspRequest | None = None) -> CameraPlace:
    """What the request says, or else the parameters."""
    if message is not None and message.use_view_point:
        x, y, z = array_of(message.view_point).tolist()
        return CameraPlace((x, y, z))
    if message is not None and message.sensor_frame:
        return CameraPlace(sensor_frame=message.sensor_frame)
    x, y, z = settings.view_point
    return CameraPlace((x, y, z) if any(settings.view_point) else None, settings.sensor_frame)


def seen_by_camera(frame: SensorFrame, place: CameraPlace, lookup: Lookup) -> PointCloud:
    """Return what a frame shows, from where its camera stood.

    Raises:
        CloudError: the cloud cannot be read, or its pixels show that its camera stood elsewhere.
        TransformError: /tf does not know the camera's frame.
    """
    return frame.read(place, lambda target, source: lookup(target, source, frame.stamp))


def masked_points(
    frame: SensorFrame, mask: Image, name: str = "target_mask"
) -> tuple[Float[np.ndarray, "points 3"], Bool[np.ndarray, "points"]]:
    """Return a point a pixel, NaN where none was seen, and which of them the mask of this name shows.

    Raises RequestError: the mask is no mono8 image of the cloud's size; CloudError: the cloud cannot be read.
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
    """Clouds of one scene, all in one frame. Immutable: `add` returns new ones."""

    frame: str = ""
    stamp: Time = field(default_factory=Time)
    clouds: tuple[PointCloud, ...] = ()

    def add(self, sensor_frame: SensorFrame, cloud: PointCloud, settings: Settings, lookup: Lookup) -> Views:
        """Add what a camera saw, moved to the frame of the other views (the settings' fixed_frame, or the first's).

        Raises GraspdError: there are as many views as there may be, or this one cannot be trimmed or moved.
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


def scene_of_views(views: tuple[PointCloud, ...], settings: Settings, target: Target | None) -> Scene:
    """Return the scene that clouds in one frame show; `target` says which object is meant, in that frame.

    Raises GraspdError: the clouds show no usable object, or the file of the settings has changed and cannot be used.
    """
    # Beside its distance grid, if grasps will have to hold on it.
    certainty = load_preset(settings.preset).certainty
    ahead = None if settings.verify == "none" else partial(begin_other_shapes, certainty.probability)
    return scene_from_views(
        views,
        target=target,
        alone=not settings.segment,
        settings=load_scene_config(settings.scene_config) if settings.scene_config else None,
        mass=settings.mass or None,
        friction=settings.friction,
        ahead=ahead,
    )


def trimmed(cloud: PointCloud, settings: Settings) -> PointCloud:
    """The points inside the workspace, one a voxel where the settings give a voxel its size."""
    points = cloud.points[within(cloud.points, settings)]
    if not len(points):
        workspace = f"roi_min={settings.roi_min} to roi_max={settings.roi_max}"
        told = f"none of {len(cloud.points)} points lies in the workspace, {workspace}"
        raise RequestError(ErrorCode.BAD_CLOUD, told)
    inside = replace(cloud, points=points)
    return inside.thinned(settings.voxel_size) if settings.voxel_size > 0 else inside


def within(points: Float[np.ndarray, "n 3"], settings: Settings) -> Bool[np.ndarray, "n"]:
    """Which points lie in the workspace; NaN does not."""
    low, high = np.array(settings.roi_min), np.array(settings.roi_max)
    return np.asarray(((points >= low) & (points <= high)).all(1))
