"""Grasps come from where they are asked to, touch regions that they are asked to, and enter no avoided box."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from expected import some
from hypothesis import given
from hypothesis import strategies as st

from graspd_core import Verdict, draw_starts, hand_names, load_hand, load_scene, make_shape, plan_grasps
from graspd_core.errors import ConfigError
from graspd_core.hands.kinematics import link_poses
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.mesh.topology import moved_mesh
from graspd_core.optimize.restrictions import BoundRestrictions, Refusal, Roll
from graspd_core.perception.scene import near_scene
from graspd_core.planning.regions import Box, NearPoints, Sphere, boxes_in_reach, entered
from graspd_core.planning.steering import (
    CONTACT_TOLERANCE,
    Steering,
    angle_of_approach,
    hand_side,
    outside_region,
    untouched_part,
)
from graspd_core.se3 import axis_rotation, quaternion_from_rotation
from graspd_core.types import Outcome, Plane, Posture

DOWN = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def bottle():
    return load_scene("shape:bottle", mass=0.1)


def plan(scene, hand, steering, **settings):
    options = {"count": 3, "preset": "fast", "measure": False, **settings}
    return plan_grasps(scene, hand, restrictions=[steering], **options)


@pytest.mark.parametrize("name", hand_names())
def test_starts_are_drawn_inside_cone_and_roll(bottle, name):
    hand = load_hand(name)
    steering = Steering(approach_direction=(2.0, 1.0, -1.0), approach_angle=0.4, roll=1.0, roll_tolerance=0.2)
    bound = steering.bind(bottle, hand)
    starts = draw_starts(bottle, hand, 30, 5, "cpu", torch.float64, restrictions=BoundRestrictions((bound,)))
    rotation = starts.base.rotation
    approach = rotation @ torch.as_tensor(hand.approach)
    wanted = torch.tensor([2.0, 1.0, -1.0], dtype=torch.float64)
    assert (approach @ wanted / wanted.norm() >= np.cos(0.4)).all()
    assert (some(bound.wanted.roll).missing(approach, rotation).abs() <= 0.2).all()
    # They differ among each other, and face the object.
    assert approach.std(0).max() > 0.01
    palms = starts.translation + (rotation @ torch.as_tensor(hand.palm_center))
    ahead = (torch.as_tensor(bottle.object.center_of_mass) - palms) * approach
    assert (ahead.sum(-1) > 0).double().mean() > 0.8
    side = hand_side(hand)
    assert abs(side @ hand.approach) < 1e-9
    assert abs(np.linalg.norm(side) - 1) < 1e-9


def test_a_roll_is_measured_right_handed_about_the_approach_from_upright():
    side, up = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    approach = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    for angle in (-3.0, -0.5, 0.0, 0.7, 3.1):
        # Turns y, the hand's side, to z, and on by the angle about x.
        turned = axis_rotation(np.array([1.0, 0, 0]), np.pi / 2 + angle)
        missing = Roll(side, up, angle, 0.1).missing(approach, torch.as_tensor(turned)[None])
        assert abs(float(missing)) < 1e-9


def test_the_side_of_a_hand_is_where_its_fingers_are_and_of_a_gripper_where_it_closes(hand):
    assert hand_side(hand) @ np.array([0.0, 0.0, 1.0]) > 0.9
    gripper = load_hand("parallel_gripper")
    assert np.allclose(np.abs(hand_side(gripper)), np.abs(hand_side(gripper)).round(), atol=1e-6)


def test_verified_grasps_are_inside_cone_and_roll_and_the_rest_is_counted(bottle, hand):
    steering = Steering(approach_direction=DOWN + np.array([0.0, 1.0, 0.0]), approach_angle=0.5, roll=0.3)
    found = plan(bottle, hand, steering)
    assert found.tried
    assert found.tried[0].verdict is Verdict.VERIFIED
    bound = steering.bind(bottle, hand)
    for grasp in found.tried:
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
        good = [grasp for grasp in found.tried if grasp.verdict is Verdict.VERIFIED]
        assert good, found.message
        assert all(outside_region(region, grasp) <= CONTACT_TOLERANCE for grasp in found.tried)


def test_the_untouched_part_is_the_object_outside_the_region(bottle):
    middle = bottle.object.mesh.vertices.mean(0)
    half = Box(middle - 0.5 * DOWN, (1.0, 1.0, 1.0))
    rest = untouched_part(bottle, half)
    gap = sample_sdf(rest.sdf, torch.as_tensor(bottle.object.mesh.vertices).float())[0].numpy()
    above = half.distance(bottle.object.mesh.vertices)
    assert (gap[above > 0.015] < 0.0).all()
    assert (gap[above < -0.005] > 0.0).all()


def test_no_link_enters_an_avoided_box(bottle, hand):
    steering = Steering(avoid=[Box((0.0, 0.0, -0.5), (2.0, 2.0, 1.0))])
    free = plan_grasps(bottle, hand, count=6, preset="fast", measure=False)
    stages = ("pregrasp", "grasp", "squeeze")
    in_box = [entered(hand, [getattr(g, s) for s in stages], steering.avoid).any() for g in free.tried]
    assert any(in_box)
    found = plan(bottle, hand, steering)
    assert found.outcome is Outcome.SUCCEEDED, found.message
    for grasp in found.tried:
        assert not entered(hand, [getattr(grasp, s) for s in stages], steering.avoid).any()
    kept = steering.bind(bottle, hand).admit(free.tried)
    assert [isinstance(answer, Refusal) for answer in kept] == in_box


def test_from_below_the_table_is_said_to_be_impossible_without_a_search_and_from_above_is_not(
    bottle, hand, monkeypatch
):
    monkeypatch.delattr("graspd_core.planning.rounds.find_candidates")
    low = float(bottle.object.mesh.vertices[:, 2].min())
    standing = replace(bottle, support=Plane(np.array([0.0, 0.0, 1.0]), low))
    found = plan(standing, hand, Steering(approach_direction=-DOWN))
    assert found.outcome is Outcome.NO_CANDIDATES
    assert found.message.startswith("approach_direction: impossible, because the hand would reach")
    for direction in (DOWN, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, -1.0])):
        assert Steering(approach_direction=direction).bind(standing, hand).impossible == ""


def test_what_cannot_be_met_says_which_wish_refused_the_rest(bottle, hand):
    corner = bottle.object.mesh.vertices[bottle.object.mesh.vertices[:, 2].argmin()]
    found = plan(bottle, hand, Steering(approach_direction=DOWN, region=Sphere(corner, 0.002)))
    assert not found.tried
    assert found.message.startswith("0 candidates held")
    assert "with a contact outside the region" in found.message


@pytest.mark.parametrize("length", [1e-200, 1e200, 1e308])
def test_the_length_of_a_direction_and_of_a_quaternion_is_free(length: float):
    steering = Steering((length, 0, length), roll=0.1, roll_zero=(0, length, 0))
    assert np.allclose(np.array(steering.approach_direction), np.sqrt([0.5, 0, 0.5]))
    assert steering.roll_zero == (0, 1, 0)
    turned = Box((0, 0, 0), (1, 1, 1), (length, 0, 0, length)).rotation
    assert np.allclose(turned, axis_rotation(np.array([0.0, 0.0, 1.0]), np.pi / 2))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (partial(Steering, (0, 0, 0)), "approach_direction: .*not all 0"),
        (partial(Steering, (0, np.nan, 1)), "approach_direction: .*3 finite numbers"),
        (partial(Steering, (0, 1)), "approach_direction: .*3 finite numbers"),
        (partial(Steering, (0, 0, 1), approach_angle=0.0), "approach_angle: 0 rad; valid"),
        (partial(Steering, (0, 0, 1), approach_angle=3.2), "approach_angle: 3.2 rad; valid"),
        (partial(Steering, (0, 0, 1), approach_angle=np.nan), "approach_angle: nan"),
        (partial(Steering, (0, 0, 1), roll=np.inf), "roll: inf"),
        (partial(Steering, (0, 0, 1), roll=0, roll_tolerance=-1), "roll_tolerance: -1"),
        (partial(Steering, (0, 0, 1), approach_angle=2.0, roll=0), "roll: approach_angle is 2 rad; valid: below pi/2"),
        (partial(Steering, roll=0.0), "roll: no approach_direction is given"),
        (partial(Steering, (0, 0, 1), roll=0.0, roll_zero=(0, 0, 2)), "roll_zero: .*not along"),
        (partial(Box, (0, 0), (1, 1, 1)), "box center: .*3 finite numbers"),
        (partial(Box, (0, 0, np.nan), (1, 1, 1)), "box center"),
        (partial(Box, (0, 0, 0), (1, 0, 1)), "box size: .*above 0"),
        (partial(Box, (0, 0, 0), (1, 1, 1), (0, 0, 0, 0)), "quaternion_wxyz: .*not all 0"),
        (partial(Steering, (0, 0, 1), roll_zero=(0, 0, 0)), "roll_zero: .*not all 0"),
        (partial(Sphere, (0, 0, 0), 0.0), "sphere radius: 0.0 m"),
        (partial(Sphere, (0, 0, 0), np.nan), "sphere radius"),
        (partial(NearPoints, np.full((2, 3), np.nan)), "no finite row"),
        (partial(NearPoints, np.zeros((0, 3))), "no finite row"),
        (partial(NearPoints, np.zeros((1, 3)), radius=-1.0), "region radius"),
    ],
)
def test_a_wish_that_makes_no_sense_and_what_is_no_region_are_refused(make, said):
    with pytest.raises(ConfigError, match=said):
        make()


def test_a_region_off_the_object_or_in_an_avoided_box_is_refused(bottle, hand):
    with pytest.raises(
        ConfigError, match=r"region: no part of the object lies inside; the object extends from .* 0.9\d+ m"
    ):
        plan(bottle, hand, Steering(region=Sphere((1.1, 0.0, 0.0), 0.1)))
    both = Steering(region=Sphere((0.0, 0.0, 0.0), 1.0), avoid=[Box((1, 1, 1), (1, 1, 1)), Box((0, 0, 0), (2, 2, 2))])
    with pytest.raises(ConfigError, match="region: avoid box 1 covers the object in the region"):
        plan(bottle, hand, both)


def test_avoided_boxes_that_are_no_sequence_are_refused():
    box = Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    # A generator would be used up by the check, and nothing would be avoided.
    for boxes in (box, (each for each in [box]), None):
        # The type checks of the tests would refuse it before.
        steering = Steering()
        object.__setattr__(steering, "avoid", boxes)
        with pytest.raises(ConfigError, match=r"avoid: .*; valid: a sequence of Box"):
            steering.__post_init__()


def test_steering_is_in_the_frame_of_the_scene_far_from_the_origin_too(hand):
    away = np.array([300.0, -200.0, 50.0])
    scene = load_scene(moved_mesh(make_shape("bottle"), away))
    top = Sphere(scene.object.mesh.vertices.mean(0), 0.09)
    found = plan(scene, hand, Steering(approach_direction=(1, 0, 0), region=top), count=4)
    assert found.tried, found.message
    assert found.tried[0].verdict is Verdict.VERIFIED
    assert max(outside_region(top, grasp) for grasp in found.tried) <= CONTACT_TOLERANCE
    assert np.linalg.norm(found.tried[0].grasp.position - away) < 0.5


def test_the_search_sees_region_and_boxes_in_place_in_map_coordinates_too(hand):
    """At 5000 km, float32 rounds to half a metre. The obstacles of the search must not move by that."""
    away = np.array([4999123.457, 123456.789, 0.0])
    points = torch.as_tensor(np.random.default_rng(0).uniform(-0.1, 0.1, (500, 3)), dtype=torch.float32)

    def seen(origin: np.ndarray) -> list[torch.Tensor]:
        scene = load_scene(moved_mesh(make_shape("hammer"), origin), mass=0.2)
        head = Box(origin + np.array([0.0, 0.0, 0.065]), (0.15, 0.08, 0.07))
        steering = Steering(region=Sphere(origin, 0.06), avoid=[head])
        searched = BoundRestrictions((steering.bind(scene, hand),), origin).searched(near_scene(scene)[0])
        return [sample_sdf(obstacle.sdf, points)[0] for obstacle in searched.obstacles]

    for near, far in zip(seen(np.zeros(3)), seen(away), strict=True):
        assert float((near - far).abs().max()) < 1e-3


QUARTER = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))


def test_a_turned_box_has_signed_distances():
    box = Box((0.1, 0.0, 0.0), (0.2, 0.04, 0.06), QUARTER)
    at = np.array([[0.1, 0.0, 0.0], [0.1, 0.1, 0.0], [0.1, 0.13, 0.0], [0.15, 0.14, 0.0], [0.1, 0.0, 0.03]])
    assert np.allclose(box.distance(at), [-0.02, 0.0, 0.03, np.hypot(0.03, 0.04), 0.0])


def test_a_ball_and_what_is_near_have_signed_distances():
    at = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])
    assert np.allclose(Sphere((0.0, 0.0, 0.1), 0.2).distance(at), [-0.1, np.hypot(0.3, 0.1) - 0.2])
    near = NearPoints(np.array([[0.0, 0.0, 0.0], [0.31, 0.0, 0.0], [np.nan, 0.0, 0.0]]), radius=0.02)
    assert np.allclose(near.distance(at), [-0.02, -0.01])


@given(st.lists(st.floats(-0.2, 0.2), min_size=6, max_size=6))
def test_distances_never_change_faster_than_the_point(values: list[float]):
    a, b = np.array(values[:3]), np.array(values[3:])
    for region in (Box((0.01, 0.02, 0.0), (0.1, 0.05, 0.2), (0.5, 0.1, 0.3, 0.7)), Sphere((0, 0, 0), 0.05)):
        change = abs(float(np.diff(region.distance(np.stack([a, b])))[0]))
        assert change <= np.linalg.norm(a - b) + 1e-12


def posture(hand, position=(0.0, 0.0, 0.0)) -> Posture:
    return Posture(np.array(position), np.array([1.0, 0.0, 0.0, 0.0]), hand.open_posture)


@pytest.mark.parametrize("name", hand_names())
def test_a_box_with_a_point_of_the_hand_in_it_is_entered_and_one_beside_all_solids_is_not(name):
    hand = load_hand(name)
    rotations, translations = link_poses(hand, hand.open_posture)
    links = hand.candidate_link
    points = np.einsum("pij,pj->pi", rotations[links], hand.candidate_points) + translations[links]
    for point in points[::37]:
        assert entered(hand, [posture(hand)], [Box(point, (0.002, 0.003, 0.004), (0.9, 0.1, 0.3, 0.2))]).all()
    beside = points.max(0) + 0.05
    assert not entered(hand, [posture(hand)], [Box(beside, (0.02, 0.02, 0.02))]).any()


def test_an_edge_between_corners_is_seen_and_a_narrow_gap_is_a_gap():
    hand = load_hand("parallel_gripper")
    solid = max(hand.primitives, key=lambda p: p.size[0] * p.size[1] * p.size[2])
    link = link_poses(hand, hand.open_posture)
    rotation, at = link[0][solid.link] @ solid.rotation, link[0][solid.link] @ solid.translation + link[1][solid.link]
    alone = replace(hand, primitives=(solid,))
    half = np.array(solid.size)
    # A stick through the middle of the largest box: no corner of either is in the other.
    assert entered(alone, [posture(hand)], [Box(at, 6 * half.max() * np.array([1, 1e-3, 1e-3]))]).all()
    for gap, inside in ((1e-3, False), (-1e-3, True)):
        middle = at + rotation @ np.array([half[0] + 0.01 + gap, 0.0, 0.0])
        turn = tuple(quaternion_from_rotation(torch.as_tensor(rotation)).tolist())
        assert entered(alone, [posture(hand)], [Box(middle, (0.02, 0.02, 0.02), turn)]).all() == inside


def test_hands_are_placed_by_their_posture(hand):
    box = Box((1.0, 2.0, 3.0), (0.3, 0.3, 0.3))
    found = entered(hand, [posture(hand), posture(hand, (1.0, 2.0, 3.0)), posture(hand, (1.0, 2.0, 3.8))], [box])
    assert found.tolist() == [False, True, False]
    assert entered(hand, [posture(hand)], []).tolist() == [False]
    assert entered(hand, [], [box]).tolist() == []


def test_of_a_wide_box_the_search_sees_what_is_in_reach(hand):
    scene = load_scene("shape:box")
    plate, far = Box((0.0, 0.0, -0.1), (100.0, 100.0, 0.02)), Box((5.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    (found,) = boxes_in_reach(scene, hand, [plate, far])
    assert 0.3 < np.ptp(found.mesh.vertices[:, 0]) < 1.5
    heights = torch.tensor([[0.0, 0.0, -0.1], [0.0, 0.0, 0.0]])
    assert np.allclose(sample_sdf(found.sdf, heights)[0], [-0.01, 0.09], atol=0.02)
