"""Whether ROS works here: asked by `graspd doctor`, in a process of its own."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path


def foreign_rclpy(file: str) -> str:
    """One line about an rclpy that comes before the environment's own; empty where there is one rclpy only."""
    own = next((Path(sys.prefix) / "lib").glob("python3*/site-packages/rclpy/__init__.py"), None)
    if own is None or Path(file).resolve() == own.resolve():
        return ""
    where = Path(file).parents[1]
    return f"rclpy is that of {where}, not this environment's: unset PYTHONPATH, or do not source another ROS"


def probe() -> str:
    """Make and destroy a node; tell the middleware. Raises what rclpy raises where ROS does not work."""
    spec = importlib.util.find_spec("rclpy")
    if spec is not None and spec.origin and (told := foreign_rclpy(spec.origin)):
        raise ImportError(told)
    import rclpy
    from geometry_msgs.msg import PoseStamped
    from graspd_msgs.msg import GraspRequest
    from rclpy.utilities import get_rmw_implementation_identifier
    from sensor_msgs.msg import PointCloud2

    rclpy.init()
    node = rclpy.create_node("graspd_doctor")
    node.create_publisher(PoseStamped, "~/probe_pose", 1)
    node.create_publisher(PointCloud2, "~/probe_points", 1)
    node.create_publisher(GraspRequest, "~/probe_request", 1)
    node.destroy_node()
    rclpy.shutdown()
    return f"{get_rmw_implementation_identifier()}, makes a node"
