"""Starts the node with the shipped parameters.

`ros2 launch graspd_ros graspd.launch.py points:=/camera/depth/color/points hand:=allegro_right output_frame:=base_link`
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from graspd_core.paths import config_dir


def _arguments() -> list[DeclareLaunchArgument]:
    """What differs from robot to robot."""
    return [
        DeclareLaunchArgument("points", default_value="points", description="PointCloud2 topic to listen to"),
        DeclareLaunchArgument(
            "depth_image", default_value="depth/image_rect", description="depth image topic to listen to"
        ),
        DeclareLaunchArgument(
            "camera_info", default_value="depth/camera_info", description="CameraInfo topic of the depth image"
        ),
        DeclareLaunchArgument("hand", default_value="allegro_right", description="name or path of the hand"),
        DeclareLaunchArgument(
            "output_frame", default_value="", description="frame of the results, by /tf; empty: that of the input"
        ),
        DeclareLaunchArgument("params", default_value=str(config_dir() / "graspd.yaml"), description="parameter file"),
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the node"),
        DeclareLaunchArgument("use_sim_time", default_value="false", description="whether /clock tells the time"),
        DeclareLaunchArgument(
            "large_clouds",
            default_value="false",
            description="share 64 MB instead of 512 KB with this machine's cameras; they must do so too",
        ),
        DeclareLaunchArgument("respawn", default_value="false", description="start the node again when it dies"),
    ]


def generate_launch_description() -> LaunchDescription:
    """One node, with arguments on the command line."""
    return LaunchDescription(
        [
            *_arguments(),
            SetEnvironmentVariable(
                "FASTRTPS_DEFAULT_PROFILES_FILE",
                str(config_dir() / "fastdds.xml"),
                condition=IfCondition(LaunchConfiguration("large_clouds")),
            ),
            Node(
                package="graspd_ros",
                executable="graspd_node",
                name="graspd",
                namespace=LaunchConfiguration("namespace"),
                output="screen",
                respawn=LaunchConfiguration("respawn"),
                respawn_delay=2.0,
                parameters=[
                    LaunchConfiguration("params"),
                    {name: LaunchConfiguration(name) for name in ("hand", "output_frame", "use_sim_time")},
                ],
                remappings=[
                    ("points", LaunchConfiguration("points")),
                    ("depth/image_rect", LaunchConfiguration("depth_image")),
                    ("depth/camera_info", LaunchConfiguration("camera_info")),
                ],
            ),
        ]
    )
