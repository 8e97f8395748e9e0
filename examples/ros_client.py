"""Request grasps from a running `graspd_node`: python examples/ros_client.py mug.obj.

The program uses the action /graspd/synthesize, shows progress, and prints what a robot must execute. A path is
relative to the node's folder. To grasp what a camera sees, set `source=GraspRequest.LATEST_CLOUD` instead.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import rclpy
from graspd_msgs.action import SynthesizeGrasps
from graspd_msgs.msg import Grasp, GraspArray, GraspRequest
from rclpy.action.client import ActionClient
from rclpy.utilities import try_shutdown

TIMEOUT = 120.0  # longest wait for the node [s]


def ask(node: Any, request: GraspRequest) -> GraspArray:
    """Send a goal and wait for its answer. Raises TimeoutError: no answer. Raises RuntimeError: goal refused."""
    client = ActionClient(node, SynthesizeGrasps, "/graspd/synthesize")
    if not client.wait_for_server(timeout_sec=TIMEOUT):
        raise TimeoutError("no graspd_node answers; is it running, in the same ROS_DOMAIN_ID?")

    def show(message: Any) -> None:
        progress = message.feedback.progress
        print(f"  {progress.elapsed:5.2f} s  {progress.stage}: {progress.verified} verified")

    def wait(future: Any) -> Any:
        rclpy.spin_until_future_complete(node, future, timeout_sec=TIMEOUT)
        if not future.done():
            raise TimeoutError(f"no answer within {TIMEOUT:.0f} s")
        return future.result()

    goal = wait(client.send_goal_async(SynthesizeGrasps.Goal(request=request), feedback_callback=show))
    if not goal.accepted:
        raise RuntimeError("the goal was refused; the node's log and /graspd/status say why")
    return wait(goal.get_result_async()).result.result


def show_grasp(grasp: Grasp) -> None:
    """Print what to execute: move the arm so that `base_link` is at the pregrasp pose, then run the trajectory."""
    at, touch, press = grasp.grasp_pose.position, grasp.grasp_joints, grasp.squeeze_joints
    print(f"#{grasp.rank} {grasp.base_link} at ({at.x:.3f}, {at.y:.3f}, {at.z:.3f}) m in {grasp.header.frame_id!r}")
    for name, value, target in zip(touch.name, touch.position, press.position, strict=True):
        print(f"    {name}: {value:.3f}, pressing towards {target:.3f}")


def main(arguments: Sequence[str]) -> int:
    """Return 0 if the node answered with a verified grasp, else 1."""
    if not arguments:
        print("usage: python examples/ros_client.py MESH", file=sys.stderr)
        return 2
    rclpy.init()
    node = rclpy.create_node("graspd_example_client")
    try:
        request = GraspRequest(
            source=GraspRequest.MESH, mesh_uri=arguments[0], num_grasps=2, preset="fast", time_budget=60.0
        )
        answer = ask(node, request)
    except (TimeoutError, RuntimeError) as error:
        print(f"ros_client: {error}", file=sys.stderr)
        return 1
    finally:
        node.destroy_node()
        try_shutdown()
    print(answer.message or answer.outcome)
    verified = [grasp for grasp in answer.grasps if grasp.verdict == Grasp.VERIFIED]
    for grasp in verified:
        show_grasp(grasp)
    return 0 if verified else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
