"""Convert ROS messages to arrays. Messages may be live, recorded, or any objects with the attributes of a message."""

from __future__ import annotations

import io
import struct
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
    depth_encoding,
    depth_in_metres,
)
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.cloud.viewpoint_check import seen_from
from graspd_core.transforms import SECOND, TransformBuffer

# The camera looks along an axis if the mean cosine between the axis and the directions to the points is at least this.
_AHEAD = 0.8
# Types of sensor_msgs/PointField, by ascending number from 1.
_FIELD_TYPES = ("INT8", "UINT8", "INT16", "UINT16", "INT32", "UINT32", "FLOAT32", "FLOAT64")
# About this many numbers of a cloud are checked for the byte order.
_SOME_NUMBERS = 5000
# The data of a `compressedDepth` image begins with its format as int32 and two quantisation numbers as float32. Then a
# PNG follows. A PNG begins with 8 fixed bytes, and its width and height are at byte 16.
_QUANTISED = struct.Struct("<iff")
_PNG, _PNG_SIZES = b"\x89PNG\r\n\x1a\n", struct.Struct(">II")
_MOST_PIXELS = 2**26


def stamp_of(message: Any) -> int:
    """Return the time stamp of a message's header [ns]."""
    stamp = message.header.stamp
    return stamp.sec * SECOND + stamp.nanosec


def points_from_message(message: Any) -> Float[np.ndarray, "n 3"]:
    """Return the finite points of a sensor_msgs/PointCloud2, in row order, in the message's frame and unit.

    The cloud may be organised and padded. Coordinates may be float32 or float64, in either byte order, at any offset.
    Raises CloudError: no point is finite, x, y or z is missing or not a float, or the sizes contradict each other.
    """
    return finite_points(pixels_from_message(message))


def finite_points(pixels: Float[np.ndarray, "height width 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the finite points of an organised cloud, in row order. Raises CloudError: no point is finite."""
    points = pixels.reshape(-1, 3)
    # Check column by column, which is three times as fast as `isfinite(points).all(1)`.
    finite = np.isfinite(points[:, 0]) & np.isfinite(points[:, 1]) & np.isfinite(points[:, 2])
    kept = points[finite] if not finite.all() else points
    if len(kept) == 0:
        raise CloudError(f"the cloud has no finite point: all {len(points)} are NaN or infinite")
    return kept


def pixels_from_message(message: Any) -> Float[np.ndarray, "height width 3"]:
    """Return the points of a PointCloud2 as an image, with NaN. Raises CloudError: the cloud is empty or malformed."""
    width, height, data = message.width, message.height, memoryview(message.data)
    if width == 0 or height == 0:
        raise CloudError(f"the cloud is empty: width={width}, height={height}")
    strides = (_row_step(message, data.nbytes), message.point_step)
    # Check the fields before allocating memory, because the sizes in a broken message can ask for too much memory.
    places = [_place_of(message, name) for name in "xyz"]
    points = np.empty((height, width, 3))
    for axis, (dtype, offset) in enumerate(places):
        # Without `errstate`, NumPy would warn of signalling NaNs. They stay NaN.
        with np.errstate(invalid="ignore"):
            points[..., axis] = np.ndarray((height, width), dtype, data, offset, strides)
    _check_order(message.is_bigendian, places[0][0], points)
    return points


def _row_step(message: Any, size: int) -> int:
    """Count the bytes from one row to the next. Some drivers set `row_step` to 0, or to the size of all rows.

    `size` is the number of bytes of the data. Raises CloudError: the sizes contradict each other.
    """
    width, height, step, row_step = message.width, message.height, message.point_step, message.row_step
    row = width * step
    if row_step in (0, size) and size == height * row:
        return row
    if row_step < row:
        raise CloudError(f"row_step={row_step} is smaller than width*point_step={width}*{step}={row}")
    needed = (height - 1) * row_step + row
    if size < needed:
        raise CloudError(
            f"data holds {size} bytes, but height={height}, row_step={row_step}, "
            f"width={width} and point_step={step} need {needed}"
        )
    return row_step


def _place_of(message: Any, name: str) -> tuple[np.dtype, int]:
    """Return the NumPy type of a coordinate, and its byte offset within a point."""
    fields = {field.name: field for field in message.fields}
    if name not in fields:
        raise CloudError(f"the cloud has no field {name!r}; it has: {', '.join(fields) or 'none'}")
    offset, number = fields[name].offset, fields[name].datatype
    kind = dict(enumerate(_FIELD_TYPES, 1)).get(number, str(number))
    if not kind.startswith("FLOAT"):
        raise CloudError(f"field {name!r} is {kind}; it must be FLOAT32 or FLOAT64")
    dtype = np.dtype(kind.lower()).newbyteorder(">" if message.is_bigendian else "<")
    if offset + dtype.itemsize > message.point_step:
        raise CloudError(
            f"field {name!r} ends at byte {offset + dtype.itemsize}, beyond point_step={message.point_step}"
        )
    return dtype, offset


def _check_order(is_bigendian: bool, dtype: np.dtype, points: Float[np.ndarray, "height width 3"]) -> None:
    """Raise CloudError if the coordinates of a cloud are plausible lengths only in the other byte order."""
    some = points.reshape(-1)[:: 1 + points.size // _SOME_NUMBERS]
    if _odd_share(some) < 0.5:
        return
    with np.errstate(over="ignore", invalid="ignore"):
        swapped = some.astype(dtype.newbyteorder("=")).byteswap().astype(float)
    if _odd_share(swapped) < 0.01:
        said, other = ("true", "false") if is_bigendian else ("false", "true")
        raise CloudError(f"is_bigendian={said}, but the coordinates are plausible only with is_bigendian={other}")


def _odd_share(numbers: Float[np.ndarray, "n"]) -> float:
    """Return the fraction of the finite, non-zero numbers that are not plausible lengths in any unit."""
    size = np.abs(numbers[np.isfinite(numbers) & (numbers != 0)])
    return float(((size < 1e-6) | (size > 1e9)).mean()) if len(size) else 0.0


@dataclass(frozen=True)
class CameraPlace:
    """Position of a cloud's camera. The default is the origin of the cloud's frame.

    `view_point` is the position in the cloud's frame [m]. If it is None, the camera is at the origin of `sensor_frame`,
    by default the cloud's frame. If this frame's name ends in optical_frame, the camera looks along z (REP 103).
    """

    view_point: tuple[float, float, float] | None = None
    sensor_frame: str = ""

    def cloud(self, message: Any, lookup: Callable[[str, str], Float[np.ndarray, "4 4"]]) -> PointCloud:
        """Return the cloud of a sensor_msgs/PointCloud2 with its viewpoint. `lookup` returns `T_target_source` [m].

        Raises:
            CloudError: see `points_from_message`. It is also raised if the pixels contradict the camera position.
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
    """Raise TransformError. Callers without transforms use this as lookup function."""
    raise TransformError(f"transform {source} -> {target}: no transforms are given")


def frame_fault(frame: str, points: Float[np.ndarray, "n 3"]) -> str:
    """Return a warning if the camera's viewing direction contradicts the frame's name, else "".

    The camera is at the frame's origin. By REP 103, cameras look along z in optical frames and along x in body frames.
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
    not calibrated, or the distortion model is unknown, or a number is not finite.
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
    # A rectified image needs no distortion model. So ignore an unknown model, e.g. the model of a fisheye lens.
    distortion, model = ([], "") if rectified else (list(info.d), info.distortion_model)
    return camera_from_calibration(int(width), int(height), filled.ravel().tolist(), distortion, model)


def image_size(message: Any) -> tuple[int, int]:
    """Return width and height [pixels] of a raw or compressed depth image, or of the images of a CameraInfo.

    Raises CloudError: a compressed image does not state its size.
    """
    if hasattr(message, "roi"):
        bins = max(message.binning_x, 1), max(message.binning_y, 1)
        return (message.roi.width or message.width) // bins[0], (message.roi.height or message.height) // bins[1]
    if hasattr(message, "format"):
        return _size_of_compressed(memoryview(message.data), message.format)
    return message.width, message.height


def depth_from_message(image: Any) -> DepthImage:
    """Return the depth [m] of an Image or CompressedImage, 0 where there is no depth. Rows may be padded.

    Raises CloudError: the encoding holds no depth, the image is empty or broken, or its sizes disagree.
    """
    if hasattr(image, "format"):
        return _depth_from_compressed(memoryview(image.data), image.format)
    width, height, step, data = image.width, image.height, image.step, memoryview(image.data)
    if width == 0 or height == 0:
        raise CloudError(f"the depth image is empty: width={width}, height={height}")
    dtype = np.dtype((">" if image.is_bigendian else "<") + depth_encoding(image.encoding)[0])
    row = width * dtype.itemsize
    if step < row:
        raise CloudError(f"depth image: step={step} is smaller than width={width} pixels of {dtype.itemsize} bytes")
    needed = (height - 1) * step + row
    if data.nbytes < needed:
        raise CloudError(
            f"depth image: {data.nbytes} bytes, but height={height}, step={step} and width={width} need {needed}"
        )
    pixels = np.ndarray((height, width), dtype, data, 0, (step, dtype.itemsize))
    return depth_in_metres(pixels.astype(dtype.newbyteorder("=")), image.encoding)


def _size_of_compressed(data: memoryview, told: str) -> tuple[int, int]:
    """Return width and height [pixels] of the PNG in a CompressedImage. Raises CloudError: there is no usable PNG."""
    at = _png_begins(data, told) + 16
    if len(data) < at + _PNG_SIZES.size:
        raise CloudError(f"depth image: its PNG is cut off, the message has {len(data)} bytes")
    width, height = _PNG_SIZES.unpack_from(data, at)
    if width * height > _MOST_PIXELS:
        raise CloudError(f"depth image: its PNG has {width} x {height} pixels; valid: at most {_MOST_PIXELS}")
    return width, height


def _depth_from_compressed(data: memoryview, told: str) -> DepthImage:
    """Return depth [m] of a sensor_msgs/CompressedImage of `compressedDepth`, or of a plain PNG of 16 bits.

    For 32FC1, a pixel v holds quantised inverse depth. The depth is a / (v - b). The numbers a and b are stored before
    the PNG. `told` is the message's `format`: an encoding and "compressedDepth png".
    """
    from PIL import Image

    encoding = told.partition(";")[0].strip() if ";" in told else "16UC1"
    kind, unit = depth_encoding(encoding)
    _size_of_compressed(data, told)
    begins = _png_begins(data, told)
    try:
        with Image.open(io.BytesIO(data[begins:])) as picture:
            mode, pixels = picture.mode, np.asarray(picture)
    except Exception as error:  # For a broken file, Pillow may raise any exception.
        raise CloudError(f"depth image: its PNG is broken ({error})") from None
    if not mode.startswith("I"):
        raise CloudError(f"depth image: format {told[:64]!r} holds a PNG of mode {mode}; valid: 16 bits a pixel")
    if kind[0] == "u":
        return depth_in_metres(pixels.astype(np.uint16), encoding)
    if not begins:
        raise CloudError(f"depth image: format {told[:64]!r} lacks the {_QUANTISED.size} bytes of its quantisation")
    _, a, b = _QUANTISED.unpack_from(data)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth = unit * np.float32(a) / (pixels.astype(np.float32) - np.float32(b))
    return depth_in_metres(np.where(pixels > 0, depth, np.float32(0)).astype(np.float32), "32FC1")


def _png_begins(data: memoryview, told: str) -> int:
    for at in (_QUANTISED.size, 0):
        if bytes(data[at : at + len(_PNG)]) == _PNG:
            return at
    raise CloudError(f"depth image: format {told[:64]!r}, but data is not a PNG; valid: '16UC1; compressedDepth png'")


def depth_and_camera(image: Any, info: Any, *, rectified: bool = False) -> tuple[DepthImage, PinholeCamera]:
    """Return the depth image [m], 0 where there is no depth, and its camera from a sensor_msgs/CameraInfo.

    Args:
        image: a sensor_msgs/Image with a depth encoding, or a CompressedImage of `compressedDepth`.
        info: calibration of the camera, for an image of the same size.
        rectified: whether the image is rectified. A rectified image has no distortion.

    Raises:
        CloudError: the image is not a depth image, is broken, or has another frame than the calibration.
    """
    theirs, own = info.header.frame_id, image.header.frame_id
    if theirs and theirs.removeprefix("/") != own.removeprefix("/"):
        raise CloudError(f"depth image: frame {own!r}, but its camera_info has {theirs!r}")
    camera = camera_from_message(info, rectified=rectified)
    return depth_from_message(image), camera


def cloud_from_depth_message(image: Any, info: Any, *, rectified: bool = False) -> PointCloud:
    """Return the point cloud of a depth image, in the camera's optical frame. Arguments as for `depth_and_camera`.

    Raises CloudError: as in `depth_and_camera`, or no pixel has a depth, or the image does not fit the calibration.
    """
    depth, camera = depth_and_camera(image, info, rectified=rectified)
    cloud = cloud_from_depth(depth, camera)
    if len(cloud.points) == 0:
        raise CloudError(f"depth image: none of its {depth.shape[1]} x {depth.shape[0]} pixels has a depth")
    return cloud


def add_transforms(buffer: TransformBuffer, message: Any, *, static: bool) -> tuple[str, ...]:
    """Add the valid transforms of a tf2_msgs/TFMessage to a buffer. Return an error line for each invalid transform."""
    refused = []
    for item in message.transforms:
        try:
            pose = _pose(item.transform)
            buffer.add(item.header.frame_id, item.child_frame_id, pose, stamp_of(item), static)
        except TransformError as error:
            refused.append(str(error))
    return tuple(refused)


def _pose(transform: Any) -> Float[np.ndarray, "4 4"]:
    """Return a geometry_msgs/Transform as matrix. The rotation is NaN if the quaternion does not have length 1."""
    from scipy.spatial.transform import Rotation

    turn, move = transform.rotation, transform.translation
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    pose = np.eye(4)
    pose[:3, 3] = move.x, move.y, move.z
    usable = np.isfinite(quaternion).all() and abs(np.linalg.norm(quaternion.clip(-2, 2)) - 1) < 1e-2
    pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix() if usable else np.nan
    return pose
