"""What a request asks of a grasp's place and direction comes to the object's frame, or is refused by name."""

from __future__ import annotations

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from graspd_msgs.msg import GraspRequest
from sensor_msgs.msg import Image
from shape_msgs.msg import SolidPrimitive
from std_msgs.msg import Header

from graspd_core import Box, Sphere
from graspd_core.errors import GraspdError
from graspd_ros.error_codes import ErrorCode, code_of
from graspd_ros.inputs.request_builder import RequestBuilder
from graspd_ros.parameters import Settings
from graspd_ros.request import Request

# A quarter turn about x: the object's z is the header's −y.
LYING = Pose(position=Point(x=0.5), orientation=Quaternion(x=np.sqrt(0.5), w=np.sqrt(0.5)))
BOX, BALL = SolidPrimitive.BOX, SolidPrimitive.SPHERE
DOWN = Vector3(z=-1.0)


def solid(kind: int, *sizes: float) -> SolidPrimitive:
    return SolidPrimitive(type=kind, dimensions=list(sizes))


def request(tmp_path, lookup=lambda *_: np.eye(4), **fields) -> Request:
    (tmp_path / "can.obj").touch()
    message = GraspRequest(source=GraspRequest.MESH, mesh_uri=str(tmp_path / "can.obj"), **fields)
    builder = RequestBuilder("allegro_right", lambda: Time(sec=1), lookup)
    return builder.from_message("r", Settings(mesh_roots=[str(tmp_path)]), message)


def test_a_request_that_asks_for_nothing_has_no_wishes(tmp_path):
    assert request(tmp_path).steering is None
    assert request(tmp_path, object_pose=LYING, region=SolidPrimitive(), region_pose=LYING).steering is None


def test_wishes_come_to_the_frame_of_the_object(tmp_path):
    asked = request(
        tmp_path,
        object_pose=LYING,
        approach_direction=DOWN,
        approach_angle=0.3,
        use_roll=True,
        roll=1.0,
        region=solid(BALL, 0.1),
        region_pose=Pose(position=Point(x=0.5, z=0.2)),
        avoid=[solid(BOX, 0.1, 0.2, 0.3)],
        avoid_poses=[Pose(position=Point(x=0.6))],
    ).steering
    assert asked is not None
    found = asked()
    # Header's −z is the object's −y; the header's x, from which a vertical approach's roll is measured, stays.
    assert np.allclose(np.asarray(found.approach_direction), [0, -1, 0])
    assert found.roll_zero is not None
    assert np.allclose(np.asarray(found.roll_zero), [1, 0, 0])
    assert (found.approach_angle, found.roll, found.roll_tolerance) == (0.3, 1.0, np.pi / 12)
    assert isinstance(found.region, Sphere)
    assert np.allclose(np.asarray(found.region.center), [0, 0.2, 0])
    (box,) = found.avoid
    assert np.allclose(np.asarray(box.center), [0.1, 0, 0])
    # The box's edges lie along the header's axes.
    assert np.allclose(box.rotation @ [0, 0, 1], [0, 1, 0])
    assert box.size == (0.1, 0.2, 0.3)


def test_wishes_in_another_frame_than_the_cloud_go_by_tf():
    from sensor_msgs.msg import PointCloud2

    T = np.eye(4)
    T[:3, :3] = [[0, 1, 0], [0, 0, 1], [1, 0, 0]]
    builder = RequestBuilder("allegro_right", lambda: Time(sec=1), lambda target, source, stamp: T)
    cloud = PointCloud2(header=Header(frame_id="camera", stamp=Time(sec=1)))
    for frame, direction in (("map", [0, -1, 0]), ("camera", [0, 0, -1]), ("", [0, 0, -1])):
        message = GraspRequest(header=Header(frame_id=frame), cloud=cloud, approach_direction=DOWN)
        steering = builder.from_message("r", Settings(), message).steering
        assert steering is not None
        assert np.allclose(np.asarray(steering().approach_direction), direction)


def test_a_box_may_be_the_region(tmp_path):
    steering = request(tmp_path, region=solid(BOX, 0.1, 0.1, 0.1)).steering
    assert steering is not None
    assert isinstance(steering().region, Box)


@pytest.mark.parametrize(
    ("fields", "culprit"),
    [
        ({"approach_direction": Vector3(x=float("nan"))}, "approach_direction: .*3 finite numbers"),
        ({"approach_angle": 0.5}, "approach_angle: it needs approach_direction"),
        ({"approach_direction": DOWN, "approach_angle": -0.5}, "approach_angle: -0.5 rad; valid: above 0"),
        ({"approach_direction": DOWN, "approach_angle": 4.0}, "approach_angle: 4 rad; valid: above 0"),
        ({"approach_direction": DOWN, "approach_angle": float("nan")}, "approach_angle: nan"),
        ({"approach_direction": DOWN, "roll": 0.5}, "roll: use_roll is false"),
        ({"use_roll": True}, "roll: needs approach_direction"),
        ({"approach_direction": DOWN, "use_roll": True, "roll": float("inf")}, "roll: inf"),
        ({"region": solid(BOX, 0.1)}, "region: type 1 of 1 dimensions; valid: BOX=1 or SPHERE=2"),
        ({"region": solid(BALL, 0.1, 0.1)}, "region: 2 dimensions; valid: the radius of a SPHERE"),
        ({"region": solid(BALL, -0.1)}, "sphere radius: -0.1 m; valid: above 0"),
        ({"region": solid(SolidPrimitive.CONE, 0.1, 0.1)}, "region: type 4 of 2 dimensions"),
        ({"region": solid(BALL, 0.1), "region_pose": Pose(position=Point(x=float("inf")))}, "region_pose: position"),
        ({"region_mask": Image(height=1)}, "region_mask: with source 1; valid with CLOUD=0"),
        ({"region_mask": Image(height=1), "region": solid(BALL, 0.1)}, "region_mask: region is given too"),
        ({"avoid": [solid(BOX, 1, 1, 1)]}, "avoid: 1 boxes, 0 poses; valid: one avoid_poses for each, at most 64"),
        ({"avoid": [solid(BALL, 1)], "avoid_poses": [Pose()]}, "avoid: type 2 of 1 dimensions; valid: BOX=1"),
        ({"avoid": [solid(BOX, 1, 0, 1)], "avoid_poses": [Pose()]}, "box size: .*three lengths above 0"),
    ],
)
def test_wishes_that_make_no_sense_are_refused_by_name(tmp_path, fields, culprit):
    with pytest.raises(GraspdError, match=culprit) as refused:
        request(tmp_path, **fields)
    assert code_of(refused.value) is ErrorCode.BAD_REQUEST
