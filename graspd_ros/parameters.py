"""Parameters of the node. The fields of `Settings` give the type, default, range and description of each parameter."""

from __future__ import annotations

import array
import dataclasses
import difflib
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.validate_topic_name import validate_topic_name

from graspd_core import load_preset
from graspd_core.config import VERIFICATIONS, load_scene_config
from graspd_core.errors import ConfigError, GraspdError
from graspd_core.perception.scene import MASSES
from graspd_ros.outputs.messages import GEOMETRIES, PARTS, USUAL_PARTS
from graspd_ros.worker import BusyPolicy

CLOUD_POLICIES = ("newest", "each", "off")
MOST_GRASPS = 256
BUDGETS = (0.1, 3600.0)  # valid time limits of a request [s]
SCALES = (1e-6, 1e6)
_CORNERS = ("roi_min", "roi_max", "view_point")
WORKSPACE = 10.0  # default limit of the cloud coordinates [m]. Depth sensors for grasping see less far


def _setting(
    default: Any,
    description: str,
    *,
    limits: tuple[float, float] | None = None,
    choices: Iterable[str] = (),
    check: Callable[[Any], object] | None = None,
    read_only: bool = False,
) -> Any:
    metadata = {"description": description, "limits": limits, "choices": tuple(choices)}
    metadata |= {"check": check, "read_only": read_only}
    if isinstance(default, list):
        return dataclasses.field(default_factory=lambda: list(default), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def _check_device(name: str) -> None:
    import torch

    try:
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError):  # torch's build decides which error is raised
        valid = ["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
        raise ConfigError(f"{name!r} is not a device of this machine; valid: {', '.join(valid)}") from None


def _check_arm(name: str) -> None:
    from graspd_core import load_arm
    from graspd_core.arms.arm import from_robot_description, read_arm_file

    if not from_robot_description(read_arm_file(name)[1]):
        load_arm(name)


def _check_library(path: str) -> None:
    from graspd_core.library.grasp_library import GraspLibrary

    GraspLibrary(Path(path)).checked()


def _check_topic(name: str) -> None:
    try:
        validate_topic_name(name)
    except InvalidTopicNameException:
        raise ConfigError(f"{name!r} is not a topic name; valid: a name such as /collision_object") from None


def _check_corner(corner: Any) -> None:
    if not _numbers(corner) or len(corner) != 3 or not np.isfinite(corner).all():
        raise ConfigError(f"{corner} is not a position; valid: three finite numbers x, y, z [m]")


def _check_parts(parts: Any) -> None:
    unknown = [part for part in parts or [] if part not in PARTS]
    if unknown:
        raise ConfigError(f"{unknown[0]!r} is not one of {', '.join(PARTS)}")


@dataclass(frozen=True)
class Settings:
    """Values of the parameters at the time of a request. `ros2 param describe` shows the descriptions."""

    hand: str = _setting("allegro_right", "name of a built-in hand, or path of a hand description", read_only=True)
    hand_prefix: str = _setting(
        "", "prefix of the names of the hand's joints and links, for a robot with several hands", read_only=True
    )
    arm: str = _setting(
        "",
        "name of a built-in arm, or path of an arm description; only grasps within its reach are tried; empty: no arm",
        check=_check_arm,
    )
    arm_base_frame: str = _setting("", "frame of the arm's base in /tf; empty: the name of the arm's base link")
    device: str = _setting("cpu", "torch device of the optimiser", check=_check_device, read_only=True)
    torch_threads: int = _setting(
        1,
        "number of threads for optimiser and trials; several are slower on a busy machine",
        limits=(1, 64),
        read_only=True,
    )
    queue_size: int = _setting(4, "number of requests that may wait", limits=(0, 64), read_only=True)
    busy_policy: str = _setting("queue", "treatment of a request while the node is busy", choices=BusyPolicy)
    cloud_policy: str = _setting(
        "newest",
        "newest: a cloud waits until the node is idle, and a newer cloud replaces it; each: every cloud is a request "
        "under busy_policy; off: a cloud starts no request",
        choices=CLOUD_POLICIES,
    )
    cloud_max_age: float = _setting(
        5.0, "greatest age of clouds and depth images, older ones are refused [s]; 0: any age", limits=(0.0, 1e6)
    )
    segment: bool = _setting(True, "whether the object is cut out of the cloud; false: clouds show only the object")
    voxel_size: float = _setting(0.0, "clouds keep one point per cube of this side [m]; 0: all points", limits=(0, 1))
    roi_min: list[float] = _setting(
        [-WORKSPACE] * 3, "lower corner of the workspace, in the frame of the cloud [m]", check=_check_corner
    )
    roi_max: list[float] = _setting(
        [WORKSPACE] * 3, "upper corner of the workspace, in the frame of the cloud [m]", check=_check_corner
    )
    sensor_frame: str = _setting(
        "", "frame in /tf whose origin is the position of the camera, for clouds; empty: the frame of the cloud"
    )
    view_point: list[float] = _setting(
        [0.0] * 3,
        "position of the camera of the clouds, in the frame of the cloud [m]; all 0: use sensor_frame",
        check=_check_corner,
    )
    scene_config: str = _setting(
        "",
        "path of a yaml file with settings for segmentation, reconstruction and obstacles, as for `--scene`; "
        "empty: the defaults",
        check=load_scene_config,
    )
    collision_objects: str = _setting(
        "",
        "topic of moveit_msgs/CollisionObject, such as /collision_object; its objects are obstacles of later requests; "
        "empty: no topic",
        check=_check_topic,
        read_only=True,
    )
    grasp_library: str = _setting(
        "",
        "path of a grasp library from `graspd library build`; it answers requests for its objects, and grasps planned "
        "for meshes are added; empty: no library",
        check=_check_library,
    )
    fixed_frame: str = _setting("", "frame of the views of ~/add_view, in /tf; empty: the frame of the first view")
    output_frame: str = _setting("", "frame of the results in /tf; empty: the frame of the input")
    num_grasps: int = _setting(8, "number of grasps to find and verify", limits=(1, MOST_GRASPS))
    preset: str = _setting("balanced", "name of a built-in preset, or path of a preset file", check=load_preset)
    verify: str = _setting("standard", "trials that a grasp must pass", choices=VERIFICATIONS)
    deadline: float = _setting(60.0, "time limit of a request [s]", limits=BUDGETS)
    seed: int = _setting(0, "seed of all random draws", limits=(0, 2**63 - 1))
    mass: float = _setting(
        0.0, "mass of the object [kg]; 0: unknown, the largest likely mass for its volume", limits=(0.0, MASSES[1])
    )
    friction: float = _setting(0.6, "friction coefficient between hand and object", limits=(0.01, 5.0))
    mesh_scale: float = _setting(1.0, "metres per unit of a mesh", limits=SCALES)
    mesh_frame: str = _setting("object", "frame id of grasps on a mesh if the request gives none: the mesh's frame")
    mesh_roots: list[str] = _setting(
        [".", "package://graspd_ros"], "directories from which meshes may be read: paths or package://NAME"
    )
    progress_rate: float = _setting(10.0, "greatest rate of progress reports [Hz]", limits=(0.1, 10.0))
    joint_speed: float = _setting(
        1.0, "greatest speed of the finger joints in a trajectory [rad/s]", limits=(0.01, 100.0)
    )
    base_speed: float = _setting(0.05, "greatest speed of the hand's base in a trajectory [m/s]", limits=(0.001, 10.0))
    base_turn: float = _setting(
        0.5, "greatest angular speed of the hand's base in a trajectory [rad/s]", limits=(0.01, 100.0)
    )
    shortest_stage: float = _setting(1.0, "least duration of each stage of a trajectory [s]", limits=(0.01, 100.0))
    publish_markers: bool = _setting(True, "whether ~/markers shows the result")
    marker_grasps: int = _setting(1, "number of best grasps that ~/markers shows", limits=(0, MOST_GRASPS))
    marker_parts: list[str] = _setting(
        list(USUAL_PARTS), f"what ~/markers shows: any of {', '.join(PARTS)}", check=_check_parts
    )
    marker_geometry: str = _setting(
        "visual",
        "shapes that ~/markers draws for the hand: visual (of its URDF) or collision (used by planning)",
        choices=GEOMETRIES,
    )
    output_dir: str = _setting("", "directory for result files <request id>.json (graspd/grasps); empty: no files")


class LiveSettings:
    """Settings of a node, updated when a parameter changes. `now` has the current values. Warnings are logged.

    `frames` returns the frames in /tf. Raises ConfigError if a start value is not a valid choice, and rclpy's
    ParameterException if a value has a wrong type or is out of range.
    """

    def __init__(self, node: Node, frames: Callable[[], Sequence[str]] = tuple) -> None:
        fields, defaults = dataclasses.fields(Settings), Settings()
        for setting in fields:
            node.declare_parameter(setting.name, getattr(defaults, setting.name), _descriptor(setting))
        for setting in fields:
            _check_value(setting.name, node.get_parameter(setting.name).value)
        self._node, self._frames = node, frames
        # Convert integers of float parameters once, so that clients always see a float.
        given = [node.get_parameter(setting.name) for setting in fields if not setting.metadata["read_only"]]
        node.set_parameters(_of_their_types(given))
        for warning in unknown_names(node):
            node.get_logger().warning(warning)
        self._warnings: list[str] = []
        self._changed([])
        node.add_pre_set_parameters_callback(_of_their_types)
        node.add_on_set_parameters_callback(check_parameters)
        node.add_post_set_parameters_callback(self._changed)

    def _changed(self, changed: list[Parameter]) -> None:
        fields = dataclasses.fields(Settings)
        values: dict[str, Any] = {s.name: _word(s, self._node.get_parameter(s.name).value) for s in fields}
        for name in ("mesh_roots", "marker_parts"):
            values[name] = list(values[name] or [])
        self.now = Settings(**values)
        names, before = {parameter.name for parameter in changed}, self._warnings
        self._warnings = parameter_warnings(self.now) + _unknown_frames(self.now, names, tuple(self._frames()))
        for warning in self._warnings:
            if warning not in before:
                self._node.get_logger().warning(warning)


def unknown_names(node: Node) -> list[str]:
    """Return a warning for each unknown parameter name given at the start."""
    found, known = [], [setting.name for setting in dataclasses.fields(Settings)]
    # rclpy has no public function for start parameters, and does not report undeclared parameters.
    for name in getattr(node, "_parameter_overrides", {}):
        if not node.has_parameter(name) and not name.startswith("qos_overrides."):
            near = difflib.get_close_matches(name, known, 1)
            found.append(f"unknown parameter {name!r}; " + (f"did you mean {near[0]!r}?" if near else "it is ignored"))
    return found


def parameter_warnings(settings: Settings) -> list[str]:
    """Return warnings about values that make requests fail: an empty workspace, or mesh roots that do not exist."""
    found = []
    if any(low > high for low, high in zip(settings.roi_min, settings.roi_max, strict=True)):
        found.append(f"roi_min={settings.roi_min} is above roi_max={settings.roi_max}: no point lies in the workspace")
    for root in settings.mesh_roots:
        if not root.startswith("package://") and not Path(root).is_dir():
            found.append(f"mesh_roots: {root!r} is not a directory")
    return found


def _unknown_frames(settings: Settings, changed: Collection[str], known: Sequence[str]) -> list[str]:
    """Return a warning for each changed parameter whose frame is not in /tf. No warnings if /tf is still empty."""
    found = []
    for name in ("sensor_frame", "output_frame", "fixed_frame", "arm_base_frame"):
        frame = getattr(settings, name).removeprefix("/")
        if name in changed and frame and known and frame not in known:
            found.append(f"parameter {name}: frame {frame!r} is not in /tf yet; known: {', '.join(known)}")
    return found


def _of_their_types(parameters: list[Parameter]) -> list[Parameter]:
    """Convert parameters to the types of `Settings`: integers to floats where needed, and YAML's false to `off`."""
    kept = []
    for parameter in parameters:
        setting = Settings.__dataclass_fields__.get(parameter.name)
        value = parameter.value if setting is None else _word(setting, parameter.value)
        kept.append(parameter if value is parameter.value else Parameter(parameter.name, value=value))
    return kept


# Valid QoS overrides by policy. For other values, rclpy ends the node with a traceback.
_QOS = {
    "reliability": ("reliable", "best_effort", "best_available", "system_default"),
    "history": ("keep_last", "keep_all", "system_default"),
    "depth": range(2**31),
}


def check_parameters(parameters: list[Parameter]) -> SetParametersResult:
    """Check the values, which ROS checks only in part. Return whether all are valid, and the reason if not."""
    try:
        for parameter in parameters:
            _check_value(parameter.name, parameter.value)
    except ConfigError as error:
        return SetParametersResult(successful=False, reason=str(error))
    return SetParametersResult(successful=True)


def _check_value(name: str, value: Any) -> None:
    setting = Settings.__dataclass_fields__.get(name)
    if setting is None:  # a parameter that ROS adds to every node
        valid = _QOS.get(name.rpartition(".")[2], ()) if name.startswith("qos_overrides.") else ()
        if valid and (value.lower() if isinstance(value, str) else value) not in valid:
            text = f"{valid[0]} to {valid[-1]}" if isinstance(valid, range) else ", ".join(valid)
            raise ConfigError(f"parameter {name}: {value!r}; valid: {text}")
        return
    choices, check, value = setting.metadata["choices"], setting.metadata["check"], _word(setting, value)
    if _is_number(setting):
        low, high = setting.metadata["limits"]
        if not _is_number_like(value):
            raise ConfigError(f"parameter {name}: {value!r} is not a number; valid: a number such as 1.0")
        if not low <= value <= high:
            raise ConfigError(f"parameter {name}: {value!r}; valid: {low:g} to {high:g}")
    if choices and value not in choices:
        raise ConfigError(f"parameter {name}: {value!r} is not one of {', '.join(choices)}")
    if check is not None and not (value == setting.default == ""):  # by default, "" switches a part of the node off
        try:
            check(value)
        except GraspdError as error:
            raise ConfigError(f"parameter {name}: {error}") from None


def _word(setting: dataclasses.Field, value: Any) -> Any:
    """Convert a value to its field's type. YAML reads an unquoted `off` as a boolean and `1` as an integer."""
    if isinstance(value, int) and not isinstance(value, bool) and _is_number(setting):
        return float(value)
    if setting.name in _CORNERS:
        return [float(number) for number in value] if _numbers(value) else value
    if isinstance(value, bool) and "off" in setting.metadata["choices"]:
        return "on" if value else "off"
    return value


def _is_number(setting: dataclasses.Field) -> bool:
    return isinstance(setting.default, float)


def _is_number_like(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _numbers(values: Any) -> TypeGuard[list[float]]:
    return isinstance(values, list | tuple | array.array) and all(_is_number_like(value) for value in values)


def _descriptor(setting: dataclasses.Field) -> ParameterDescriptor:
    choices = setting.metadata["choices"]
    descriptor = ParameterDescriptor(
        description=setting.metadata["description"],
        read_only=setting.metadata["read_only"],
        # This module checks these types, because ROS would refuse 5 for 5.0.
        dynamic_typing="off" in choices or _is_number(setting) or setting.name in _CORNERS,
        additional_constraints=f"one of {', '.join(choices)}" if choices else "",
    )
    if setting.metadata["limits"] is not None:
        low, high = setting.metadata["limits"]
        if _is_number(setting):
            descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
        else:
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    return descriptor
