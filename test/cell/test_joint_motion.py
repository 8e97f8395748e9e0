"""Motions as controllers interpolate them, and what is refused of them."""

from __future__ import annotations

import numpy as np
import pytest

from graspd_cell.robot import JointMotion, JointReading
from graspd_core.errors import ConfigError

TIMES = np.array([1.0, 3.0])
POSITIONS = np.array([[1.0, -1.0], [3.0, 1.0]])


def test_straight_lines_begin_at_the_targets_of_before():
    motion = JointMotion(("a", "b"), TIMES, POSITIONS)
    start = np.array([0.0, 1.0])
    assert motion.duration == 3.0
    np.testing.assert_allclose(motion.at(0.0, start), start)
    np.testing.assert_allclose(motion.at(0.5, start), [0.5, 0.0])
    np.testing.assert_allclose(motion.at(2.0, start), [2.0, 0.0])
    np.testing.assert_allclose(motion.at(9.0, start), POSITIONS[-1])


def test_splines_meet_the_velocities_of_their_waypoints():
    motion = JointMotion(("a", "b"), TIMES, POSITIONS, np.array([[0.5, 0.0], [0.0, 0.0]]))
    start, eps = np.zeros(2), 1e-6
    for time, velocity in ((0.0, [0.0, 0.0]), (1.0, [0.5, 0.0]), (3.0 - 1e-5, [0.0, 0.0])):
        slope = (motion.at(time + eps, start) - motion.at(time, start)) / eps
        np.testing.assert_allclose(slope, velocity, atol=1e-4)
    np.testing.assert_allclose(motion.at(1.0, start), POSITIONS[0], atol=1e-12)


@pytest.mark.parametrize(
    ("times", "positions", "culprit"),
    [
        ([2.0, 1.0], POSITIONS, "times"),
        ([-1.0, 1.0], POSITIONS, "times"),
        ([1.0, np.nan], POSITIONS, "times"),
        ([1.0, 2.0], np.full((2, 2), np.inf), "positions"),
        ([1.0, 2.0], np.zeros((2, 3)), "positions"),
    ],
)
def test_a_motion_that_makes_no_sense_is_refused_by_name(times: list[float], positions: np.ndarray, culprit: str):
    with pytest.raises(ConfigError, match=f"a motion's {culprit} .*valid: "):
        JointMotion(("a", "b"), np.array(times), positions)


def test_a_reading_gives_joints_in_any_order_and_names_an_unknown_one():
    reading = JointReading(0.0, ("a", "b"), np.array([1.0, 2.0]), np.array([3.0, 4.0]))
    assert reading.of(("b",)).positions.tolist() == [2.0]
    assert reading.of(("b", "a")).efforts.tolist() == [4.0, 3.0]
    with pytest.raises(ConfigError, match=r"joint 'c'.*valid: a, b"):
        reading.of(("c",))
