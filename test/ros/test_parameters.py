"""What parameters may be set to while the node runs."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from rclpy.parameter import Parameter

from graspd_core import PointCloud
from graspd_ros.inputs.sensor_frames import scene_of_views
from graspd_ros.parameters import Settings, check_parameters


@pytest.mark.parametrize(
    ("name", "value", "culprit"),
    [
        ("busy_policy", "perhaps", "reject, queue, replace"),
        ("cloud_policy", True, "'on' is not one of newest, each, off"),
        ("cloud_policy", 3, "3 is not one of newest, each, off"),
        ("preset", "no_such_preset", "valid presets"),
        ("scene_config", "none.yaml", "none.yaml: No such file"),
        ("roi_min", [0.0, 1.0], "three finite numbers"),
        ("roi_max", [0.0, 1.0, math.nan], "three finite numbers"),
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
        ("roi_min", [-1.0, -1.0, 0.0]),
        ("use_sim_time", True),
    ],
)
def test_choices_are_taken(name, value):
    assert check_parameters([Parameter(name, value=value)]).successful


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
    assert answer.reason.startswith("parameter scene_config: scene.yaml.reconstruction: unknown key 'most_faces'")
