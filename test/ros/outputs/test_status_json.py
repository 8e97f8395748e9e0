"""Grasps as messages and as lines of JSON."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import yaml
from builtin_interfaces.msg import Time

from graspd_core.hands.library import load_hand
from graspd_core.paths import config_dir
from graspd_core.types import (
    Grasp,
    GraspMetrics,
    GraspResult,
    Outcome,
    Posture,
    Progress,
    Stage,
    Timing,
    TrialResult,
    Verdict,
)
from graspd_ros.outputs import status_json as convert
from graspd_ros.parameters import Settings


def grasp(verdict: Verdict) -> Grasp:
    posture = Posture(np.array([1.0, 2.0, 3.0]), np.array([0.5, 0.1, -0.7, 0.5]), np.array([0.25, -1.0]))
    hold = TrialResult("hold", verdict is Verdict.VERIFIED, 0.002, 0.01)
    trials = () if verdict is Verdict.UNVERIFIED else (hold,)
    return Grasp(posture, posture, posture, (), score=1.5, metrics=GraspMetrics({"penetration": 0.001}), trials=trials)


def result(*grasps: Grasp) -> GraspResult:
    return GraspResult(Outcome.TOO_FEW, grasps, Timing(total=1.0), seed=0, method="closed_form")


def test_the_pose_names_its_frame_and_turns_wxyz_to_xyzw():
    message = convert.pose_message(grasp(Verdict.VERIFIED), "camera", Time(sec=7))
    assert message.header.frame_id == "camera"
    assert message.header.stamp.sec == 7
    orientation = message.pose.orientation
    assert (orientation.w, orientation.x, orientation.y, orientation.z) == (0.5, 0.1, -0.7, 0.5)
    assert (message.pose.position.x, message.pose.position.y, message.pose.position.z) == (1.0, 2.0, 3.0)


def test_the_joint_state_names_its_joints_and_carries_positions_only():
    hand = load_hand("parallel_gripper", candidates=8)
    posture = dataclasses.replace(grasp(Verdict.VERIFIED).grasp, joint_positions=np.array([0.0625]))
    message = convert.joint_message(posture, hand, Time())
    assert message.header.frame_id == "base_link"
    # The jaw that follows the other has its own value.
    assert list(message.name) == ["left_jaw", "right_jaw"]
    assert list(message.position) == [0.0625, 0.0625]
    assert not message.velocity
    assert not message.effort


def test_a_grasp_known_to_be_bad_is_not_presented():
    good, unknown, bad = (grasp(v) for v in (Verdict.VERIFIED, Verdict.UNVERIFIED, Verdict.FAILED))
    assert convert.presentable(result(good, bad)) is good
    assert convert.presentable(result(unknown)) is unknown
    assert convert.presentable(result(bad)) is None
    assert convert.presentable(result()) is None
    event = convert.result_event(result(bad))
    assert (event["best"], event["grasps"], event["verified"]) == (None, 1, 0)


def test_every_event_is_one_line_of_json_without_nan():
    odd = {
        "a": float("nan"),
        "b": [np.float32(1.5), np.inf],
        "c": {"d": np.int64(3)},
        "e": "two\nlines",
        "f": Stage.LOAD,
    }
    line = convert.status_line(odd)
    assert "\n" not in line
    assert json.loads(line) == {"a": None, "b": [1.5, None], "c": {"d": 3}, "e": "two\nlines", "f": "load"}
    progress = Progress(Stage.OPTIMISE, 5, 10, float("inf"), 0, 0.5)
    assert json.loads(convert.status_line(convert.progress_event(progress)))["fraction"] == 0.5
    summary = json.loads(convert.status_line(convert.result_event(result(grasp(Verdict.VERIFIED)))))
    assert summary["best"]["metrics"]["penetration_mm"] == 1.0
    assert summary["best"]["metrics"]["epsilon"] is None
    assert summary["best"]["trials"] == [
        {"name": "hold", "passed": True, "displacement": 0.002, "rotation": 0.01, "reason": ""}
    ]
    assert summary["outcome"] == "too_few"


def test_the_shipped_parameter_file_holds_every_parameter_at_its_default():
    shipped = yaml.safe_load((config_dir() / "graspd.yaml").read_text())["/**"]["ros__parameters"]
    assert shipped == dataclasses.asdict(Settings())
