"""PointCloud2 to an array of points, whatever the layout of its bytes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from sensor_msgs.msg import PointCloud2, PointField

from graspd_core.errors import CloudError

_FLOAT_TYPES = {PointField.FLOAT32: "f4", PointField.FLOAT64: "f8"}
_TYPE_NAMES = {
    PointField.INT8: "INT8",
    PointField.UINT8: "UINT8",
    PointField.INT16: "INT16",
    PointField.UINT16: "UINT16",
    PointField.INT32: "INT32",
    PointField.UINT32: "UINT32",
}


def points_from_message(message: PointCloud2) -> Float[np.ndarray, "n 3"]:
    """The finite points of a cloud, in row order, in the cloud's own frame and unit.

    Organised or not, padded points and rows, float32 or float64, either byte order, x, y and z at any offset.

    Raises:
        CloudError: no points, x, y or z missing or not a float, sizes that contradict each other, or nothing finite.
    """
    width, height = message.width, message.height
    if width == 0 or height == 0:
        raise CloudError(f"the cloud is empty: width={width}, height={height}")
    _check_sizes(message)
    points = np.empty((height, width, 3))
    for axis, name in enumerate("xyz"):
        dtype, offset = _layout_of(message, name)
        strides = (message.row_step, message.point_step)
        points[..., axis] = np.ndarray((height, width), dtype, memoryview(message.data), offset, strides)
    points = points.reshape(-1, 3)
    finite = np.isfinite(points).all(1)
    if not finite.any():
        raise CloudError(f"the cloud has no finite point: all {width * height} are NaN or infinite")
    return points[finite]


def _check_sizes(message: PointCloud2) -> None:
    row = message.width * message.point_step
    if message.row_step < row:
        raise CloudError(
            f"row_step={message.row_step} is smaller than width*point_step={message.width}*{message.point_step}={row}"
        )
    needed = (message.height - 1) * message.row_step + row
    if len(message.data) < needed:
        raise CloudError(
            f"data holds {len(message.data)} bytes, but height={message.height}, row_step={message.row_step}, "
            f"width={message.width} and point_step={message.point_step} need {needed}"
        )


def _layout_of(message: PointCloud2, name: str) -> tuple[np.dtype, int]:
    """Type and byte offset of a coordinate within a point."""
    field = next((field for field in message.fields if field.name == name), None)
    if field is None:
        present = ", ".join(field.name for field in message.fields) or "none"
        raise CloudError(f"the cloud has no field {name!r}; it has: {present}")
    if field.datatype not in _FLOAT_TYPES:
        found = _TYPE_NAMES.get(field.datatype, field.datatype)
        raise CloudError(f"field {name!r} is {found}; it must be FLOAT32 or FLOAT64")
    dtype = np.dtype((">" if message.is_bigendian else "<") + _FLOAT_TYPES[field.datatype])
    if field.offset + dtype.itemsize > message.point_step:
        raise CloudError(
            f"field {name!r} ends at byte {field.offset + dtype.itemsize}, beyond point_step={message.point_step}"
        )
    return dtype, field.offset
