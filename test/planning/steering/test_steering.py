"""Grasps come from where they are asked to, touch what they are asked to, and enter no avoided box."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from graspd_core import Verdict, load_hand, load_scene, plan_grasps
from graspd_core.errors import ConfigError
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.mesh.shapes import make_shape
from graspd_core.mesh.topology import moved_mesh
from graspd_core.optimize.initial_poses import draw_starts
from graspd_core.optimize.restrictions import BoundRestrictions, Refusal, Roll
from graspd_core.planning.regions import Box, NearPoints, Sphere, entered
from graspd_core.planning.steering import (
    CONTACT_TOLERANCE,
    Steering,
    angle_of_approach,
    hand_side,
    outside_region,
    untouched_part,
)
from graspd_core.se3 import axis_rotation
from graspd_core.types import Outcome, Plane

HANDS = ("allegro_right", "allegro_left", "leap_right", "barrett_like", "parallel_gripper")
DOWN = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def bottle():
    return load_scene("shape:bottle")


@pytest.fixture(scope="module")
def hand():
    return load_hand("allegro_right")


def plan(scene, hand, steering, **settings):
    options = {"count": 3, "preset": "fast", "measure": False, **settings}
    return plan_grasps(scene, hand, restrictions=[steering], **options)


@pytest.mark.parametrize("name", HANDS)
def test_starts_are_drawn_inside_cone_and_roll(bottle, name):
    hand = load_hand(name)
    steering = Steering(approach_direction=(2.0, 1.0, -1.0), approach_angle=0.4, roll=1.0, roll_tolerance=0.2)
    bound = steering.bind(bottle, hand)
    starts = draw_starts(bottle, hand, 30, 5, "cpu", torch.float64, restrictions=BoundRestrictions((bound,)))
    rotation = starts.base.rotation
    approach = rotation @ torch.as_tensor(hand.approach)
    wanted = torch.tensor([2.0, 1.0, -1.0], dtype=torch.float64)
    assert (approach @ wanted / wanted.norm() >= np.cos(0.4)).all()
    assert bound.wanted.roll is not None
    assert (bound.wanted.roll.missing(approach, rotation).abs() <= 0.2).all()
    # They differ among each other, and face the object.
    assert approach.std(0).max() > 0.01
    palms = starts.translation + (rotation @ torch.as_tensor(hand.palm_center))
    ahead = (torch.as_tensor(bottle.object.center_of_mass) - palms) * approach
    assert (ahead.sum(-1) > 0).double().mean() > 0.8


def test_a_roll_is_measured_right_handed_about_the_approach_from_upright():
    side, up = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    approach = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    for angle in (-3.0, -0.5, 0.0, 0.7, 3.1):
        # Turns y, the hand's side, to z, and on by the angle about x.
        turned = axis_rotation(np.array([1.0, 0, 0]), np.pi / 2 + angle)
        missing = Roll(side, up, angle, 0.1).missing(approach, torch.as_tensor(turned)[None])
        assert abs(float(missing)) < 1e-9


@pytest.mark.parametrize("name", HANDS)
def test_a_hands_side_is_square_to_its_approach(name):
    hand = load_hand(name)
    side = hand_side(hand)
    assert abs(side @ hand.approach) < 1e-9
    assert abs(np.linalg.norm(side) - 1) < 1e-9


def test_the_side_of_a_hand_is_where_its_fingers_are_and_of_a_gripper_where_it_closes(hand):
    assert hand_side(hand) @ np.array([0.0, 0.0, 1.0]) > 0.9
    gripper = load_hand("parallel_gripper")
    assert np.allclose(np.abs(hand_side(gripper)), np.abs(hand_side(gripper)).round(), atol=1e-6)


def test_verified_grasps_are_inside_cone_and_roll_and_the_rest_is_counted(bottle, hand):
    steering = Steering(approach_direction=DOWN + np.array([0.0, 1.0, 0.0]), approach_angle=0.5, roll=0.3)
    found = plan(bottle, hand, steering)
    assert found.grasps
    assert found.grasps[0].verdict is Verdict.VERIFIED
    bound = steering.bind(bottle, hand)
    for grasp in found.grasps:
        assert angle_of_approach(hand, grasp, np.array([0.0, 1.0, -1.0]) / np.sqrt(2)) <= 0.5 + 1e-6
        assert bound.admit([grasp])[0] is grasp
    if found.refused:
        assert "approach cone of 29 degrees" in found.message or "roll" in found.message


def test_contacts_lie_in_the_region_whatever_kind_it_is(bottle, hand):
    low, high = bottle.object.mesh.vertices.min(0), bottle.object.mesh.vertices.max(0)
    top = Box((low + high) / 2 - (high - low)[2] / 4 * DOWN, (1.0, 1.0, (high - low)[2] / 2))
    seen = bottle.object.mesh.vertices[top.distance(bottle.object.mesh.vertices) <= 0]
    for region in (top, Sphere(top.center, 0.08), NearPoints(seen, 0.02)):
        found = plan(bottle, hand, Steering(region=region))
        good = [grasp for grasp in found.grasps if grasp.verdict is Verdict.VERIFIED]
        assert good, found.message
        assert all(outside_region(region, grasp) <= CONTACT_TOLERANCE for grasp in found.grasps)


def test_the_untouched_part_is_the_object_outside_the_region(bottle):
    middle = bottle.object.mesh.vertices.mean(0)
    half = Box(middle - 0.5 * DOWN, (1.0, 1.0, 1.0))
    rest = untouched_part(bottle, half)
    gap = sample_sdf(rest.sdf, torch.as_tensor(bottle.object.mesh.vertices).float())[0].numpy()
    above = half.distance(bottle.object.mesh.vertices)
    assert (gap[above > 0.015] < 0.0).all()
    assert (gap[above < -0.005] > 0.0).all()


def test_the_search_is_pulled_into_the_region_by_a_true_gradient(bottle):
    """Value and gradient of the distance that the loss takes, by central differences where it has no kink."""
    region = Sphere(bottle.object.mesh.vertices.mean(0) - 0.05 * DOWN, 0.06)
    sdf = untouched_part(bottle, region).sdf.to("cpu", torch.float64)
    generator = torch.Generator().manual_seed(1)
    low, high = sdf.origin, sdf.origin + 2 * sdf.half
    points = low + (high - low) * torch.rand(300, 3, generator=generator, dtype=torch.float64)
    points.requires_grad_(True)
    value = sample_sdf(sdf, points)[0]
    (gradient,) = torch.autograd.grad(value.sum(), points)
    step = 1e-6
    for axis in range(3):
        ahead, behind = (sample_sdf(sdf, points.detach() + s * torch.eye(3)[axis])[0] for s in (step, -step))
        numeric = (ahead - behind) / (2 * step)
        close = (gradient[:, axis] - numeric).abs() < 1e-4
        # A point in three hundred may lie within a step of the border of a cell.
        assert close.double().mean() > 0.98


def test_no_link_enters_an_avoided_box(bottle, hand):
    steering = Steering(avoid=[Box((0.0, 0.0, -0.5), (2.0, 2.0, 1.0))])
    free = plan_grasps(bottle, hand, count=6, preset="fast", measure=False)
    stages = ("pregrasp", "grasp", "squeeze")
    in_box = [entered(hand, [getattr(g, s) for s in stages], steering.avoid).any() for g in free.grasps]
    assert any(in_box)
    found = plan(bottle, hand, steering)
    assert found.outcome is Outcome.SUCCEEDED, found.message
    for grasp in found.grasps:
        assert not entered(hand, [getattr(grasp, s) for s in stages], steering.avoid).any()
    kept = steering.bind(bottle, hand).admit(free.grasps)
    assert [isinstance(answer, Refusal) for answer in kept] == in_box


def test_from_below_the_table_is_said_to_be_impossible_without_a_search_and_from_above_is_not(
    bottle, hand, monkeypatch
):
    monkeypatch.delattr("graspd_core.planning.rounds.find_candidates")
    low = float(bottle.object.mesh.vertices[:, 2].min())
    standing = replace(bottle, support=Plane(np.array([0.0, 0.0, 1.0]), low))
    found = plan(standing, hand, Steering(approach_direction=-DOWN))
    assert found.outcome is Outcome.NO_CANDIDATES
    assert found.message.startswith("approach_direction: nothing is left of it")
    for direction in (DOWN, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, -1.0])):
        assert Steering(approach_direction=direction).bind(standing, hand).impossible == ""


def test_what_cannot_be_met_says_which_wish_refused_the_rest(bottle, hand):
    corner = bottle.object.mesh.vertices[bottle.object.mesh.vertices[:, 2].argmin()]
    found = plan(bottle, hand, Steering(approach_direction=DOWN, region=Sphere(corner, 0.002)))
    assert not found.grasps
    assert found.message.startswith("0 candidates held")
    assert "with a contact outside the region" in found.message


@pytest.mark.parametrize(
    ("wishes", "said"),
    [
        ({"approach_direction": (0, 0, 0)}, "approach_direction: .*not all 0"),
        ({"approach_direction": (0, np.nan, 1)}, "approach_direction: .*3 finite numbers"),
        ({"approach_direction": (0, 1)}, "approach_direction: .*3 finite numbers"),
        ({"approach_direction": (0, 0, 1), "approach_angle": 0.0}, "approach_angle: 0 rad; valid"),
        ({"approach_direction": (0, 0, 1), "approach_angle": 3.2}, "approach_angle: 3.2 rad; valid"),
        ({"approach_direction": (0, 0, 1), "approach_angle": float("nan")}, "approach_angle: nan"),
        ({"approach_direction": (0, 0, 1), "roll": float("inf")}, "roll: inf"),
        ({"approach_direction": (0, 0, 1), "roll": 0, "roll_tolerance": -1}, "roll_tolerance: -1"),
        ({"approach_direction": (0, 0, 1), "approach_angle": 2.0, "roll": 0}, "roll: needs .*below pi/2"),
        ({"roll": 0.0}, "roll: needs approach_direction"),
        ({"approach_direction": (0, 0, 1), "roll": 0.0, "roll_zero": (0, 0, 2)}, "roll_zero: .*not along"),
    ],
)
def test_a_wish_that_makes_no_sense_is_refused(wishes, said):
    with pytest.raises(ConfigError, match=said):
        Steering(**wishes)


def test_a_region_off_the_object_or_in_an_avoided_box_is_refused(bottle, hand):
    with pytest.raises(
        ConfigError, match=r"region: no part of the object lies in it; the object goes from .* 0.9\d+ m"
    ):
        plan(bottle, hand, Steering(region=Sphere((1.1, 0.0, 0.0), 0.1)))
    both = Steering(region=Sphere((0.0, 0.0, 0.0), 1.0), avoid=[Box((1, 1, 1), (1, 1, 1)), Box((0, 0, 0), (2, 2, 2))])
    with pytest.raises(ConfigError, match="region: all of it that is on the object lies in avoid box 1"):
        plan(bottle, hand, both)


def test_steering_is_in_the_frame_of_the_scene_far_from_the_origin_too(hand):
    away = np.array([300.0, -200.0, 50.0])
    scene = load_scene(moved_mesh(make_shape("bottle"), away))
    top = Sphere(scene.object.mesh.vertices.mean(0), 0.09)
    found = plan(scene, hand, Steering(approach_direction=(1, 0, 0), region=top), count=4)
    assert found.grasps, found.message
    assert found.grasps[0].verdict is Verdict.VERIFIED
    assert max(outside_region(top, grasp) for grasp in found.grasps) <= CONTACT_TOLERANCE
    assert np.linalg.norm(found.grasps[0].grasp.position - away) < 0.5
