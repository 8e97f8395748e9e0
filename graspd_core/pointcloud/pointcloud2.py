"""The bytes of a PointCloud2 to an array of points, whatever their layout."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from graspd_core.errors import CloudError

# The numbers of sensor_msgs/PointField.
FIELD_TYPES = {
    1: ("INT8", "i1"),
    2: ("UINT8", "u1"),
    3: ("INT16", "i2"),
    4: ("UINT16", "u2"),
    5: ("INT32", "i4"),
    6: ("UINT32", "u4"),
    7: ("FLOAT32", "f4"),
    8: ("FLOAT64", "f8"),
}


@dataclass(frozen=True)
class CloudLayout:
    """A cloud as a driver sends it.

    Attributes:
        width, height: points in a row, and rows; height 1 where the cloud is not organised as an image.
        point_step, row_step: bytes from one point, or row, to the next.
        is_bigendian: byte order.
        fields: byte offset within a point and number of the type (`FIELD_TYPES`) of each field.
        data: the bytes.
    """

    width: int
    height: int
    point_step: int
    row_step: int
    is_bigendian: bool
    fields: Mapping[str, tuple[int, int]]
    data: memoryview


def points_from_layout(layout: CloudLayout) -> Float[np.ndarray, "n 3"]:
    """The finite points of a cloud, in row order, in the cloud's own frame and unit.

    Organised or not, padded points and rows, float32 or float64, either byte order, x, y and z at any offset.

    Raises:
        CloudError: no points, x, y or z missing or not a float, sizes that contradict each other, or nothing finite.
    """
    points = organised_points(layout).reshape(-1, 3)
    # Column by column: three times as fast as `isfinite(points).all(1)`.
    finite = np.isfinite(points[:, 0]) & np.isfinite(points[:, 1]) & np.isfinite(points[:, 2])
    kept = points[finite] if not finite.all() else points
    if len(kept) == 0:
        raise CloudError(f"the cloud has no finite point: all {len(points)} are NaN or infinite")
    return kept


def organised_points(layout: CloudLayout) -> Float[np.ndarray, "height width 3"]:
    """Every point of a cloud in its place, NaN and infinite ones too. Raises CloudError as `points_from_layout`."""
    width, height = layout.width, layout.height
    if width == 0 or height == 0:
        raise CloudError(f"the cloud is empty: width={width}, height={height}")
    _check_sizes(layout)
    # Before the array is made: a message's numbers can ask for any amount of memory, its bytes cannot.
    places = [_place_of(layout, name) for name in "xyz"]
    points = np.empty((height, width, 3))
    for axis, (dtype, offset) in enumerate(places):
        strides = (layout.row_step, layout.point_step)
        # A NaN of any kind stays one: numpy would warn of those that signal.
        with np.errstate(invalid="ignore"):
            points[..., axis] = np.ndarray((height, width), dtype, layout.data, offset, strides)
    return points


def _check_sizes(layout: CloudLayout) -> None:
    row = layout.width * layout.point_step
    if layout.row_step < row:
        raise CloudError(
            f"row_step={layout.row_step} is smaller than width*point_step={layout.width}*{layout.point_step}={row}"
        )
    needed = (layout.height - 1) * layout.row_step + row
    if layout.data.nbytes < needed:
        raise CloudError(
            f"data holds {layout.data.nbytes} bytes, but height={layout.height}, row_step={layout.row_step}, "
            f"width={layout.width} and point_step={layout.point_step} need {needed}"
        )


def _place_of(layout: CloudLayout, name: str) -> tuple[np.dtype, int]:
    """Type and byte offset of a coordinate within a point."""
    if name not in layout.fields:
        raise CloudError(f"the cloud has no field {name!r}; it has: {', '.join(layout.fields) or 'none'}")
    offset, number = layout.fields[name]
    kind, code = FIELD_TYPES.get(number, (str(number), ""))
    if not kind.startswith("FLOAT"):
        raise CloudError(f"field {name!r} is {kind}; it must be FLOAT32 or FLOAT64")
    dtype = np.dtype((">" if layout.is_bigendian else "<") + code)
    if offset + dtype.itemsize > layout.point_step:
        raise CloudError(
            f"field {name!r} ends at byte {offset + dtype.itemsize}, beyond point_step={layout.point_step}"
        )
    return dtype, offset
