"""Request any object over DDS. The answer names the object of its grasps first, and lost objects last."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Point, Pose, Quaternion, TransformStamped, Vector3
from graspd_msgs.msg import GraspArray, GraspRequest
from moveit_msgs.msg import AttachedCollisionObject
from shape_msgs.msg import SolidPrimitive
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from graspd_bench.rendering.depth_noise import DEFAULT
from graspd_bench.rendering.tabletop import CAMERA, ring_poses, tabletop, views_of
from graspd_core import PointCloud
from graspd_ros.convert import array_of, matrix_of_pose

pytestmark = pytest.mark.timeout(300)
# The node's other frame is this far along x [m].
SHIFT = 1.0
# Where the box stands, and the flat bowl beside it [m].
PLACES = np.array([[0.0, 0.0], [0.15, 0.05]])


@pytest.fixture(scope="module")
def view() -> PointCloud:
    scene = tabletop("box", obstacles=[("bowl", 0.16, 0.05)])
    view = views_of(scene, CAMERA, ring_poses(1, elevation=np.deg2rad(55.0)), DEFAULT, 3)[0]
    return replace(view, points=view.points[::10])


def places(answer: GraspArray) -> np.ndarray:
    """The middle of each object that the answer names [m]."""
    assert len(answer.objects) == len(answer.object_reasons) == 2, answer.message
    return np.array([array_of(place)[:2] for place in answer.objects])


def nearest(answer: GraspArray) -> int:
    """The row of PLACES that the contacts of the best grasp are nearest to."""
    middle = np.mean([array_of(contact.position)[:2] for contact in next(iter(answer.grasps)).contacts], 0)
    return int(np.linalg.norm(PLACES - middle, axis=1).argmin())


def test_any_object_is_taken_and_after_a_loss_another(client, start_node, make_cloud, view):
    start_node(hand="parallel_gripper", preset="fast", num_grasps=1, deadline=100.0, mass=0.1, cloud_max_age=0.0)
    client.set_parameters(cloud_policy="off")
    frames, cloud = client.kept(TFMessage, "/tf_static"), make_cloud(view.points, "table")
    cloud.header.stamp = client.now()
    shift = TransformStamped(header=Header(frame_id="world"), child_frame_id="table")
    shift.transform.translation, shift.transform.rotation = Vector3(x=SHIFT), Quaternion(w=1.0)
    frames.publish(TFMessage(transforms=[shift]))
    attached = client.late(AttachedCollisionObject, "/graspd/attached_object")
    x, y, z = view.viewpoint.tolist()
    there = {"cloud": cloud, "use_view_point": True, "view_point": Point(x=x, y=y, z=z), "any_object": True}

    def ask(name: str, **fields: Any) -> GraspArray:
        client.send_request(id=name, **{**there, **fields})
        return client.answer(name)

    first = ask("first")
    assert first.status == GraspArray.SUCCEEDED, first.message
    np.testing.assert_allclose(places(first), PLACES, atol=0.04)
    assert list(first.object_reasons) == ["", "not tried before the search ended"]
    assert nearest(first) == 0
    # The object in the hand, for a motion planner: its middle is where the answer says, seen from the base link.
    (held,) = client.spin_until(lambda: attached, "object in the hand")
    assert (held.object.id, held.link_name, held.weight) == ("first", next(iter(first.grasps)).base_link, first.mass)
    middle = matrix_of_pose(next(iter(first.grasps)).grasp_pose) @ matrix_of_pose(held.object.pose)
    np.testing.assert_allclose(middle[:2, 3], PLACES[0], atol=0.02)
    # The newest cloud that came is asked in the same way. Trials would only take time from here on.
    client.set_parameters(view_point=[x, y, z], verify="none")
    client.show(lambda: client.send_cloud(cloud), cloud.header)
    newest = ask("newest", source=GraspRequest.LATEST_CLOUD, cloud=type(cloud)(), use_view_point=False)
    np.testing.assert_array_equal(places(newest), places(first))
    # What was lost comes last, in another frame too.
    client.set_parameters(output_frame="world")
    second = ask("second", exclude=["first/0"])
    assert second.header.frame_id == "world"
    np.testing.assert_allclose(places(second), PLACES[::-1] + np.array([SHIFT, 0.0]), atol=0.04)
    client.set_parameters(output_frame="")
    # One object is asked for as ever, and names no other.
    one = ask("one", any_object=False, use_target_point=True, target_point=next(iter(first.objects)))
    assert nearest(one) == 0
    assert (list(one.objects), list(one.object_reasons)) == ([], [])

    refused = ask("both", use_target_point=True)
    assert refused.status == GraspArray.REFUSED
    told = "any_object: use_target_point is given too and selects an object; remove one of them"
    assert (refused.error_code, refused.message) == ("BAD_REQUEST", told)
    ball = SolidPrimitive(type=SolidPrimitive.SPHERE, dimensions=[0.1])
    nowhere = ask("nowhere", region=ball, region_pose=Pose(position=Point(x=9.0)))
    assert (nowhere.status, nowhere.error_code) == (GraspArray.FAILED, "BAD_REQUEST")
    assert nowhere.message.count("region: no part of the object lies") == 2
    bare = ask("bare", cloud=make_cloud(view.points[view.points[:, 2] < 0.003], "table"))
    assert bare.error_code == "NO_OBJECT"
    assert bare.message.startswith("cloud: no object is seen, except known solids")
