"""Starts the node with the shipped parameters.

`ros2 launch graspd_ros graspd.launch.py points:=/camera/depth/points hand:=allegro_right`
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from graspd_core.paths import config_dir


def generate_launch_description() -> LaunchDescription:
    """One node; the cloud's topic, the hand and the parameter file can be given on the command line."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("points", default_value="points", description="PointCloud2 topic to listen to"),
            DeclareLaunchArgument("hand", default_value="allegro_right", description="name or path of the hand"),
            DeclareLaunchArgument(
                "params", default_value=str(config_dir() / "graspd.yaml"), description="parameter file"
            ),
            Node(
                package="graspd_ros",
                executable="graspd_node",
                name="graspd",
                output="screen",
                parameters=[LaunchConfiguration("params"), {"hand": LaunchConfiguration("hand")}],
                remappings=[("points", LaunchConfiguration("points"))],
            ),
        ]
    )
