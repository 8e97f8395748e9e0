"""Whether a link enters a box, against closed forms and against samples of the hand's solids."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from graspd_core import load_hand, load_scene
from graspd_core.hands.kinematics import link_poses
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.planning.regions import Box, boxes_in_reach, entered
from graspd_core.types import Posture

HANDS = ("allegro_right", "leap_right", "barrett_like", "parallel_gripper")


def posture(hand, position=(0.0, 0.0, 0.0), quaternion=(1.0, 0.0, 0.0, 0.0)) -> Posture:
    return Posture(np.array(position), np.array(quaternion), hand.open_posture)


@pytest.mark.parametrize("name", HANDS)
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
        turn = _quaternion(rotation)
        assert entered(alone, [posture(hand)], [Box(middle, (0.02, 0.02, 0.02), turn)]).all() == inside


def _quaternion(rotation):
    from graspd_core.se3 import quaternion_from_rotation

    return tuple(quaternion_from_rotation(torch.as_tensor(rotation)).tolist())


def test_hands_are_placed_by_their_posture():
    hand = load_hand("allegro_right")
    box = Box((1.0, 2.0, 3.0), (0.3, 0.3, 0.3))
    found = entered(hand, [posture(hand), posture(hand, (1.0, 2.0, 3.0)), posture(hand, (1.0, 2.0, 3.8))], [box])
    assert found.tolist() == [False, True, False]
    assert entered(hand, [posture(hand)], []).tolist() == [False]
    assert entered(hand, [], [box]).tolist() == []


def test_of_a_wide_box_the_search_sees_what_is_in_reach():
    scene, hand = load_scene("shape:box"), load_hand("allegro_right")
    plate, far = Box((0.0, 0.0, -0.1), (100.0, 100.0, 0.02)), Box((5.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    (found,) = boxes_in_reach(scene, hand, [plate, far])
    assert 0.3 < np.ptp(found.mesh.vertices[:, 0]) < 1.5
    heights = torch.tensor([[0.0, 0.0, -0.1], [0.0, 0.0, 0.0]])
    assert np.allclose(sample_sdf(found.sdf, heights)[0], [-0.01, 0.09], atol=0.02)
