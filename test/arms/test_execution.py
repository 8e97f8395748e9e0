"""A grasp as a timed trajectory of arm and hand: gates at rest, speeds within limits, efforts of a closed hand."""

from dataclasses import replace

import numpy as np
import pytest
from expected import some
from scipy.interpolate import CubicHermiteSpline

from graspd_core.arms.arm_paths import LIFT, STAGE_ROWS
from graspd_core.arms.execution import GATES, PEAK_ACCELERATION, ExecutionPace, execution_of, lift_time
from graspd_core.errors import ConfigError
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import Mimic
from graspd_core.types import ArmPath, Grasp, GraspMetrics, Posture

HAND = load_hand("allegro_right", candidates=50)
SPEEDS = np.array([0.5, 1.0, 2.0])


def reached_grasp(seed: int = 0) -> Grasp:
    """A grasp whose arm moves three joints along a bent path, and whose squeeze asks for more than the hand can."""
    rng = np.random.default_rng(seed)
    steps = np.cumsum(rng.uniform(-0.1, 0.1, (STAGE_ROWS[-1] + 1, 3)), axis=0)
    turn = np.array([1.0, 0.0, 0.0, 0.0])
    joints = [HAND.lower + share * (HAND.upper - HAND.lower) for share in (0.2, 0.5, 0.9)]
    places = [np.array([0.0, 0.0, z]) for z in (0.23, 0.2, 0.2)]
    before, touch, press = (Posture(place, turn, q) for place, q in zip(places, joints, strict=True))
    return Grasp(before, touch, press, arm=ArmPath(("a", "b", "c"), steps, STAGE_ROWS))


@pytest.mark.parametrize("seed", range(4))
def test_no_joint_is_faster_than_its_limit_and_all_rest_at_every_gate(seed: int):
    pace = ExecutionPace(shortest=0.05)
    made = execution_of(reached_grasp(seed), HAND, arm_speeds=SPEEDS, pace=pace)
    assert (np.diff(made.times) > 0).all()
    for rows, speeds, limits in (
        (made.arm, made.arm_speed, SPEEDS),
        (made.hand, made.hand_speed, np.full(HAND.num_joints, pace.finger_speed)),
    ):
        assert np.abs(speeds[[0, *made.gates]]).max() == pytest.approx(0.0, abs=1e-9)
        between = CubicHermiteSpline(made.times, rows, speeds)(np.linspace(0, made.times[-1], 2000), 1)
        # It is looked at in other moments than by the code.
        assert (np.abs(between).max(0) <= 1.01 * limits).all()
    assert (np.abs(made.arm_speed) <= SPEEDS + 1e-9).all()


def test_coupled_joints_keep_the_limit_too():
    joint = HAND.num_joints - 1
    link = HAND.link_joint.tolist().index(joint)
    coupled = replace(HAND, mimics=(Mimic("tip", link, joint, 2.0, 0.0),))
    made = execution_of(reached_grasp(), coupled, arm_speeds=10 * SPEEDS, pace=ExecutionPace(shortest=0.01))
    # The coupled joint is twice as fast.
    assert np.abs(made.hand_speed[:, joint]).max() <= 0.5 + 1e-9
    assert coupled.joint_speeds(1.0, 0.1)[joint] == 0.5


def test_rows_follow_the_arms_path_and_the_three_postures_in_the_order_of_the_gates():
    grasp = reached_grasp()
    made = execution_of(grasp, HAND, arm_speeds=SPEEDS)
    gates = {str(gate): row for gate, row in zip(GATES, made.gates, strict=True)}
    for gate, stage in (("pregrasp", "pregrasp"), ("closed", "grasp"), ("squeezed", "grasp"), ("lifted", "lift")):
        np.testing.assert_allclose(made.arm[gates[gate]], some(grasp.arm).at(stage))
    for gate, posture in (("pregrasp", grasp.pregrasp), ("closed", grasp.grasp), ("squeezed", grasp.squeeze)):
        np.testing.assert_allclose(made.hand[gates[gate]], posture.joint_positions)
    assert made.rows_to("pregrasp") == slice(0, gates["pregrasp"] + 1)
    assert made.rows_to("lifted") == slice(gates["squeezed"], len(made.times))


SPEED = r"arm_speeds: .*; valid: one positive number for each of a, b, c"


@pytest.mark.parametrize(
    ("speeds", "mass", "told"),
    [
        *(([0.5, speed, 2.0], None, SPEED) for speed in (0.0, np.nan, -1.0)),
        ([0.5, 1.0], None, SPEED),
        # With NaN, all times of the lift would be NaN.
        *((SPEEDS, mass, f"mass: {mass} kg; valid: a number from 0, or None") for mass in (np.nan, -0.1)),
    ],
)
def test_speeds_and_masses_that_cannot_be_are_refused(speeds: list[float], mass: float | None, told: str):
    grasp = replace(reached_grasp(), metrics=GraspMetrics({"payload": 1.0}))
    with pytest.raises(ConfigError, match=told):
        execution_of(grasp, HAND, arm_speeds=np.array(speeds), mass=mass)


def test_joints_press_within_their_limits_and_only_once_the_hand_is_closed():
    made = execution_of(reached_grasp(), HAND, arm_speeds=SPEEDS)
    assert not made.efforts[: made.gates[1] + 1].any()
    assert (np.abs(made.efforts) <= HAND.effort + 1e-9).all()
    np.testing.assert_allclose(made.efforts[made.gates[2] :], np.broadcast_to(HAND.effort, (6, HAND.num_joints)))


def test_what_a_grasp_would_hold_beyond_the_mass_makes_the_lift_faster():
    pace, grasp = ExecutionPace(), reached_grasp()
    gentle = lift_time(grasp, 1.0, pace)
    assert gentle == pytest.approx(np.sqrt(PEAK_ACCELERATION * LIFT / pace.gentlest))
    times = [lift_time(replace(grasp, metrics=GraspMetrics({"payload": p})), 1.0, pace) for p in (1.0, 1.35, 9.0)]
    assert times == sorted(times, reverse=True)
    assert times[0] == gentle > times[1] > times[2]
    made = [
        execution_of(grasp, HAND, arm_speeds=10 * SPEEDS, mass=1.0),
        execution_of(grasp, HAND, arm_speeds=10 * SPEEDS),
    ]
    assert made[0].times[-1] == pytest.approx(made[1].times[-1])


def test_a_grasp_that_no_arm_reaches_has_no_execution():
    with pytest.raises(ConfigError, match="has no arm path"):
        execution_of(replace(reached_grasp(), arm=None), HAND, arm_speeds=SPEEDS)
    with pytest.raises(ConfigError, match=r"finger_speed: 0\.0; valid: a positive"):
        ExecutionPace(finger_speed=0.0)
