"""What cameras showed the node: the newest cloud or depth image, and the views that were kept of one scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from builtin_interfaces.msg import Time
from jaxtyping import Bool, Float
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from graspd_core import PointCloud, Scene, Target, cloud_from_depth, load_preset, scene_from_views
from graspd_core.config import load_scene_config
from graspd_core.io.bags import pixels_from_message, points_from_message
from graspd_core.perception.cloud.camera import camera_rays
from graspd_core.perception.cloud.point_cloud import transform_cloud
from graspd_core.verify.robustness import begin_other_shape
from graspd_ros.inputs.depth_stream import frame_of
from graspd_ros.inputs.requests import MOST_CLOUD_BYTES
from graspd_ros.outputs.error_codes import ErrorCode, RequestError
from graspd_ros.parameters import Settings

CLOUD = "cloud"  # the kind of frame whose camera the message does not name
Pixels = Float[np.ndarray, "height width 3"]

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
        read: its points, in its frame, seen from its origin; takes some milliseconds, may raise a CloudError.
        pixels: all of its points in their pixels, NaN where nothing was seen; may raise a CloudError.
    """

    kind: str
    frame: str
    stamp: Time
    arrived: int
    read: Callable[[], PointCloud]
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
    """A cloud message; it is read only when it is used. `seen_by_camera` says where its camera stood.

    Raises:
        RequestError: it is too large to keep.
    """
    if len(message.data) > MOST_CLOUD_BYTES:
        told = f"a cloud of {len(message.data)} bytes; at most {MOST_CLOUD_BYTES} are taken"
        raise RequestError(ErrorCode.BAD_CLOUD, told)
    header = message.header
    return SensorFrame(
        CLOUD,
        header.frame_id,
        header.stamp,
        arrived,
        read=lambda: PointCloud(points_from_message(message), np.zeros(3)),
        pixels=lambda: pixels_from_message(message),
    )


def depth_sensor_frame(image: Image, info: CameraInfo, arrived: int) -> SensorFrame:
    """A depth image with its calibration; it is read only when it is used."""

    def read() -> PointCloud:
        frame = frame_of(image, info)
        return cloud_from_depth(frame.depth, frame.camera)

    def pixels() -> Pixels:
        frame = frame_of(image, info)
        return camera_rays(frame.camera) * np.where(frame.depth > 0, frame.depth, np.nan)[..., None]

    return SensorFrame("depth image", image.header.frame_id, image.header.stamp, arrived, read, pixels)


@dataclass(frozen=True)
class Views:
    """Clouds of one scene, all in one frame. Immutable: `add` returns new ones."""

    frame: str = ""
    stamp: Time = field(default_factory=Time)
    clouds: tuple[PointCloud, ...] = ()

    def add(
        self,
        sensor_frame: SensorFrame,
        cloud: PointCloud,
        settings: Settings,
        lookup: Callable[[str, str, Time], np.ndarray],
    ) -> Views:
        """With one more view, moved to the frame of the others (the settings' fixed_frame, or that of the first).

        Args:
            sensor_frame: the view.
            cloud: what it shows, from where its camera stood.
            settings: workspace, thinning and frame.
            lookup: `T_target_source` of two frames at a time; may raise a TransformError.

        Raises:
            RequestError: as many views as there may be.
            GraspdError: the view cannot be read or moved.
        """
        if len(self.clouds) >= MOST_VIEWS:
            raise RequestError(ErrorCode.BAD_REQUEST, f"{MOST_VIEWS} views are kept already; call ~/reset_views first")
        frame = self.frame or settings.fixed_frame or sensor_frame.frame
        cloud = trimmed(cloud, settings)
        if len(cloud.points) > MOST_VIEW_POINTS:
            every = -(-len(cloud.points) // MOST_VIEW_POINTS)
            cloud = PointCloud(cloud.points[::every], cloud.viewpoint, cloud.forward)
        if frame != sensor_frame.frame:
            cloud = transform_cloud(cloud, lookup(frame, sensor_frame.frame, sensor_frame.stamp))
        return Views(frame, sensor_frame.stamp, (*self.clouds, cloud))


def scene_of_views(views: tuple[PointCloud, ...], settings: Settings, target: Target | None) -> Scene:
    """The scene that clouds in one frame show; `target` says which object is meant, in that frame.

    Raises:
        GraspdError: the clouds show no usable object, or the file of the settings has changed and cannot be used.
    """
    # Beside its distance grid, if grasps will have to hold on it.
    certainty = load_preset(settings.preset).certainty
    ahead = None if settings.verify == "none" else partial(begin_other_shape, certainty.probability)
    return scene_from_views(
        views,
        target=target,
        alone=not settings.segment,
        settings=load_scene_config(settings.scene_config) if settings.scene_config else None,
        mass=settings.mass,
        friction=settings.friction,
        ahead=ahead,
    )


def trimmed(cloud: PointCloud, settings: Settings) -> PointCloud:
    """The points inside the workspace, one a voxel where the settings give a voxel its size."""
    points = cloud.points[within(cloud.points, settings)]
    if not len(points):
        raise RequestError(
            ErrorCode.BAD_CLOUD,
            f"none of {len(cloud.points)} points lies in the workspace, roi_min={settings.roi_min} to "
            f"roi_max={settings.roi_max}",
        )
    inside = PointCloud(points, cloud.viewpoint, cloud.forward)
    return inside.thinned(settings.voxel_size) if settings.voxel_size > 0 else inside


def within(points: Float[np.ndarray, "n 3"], settings: Settings) -> Bool[np.ndarray, "n"]:
    """Which points lie in the workspace; NaN does not."""
    low, high = np.array(settings.roi_min), np.array(settings.roi_max)
    return np.asarray(((points >= low) & (points <= high)).all(1))


def nanoseconds(stamp: Time) -> int:
    """A stamp as one number."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec
