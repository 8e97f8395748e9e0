"""PointCloud2 layouts: fields are read where the message says, broken ones are refused by name."""

from __future__ import annotations

import array

import numpy as np
import pytest
from sensor_msgs.msg import PointCloud2, PointField

from graspd_core.errors import CloudError
from graspd_core.io.bags import points_from_message


def encode(points: np.ndarray, order: str, formats: list[str], offsets: list[int], step: int, row_padding: int):
    """A cloud message of `points [height, width, 3]` with the given layout; the padding holds junk."""
    height, width, _ = points.shape
    row_step = width * step + row_padding
    data = np.full(height * row_step, 0xAB, dtype=np.uint8)
    for axis in range(3):
        view = np.ndarray((height, width), order + formats[axis], data, offsets[axis], (row_step, step))
        view[...] = points[..., axis]
    kinds = {"f4": PointField.FLOAT32, "f8": PointField.FLOAT64}
    fields = [
        PointField(name=n, offset=o, datatype=kinds[f], count=1)
        for n, o, f in zip("xyz", offsets, formats, strict=True)
    ]
    return PointCloud2(
        height=height,
        width=width,
        fields=[PointField(name="rgb", offset=0, datatype=PointField.UINT32, count=1), *reversed(fields)],
        is_bigendian=order == ">",
        point_step=step,
        row_step=row_step,
        data=array.array("B", data.tobytes()),
    )


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("formats", "offsets"),
    [(["f4", "f4", "f4"], [0, 4, 8]), (["f8", "f4", "f8"], [12, 5, 21]), (["f4"] * 3, [8, 4, 0])],
)
def test_the_fields_of_a_message_are_read_where_it_says(order, formats, offsets):
    """Any layout is drawn in test/pointcloud/test_pointcloud2.py. Values that float32 holds come back exactly."""
    points = np.random.default_rng(0).normal(size=(3, 4, 3)).astype("f4").astype(float)
    np.testing.assert_array_equal(
        points_from_message(encode(points, order, formats, offsets, 32, 5)), points.reshape(-1, 3)
    )


def plain(count: int = 10) -> PointCloud2:
    return encode(np.ones((1, count, 3)), "<", ["f4"] * 3, [0, 4, 8], 12, 0)


def without_y(message: PointCloud2) -> None:
    message.fields = [field for field in message.fields if field.name != "y"]


def integer_z(message: PointCloud2) -> None:
    next(field for field in message.fields if field.name == "z").datatype = PointField.UINT16


def z_beyond_the_point(message: PointCloud2) -> None:
    next(field for field in message.fields if field.name == "z").offset = 10


def zero_width(message: PointCloud2) -> None:
    message.width, message.row_step, message.data = 0, 0, array.array("B")


def short_data(message: PointCloud2) -> None:
    message.data = message.data[:-1]


def short_rows(message: PointCloud2) -> None:
    message.row_step = 119


@pytest.mark.parametrize(
    ("spoil", "culprit"),
    [
        (without_y, "no field 'y'; it has: rgb, z, x"),
        (integer_z, "field 'z' is UINT16; it must be FLOAT32 or FLOAT64"),
        (z_beyond_the_point, "field 'z' ends at byte 14, beyond point_step=12"),
        (zero_width, "empty: width=0, height=1"),
        (short_data, "data holds 119 bytes"),
        (short_rows, "row_step=119 is smaller"),
    ],
)
def test_a_broken_cloud_is_refused_by_name(spoil, culprit):
    message = plain()
    spoil(message)
    with pytest.raises(CloudError) as refused:
        points_from_message(message)
    assert culprit in str(refused.value)
    assert "\n" not in str(refused.value)
