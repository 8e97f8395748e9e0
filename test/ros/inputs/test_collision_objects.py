"""CollisionObject messages: what a planning scene holds after each, what is refused, where the things are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion
from moveit_msgs.msg import CollisionObject
from shape_msgs.msg import Mesh, Plane, SolidPrimitive
from std_msgs.msg import Header

from graspd_core import load_scene
from graspd_core.errors import GraspdError, TransformError
from graspd_ros.error_codes import code_of
from graspd_ros.inputs.solids import MOST_THINGS, Thing, among_things, changed_things
from graspd_ros.parameters import Settings
from graspd_ros.request import Request

QUARTER = Quaternion(w=np.sqrt(0.5), z=np.sqrt(0.5))


def message(operation: bytes = CollisionObject.ADD, name: str = "wall", frame: str = "map", **fields: Any):
    return CollisionObject(header=Header(frame_id=frame), id=name, operation=operation, **fields)


def box(x: float = 0.0, **fields: Any) -> dict[str, Any]:
    solid = SolidPrimitive(type=SolidPrimitive.BOX, dimensions=[0.02, 0.2, 0.2])
    return {"primitives": [solid], "primitive_poses": [Pose(position=Point(x=x))], **fields}


def corner(thing) -> np.ndarray:
    return np.concatenate([shape.vertices for shape in thing.shapes]).max(0)


def test_things_are_added_replaced_extended_moved_and_removed():
    first = changed_things({}, message(**box(), pose=Pose(position=Point(x=1.0))))
    np.testing.assert_allclose(corner(first["wall"]), [0.01, 0.1, 0.1])
    assert first["wall"].T_frame_thing[0, 3] == 1.0
    longer = changed_things(first, message(CollisionObject.APPEND, **box(x=0.5)))
    np.testing.assert_allclose(corner(longer["wall"]), [0.51, 0.1, 0.1])
    assert longer["wall"].T_frame_thing[0, 3] == 1.0
    moved = changed_things(longer, message(CollisionObject.MOVE, frame="shelf", pose=Pose(orientation=QUARTER)))
    assert (moved["wall"].frame, len(moved["wall"].shapes)) == ("shelf", 2)
    assert len(changed_things(moved, message(**box()))["wall"].shapes) == 1
    both = changed_things(moved, message(CollisionObject.APPEND, name="other", **box()))
    assert list(changed_things(both, message(CollisionObject.REMOVE, frame=""))) == ["other"]
    assert changed_things(both, message(CollisionObject.REMOVE, name="", frame="")) == {}
    assert len(first["wall"].shapes) == 1, "what a request holds on to stays"


BAD = {
    "collision object 'cup': REMOVE: there is none; there are: wall": message(CollisionObject.REMOVE, "cup"),
    "collision object 'cup': MOVE: there is none; there are: wall": message(CollisionObject.MOVE, "cup"),
    "collision object '': id: empty": message(name="", **box()),
    "operation: 7; valid: ADD=0, REMOVE=1, APPEND=2, MOVE=3": message(b"\x07", **box()),
    "'wall': meshes: 0 vertices and 0 triangles": message(meshes=[Mesh()]),
    "'wall': planes: not taken": message(planes=[Plane()], **box()),
    "'wall': no primitives and no meshes": message(),
    "'wall': header.frame_id: empty": message(frame="", **box()),
    "'wall': pose: position [nan, 0.0, 0.0]": message(**box(), pose=Pose(position=Point(x=np.nan))),
    "'wall': primitive_poses: a quaternion of length 3": message(
        primitives=box()["primitives"], primitive_poses=[Pose(orientation=Quaternion(w=3.0))]
    ),
    "'wall': primitive_poses: 2 poses of 1 shapes": message(**{**box(), "primitive_poses": [Pose(), Pose()]}),
    "'wall': primitives: type 5; valid: BOX=1": message(primitives=[SolidPrimitive(type=5)]),
    "'wall': MOVE with shapes": message(CollisionObject.MOVE, **box()),
}


@pytest.mark.parametrize("culprit", BAD)
def test_a_message_that_cannot_be_meant_is_refused_by_name(culprit: str):
    with pytest.raises(GraspdError) as refused:
        changed_things(changed_things({}, message(**box())), BAD[culprit])
    assert culprit in str(refused.value)
    assert "\n" not in str(refused.value)
    assert code_of(refused.value) == "BAD_REQUEST"


def test_there_is_an_end_of_things():
    wall = changed_things({}, message(**box()))["wall"]
    many = {str(number): wall for number in range(MOST_THINGS)}
    with pytest.raises(GraspdError, match="1000 things are kept already"):
        changed_things(many, message(**box()))
    assert changed_things(many, message(name="7", **box()))


def request(things: Mapping[str, Thing], pose: np.ndarray | None = None) -> Request:
    load = lambda: load_scene("shape:box")  # noqa: E731
    return Request("r", "mesh", "map", Time(), Settings(), load, T_frame_object=pose, things=things)


def test_things_come_to_the_object_through_their_frame_and_its_pose():
    things = changed_things({}, message(frame="shelf", **box(), pose=Pose(position=Point(x=0.1))))
    T_map_shelf, T_map_object = np.eye(4), np.eye(4)
    T_map_shelf[:3, 3] = [1.0, 0.0, 0.0]
    T_map_object[:3, 3] = [0.95, 0.0, 0.0]
    scene = among_things(request(things, T_map_object), lambda *asked: {("map", "shelf"): T_map_shelf}[asked]).load()
    (obstacle,) = scene.obstacles
    assert obstacle.mesh.vertices[:, 0].mean() == pytest.approx(0.15, abs=0.005)
    own = {"wall": replace(things["wall"], frame="map")}
    assert not among_things(request(own, T_map_object), lambda *_: pytest.fail("asked")).load().obstacles


def test_a_frame_that_nobody_knows_names_the_thing():
    def lookup(*_: str) -> np.ndarray:
        raise TransformError("unknown frame 'shelf'; known: map")

    things = changed_things({}, message(frame="shelf", **box()))
    with pytest.raises(TransformError, match="collision object 'wall': unknown frame 'shelf'; known: map"):
        among_things(request(things), lookup)
