"""Launch file of the node with the shipped parameters.

`ros2 launch graspd_ros graspd.launch.py points:=/camera/depth/color/points hand:=allegro_right output_frame:=base_link`

An argument overrides the parameter of the same name in the parameter file.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from graspd_core.paths import config_dir

# Settings that differ between robots, by name: default and description.
ARGUMENTS = {
    "points": ("points", "PointCloud2 topic to listen to"),
    "depth_image": ("depth/image_rect", "depth image topic to listen to"),
    "camera_info": ("depth/camera_info", "CameraInfo topic of the depth image"),
    "hand": ("", "name or path of the hand"),
    "hand_prefix": ("", "prefix of the names of the hand's joints and links"),
    "output_frame": ("", "frame of the results in /tf"),
    "sensor_frame": ("", "frame in /tf whose origin is the position of the camera, for clouds"),
    "params": (str(config_dir() / "graspd.yaml"), "parameter file"),
    "name": ("graspd", "name of the node"),
    "namespace": ("", "namespace of the node"),
    "use_sim_time": ("", "whether the time comes from /clock"),
    "large_clouds": ("false", "whether Fast DDS shares 64 MB instead of 512 KB of memory; cameras need the same"),
    "respawn": ("false", "whether to restart the node when it dies"),
}
PARAMETERS = ("hand", "hand_prefix", "output_frame", "sensor_frame", "use_sim_time")


def given(values: dict[str, str]) -> dict[str, str | bool]:
    """Return the non-empty values, converted to the parameters' types. The parameter file supplies the rest."""
    typed: dict[str, str | bool] = {name: value for name, value in values.items() if value}
    if "use_sim_time" in typed:
        typed["use_sim_time"] = values["use_sim_time"].lower() in ("true", "1")
    return typed


def _argument(name: str) -> DeclareLaunchArgument:
    default, text = ARGUMENTS[name]
    text += ". If empty, the parameter file sets it" if name in PARAMETERS else ""
    return DeclareLaunchArgument(name, default_value=default, description=text)


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
    """Return the launch description of the node with its arguments."""
    large_clouds = SetEnvironmentVariable(
        "FASTRTPS_DEFAULT_PROFILES_FILE",
        str(config_dir() / "fastdds.xml"),
        condition=IfCondition(LaunchConfiguration("large_clouds")),
    )
    return LaunchDescription([*map(_argument, ARGUMENTS), large_clouds, OpaqueFunction(function=_node)])
