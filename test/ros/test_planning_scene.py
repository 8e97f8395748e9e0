"""A node that hears a planning scene: later requests keep clear of what is in it; bad messages do no harm."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Point, Pose, Quaternion, TransformStamped, Vector3
from graspd_msgs.msg import GraspArray, GraspRequest
from moveit_msgs.msg import CollisionObject
from rclpy.qos import DurabilityPolicy, QoSProfile
from scipy.spatial.transform import Rotation
from shape_msgs.msg import Mesh, SolidPrimitive
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from graspd_core import hand_mesh, load_hand

WALL = 0.1  # metres: how far the wall's face is from the middle of the mug
HAND = load_hand("allegro_right")

pytestmark = pytest.mark.timeout(300)


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
    frames = client.node.create_publisher(
        TFMessage, "/tf_static", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    )
    client.spin_until(things.get_subscription_count, "node that hears the scene")
    shelf = TransformStamped(header=Header(frame_id="object"), child_frame_id="shelf")
    shelf.transform.translation, shelf.transform.rotation = Vector3(x=WALL + 0.25), Quaternion(w=1.0)
    frames.publish(TFMessage(transforms=[shelf]))

    def ask(name: str, **fields: Any) -> GraspArray:
        client.send_request(id=name, source=GraspRequest.MESH, mesh_uri="mug.obj", **fields)
        return client.answer(name)

    # From the side that the wall will be on.
    there = {"approach_direction": Vector3(x=-1.0), "approach_angle": 0.8}
    assert farthest(ask("free", **there)) > WALL
    things.publish(CollisionObject(id="cup", operation=CollisionObject.REMOVE))
    told = client.event(event="refused", source="collision_objects")
    assert told["message"] == "collision object 'cup': REMOVE: there is none; there are: none"
    client.forget()
    things.publish(CollisionObject(header=Header(frame_id="shelf"), id="torn", meshes=[Mesh()]))
    assert "'torn': meshes: 0 vertices" in client.event(event="refused", source="collision_objects")["message"]

    # A wall in a frame of its own, and the mug as the scene has it.
    things.publish(box("mug", [0.09, 0.08, 0.09], 0.0, "object"))
    things.publish(box("wall", [0.5, 1.0, 1.0], 0.0, "shelf"))
    things.publish(CollisionObject(id="nobody", operation=CollisionObject.REMOVE))
    client.forget()
    client.event(event="refused", source="collision_objects")
    answer = ask("walled")
    assert farthest(answer) < WALL + 0.002
    assert [w for w in answer.warnings if "collision object 'mug' fills the object's own place" in w]

    things.publish(box("lost", [0.1, 0.1, 0.1], 0.0, "nowhere"))
    things.publish(CollisionObject(id="nobody", operation=CollisionObject.REMOVE))
    client.forget()
    client.event(event="refused", source="collision_objects")
    lost = ask("lost")
    assert lost.status == GraspArray.FAILED
    assert lost.message.startswith("collision object 'lost': unknown frame 'nowhere'; known:")
    things.publish(CollisionObject(operation=CollisionObject.REMOVE))
    things.publish(CollisionObject(id="nobody", operation=CollisionObject.REMOVE))
    client.forget()
    client.event(event="refused", source="collision_objects")
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


def test_who_asks_for_no_scene_imports_nothing_of_it():
    code = "import sys, graspd_ros.grasp_node; print('moveit_msgs' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
