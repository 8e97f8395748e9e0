"""Starts the node with the shipped parameters.

`ros2 launch graspd_ros graspd.launch.py points:=/camera/depth/color/points hand:=allegro_right output_frame:=base_link`

An argument that is a parameter of the node goes before the parameter file only where it is given.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from graspd_core.paths import config_dir

PARAMETERS = {
    "hand": "name or path of the hand",
    "hand_prefix": "put before the names of the hand's joints and links",
    "output_frame": "frame of the results, by /tf",
    "sensor_frame": "frame at whose origin the camera of clouds stood, by /tf",
    "use_sim_time": "whether /clock tells the time",
}


def _arguments() -> list[DeclareLaunchArgument]:
    """What differs from robot to robot."""

    def told(name: str) -> str:
        return f"{PARAMETERS[name]}; empty: as the parameter file says"

    return [
        DeclareLaunchArgument("points", default_value="points", description="PointCloud2 topic to listen to"),
        DeclareLaunchArgument(
            "depth_image", default_value="depth/image_rect", description="depth image topic to listen to"
        ),
        DeclareLaunchArgument(
            "camera_info", default_value="depth/camera_info", description="CameraInfo topic of the depth image"
        ),
        DeclareLaunchArgument("hand", default_value="", description=told("hand")),
        DeclareLaunchArgument("hand_prefix", default_value="", description=told("hand_prefix")),
        DeclareLaunchArgument("output_frame", default_value="", description=told("output_frame")),
        DeclareLaunchArgument("sensor_frame", default_value="", description=told("sensor_frame")),
        DeclareLaunchArgument("params", default_value=str(config_dir() / "graspd.yaml"), description="parameter file"),
        DeclareLaunchArgument("name", default_value="graspd", description="name of the node"),
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the node"),
        DeclareLaunchArgument("use_sim_time", default_value="", description=told("use_sim_time")),
        DeclareLaunchArgument(
            "large_clouds",
            default_value="false",
            description="share 64 MB instead of 512 KB with this machine's cameras; they must do so too",
        ),
        DeclareLaunchArgument("respawn", default_value="false", description="start the node again when it dies"),
    ]


def given(values: dict[str, str]) -> dict[str, str | bool]:
    """Those that were given, of the type that the node declares; the others are left to the parameter file."""
    typed: dict[str, str | bool] = {name: value for name, value in values.items() if value}
    if "use_sim_time" in typed:
        typed["use_sim_time"] = values["use_sim_time"].lower() in ("true", "1")
    return typed


def _node(context) -> list[Node]:
    values = {name: LaunchConfiguration(name).perform(context) for name in PARAMETERS}
    return [
        Node(
            package="graspd_ros",
            executable="graspd_node",
            name=LaunchConfiguration("name"),
            namespace=LaunchConfiguration("namespace"),
            output="screen",
            respawn=LaunchConfiguration("respawn"),
            respawn_delay=2.0,
            parameters=[LaunchConfiguration("params"), given(values)],
            remappings=[
                ("points", LaunchConfiguration("points")),
                ("depth/image_rect", LaunchConfiguration("depth_image")),
                ("depth/camera_info", LaunchConfiguration("camera_info")),
            ],
        )
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
            OpaqueFunction(function=_node),
        ]
    )
