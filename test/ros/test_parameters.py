"""What parameters may be set to while the node runs."""

from __future__ import annotations

import math

import pytest
from rclpy.parameter import Parameter

from graspd_ros.parameters import check_parameters


@pytest.mark.parametrize(
    ("name", "value", "culprit"),
    [
        ("busy_policy", "perhaps", "reject, queue, replace"),
        ("cloud_policy", True, "'on' is not one of newest, each, off"),
        ("cloud_policy", 3, "3 is not one of newest, each, off"),
        ("preset", "no_such_preset", "valid presets"),
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
        ("roi_min", [-1.0, -1.0, 0.0]),
        ("use_sim_time", True),
    ],
)
def test_choices_are_taken(name, value):
    assert check_parameters([Parameter(name, value=value)]).successful
