"""Request MoveIt grasps of a box from a running graspd_node: `moveit_client.py [WIDTH DEPTH HEIGHT]`, in metres."""

from __future__ import annotations

import sys

import rclpy
from geometry_msgs.msg import Pose
from grasping_msgs.action import GraspPlanning
from rclpy.action.client import ActionClient
from shape_msgs.msg import Plane, SolidPrimitive


def main() -> int:
    sizes = [float(size) for size in sys.argv[1:]] or [0.05, 0.05, 0.12]
    rclpy.init()
    node = rclpy.create_node("moveit_client")
    client = ActionClient(node, GraspPlanning, "/graspd/grasp_planning")
    if not client.wait_for_server(timeout_sec=20.0):
        sys.exit("no node offers /graspd/grasp_planning")

    goal = GraspPlanning.Goal()
    goal.object.name = "box"
    goal.object.header.frame_id = "table"
    goal.object.primitives = [SolidPrimitive(type=SolidPrimitive.BOX, dimensions=sizes)]
    pose = Pose()
    pose.position.z = sizes[2] / 2  # the box stands on the table, whose surface is z = 0
    goal.object.primitive_poses = [pose]
    goal.object.surface = Plane(coef=[0.0, 0.0, 1.0, 0.0])

    def told(message) -> None:
        print(f"{len(message.feedback.grasps)} grasps found thus far", flush=True)

    sent = client.send_goal_async(goal, feedback_callback=told)
    rclpy.spin_until_future_complete(node, sent)
    handle = sent.result()
    if handle is None:
        sys.exit("no answer to the goal")
    answer = handle.get_result_async()
    rclpy.spin_until_future_complete(node, answer)
    ended = answer.result()
    grasps = ended.result.grasps if ended else []
    for grasp in grasps:
        place, pose = grasp.grasp_pose.header.frame_id, grasp.grasp_pose.pose.position
        print(f"{grasp.id}: quality {grasp.grasp_quality:.3f}, at {pose.x:.3f} {pose.y:.3f} {pose.z:.3f} in {place}")
        print(f"  closes {', '.join(grasp.grasp_posture.joint_names)}")
    rclpy.shutdown()
    return 0 if grasps else 1


if __name__ == "__main__":
    sys.exit(main())
