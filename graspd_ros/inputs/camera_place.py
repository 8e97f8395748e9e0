"""Where the camera of a cloud stood: as the request or the node's parameters say, else at the origin of its frame.

A cloud message does not tell. What nobody said is checked against the cloud itself: taken from a wrong place, its
table is lost and its object has the wrong shape, and grasps are verified on what is not there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from builtin_interfaces.msg import Time
from graspd_msgs.msg import GraspRequest
from jaxtyping import Bool
from sensor_msgs.msg import Image

from graspd_core import PointCloud
from graspd_core.perception.cloud.viewpoint_check import check_viewpoint
from graspd_ros.inputs.sensor_frames import CLOUD, SensorFrame
from graspd_ros.outputs.error_codes import ErrorCode, RequestError
from graspd_ros.parameters import Settings


@dataclass(frozen=True)
class CameraPlace:
    """Where a cloud's camera stood; nothing given: at the origin of the cloud's frame, if the cloud agrees.

    Attributes:
        view_point: in the cloud's frame [m]; goes before `sensor_frame`.
        sensor_frame: the camera stood at the origin of this frame; it looked along z if its name ends in
            optical_frame (REP 103).
    """

    view_point: tuple[float, float, float] | None = None
    sensor_frame: str = ""


def place_of(settings: Settings, message: GraspRequest | None = None) -> CameraPlace:
    """What the request says, or else the parameters."""
    if message is not None and message.use_view_point:
        return CameraPlace((message.view_point.x, message.view_point.y, message.view_point.z))
    if message is not None and message.sensor_frame:
        return CameraPlace(sensor_frame=message.sensor_frame)
    x, y, z = settings.view_point
    return CameraPlace((x, y, z) if any(settings.view_point) else None, settings.sensor_frame)


def seen_by_camera(
    frame: SensorFrame, place: CameraPlace, lookup: Callable[[str, str, Time], np.ndarray], *, alone: bool
) -> PointCloud:
    """What a frame shows, from where its camera stood. A depth image knows that by itself.

    Args:
        frame: read here.
        place: where it stood, if anybody said.
        lookup: `T_target_source` of two frames at a time; may raise a TransformError.
        alone: whether the cloud shows one object and nothing else.

    Raises:
        CloudError: the cloud cannot be read, or nobody said where its camera stood and it was not at the origin.
        TransformError: /tf does not know the camera's frame.
    """
    cloud = frame.read()
    if frame.kind != CLOUD:
        return cloud
    if place.view_point is not None:
        return replace(cloud, viewpoint=np.array(place.view_point))
    if place.sensor_frame:
        same = place.sensor_frame == frame.frame
        T = np.eye(4) if same else lookup(frame.frame, place.sensor_frame, frame.stamp)
        forward = T[:3, 2] if place.sensor_frame.endswith("optical_frame") else None
        return replace(cloud, viewpoint=T[:3, 3], forward=forward)
    check_viewpoint(cloud.points, cloud.viewpoint, grid=None if frame.pixels is None else frame.pixels(), alone=alone)
    return cloud


def masked_cloud(
    frame: SensorFrame, cloud: PointCloud, mask: Image, name: str = "target_mask"
) -> tuple[PointCloud, Bool[np.ndarray, "points"]]:
    """The cloud with a point for every pixel, NaN where none was seen, and which of them the mask of this name shows.

    Raises:
        RequestError: the mask is no mono8 image of the cloud's size.
        CloudError: the cloud cannot be read.
    """
    pixels = np.empty((0, 0, 3)) if frame.pixels is None else frame.pixels()
    height, width = pixels.shape[:2]
    if mask.encoding not in ("mono8", "8UC1") or (mask.height, mask.width) != (height, width):
        raise RequestError(
            ErrorCode.BAD_REQUEST,
            f"{name}: {mask.width} x {mask.height} {mask.encoding[:16]!r}; valid: mono8 of {width} x {height} "
            f"pixels, as the {frame.kind} has",
        )
    if mask.step < width or len(mask.data) < (height - 1) * mask.step + width:
        told = f"{name}: {len(mask.data)} bytes, step {mask.step}, are too few for {width} x {height} pixels"
        raise RequestError(ErrorCode.BAD_REQUEST, told)
    shown = np.ndarray((height, width), np.uint8, memoryview(mask.data), 0, (mask.step, 1)) > 0
    return replace(cloud, points=np.where(np.isfinite(pixels), pixels, np.nan).reshape(-1, 3)), shown.reshape(-1)
