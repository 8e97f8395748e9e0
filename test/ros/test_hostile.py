"""Messages that nobody means well: any numbers, texts and bytes end in a request or a refusal; the node lives on."""

import array
import json
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion
from graspd_msgs.msg import GraspArray, GraspRequest
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField
from std_msgs.msg import Header

from graspd_core.errors import GraspdError
from graspd_core.io.messages import CameraPlace, no_lookup
from graspd_ros.inputs.request_builder import RequestBuilder
from graspd_ros.inputs.sensor_frames import ImagePairs, cloud_frame, depth_sensor_frame
from graspd_ros.outputs.responses import status_line
from graspd_ros.parameters import Settings

HAND = "allegro_right"
floats = st.one_of(st.floats(), st.sampled_from([0.0, 1.0, np.nan, np.inf, -np.inf, 1e308, 5e-324]))
uints = st.one_of(st.integers(0, 40), st.sampled_from([2**31, 2**32 - 1]))
bytes_ = st.one_of(st.integers(0, 8), st.integers(0, 255))
texts = st.one_of(
    st.sampled_from(
        ["", "/", "..", "sphere.obj", "file://", "package://a/b", "camera", "\0", "x" * 300, "a\nb", "32FC1"]
    ),
    st.text(st.characters(exclude_categories=["Cs"]), max_size=20),
)
stamps = st.builds(Time, sec=st.integers(-(2**31), 2**31 - 1), nanosec=st.integers(0, 2**32 - 1))
headers = st.builds(Header, stamp=st.one_of(st.just(Time()), stamps), frame_id=texts)
points = st.builds(Point, x=floats, y=floats, z=floats)
poses = st.builds(Pose, position=points, orientation=st.builds(Quaternion, x=floats, y=floats, z=floats, w=floats))
data = st.binary(max_size=200).map(lambda raw: array.array("B", raw))
fields = st.builds(PointField, name=st.sampled_from(["x", "y", "z", "", "rgb"]), offset=uints, datatype=bytes_)
# Good messages, of which any field may be something else.
XYZ = [PointField(name=n, offset=4 * i, datatype=PointField.FLOAT32, count=1) for i, n in enumerate("xyz")]
CLOUD = {"height": 2, "width": 3, "fields": XYZ, "point_step": 12, "row_step": 36, "data": array.array("B", [1] * 72)}
IMAGE = {"height": 2, "width": 3, "encoding": "16UC1", "step": 6, "data": array.array("B", [1] * 12)}
INFO = {"height": 2, "width": 3, "distortion_model": "plumb_bob", "k": [4.0, 0, 1, 0, 4, 1, 0, 0, 1],
        "p": [4.0, 0, 1, 0, 0, 4, 1, 0, 0, 0, 1, 0]}  # fmt: skip


def changed(kind: type, good: dict[str, Any], **strategies: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    changes = st.fixed_dictionaries({}, optional={"header": headers, **strategies})
    return changes.map(lambda drawn: kind(**{**good, **drawn}))


clouds = changed(
    PointCloud2, CLOUD, height=uints, width=uints, fields=st.lists(fields, max_size=4),
    is_bigendian=st.booleans(), point_step=uints, row_step=uints, data=data,
)  # fmt: skip
images = changed(
    Image, IMAGE, height=uints, width=uints, encoding=st.sampled_from(["16UC1", "32FC1", "rgb8", ""]),
    step=uints, is_bigendian=bytes_, data=data,
)  # fmt: skip
infos = changed(
    CameraInfo, INFO, height=uints, width=uints, distortion_model=texts, d=st.lists(floats, max_size=9),
    k=st.lists(floats, min_size=9, max_size=9), p=st.lists(floats, min_size=12, max_size=12), binning_x=uints,
)  # fmt: skip
requests = st.builds(
    GraspRequest, header=headers, id=texts, source=bytes_, cloud=clouds, mesh_uri=texts, mesh_scale=floats,
    object_pose=poses, hand=st.one_of(st.just(""), texts), num_grasps=uints, preset=texts,
    seed=st.integers(-(2**63), 2**63 - 1), time_budget=st.one_of(st.just(0.0), floats),
    use_target_point=st.booleans(), target_point=points,
)  # fmt: skip


def refused(call: Any) -> tuple[Any, str]:
    """What a call gives, and the one line that it is refused with; fails where it raises anything else."""
    try:
        return call(), ""
    except GraspdError as error:
        message = str(error)
    assert message
    assert "\n" not in message
    assert len(message) < 2000
    # It goes out on ~/status.
    assert json.loads(status_line({"message": message}))["message"] == message
    return None, message


@settings(max_examples=60)
@given(message=requests, now=stamps)
def test_any_request_is_taken_or_refused_in_one_line(tmp_path_factory, message: GraspRequest, now: Time):
    intake = RequestBuilder(HAND, lambda: now, lambda target, source, stamp: np.eye(4))
    roots = Settings(mesh_roots=[str(tmp_path_factory.getbasetemp())])
    request, _ = refused(lambda: intake.from_message("r", roots, message))
    if request is not None and message.source == GraspRequest.CLOUD:
        refused(request.load)


@settings(max_examples=60)
@given(message=clouds, now=stamps)
def test_any_cloud_is_read_or_refused_in_one_line(message: PointCloud2, now: Time):
    intake = RequestBuilder(HAND, lambda: now, lambda target, source, stamp: np.eye(4))
    sensor_frame = cloud_frame(message, 5)
    refused(lambda: intake.from_sensor_frame("r", Settings(), sensor_frame))
    view, _ = refused(lambda: sensor_frame.read(CameraPlace(), no_lookup))
    if view is not None:
        assert np.isfinite(view.points).all()


@settings(max_examples=60)
@given(image=images, info=infos)
def test_any_depth_image_is_read_or_refused_in_one_line(image: Image, info: CameraInfo):
    pairs = ImagePairs()
    pairs.add(image)
    pairs.add(info)
    info.header.frame_id = image.header.frame_id
    view, _ = refused(depth_sensor_frame(image, info, 5).read)
    if view is not None:
        assert np.isfinite(view.points).all()


@pytest.mark.timeout(300)
def test_200_hostile_messages_leave_a_node_that_grasps(client, node):
    """Answers are not waited for one by one: whatever is queued ends with the cancel, and then the node must serve."""
    sent = {"count": 0}
    images_out = client.node.create_publisher(Image, "/depth/image_rect", 10)
    infos_out = client.node.create_publisher(CameraInfo, "/depth/camera_info", 10)
    client.spin_until(images_out.get_subscription_count, "match of the depth image")

    @settings(
        max_examples=50,
        derandomize=True,
        database=None,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    )
    @seed(0)
    @given(request=requests, cloud=clouds, image=images, info=infos, text=texts)
    def throw(request: GraspRequest, cloud: PointCloud2, image: Image, info: CameraInfo, text: str) -> None:
        request.id = f"hostile-{sent['count']}"
        client.send_request(request)
        client.send_cloud(cloud)
        info.header = image.header
        images_out.publish(image)
        infos_out.publish(info)
        client.send_mesh(text)
        client.send_cancel(text)
        sent["count"] += 1
        client.spin_for(0.01)

    throw()
    wanted = {f"hostile-{number}" for number in range(sent["count"])}
    client.send_cancel("")
    client.spin_until(lambda: wanted <= {a.request_id for a in client.answers}, "an answer to every request")
    assert sent["count"] >= 40
    while (health := client.health())["worker"] != "idle" or health["queue length"] != "0":
        client.send_cancel("")
    client.node.destroy_publisher(images_out)
    client.node.destroy_publisher(infos_out)
    assert node.alive()
    assert "Traceback" not in node.log.read_text()
    client.send_request(id="good", source=GraspRequest.MESH, mesh_uri="sphere.obj", num_grasps=1, preset="fast")
    assert client.answer("good").status == GraspArray.SUCCEEDED
