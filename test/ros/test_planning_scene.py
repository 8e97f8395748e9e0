"""Things of a planning scene: what messages make of them, and that grasps keep clear of them."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from expected import refused
from geometry_msgs.msg import Point, Pose, Quaternion, TransformStamped, Vector3
from graspd_msgs.msg import GraspArray, GraspRequest
from moveit_msgs.msg import CollisionObject
from scipy.spatial.transform import Rotation
from shape_msgs.msg import Mesh, MeshTriangle, Plane, SolidPrimitive
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage
from trimesh.transformations import translation_matrix

from graspd_core import hand_mesh, load_hand, load_scene
from graspd_core.errors import GraspdError, TransformError
from graspd_ros.inputs.solids import MOST_OBJECTS, SceneObject, updated_objects, with_collision_objects
from graspd_ros.parameters import Settings
from graspd_ros.request import Request

WALL = 0.1  # metres: how far the wall's face is from the middle of the mug
HAND = load_hand("allegro_right")

pytestmark = pytest.mark.timeout(300)
QUARTER = Quaternion(w=np.sqrt(0.5), z=np.sqrt(0.5))


def box(name: str, sizes: list[float], place: float, frame: str) -> CollisionObject:
    solid = SolidPrimitive(type=SolidPrimitive.BOX, dimensions=sizes)
    header = Header(frame_id=frame)
    return CollisionObject(header=header, id=name, primitives=[solid], pose=Pose(position=Point(x=place)))


def farthest(answer: GraspArray) -> float:
    """How far any of the hands reaches along x [m]."""
    assert answer.grasps, answer.message
    found = []
    for grasp in answer.grasps:
        turn, at = grasp.grasp_pose.orientation, grasp.grasp_pose.position
        vertices = hand_mesh(HAND, np.array(grasp.grasp_joints.position[: HAND.num_joints])).vertices
        found.append(Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).apply(vertices)[:, 0].max() + at.x)
    return max(found)


def test_later_requests_keep_clear_of_the_scene_and_bad_messages_do_no_harm(client, start_node):
    start_node(collision_objects="/collision_object", num_grasps=4, preset="fast", deadline=100.0)
    things = client.node.create_publisher(CollisionObject, "/collision_object", 50)
    frames = client.kept(TFMessage, "/tf_static")
    client.spin_until(things.get_subscription_count, "node that hears the scene")
    shelf = TransformStamped(header=Header(frame_id="object"), child_frame_id="shelf")
    shelf.transform.translation, shelf.transform.rotation = Vector3(x=WALL + 0.25), Quaternion(w=1.0)
    frames.publish(TFMessage(transforms=[shelf]))

    def settle() -> None:
        """Wait until the node has taken all messages, whose last it refuses."""
        client.forget()
        things.publish(CollisionObject(id="nobody", operation=CollisionObject.REMOVE))
        client.event(event="refused", source="collision_objects")

    def ask(name: str, **fields: Any) -> GraspArray:
        client.send_request(id=name, source=GraspRequest.MESH, mesh_uri="mug.obj", **fields)
        return client.answer(name)

    # From the side that the wall will be on.
    there = {"approach_direction": Vector3(x=-1.0), "approach_angle": 0.8}
    assert farthest(ask("free", **there)) > WALL
    things.publish(CollisionObject(id="cup", operation=CollisionObject.REMOVE))
    told = client.event(event="refused", source="collision_objects")
    assert told["message"] == "collision object 'cup': REMOVE: unknown id; known: none"
    client.forget()
    things.publish(CollisionObject(header=Header(frame_id="shelf"), id="torn", meshes=[Mesh()]))
    assert "'torn': meshes: 0 vertices" in client.event(event="refused", source="collision_objects")["message"]

    # A wall in a frame of its own, and the mug as the scene has it.
    things.publish(box("mug", [0.09, 0.08, 0.09], 0.0, "object"))
    things.publish(box("wall", [0.5, 1.0, 1.0], 0.0, "shelf"))
    settle()
    answer = ask("walled")
    assert farthest(answer) < WALL + 0.002
    assert [w for w in answer.warnings if "collision object 'mug' fills the place of the object to grasp" in w]

    things.publish(box("lost", [0.1, 0.1, 0.1], 0.0, "nowhere"))
    settle()
    lost = ask("lost")
    assert (lost.status, lost.error_code) == (GraspArray.FAILED, "NO_TRANSFORM")
    assert lost.message.startswith("collision object 'lost': unknown frame 'nowhere'; known:")
    things.publish(CollisionObject(operation=CollisionObject.REMOVE))
    settle()
    assert farthest(ask("cleared", **there)) > WALL


def test_without_the_messages_the_node_says_so_in_one_line(start_node, monkeypatch, tmp_path):
    (tmp_path / "moveit_msgs").mkdir()
    (tmp_path / "moveit_msgs" / "__init__.py").touch()
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    node = start_node(ready=False, collision_objects="/collision_object")
    node.process.wait(100)
    status, log = node.stop()
    assert status == 2
    told = [line for line in log.splitlines() if line.startswith("graspd_node:")]
    assert told == [
        "graspd_node: parameter collision_objects: moveit_msgs/CollisionObject is not installed; install it "
        "(docs/moveit.md) or leave the parameter empty"
    ]


def message(operation: bytes = CollisionObject.ADD, name: str = "wall", frame: str = "map", **fields: Any):
    return CollisionObject(header=Header(frame_id=frame), id=name, operation=operation, **fields)


def crate(x: float = 0.0, **fields: Any) -> dict[str, Any]:
    solid = SolidPrimitive(type=SolidPrimitive.BOX, dimensions=[0.02, 0.2, 0.2])
    return {"primitives": [solid], "primitive_poses": [Pose(position=Point(x=x))], **fields}


def corner(thing) -> np.ndarray:
    return np.concatenate([shape.vertices for shape in thing.shapes]).max(0)


def test_things_are_added_replaced_extended_moved_and_removed():
    first = updated_objects({}, message(**crate(), pose=Pose(position=Point(x=1.0))))
    np.testing.assert_allclose(corner(first["wall"]), [0.01, 0.1, 0.1])
    assert first["wall"].T_frame_object[0, 3] == 1.0
    longer = updated_objects(first, message(CollisionObject.APPEND, **crate(x=0.5)))
    np.testing.assert_allclose(corner(longer["wall"]), [0.51, 0.1, 0.1])
    assert longer["wall"].T_frame_object[0, 3] == 1.0
    moved = updated_objects(longer, message(CollisionObject.MOVE, frame="shelf", pose=Pose(orientation=QUARTER)))
    assert (moved["wall"].frame, len(moved["wall"].shapes)) == ("shelf", 2)
    assert len(updated_objects(moved, message(**crate()))["wall"].shapes) == 1
    both = updated_objects(moved, message(CollisionObject.APPEND, name="other", **crate()))
    assert list(updated_objects(both, message(CollisionObject.REMOVE, frame=""))) == ["other"]
    assert updated_objects(both, message(CollisionObject.REMOVE, name="", frame="")) == {}
    assert len(first["wall"].shapes) == 1, "what a request holds on to stays"


BAD = {
    "collision object 'cup': REMOVE: unknown id; known: wall": message(CollisionObject.REMOVE, "cup"),
    "collision object 'cup': MOVE: unknown id; known: wall": message(CollisionObject.MOVE, "cup"),
    "collision object '': id: empty": message(name="", **crate()),
    "operation: 7; valid: ADD=0, REMOVE=1, APPEND=2, MOVE=3": message(b"\x07", **crate()),
    "'wall': meshes: 0 vertices and 0 triangles": message(meshes=[Mesh()]),
    "'wall': meshes: 1 vertices and 1 triangles; valid: finite vertices within 1e+06 m": message(
        meshes=[Mesh(vertices=[Point(x=1e200)], triangles=[MeshTriangle()])]
    ),
    "'wall': primitives: dimensions [1e+200]; valid: 1 numbers above 0, at most 1e+06 [m]": message(
        primitives=[SolidPrimitive(type=SolidPrimitive.SPHERE, dimensions=[1e200])]
    ),
    "'wall': planes: infinite planes are not supported": message(planes=[Plane()], **crate()),
    "'wall': no primitives and no meshes": message(),
    "'wall': header.frame_id: empty": message(frame="", **crate()),
    "'wall': pose: position [nan, 0.0, 0.0]": message(**crate(), pose=Pose(position=Point(x=np.nan))),
    "'wall': primitive_poses: its quaternion has length 3": message(
        primitives=crate()["primitives"], primitive_poses=[Pose(orientation=Quaternion(w=3.0))]
    ),
    "'wall': primitive_poses: 2 poses for 1 shapes": message(**{**crate(), "primitive_poses": [Pose(), Pose()]}),
    "'wall': primitives: type 5; valid: BOX=1": message(primitives=[SolidPrimitive(type=5)]),
    "'wall': operation: MOVE takes no shapes": message(CollisionObject.MOVE, **crate()),
}


@pytest.mark.parametrize("culprit", BAD)
def test_a_message_that_cannot_be_meant_is_refused_by_name(culprit: str):
    with refused(GraspdError, culprit, code="BAD_REQUEST"):
        updated_objects(updated_objects({}, message(**crate())), BAD[culprit])


def test_there_is_an_end_of_things():
    wall = updated_objects({}, message(**crate()))["wall"]
    many = {str(number): wall for number in range(MOST_OBJECTS)}
    with pytest.raises(GraspdError, match="1000 collision objects are stored, which is the limit"):
        updated_objects(many, message(**crate()))
    assert updated_objects(many, message(name="7", **crate()))


def request(things: Mapping[str, SceneObject], pose: np.ndarray | None = None) -> Request:
    load = lambda: load_scene("shape:box")  # noqa: E731
    return Request("r", "mesh", "map", Time(), Settings(), load, T_frame_object=pose, collision_objects=things)


def test_things_come_to_the_object_through_their_frame_and_its_pose():
    things = updated_objects({}, message(frame="shelf", **crate(), pose=Pose(position=Point(x=0.1))))
    T_map_shelf, T_map_object = (translation_matrix([x, 0.0, 0.0]) for x in (1.0, 0.95))
    frames = lambda *names: {("map", "shelf"): T_map_shelf}[names]  # noqa: E731
    (obstacle,) = with_collision_objects(request(things, T_map_object), frames).load().obstacles
    assert obstacle.mesh.vertices[:, 0].mean() == pytest.approx(0.15, abs=0.005)
    own = {"wall": replace(things["wall"], frame="map")}
    assert not with_collision_objects(request(own, T_map_object), lambda *_: pytest.fail("asked")).load().obstacles


def test_a_frame_that_nobody_knows_names_the_thing():
    def lookup(*_: str) -> np.ndarray:
        raise TransformError("unknown frame 'shelf'; known: map")

    things = updated_objects({}, message(frame="shelf", **crate()))
    with pytest.raises(TransformError, match="collision object 'wall': unknown frame 'shelf'; known: map"):
        with_collision_objects(request(things), lookup)
