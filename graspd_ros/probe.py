"""Whether ROS works here: asked by `graspd doctor`, in a process of its own."""

from __future__ import annotations

import rclpy
from geometry_msgs.msg import PoseStamped
from graspd_msgs.msg import GraspRequest
from rclpy.utilities import get_rmw_implementation_identifier
from sensor_msgs.msg import PointCloud2


def probe() -> str:
    """Make and destroy a node; tell the middleware. Raises what rclpy raises where ROS does not work."""
    rclpy.init()
    node = rclpy.create_node("graspd_doctor")
    node.create_publisher(PoseStamped, "~/probe_pose", 1)
    node.create_publisher(PointCloud2, "~/probe_points", 1)
    node.create_publisher(GraspRequest, "~/probe_request", 1)
    node.destroy_node()
    rclpy.shutdown()
    return f"{get_rmw_implementation_identifier()}, makes a node"
