"""Where the node's arm stands: by /tf, from the frame of the object; and what a request with an arm answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from builtin_interfaces.msg import Time

from graspd_core import load_hand, load_scene
from graspd_core.arms.arm import arm_links, tip_hand
from graspd_core.errors import TransformError
from graspd_ros.convert import matrix_of_posture
from graspd_ros.inputs.tf_listener import reach_of
from graspd_ros.parameters import Settings
from graspd_ros.request import Request
from graspd_ros.request_planner import Planner

SETTINGS = Settings(num_grasps=1, preset="fast", deadline=100.0, verify="none", arm="panda_like")


def request(settings: Settings, pose: np.ndarray | None = None) -> Request:
    return Request("r", "mesh", "map", Time(), settings, lambda: load_scene("shape:box"), T_frame_object=pose)


def at(x: float, y: float, z: float) -> np.ndarray:
    """A pose turned by a quarter about z."""
    pose = np.eye(4)
    pose[:2, :2], pose[:3, 3] = [[0.0, -1.0], [1.0, 0.0]], [x, y, z]
    return pose


def test_the_base_is_placed_in_the_frame_of_the_object():
    asked: list[tuple[str, str]] = []

    def lookup(target: str, source: str) -> np.ndarray:
        asked.append((target, source))
        return at(-0.5, 0.0, 0.1)

    seen = reach_of(request(SETTINGS), lookup)
    assert asked == [("map", "base_link")]
    assert seen.position == pytest.approx((-0.5, 0.0, 0.1))
    assert seen.quaternion_wxyz == pytest.approx((np.sqrt(0.5), 0, 0, np.sqrt(0.5)))
    placed = reach_of(request(replace(SETTINGS, arm_base_frame="robot"), at(1.0, 2.0, 0.0)), lookup)
    assert asked[-1] == ("map", "robot")
    assert placed.position == pytest.approx((-2.0, 1.5, 0.1))
    assert abs(placed.quaternion_wxyz[0]) == pytest.approx(1.0)
    assert placed.arm is seen.arm, "what is known of an arm is kept"
    own = reach_of(request(replace(SETTINGS, arm_base_frame="map")), lookup)
    assert (len(asked), own.position) == (2, (0.0, 0.0, 0.0))


def test_a_planned_grasp_has_the_arm_s_joints_in_every_frame():
    """The object stands in `map`, the result is told in `out`: the arm's tip is where the grasp's pose says."""
    base, object_pose, T_out_map = at(0.5, 2.0, -0.1), at(1.0, 2.0, 0.0), at(3.0, 0.0, 0.0)

    def lookup(target: str, source: str, stamp: Time, stop: object) -> np.ndarray:
        return {("map", "base_link"): base, ("out", "map"): T_out_map}[target, source]

    hand = load_hand("barrett_like")
    settings = replace(SETTINGS, hand="barrett_like", output_frame="out")
    planned = Planner(hand, lookup).plan(request(settings, object_pose), lambda: False, lambda _: None)
    reach = reach_of(request(settings, object_pose), lambda target, source: base)
    for grasp in planned.result.grasps:
        assert grasp.arm is not None
        links = arm_links(reach.arm, torch.as_tensor(grasp.arm.at("grasp"))[None])
        carried = links[0, reach.arm.tip].compose(tip_hand(reach.arm, hand))
        world = T_out_map @ base
        told = matrix_of_posture(grasp.grasp)
        assert np.allclose(world[:3, :3] @ carried.translation.numpy() + world[:3, 3], told[:3, 3], atol=5e-4)
        assert np.allclose(world[:3, :3] @ carried.rotation.numpy(), told[:3, :3], atol=5e-3)


def test_a_base_that_tf_does_not_know_is_named_before_any_work():
    def lookup(target: str, source: str, stamp: Time, stop: object) -> np.ndarray:
        raise TransformError(f"{source} -> {target}: not connected")

    asked = replace(request(SETTINGS), load=lambda: pytest.fail("the object was read"))
    with pytest.raises(TransformError, match="base_link -> map"):
        Planner(load_hand("barrett_like"), lookup).plan(asked, lambda: False, lambda _: None)
