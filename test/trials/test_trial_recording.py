"""A recorded trial is the trial: the same result, and frames that show it. The gripper and the cube of conftest.py."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graspd_core.errors import ConfigError
from graspd_core.types import Plane
from graspd_core.verify.trial_registry import TrialContext, grasp_trials
from graspd_core.verify.world import PROTOCOLS, build_world
from graspd_viewer.trial_controls import record_trial

STANDARD = replace(PROTOCOLS["standard"], slide_stiffness=500.0, slide_damping=10.0)
TABLE = Plane(np.array([0.0, 0.0, -1.0]), -0.02)
GOOD, CLEAR = (0.015, 0.025, (0.04, 0.04)), -0.052


@pytest.fixture(scope="module")
def context(gripper, cube) -> TrialContext:
    hand = replace(gripper, approach=np.array([0.0, 0.0, 1.0]))
    alone = build_world(hand, cube, (cube.mesh,), STANDARD)
    return TrialContext(hand, STANDARD, alone, build_world(hand, cube, (cube.mesh,), STANDARD, TABLE))


@pytest.mark.parametrize("squeeze", [(0.04, 0.04), (0.0262, 0.0262), (0.02, 0.02)])
def test_a_recorded_trial_ends_as_any_other(context, closing, squeeze):
    grasp = closing(0.015, 0.025, squeeze, height=CLEAR)
    results = grasp_trials(context, grasp)
    assert [record_trial(context, grasp, result.name).result for result in results] == list(results)


def test_its_frames_show_a_cube_that_is_held(context, closing):
    recording = record_trial(context, closing(*GOOD), "hold")
    assert recording.seconds == pytest.approx(0.02)
    stages = list(dict.fromkeys(frame.stage for frame in recording.frames))
    pulls = [f"a pull along {sign}{axis}" for sign in "+-" for axis in "xyz"]
    assert stages == ["closing", "squeezing", *pulls]
    squeezed = [frame for frame in recording.frames if frame.stage == "squeezing"][-1]
    # 15 mm of squeeze on 500 N/m from either side, which the cube bears: forces into it, and none is left over.
    left = squeezed.forces[squeezed.contacts[:, 1] > 0].sum(0)
    assert left == pytest.approx([0.0, -7.5, 0.0], abs=0.2)
    assert squeezed.forces.sum(0) == pytest.approx(np.zeros(3), abs=0.05)
    # Link 0 is the palm, the cube comes last.
    assert squeezed.positions[0] == pytest.approx([0.0, 0.0, -0.045])
    assert squeezed.positions[-1] == pytest.approx(np.zeros(3), abs=1e-3)


def test_its_last_frame_is_the_moment_of_the_failure(context, closing):
    recording = record_trial(context, closing(*GOOD, height=-0.145), "hold")
    assert recording.result.reason.endswith(recording.frames[-1].stage)
    assert np.linalg.norm(recording.frames[-1].positions[-1]) > STANDARD.max_displacement - 1e-3


def test_a_lift_goes_up(context, closing):
    frames = record_trial(context, closing(*GOOD, height=CLEAR), "lift").frames
    assert list(dict.fromkeys(frame.stage for frame in frames)) == [
        "coming", "closing", "squeezing", "lifting", "holding up",
    ]  # fmt: skip
    # Up is −z here; 20 cm, for the hand and for the cube in it.
    assert frames[-1].positions[0] == pytest.approx([0, 0, CLEAR - 0.2], abs=1e-6)
    assert frames[-1].positions[-1] == pytest.approx([0, 0, -0.2], abs=3e-3)


def test_a_trial_that_does_not_apply_is_refused(context, closing):
    with pytest.raises(ConfigError, match="'lift': valid for this scene: hold"):
        record_trial(replace(context, around=None), closing(*GOOD), "lift")
