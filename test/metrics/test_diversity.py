"""Copies are counted once, whatever the object looks like."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd_core.hands.library import load_hand
from graspd_core.types import Grasp, Posture
from graspd_core.verify.metrics import distinct


@pytest.fixture(scope="module")
def hand():
    return load_hand("parallel_gripper", candidates=60)


def grasp(hand, position=(0.0, 0.0, 0.0), turn: float = 0.0) -> Grasp:
    """A hand turned about z through the middle of its palm, which stays at `position`."""
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    quaternion = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
    posture = Posture(np.array(position) - rotation @ hand.palm_center, quaternion, hand.open_posture)
    return Grasp(posture, posture, posture, (), 0.0)


def test_sixteen_copies_are_one_grasp(hand):
    first = grasp(hand)
    assert distinct([first, *(grasp(hand, (0.001 * i, 0.0, 0.0)) for i in range(16))], hand) == (first,)
    assert distinct([], hand) == ()


@pytest.mark.parametrize(
    ("other", "kept"),
    [({"position": (0.019, 0, 0)}, 1), ({"position": (0.021, 0, 0)}, 2), ({"turn": 0.34}, 1), ({"turn": 0.36}, 2)],
)
def test_far_enough_or_turned_enough_is_another(hand, other: dict, kept: int):
    assert len(distinct([grasp(hand), grasp(hand, **other)], hand)) == kept


@given(angle=st.floats(0.4, 2 * np.pi - 0.4))
def test_a_ball_held_from_another_side_is_held_otherwise(hand, angle: float):
    around = (0.05 * np.cos(angle), 0.05 * np.sin(angle), 0.0)
    assert len(distinct([grasp(hand, (0.05, 0.0, 0.0)), grasp(hand, around, angle)], hand)) == 2
