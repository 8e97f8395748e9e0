"""What parameters may be set to while the node runs."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from rclpy.node import Node
from rclpy.parameter import Parameter

from graspd_core import PointCloud
from graspd_core.paths import config_dir
from graspd_ros.inputs.sensor_frames import scene_of_views
from graspd_ros.inputs.tf_listener import check_arm
from graspd_ros.parameters import LiveSettings, Settings, check_parameters


@pytest.mark.parametrize(
    ("name", "value", "culprit"),
    [
        ("busy_policy", "perhaps", "reject, queue, replace"),
        ("cloud_policy", True, "'on' is not one of newest, each, off"),
        ("cloud_policy", 3, "3 is not one of newest, each, off"),
        ("preset", "no_such_preset", "unknown preset 'no_such_preset'; valid: "),
        ("preset", "/no/such/preset.yaml", "preset /no/such/preset.yaml: no such file"),
        ("scene_config", "none.yaml", "none.yaml: No such file"),
        ("roi_min", [0.0, 1.0], "three finite numbers"),
        ("roi_max", [0.0, 1.0, math.nan], "three finite numbers"),
        ("view_point", "here", "three finite numbers"),
        ("arm", "ur99", "unknown arm 'ur99'; valid: "),
        ("collision_objects", "bad topic", "'bad topic' is not a topic name; valid: a name such as /collision_object"),
        ("deadline", "soon", "'soon' is not a number"),
        ("deadline", True, "True is not a number"),
        ("deadline", 0, "0.0; valid: 0.1 to 3600"),
        *(("base_turn", value, f"{value}; valid: 0.01 to 100") for value in (0.0, -1.0, math.inf, math.nan)),
    ],
)
def test_what_is_no_choice_is_refused_by_name(name, value, culprit):
    answer = check_parameters([Parameter(name, value=value)])
    assert not answer.successful
    assert answer.reason.startswith(f"parameter {name}: ")
    assert culprit in answer.reason


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("cloud_policy", "off"),
        ("cloud_policy", False),  # what YAML makes of an unquoted off
        ("scene_config", ""),
        ("arm", ""),
        ("arm", "ur5e_like"),
        ("roi_min", [-1.0, -1.0, 0.0]),
        ("use_sim_time", True),
        ("deadline", 5),
        ("roi_min", [-1, -1, 0]),
        ("collision_objects", "~/collision_object"),
    ],
)
def test_choices_are_taken(name, value):
    assert check_parameters([Parameter(name, value=value)]).successful


def test_an_arm_is_refused_if_its_urdf_is_broken_or_was_not_heard(tmp_path: Path):
    path = tmp_path / "arm.yaml"
    path.write_text("urdf: arm.urdf\ntip: tip\n")
    (tmp_path / "arm.urdf").write_text("<robot")
    changed = [Parameter("arm", value=str(path))]
    for answer in (check_parameters(changed), check_arm(changed, "")):
        assert not answer.successful
        assert answer.reason.startswith(f"parameter arm: {tmp_path / 'arm.urdf'}: not well-formed XML")
    path.write_text("urdf: robot_description\ntip: tip\n")
    assert check_parameters(changed).successful  # at the start, when the topic is still to be heard
    assert "which the node reads only at its start" in check_arm(changed, "").reason
    robot = (config_dir() / "arms" / "panda_like.urdf").read_text()
    assert "tip" in check_arm(changed, robot).reason
    path.write_text(
        (config_dir() / "arms" / "panda_like.yaml").read_text().replace("panda_like.urdf", "robot_description")
    )
    assert check_arm(changed, robot).successful


def test_a_scene_file_sets_the_reconstruction_and_is_refused_by_its_key(tmp_path: Path):
    path = tmp_path / "scene.yaml"
    path.write_text("reconstruction: {max_faces: 300}")
    assert check_parameters([Parameter("scene_config", value=str(path))]).successful
    points = np.random.default_rng(0).normal(size=(2000, 3))
    ball = PointCloud(0.04 * points / np.linalg.norm(points, axis=1, keepdims=True), np.array([0.5, 0.0, 0.3]))
    scene = scene_of_views((ball,), Settings(segment=False, scene_config=str(path)), None)
    assert len(scene.object.mesh.faces) <= 300
    path.write_text("reconstruction: {most_faces: 300}")
    answer = check_parameters([Parameter("scene_config", value=str(path))])
    told = f"parameter scene_config: {path}:1: reconstruction: unknown key 'most_faces'"
    assert answer.reason.startswith(told)


@pytest.fixture
def started(make_node) -> Callable[..., tuple[Node, LiveSettings]]:
    """Makes what a node makes of its arguments."""

    def started(*arguments: str, frames: tuple[str, ...] = ()) -> tuple[Node, LiveSettings]:
        node = make_node(*(part for given in arguments for part in ("-p", given)))
        return node, LiveSettings(node, lambda: frames)

    return started


def test_an_integer_is_taken_where_a_number_is_meant_and_doubts_are_told(started, tmp_path: Path, capfd):
    _, live = started(
        "deadline:=5", "roi_min:=[-1, -1, 0]", f"mesh_roots:=[{tmp_path}]", "view_point:=[0, 0, 1]", "cloud_policy:=off"
    )
    settings = live.now
    assert (settings.deadline, settings.roi_min, settings.view_point) == (5.0, [-1.0, -1.0, 0.0], [0.0, 0.0, 1.0])
    assert isinstance(settings.deadline, float)
    assert "[WARN]" not in "".join(capfd.readouterr())
    started("num_grasp:=3", "nothing_like_it:=1", "roi_min:=[20.0, 0.0, 0.0]", "mesh_roots:=[/no/such/place]")
    told = "".join(capfd.readouterr())
    assert "unknown parameter 'num_grasp'; did you mean 'num_grasps'?" in told
    assert "unknown parameter 'nothing_like_it'; it is ignored" in told
    assert "is above roi_max" in told
    assert "mesh_roots: '/no/such/place' is not a directory" in told


def test_who_describes_a_parameter_sees_the_same_type_whatever_was_set(started):
    node, live = started("deadline:=5", "roi_min:=[-1, -1, 0]", "cloud_policy:=off")
    names = ("mass", "deadline", "roi_min", "roi_max", "cloud_policy")
    kinds = {name: node.describe_parameter(name).type for name in names}
    numbers, word = Parameter.Type.DOUBLE_ARRAY.value, Parameter.Type.STRING.value
    assert kinds == {"mass": 3, "deadline": 3, "roi_min": numbers, "roi_max": numbers, "cloud_policy": word}
    # As `ros2 param set` sends `mass 1`, `roi_max "[1, 1, 2]"` and `cloud_policy off`.
    given = {"mass": 1, "deadline": 7, "roi_min": [0, 0, 0], "roi_max": [1, 1, 2], "cloud_policy": False}
    results = node.set_parameters([Parameter(name, value=value) for name, value in given.items()])
    assert all(result.successful for result in results)
    assert {name: node.describe_parameter(name).type for name in names} == kinds
    assert node.get_parameter("mass").value == 1.0
    assert node.get_parameter("cloud_policy").value == "off"
    assert (live.now.mass, live.now.roi_max, live.now.cloud_policy) == (1.0, [1.0, 1.0, 2.0], "off")
    (refused,) = node.set_parameters([Parameter("mass", value="heavy")])
    assert not refused.successful


def test_what_is_warned_of_at_the_start_is_warned_of_while_the_node_runs(started, capfd):
    node, _ = started(frames=("base_link", "camera_depth_optical_frame"))
    capfd.readouterr()
    for name, value, told in (
        ("roi_max", [-20.0, 1.0, 1.0], "roi_max=[-20.0, 1.0, 1.0]: no point lies in the workspace"),
        ("mesh_roots", ["/no/such/place"], "mesh_roots: '/no/such/place' is not a directory"),
        ("sensor_frame", "camera", "parameter sensor_frame: frame 'camera' is not in /tf yet; known: base_link, cam"),
    ):
        (result,) = node.set_parameters([Parameter(name, value=value)])
        assert result.successful
        assert "".join(capfd.readouterr()).count(told) == 1
        node.set_parameters([Parameter("seed", value=1)])
        assert told not in "".join(capfd.readouterr())
    node.set_parameters([Parameter("sensor_frame", value="/base_link")])
    assert "sensor_frame" not in "".join(capfd.readouterr())


def test_the_shipped_parameter_file_holds_every_parameter_at_its_default():
    shipped = yaml.safe_load((config_dir() / "graspd.yaml").read_text())["/**"]["ros__parameters"]
    assert shipped == dataclasses.asdict(Settings())


def test_settings_follow_the_parameters(started):
    node, settings = started()
    before = settings.now
    node.set_parameters([Parameter("seed", value=7), Parameter("deadline", value=-1.0)])
    assert (settings.now.seed, settings.now.deadline, before.seed) == (7, 60.0, 0)
