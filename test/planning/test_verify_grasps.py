"""Grasps from elsewhere are tried and measured as planned ones are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graspd_core import Grasp, Posture, Verdict, load_hand, load_scene, verify_grasps
from graspd_core.errors import ConfigError

HAND = load_hand("parallel_gripper")
# Half of what the jaws leave between them [m]: the box is 60 mm wide.
CLEAR, TOUCH, PRESS = 0.05, 0.03, 0.02


def gripper_at(height: float) -> Grasp:
    """The jaws about a box at the origin, from above."""
    down = np.array([0.0, 1.0, 0.0, 0.0])
    clear, touch, press = (
        Posture(np.array([0.0, 0.0, height]), down, np.array([jaw])) for jaw in (CLEAR, TOUCH, PRESS)
    )
    return Grasp(clear, touch, press)


def test_a_grasp_that_holds_and_one_that_misses_come_back_in_their_order():
    scene = load_scene("shape:box")
    missed, held = verify_grasps(scene, HAND, [gripper_at(0.4), gripper_at(0.15)])
    assert (missed.verdict, held.verdict) == (Verdict.FAILED, Verdict.VERIFIED)
    assert missed.reason
    assert missed.metrics is not None
    assert missed.metrics["contact_area"] == 0
    assert held.metrics is not None
    # Both pads, each 24 mm wide and 69 mm along the box.
    assert held.metrics["contact_area"] == pytest.approx(2 * 0.024 * 0.069, rel=0.35)


def test_what_is_not_asked_for_is_not_done():
    tried = replace(gripper_at(0.15), score=3.0)
    (grasp,) = verify_grasps(load_scene("shape:box"), HAND, [tried], verify="none", measure=False)
    assert (grasp.verdict, grasp.metrics, grasp.score) == (Verdict.UNVERIFIED, None, 3.0)


@pytest.mark.parametrize(
    ("change", "culprit"),
    [
        ({"joint_positions": np.zeros(16)}, r"grasp 1: squeeze.joint_positions .*; valid: 1 finite"),
        ({"position": np.array([0.0, np.nan, 0.0])}, "grasp 1: squeeze.position .*; valid: 3 finite"),
        ({"quaternion_wxyz": np.array([0.0, 2.0, 0.0, 0.0])}, "grasp 1: squeeze.quaternion_wxyz has length 2"),
    ],
)
def test_a_posture_that_fits_no_hand_is_refused(change: dict, culprit: str):
    good = gripper_at(0.15)
    bad = replace(good, squeeze=replace(good.squeeze, **change))
    with pytest.raises(ConfigError, match=culprit):
        verify_grasps(load_scene("shape:box"), HAND, [good, bad])


def test_an_unknown_trial_is_refused():
    with pytest.raises(ConfigError, match="verify: 'soft'; valid: standard"):
        verify_grasps(load_scene("shape:box"), HAND, [], verify="soft")
