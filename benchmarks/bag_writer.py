"""Write ROS 2 recordings for tests and fuzzing, by rosbags: clouds, depth images, camera data and transforms."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from graspd_core.io.bags import jazzy_types
from graspd_core.perception.cloud.camera import PinholeCamera
from graspd_core.transforms import SECOND

# Greatest depth that a pixel of 16 bits can hold [mm].
_MOST_MILLIMETRES = 2**16 - 1


@dataclass(frozen=True, eq=False)
class Record:
    """One message to write, with its topic and time [ns]. Functions such as `cloud_message` make the message."""

    topic: str
    stamp: int
    message: Any


def write_bag(path: str | Path, records: Iterable[Record], *, storage: str = "sqlite3") -> None:
    """Write a new recording: a directory with metadata.yaml and one storage file, of sqlite3 or mcap.

    If a message cannot be written, rosbags raises its own error.
    """
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
    from rosbags.rosbag2 import StoragePlugin, Writer

    store = jazzy_types()
    forever = QosTime(2147483647, 4294967295)
    latched = Qos(
        QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL,
        forever, forever, QosLiveliness.AUTOMATIC, forever, False,
    )  # fmt: skip
    with Writer(Path(path), version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        connections: dict[str, Any] = {}
        for record in records:
            kind = record.message.__msgtype__
            if record.topic not in connections:
                qos = [latched] if record.topic.endswith("tf_static") else []
                connections[record.topic] = writer.add_connection(
                    record.topic, kind, typestore=store, offered_qos_profiles=qos
                )
            writer.write(connections[record.topic], record.stamp, store.serialize_cdr(record.message, kind))


def cloud_message(points: Float[np.ndarray, "*n 3"], frame: str, stamp: int) -> Any:
    """Return a PointCloud2 of float32 points [m]. Points in rows and columns make an organised cloud. NaN is kept."""
    types = jazzy_types().types
    fields = [types["sensor_msgs/msg/PointField"](name, 4 * axis, 7, 1) for axis, name in enumerate("xyz")]
    data = np.ascontiguousarray(points, dtype="<f4").view(np.uint8).reshape(-1)
    height, width = (1, *points.shape)[-3:-1]
    dense = bool(np.isfinite(points).all())
    return types["sensor_msgs/msg/PointCloud2"](
        _header(frame, stamp), height, width, fields, False, 12, 12 * width, data, dense
    )


def depth_message(depth: Float[np.ndarray, "height width"], frame: str, stamp: int, *, encoding: str = "16UC1") -> Any:
    """Return an Image of a depth image [m]. 16UC1 and mono16: mm, 0 without depth. 32FC1: m, NaN."""
    height, width = depth.shape
    known = np.isfinite(depth) & (depth > 0)
    if encoding != "32FC1":
        pixels = np.where(known, np.rint(1e3 * depth), 0).clip(0, _MOST_MILLIMETRES).astype("<u2")
    else:
        pixels = np.where(known, depth, np.nan).astype("<f4")
    data = pixels.view(np.uint8).reshape(-1)
    return jazzy_types().types["sensor_msgs/msg/Image"](
        _header(frame, stamp), height, width, encoding, 0, width * pixels.itemsize, data
    )


def packed_depth(depth: Float[np.ndarray, "height width"], encoding: str = "16UC1") -> bytes:
    """Return a depth image [m] in the format `compressedDepth` of image_transport: 12 bytes, then a 16-bit PNG."""
    from PIL import Image

    known = np.isfinite(depth) & (depth > 0)
    # Default quantisation of `compressedDepth`: inverse depth in 100 steps per unit at 1 m, for depths up to 10 m.
    a, b = (100.0 * 101.0, 1.0 - 101.0 * 100.0 / 10.0) if encoding == "32FC1" else (0.0, 0.0)
    away = np.where(known, depth, 1.0)
    values = np.rint(a / away + b if encoding == "32FC1" else 1e3 * away)
    picture = io.BytesIO()
    Image.fromarray(np.where(known, values, 0).clip(0, _MOST_MILLIMETRES).astype(np.uint16)).save(picture, "PNG")
    return struct.pack("<iff", 0, a, b) + picture.getvalue()


def packed_message(depth: Float[np.ndarray, "height width"], frame: str, stamp: int, encoding: str = "16UC1") -> Any:
    """Return a CompressedImage of a depth image [m]."""
    data = np.frombuffer(packed_depth(depth, encoding), np.uint8)
    kind = jazzy_types().types["sensor_msgs/msg/CompressedImage"]
    return kind(_header(frame, stamp), f"{encoding}; compressedDepth png", data)


def camera_info_message(camera: PinholeCamera, frame: str, stamp: int) -> Any:
    """Return the CameraInfo of a camera that is not part of a stereo pair."""
    types = jazzy_types().types
    matrix = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    projection = [*matrix[0:3], 0.0, *matrix[3:6], 0.0, *matrix[6:9], 0.0]
    length = 5 if len(camera.distortion) <= 5 else 8
    coefficients = np.zeros(length)
    coefficients[: len(camera.distortion)] = camera.distortion
    return types["sensor_msgs/msg/CameraInfo"](
        header=_header(frame, stamp),
        height=camera.height,
        width=camera.width,
        distortion_model="plumb_bob" if length == 5 else "rational_polynomial",
        d=coefficients,
        k=np.array(matrix),
        r=np.eye(3).reshape(-1),
        p=np.array(projection),
        binning_x=0,
        binning_y=0,
        roi=types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
    )


def transforms_message(transforms: Sequence[tuple[str, str, Float[np.ndarray, "4 4"]]], stamp: int) -> Any:
    """Return a TFMessage. Each transform is (parent, child, T_parent_child)."""
    from scipy.spatial.transform import Rotation

    types = jazzy_types().types
    items = []
    for parent, child, pose in transforms:
        vector = types["geometry_msgs/msg/Vector3"](*map(float, pose[:3, 3]))
        turn = types["geometry_msgs/msg/Quaternion"](*map(float, Rotation.from_matrix(pose[:3, :3]).as_quat()))
        transform = types["geometry_msgs/msg/Transform"](vector, turn)
        items.append(types["geometry_msgs/msg/TransformStamped"](_header(parent, stamp), child, transform))
    return types["tf2_msgs/msg/TFMessage"](items)


def _header(frame: str, stamp: int) -> Any:
    types = jazzy_types().types
    time = types["builtin_interfaces/msg/Time"](stamp // SECOND, stamp % SECOND)
    return types["std_msgs/msg/Header"](time, frame)
