"""Conversion of ROS messages to arrays: for live and recorded messages and all objects with the same attributes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from graspd_core.errors import CloudError, TransformError
from graspd_core.perception.cloud.camera import (
    DepthImage,
    PinholeCamera,
    camera_from_calibration,
    cloud_from_depth,
    depth_from_bytes,
    depth_from_compressed,
    size_of_compressed,
)
from graspd_core.perception.cloud.point_cloud import (
    CloudLayout,
    PointCloud,
    finite_points,
    organised_points,
    points_from_layout,
)
from graspd_core.perception.cloud.viewpoint_check import seen_from
from graspd_core.transforms import SECOND, TransformBuffer

# Least mean cosine between an axis and the directions to the points, if the camera looks along this axis.
_AHEAD = 0.8


def stamp_of(message: Any) -> int:
    """Return the time stamp of a message's header [ns]."""
    stamp = message.header.stamp
    return stamp.sec * SECOND + stamp.nanosec


def points_from_message(message: Any) -> Float[np.ndarray, "n 3"]:
    """Return the finite points of a sensor_msgs/PointCloud2, in row order, in the message's frame and unit.

    Raises CloudError: no point is finite, x, y or z is missing or not a float, or the sizes contradict each other.
    """
    return points_from_layout(_layout(message))


def pixels_from_message(message: Any) -> Float[np.ndarray, "height width 3"]:
    """Return all points of a PointCloud2 as an image, including NaN and infinite ones. Raises CloudError as above."""
    return organised_points(_layout(message))


def _layout(message: Any) -> CloudLayout:
    fields = {field.name: (field.offset, field.datatype) for field in message.fields}
    return CloudLayout(
        width=message.width,
        height=message.height,
        point_step=message.point_step,
        row_step=message.row_step,
        is_bigendian=bool(message.is_bigendian),
        fields=fields,
        data=memoryview(message.data),
    )


@dataclass(frozen=True)
class CameraPlace:
    """Position of a cloud's camera. The default is the origin of the cloud's frame.

    `view_point` is the position in the cloud's frame [m]. Without it, the camera is at the origin of `sensor_frame`.
    The camera looks along z if the name of this frame ends in optical_frame (REP 103).
    """

    view_point: tuple[float, float, float] | None = None
    sensor_frame: str = ""

    def cloud(self, message: Any, lookup: Callable[[str, str], Float[np.ndarray, "4 4"]]) -> PointCloud:
        """Return the cloud of a sensor_msgs/PointCloud2 with its viewpoint. `lookup` returns `T_target_source` [m].

        Raises:
            CloudError: see `points_from_message`, or the pixels show that the camera was at another position.
            TransformError: the pose of the camera's frame is not known.
        """
        T, frame = np.eye(4), message.header.frame_id
        if self.view_point is not None:
            T[:3, 3], optical = self.view_point, False
        else:
            optical = (self.sensor_frame or frame).endswith("optical_frame")
            if self.sensor_frame.removeprefix("/") not in ("", frame.removeprefix("/")):
                T = lookup(frame, self.sensor_frame)
        pixels = pixels_from_message(message)
        points = finite_points(pixels)
        return replace(seen_from(pixels, T[:3, 3], T[:3, 2] if optical else None), points=points)


ORIGIN = CameraPlace()


def no_lookup(target: str, source: str) -> Float[np.ndarray, "4 4"]:
    """Raise TransformError. This is the lookup function if there are no transforms."""
    raise TransformError(f"transform {source} -> {target}: no transforms are given")


def frame_fault(frame: str, points: Float[np.ndarray, "n 3"]) -> str:
    """Return a warning if the camera's viewing direction contradicts the frame's name, else an empty text.

    The camera is at the frame's origin. By REP 103 it looks along z in optical frames and along x in body frames.
    """
    named = "z" if "optical" in frame else "x" if frame.endswith(("_link", "_frame")) else ""
    reach = np.linalg.norm(points, axis=1)
    known = np.isfinite(reach) & (reach > 0)
    if not named or not known.any():
        return ""
    x, _, z = (points[known] / reach[known, None]).mean(0)
    other, ahead = ("x", x) if named == "z" else ("z", z)
    if ahead < _AHEAD:
        return ""
    meant = "body" if other == "x" else "optical"
    return (
        f"frame {frame!r}: by its name the camera looks along {named} (REP 103), but the points lie along {other}, so "
        f"every grasp may be turned by 90 degrees; name the camera's {meant} frame in header.frame_id"
    )


def camera_from_message(info: Any, *, rectified: bool = False) -> PinholeCamera:
    """Return the camera of a sensor_msgs/CameraInfo: K and distortion for a raw image, P for a rectified image.

    The camera includes binning and region of interest, so it fits the image as sent. Raises CloudError: the camera is
    not calibrated, or the distortion model is unknown.
    """
    # Drivers of cameras without distortion often leave P empty.
    by_projection = rectified and info.p[0] > 0
    matrix = np.array(info.p).reshape(3, 4)[:, :3] if by_projection else np.array(info.k, dtype=float).reshape(3, 3)
    if not np.isfinite(matrix).all():
        raise CloudError(f"camera_info: {'P' if by_projection else 'K'} is {matrix.tolist()}; valid: finite numbers")
    roi, bins = info.roi, np.array([max(info.binning_x, 1), max(info.binning_y, 1)])
    filled = matrix.copy()
    filled[:2, 2] -= roi.x_offset, roi.y_offset
    filled[:2] /= bins[:, None]
    width, height = image_size(info)
    # A rectified image needs no distortion model, so an unknown model, such as that of a fisheye lens, is ignored.
    distortion, model = ([], "") if rectified else (list(info.d), info.distortion_model)
    return camera_from_calibration(int(width), int(height), filled.ravel().tolist(), distortion, model)


def image_size(message: Any) -> tuple[int, int]:
    """Return width and height [pixels] of a raw or compressed depth image, or of the images of a CameraInfo.

    Raises CloudError: a compressed image does not contain its size.
    """
    if hasattr(message, "roi"):
        bins = max(message.binning_x, 1), max(message.binning_y, 1)
        return (message.roi.width or message.width) // bins[0], (message.roi.height or message.height) // bins[1]
    if hasattr(message, "format"):
        return size_of_compressed(memoryview(message.data))
    return message.width, message.height


def depth_from_message(image: Any) -> DepthImage:
    """Return the depth [m] of an Image or CompressedImage, 0 for no depth. Raises CloudError: no depth image."""
    if hasattr(image, "format"):
        return depth_from_compressed(memoryview(image.data), image.format)
    return depth_from_bytes(
        memoryview(image.data),
        width=image.width,
        height=image.height,
        step=image.step,
        encoding=image.encoding,
        is_bigendian=bool(image.is_bigendian),
    )


def depth_and_camera(image: Any, info: Any, *, rectified: bool = False) -> tuple[DepthImage, PinholeCamera]:
    """Return the depth image [m], 0 for no depth, and its camera from a sensor_msgs/CameraInfo.

    Args:
        image: a sensor_msgs/Image with a depth encoding, or a CompressedImage of `compressedDepth`.
        info: calibration of the camera, for an image of the same size.
        rectified: whether the image is rectified, that is, without distortion.

    Raises:
        CloudError: the image is no depth image, is broken, or has another frame than the calibration.
    """
    theirs, own = info.header.frame_id, image.header.frame_id
    if theirs and theirs.removeprefix("/") != own.removeprefix("/"):
        raise CloudError(f"depth image: frame {own!r}, but its camera_info has {theirs!r}")
    camera = camera_from_message(info, rectified=rectified)
    return depth_from_message(image), camera


def cloud_from_depth_message(image: Any, info: Any, *, rectified: bool = False) -> PointCloud:
    """Return the point cloud of a depth image, in the camera's optical frame. See `depth_and_camera` for arguments.

    Raises CloudError: see `depth_and_camera`, or the image has no depth or does not fit the calibration.
    """
    depth, camera = depth_and_camera(image, info, rectified=rectified)
    cloud = cloud_from_depth(depth, camera)
    if len(cloud.points) == 0:
        raise CloudError(f"depth image: none of its {depth.shape[1]} x {depth.shape[0]} pixels has a depth")
    return cloud


def add_transforms(buffer: TransformBuffer, message: Any, *, static: bool) -> tuple[str, ...]:
    """Add the transforms of a tf2_msgs/TFMessage to a buffer. Skip invalid ones and return an error line for each."""
    refused = []
    for item in message.transforms:
        try:
            pose = _pose(item.transform)
            buffer.add(item.header.frame_id, item.child_frame_id, pose, stamp_of(item), static)
        except TransformError as error:
            refused.append(str(error))
    return tuple(refused)


def _pose(transform: Any) -> Float[np.ndarray, "4 4"]:
    """Return the matrix of a geometry_msgs/Transform. Its rotation is NaN if the quaternion has not unit length."""
    from scipy.spatial.transform import Rotation

    turn, move = transform.rotation, transform.translation
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    pose = np.eye(4)
    pose[:3, 3] = move.x, move.y, move.z
    usable = np.isfinite(quaternion).all() and abs(np.linalg.norm(quaternion.clip(-2, 2)) - 1) < 1e-2
    pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix() if usable else np.nan
    return pose
