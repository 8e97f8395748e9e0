"""A left and a right hand: two nodes under namespaces of one domain, each with topics, joints and links of its own."""

from __future__ import annotations

import json

import pytest
from graspd_msgs.action import SynthesizeGrasps
from graspd_msgs.msg import GraspArray, GraspRequest
from rclpy.action.client import ActionClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

HANDS = {"left": "allegro_left", "right": "allegro_right"}
FEW = {"num_grasps": 1, "preset": "fast", "deadline": 100.0}

pytestmark = pytest.mark.timeout(300)


@pytest.fixture
def sides(client, spawn_node, tmp_path):
    """The two nodes, when both have said that they are ready."""
    started, ready = {}, {}
    latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    heard = []
    for side, hand in HANDS.items():
        parameters = {"hand": hand, "hand_prefix": f"{side}_", "mesh_roots": f"[{tmp_path}]", **FEW}
        started[side] = spawn_node(f"/{side}", **parameters)

        def hear(message: String, side: str = side) -> None:
            event = json.loads(message.data)
            if event["event"] == "ready":
                ready[side] = event

        heard.append(client.node.create_subscription(String, f"/{side}/graspd/status", hear, latched))
    client.spin_until(lambda: len(ready) == 2, "two nodes")
    yield tmp_path
    for subscription in heard:
        client.node.destroy_subscription(subscription)
    for process in started.values():
        assert process.stop()[0] == 0


def test_two_nodes_of_one_domain_answer_each_for_its_own_hand(client, sides):
    mesh = str(sides / "sphere.obj")
    actions = {side: ActionClient(client.node, SynthesizeGrasps, f"/{side}/graspd/synthesize") for side in HANDS}
    for action in actions.values():
        client.spin_until(action.server_is_ready, "action server")
    goal = SynthesizeGrasps.Goal(request=GraspRequest(id="same-id", source=GraspRequest.MESH, mesh_uri=mesh))
    sent = {side: action.send_goal_async(goal) for side, action in actions.items()}
    client.spin_until(lambda: all(future.done() for future in sent.values()), "answers to goals")
    handles = {side: future.result() for side, future in sent.items()}
    ends = {side: handle.get_result_async() for side, handle in handles.items() if handle is not None}
    assert set(ends) == set(HANDS)
    client.spin_until(lambda: all(future.done() for future in ends.values()), "results")
    for side, future in ends.items():
        answer = future.result().result.result
        assert answer.status == GraspArray.SUCCEEDED
        grasp = answer.grasps[0]
        assert grasp.hand == HANDS[side]
        assert grasp.base_link.startswith(f"{side}_")
        assert all(name.startswith(f"{side}_") for name in grasp.trajectory.joint_names)
        assert all(contact.link.startswith(f"{side}_") for contact in grasp.contacts)
    for action in actions.values():
        action.destroy()
