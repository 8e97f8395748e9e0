"""Read rosbag2 recordings (mcap and sqlite3) with the rosbags library, without a ROS installation.

Messages keep the order of the recording, so that a bag gives equal clouds every time.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from graspd_core.errors import BagError, first_line
from graspd_core.io.messages import ORIGIN, CameraPlace, add_transforms, cloud_from_depth_message, no_lookup, stamp_of
from graspd_core.perception.cloud.camera import ENCODINGS
from graspd_core.perception.cloud.cloud_files import recording_message
from graspd_core.perception.cloud.point_cloud import PointCloud, transform_cloud
from graspd_core.transforms import TransformBuffer

BAG_ENDINGS = ("mcap", "db3")
CLOUD, IMAGE, INFO = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
PACKED = "sensor_msgs/msg/CompressedImage"
TRANSFORMS = "tf2_msgs/msg/TFMessage"


@dataclass(frozen=True)
class BagTopic:
    """One topic of a recording: name, message type and number of messages."""

    name: str
    type: str
    count: int


@dataclass(frozen=True, eq=False)
class BagFrame:
    """One recorded cloud or depth image, not yet decoded.

    Attributes:
        index: index among the topic's messages.
        stamp: time stamp of the header [ns].
        received: time at which the recorder received the message [ns].
        frame: frame id of the header.
        topic: topic of the message.
        message: a PointCloud2, a depth Image, or a CompressedImage with depth.
        info: last CameraInfo before the depth image, else the first of the recording. None for a cloud.
    """

    index: int
    stamp: int
    received: int
    frame: str
    topic: str
    message: Any
    info: Any = None

    def view(
        self, transforms: TransformBuffer | None = None, target: str | None = None, place: CameraPlace = ORIGIN
    ) -> PointCloud:
        """Return the point cloud, in the message's frame or in `target`. For a cloud, `place` locates its camera.

        Raises:
            CloudError: the message is broken or has no usable point.
            TransformError: the transform from the message's frame to `target` is not known at the stamp.
        """
        # Some drivers leave the stamp at zero. The camera may have moved since it saw the cloud.
        at = self.stamp or self.received
        lookup = no_lookup if transforms is None else lambda to, of: transforms.lookup(to, of, at)
        if self.info is None:
            cloud = place.cloud(self.message, lookup)
        else:
            # By REP 118 and image_pipeline, the last part of a rectified image's topic contains "rect".
            rectified = re.search(r"(^|_)rect(_|$)", _image_name(self.topic).rsplit("/", 1)[-1]) is not None
            cloud = cloud_from_depth_message(self.message, self.info, rectified=rectified)
        if target is None or target.removeprefix("/") == self.frame.removeprefix("/"):
            return cloud
        return transform_cloud(cloud, lookup(target, self.frame))


def is_bag(path: str | Path) -> bool:
    """Return True if a file has a recording's ending, or a directory holds such a file or metadata.yaml."""
    path = Path(path)
    if path.is_dir():
        return (path / "metadata.yaml").exists() or bool(_storage_files(path))
    return path.suffix.lower().lstrip(".") in BAG_ENDINGS


def bag_topics(path: str | Path) -> tuple[BagTopic, ...]:
    """Return the topics of a recording, sorted by name. Raises BagError: the path is not a bag or the bag is broken."""
    with _opened(path) as reader:
        return _topics(reader)


def read_transforms(path: str | Path) -> TransformBuffer:
    """Read all transforms of a recording (/tf and /tf_static).

    Raises BagError: the path is not a bag, or the bag is broken or has no transforms.
    """
    buffer = TransformBuffer(history=None)
    with _opened(path) as reader:
        connections = [c for c in reader.connections if c.msgtype == TRANSFORMS]
        if not any(c.msgcount for c in connections):
            raise BagError(f"{path}: has no transforms (/tf, /tf_static); use the frame of the clouds")
        for connection, _, raw in _messages(path, reader, connections):
            message = _decode(path, reader, connection, raw)
            add_transforms(buffer, message, static=connection.topic.endswith("tf_static"))
    return buffer


def read_frames(
    path: str | Path,
    *,
    topic: str | None = None,
    info_topic: str | None = None,
    every: int = 1,
    limit: int | None = None,
) -> Iterator[BagFrame]:
    """Yield the clouds of a recording, or its depth images with their CameraInfo, in recorded order.

    Args:
        path: a rosbag2 directory, or one of its storage files (.mcap, .db3).
        topic: topic of clouds or depth images. None takes the only cloud topic, else the only depth topic.
        info_topic: CameraInfo topic. None takes `camera_info` next to the depth topic, else the only CameraInfo topic.
        every: yield every n-th message only.
        limit: greatest number of messages to yield. None means no limit.

    Raises:
        BagError: the path is not a bag, the bag is broken, or the topic is missing, ambiguous, empty or unsuitable.
    """
    with _opened(path) as reader:
        chosen = _choose(path, reader, topic)
        connections = [c for c in reader.connections if c.topic == chosen.name]
        info = None
        if chosen.type != CLOUD:
            info_name = _info_topic(path, reader, chosen.name, info_topic)
            infos = [c for c in reader.connections if c.topic == info_name]
            connections += infos
            # The first CameraInfo may be recorded after the first image.
            info = _first(path, reader, info_name)
        index = taken = 0
        for connection, received, raw in _messages(path, reader, connections):
            if connection.msgtype == INFO:
                info = _decode(path, reader, connection, raw)
                continue
            if index % every == 0:
                if limit is not None and taken == limit:
                    return
                message = _decode(path, reader, connection, raw)
                stamp, frame = stamp_of(message), message.header.frame_id
                yield BagFrame(index, stamp, received, frame, chosen.name, message, info)
                taken += 1
            index += 1


def read_raw(path: str | Path, topics: tuple[str, ...] = ()) -> Iterator[tuple[BagTopic, int, bytes]]:
    """Yield raw messages (CDR), each with its topic and receive time [ns]. Without `topics`, all topics are read.

    Raises BagError: the path is not a bag, or the bag is broken or lacks a topic.
    """
    with _opened(path) as reader:
        known = {topic.name: topic for topic in _topics(reader)}
        for name in topics:
            if name not in known:
                raise BagError(f"{path}: no topic {name!r}; the bag has: {', '.join(known) or 'none'}")
        connections = [c for c in reader.connections if not topics or c.topic in topics]
        for connection, time, raw in _messages(path, reader, connections):
            yield known[connection.topic], time, bytes(raw)


@cache
def jazzy_types() -> Any:
    """Return the message types of ROS 2 Jazzy, for bags without message definitions."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


@contextmanager
def _opened(path: str | Path) -> Iterator[Any]:
    from rosbags.highlevel import AnyReader

    path = Path(path)
    if not path.exists():
        raise BagError(f"{path}: no such bag")
    if path.suffix.lower() == ".bag" and path.is_file():
        raise BagError(f"{path}: {recording_message(path)}")
    if not is_bag(path):
        kinds = "a directory of rosbag2, or a file ending in " + " or ".join(f".{e}" for e in BAG_ENDINGS)
        raise BagError(f"{path}: not a bag; a bag is {kinds}")
    if path.is_dir() and not (path / "metadata.yaml").exists():
        # The recorder was killed before it wrote the metadata. The storage file may still be complete.
        files = _storage_files(path)
        if len(files) > 1:
            raise BagError(f"{path}: no metadata.yaml, but {len(files)} storage files; give one of the files")
        path = files[0]
    reader: Any = None
    try:
        reader = AnyReader([path], default_typestore=jazzy_types())
        reader.open()
    # For a broken file, rosbags raises many kinds of errors, such as struct, sqlite3, yaml and assertion errors.
    except Exception as error:
        raise BagError(f"{path}: not a readable bag, or cut short ({first_line(error)})") from error
    try:
        yield reader
    finally:
        reader.close()


def _messages(path: str | Path, reader: Any, connections: list[Any]) -> Iterator[tuple[Any, int, Any]]:
    """Yield messages by receive time. Messages with equal times keep the order of the file."""
    if not connections:
        return
    try:
        yield from reader.messages(connections=connections)
    except Exception as error:
        raise BagError(f"{path}: broken or cut short ({first_line(error)})") from error


def _decode(path: str | Path, reader: Any, connection: Any, raw: Any) -> Any:
    """Decode a message with Jazzy's definition of its type. If Jazzy has none, use the definition in the bag."""
    kind, known = connection.msgtype, jazzy_types()
    types = known if kind in known.fielddefs else reader.typestore
    try:
        return types.deserialize_cdr(raw, kind)
    except Exception as error:
        raise BagError(f"{path}: a message on {connection.topic} is broken ({first_line(error)})") from error


def _topics(reader: Any) -> tuple[BagTopic, ...]:
    counts: dict[tuple[str, str], int] = {}
    for c in reader.connections:
        counts[c.topic, c.msgtype] = counts.get((c.topic, c.msgtype), 0) + c.msgcount
    return tuple(BagTopic(name, kind, count) for (name, kind), count in sorted(counts.items()))


def _choose(path: str | Path, reader: Any, name: str | None) -> BagTopic:
    topics = _topics(reader)
    clouds = [t for t in topics if t.type == CLOUD and t.count]
    images, packed = (
        [t for t in topics if t.type == kind and t.count and (t.name == name or _is_depth(path, reader, t))]
        for kind in (IMAGE, PACKED)
    )
    offered = ", ".join(t.name for t in (*clouds, *images, *packed)) or "none"
    if name is not None:
        found = next((t for t in (*clouds, *images, *packed) if t.name == name), None)
        if found is None:
            raise BagError(f"{path}: no clouds or depth images on {name!r}; valid topics: {offered}")
        return found
    # A compressed image topic repeats the raw image topic beside it, so prefer raw images.
    candidates = clouds or images or packed
    if not candidates:
        have = ", ".join(f"{t.name} ({t.type.rsplit('/', 1)[-1]})" for t in topics) or "none"
        raise BagError(f"{path}: no topic with clouds or depth images; the bag has: {have}")
    if len(candidates) > 1:
        raise BagError(f"{path}: several topics fit; name one of: {offered}")
    return candidates[0]


def _is_depth(path: str | Path, reader: Any, topic: BagTopic) -> bool:
    first = _first(path, reader, topic.name)
    if topic.type == PACKED:
        return "compressedDepth" in first.format or first.format.partition(";")[0] in ENCODINGS
    return first.encoding in ENCODINGS


def _image_name(topic: str) -> str:
    return re.sub("/compressed(Depth)?$", "", topic)


def _first(path: str | Path, reader: Any, topic: str) -> Any:
    connections = [c for c in reader.connections if c.topic == topic]
    for connection, _, raw in _messages(path, reader, connections):
        return _decode(path, reader, connection, raw)
    raise BagError(f"{path}: its metadata counts messages on {topic}, but its storage has none")


def _info_topic(path: str | Path, reader: Any, image: str, name: str | None) -> str:
    known = [t.name for t in _topics(reader) if t.type == INFO and t.count]
    wanted = name or _image_name(image).rsplit("/", 1)[0] + "/camera_info"
    if wanted in known:
        return wanted
    if name is None and len(known) == 1:
        return known[0]
    raise BagError(f"{path}: no camera info on {wanted!r} for {image}; valid topics: {', '.join(known) or 'none'}")


def _storage_files(path: Path) -> list[Path]:
    return sorted(file for ending in BAG_ENDINGS for file in path.glob(f"*.{ending}"))
