"""The table of situations by way of the node, over DDS: the answer that the library gives, or a refusal by name."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import Point
from graspd_msgs.msg import GraspArray, GraspRequest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from situations import CLOUDS, DRIVERS, FILE_ONLY, MESHES, MESSAGES, SITUATIONS, Situation, camera_place, recorded

from graspd_core.io.bags import read_raw

pytestmark = pytest.mark.timeout(300)
KINDS = {"points": PointCloud2, "image_rect": Image, "camera_info": CameraInfo}


@pytest.fixture(scope="module", autouse=True)
def _end_the_node(shared_node) -> Iterator[None]:
    """End the node after these tests: the next test would get the refusal of an image that comes late."""
    yield
    shared_node.stop()


def messages(recording: Path) -> dict[str, Any]:
    """Return the messages of a recording by the end of their topic's name."""
    read = ((topic.name.rpartition("/")[2], data) for topic, _, data in read_raw(recording))
    return {name: deserialize_message(data, KINDS[name]) for name, data in read}


def point(values: tuple[float, ...]) -> Point:
    x, y, z = map(float, values)
    return Point(x=x, y=y, z=z)


def source_of(row: Situation, path: Path, show: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Return the request's fields that give a row's object."""
    if row in MESHES.values():
        return {"source": GraspRequest.MESH, "mesh_uri": str(path), "mesh_scale": row.options.get("scale", 1.0)}
    found = messages(recorded(path))
    if "points" in found:
        return {"source": GraspRequest.CLOUD, "cloud": found["points"]}
    show(found)
    return {"source": GraspRequest.LATEST_CLOUD}


def rows() -> Iterator[Any]:
    """Yield the rows. Answers of a kind (table, options, warning) after the first are slow: the library gives the same.

    `test_the_library_makes_the_object_that_it_shows` and `test_replay_of_a_recording_answers_the_same` have all rows.
    """
    seen = set()
    for name, row in SITUATIONS.items():
        if name not in FILE_ONLY:
            tables = tuple(name in table for table in (CLOUDS, MESHES, DRIVERS, MESSAGES))
            kind = name if isinstance(row.expect, str) else (tables, *row.options, bool(row.warns))
            yield pytest.param(row, id=name, marks=pytest.mark.slow if kind in seen else ())
            seen.add(kind)


@pytest.mark.parametrize("row", list(rows()))
def test_the_node_answers_the_same(row: Situation, client, node, tmp_path: Path):
    def show(found: dict[str, Any]) -> None:
        publishers = {name: client.node.create_publisher(KINDS[name], f"/depth/{name}", 10) for name in found}
        send = lambda: [publishers[name].publish(message) for name, message in found.items()]  # noqa: E731
        client.show(send, found["image_rect"].header)
        for publisher in publishers.values():
            client.node.destroy_publisher(publisher)

    client.set_parameters(cloud_policy="off", cloud_max_age=0.0, verify="none", mesh_roots=[str(tmp_path)])
    path = row.make(tmp_path)
    asked = source_of(row, path, show)
    place, target = row.options.get("view_point") or camera_place(path), row.options.get("target")
    if any(place):
        asked |= {"use_view_point": True, "view_point": point(place)}
    if target:
        asked |= {"use_target_point": True, "target_point": point(target)}
    client.send_request(id="row", num_grasps=1, preset="fast", alone="alone" in row.options, **asked)
    answer = client.answer("row")
    told = "\n".join(answer.warnings)
    if isinstance(row.expect, str):
        assert answer.status in (GraspArray.REFUSED, GraspArray.FAILED)
        assert re.search(row.expect, answer.message)
        assert "\n" not in answer.message
        return
    assert answer.status == GraspArray.SUCCEEDED, answer.message
    (volume,) = re.findall(r"plausible mass for (\d+) cm³", told)
    assert 1e-6 * int(volume) == pytest.approx(row.expect, rel=row.near)
    assert re.search(row.warns, told), told
