"""The lift trial, its recordings, and free things that a lift takes out of others: a gripper comes down on a cube."""

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from made_meshes import box_of

from graspd_bench.trials import FreeBody, settle
from graspd_core import HandModel
from graspd_core.errors import ConfigError
from graspd_core.hands.kinematics import retreat_posture
from graspd_core.mesh.sdf import build_sdf
from graspd_core.perception.scene import Obstacle
from graspd_core.types import Plane, TrialResult, Verdict
from graspd_core.verify.lift_trial import LiftSettings, lift_trial
from graspd_core.verify.trial_registry import TrialContext, grasp_trials
from graspd_core.verify.world import PROTOCOLS, World, build_world
from graspd_viewer.trial_controls import record_trial

# On softer springs than the trials' own, so that a millimetre of squeeze is half a newton.
STANDARD = replace(PROTOCOLS["standard"], slide_stiffness=500.0, slide_damping=10.0)

# The fixtures' gripper reaches along +z; a table whose free side is −z makes that "down". The cube ends at z = 20 mm.
TABLE = Plane(np.array([0.0, 0.0, -1.0]), -0.02)
GOOD = (0.015, 0.025, (0.04, 0.04))

# The fingers end 70 mm from the base: 2 mm above the table.
CLEAR = -0.052


def box(centre: tuple[float, float, float], half: float) -> Obstacle:
    """A fixed cube [m]."""
    mesh = box_of(half, centre)
    return Obstacle(mesh, build_sdf(mesh, resolution=16))


@pytest.fixture(scope="module")
def hand(gripper) -> HandModel:
    """The gripper, coming along its fingers."""
    return replace(gripper, approach=np.array([0.0, 0.0, 1.0]))


@pytest.fixture(scope="module")
def table(hand, cube) -> World:
    return build_world(hand, cube, (cube.mesh,), STANDARD, TABLE)


@pytest.fixture(scope="module")
def context(hand, world, table) -> TrialContext:
    return TrialContext(hand, STANDARD, world, table)


def test_the_retreat_lies_straight_back(hand, closing):
    pregrasp = closing(*GOOD).pregrasp
    assert retreat_posture(hand, pregrasp).position == pytest.approx([0, 0, -0.145])
    assert retreat_posture(hand, pregrasp, 0.02).position == pytest.approx([0, 0, -0.065])


def test_a_firm_squeeze_lifts_and_the_same_lift_gives_the_same_figures(table, hand, closing):
    lift = lift_trial(table, hand, closing(*GOOD, height=CLEAR), STANDARD)
    assert lift.passed, lift
    assert lift.reason == ""
    # 1 N of weight on the springs of 500 N/m, as in the hold trial; the cube rose with the hand.
    assert lift.displacement < 0.003
    assert lift.rotation < np.deg2rad(1)
    grasp = closing(0.015, 0.025, (0.0262, 0.0262), height=CLEAR)
    assert lift_trial(table, hand, grasp, STANDARD) == lift_trial(table, hand, grasp, STANDARD)


# The fingers end 5 mm below the table and 2 mm above it.
@pytest.mark.parametrize(("margin", "height"), [(0.0, -0.045), (0.007, CLEAR)])
def test_fingers_through_the_table_or_in_its_margin_are_refused(margin, height, hand, cube, closing):
    world = build_world(hand, cube, (cube.mesh,), STANDARD, replace(TABLE, margin=margin))
    lift = lift_trial(world, hand, closing(*GOOD, height=height), STANDARD)
    assert (lift.passed, lift.reason) == (False, "the hand reaches 5.0 mm into the support while approaching")


def test_a_weak_squeeze_leaves_the_object_on_the_table(table, hand, closing):
    # 0.5 N on either side hold 0.6 N by friction, of 1 N.
    lift = lift_trial(table, hand, closing(0.015, 0.025, (0.026, 0.026), height=CLEAR), STANDARD)
    assert not lift.passed
    assert lift.reason.startswith("the object moved")
    assert lift.reason.endswith("while lifting")
    missed = lift_trial(table, hand, closing(0.0, 0.0, (0.0, 0.0), height=CLEAR), STANDARD)
    assert missed.reason.endswith("while lifting")


@pytest.mark.parametrize(("share", "lifted"), [(1.3, True), (0.75, False)])
def test_friction_lifts_above_coulombs_limit_and_slips_below(table, hand, cube, closing, share: float, lifted: bool):
    # 2 μ N ≥ m (g + a), a the greatest acceleration of the lift, 6 h / T².
    weight = cube.mass * (9.81 + 6 * LiftSettings.lift_height / LiftSettings.lift_time**2)
    normal = share * (weight if lifted else cube.mass * 9.81) / (2 * 0.6)
    squeeze = 0.025 + normal / STANDARD.slide_stiffness
    lift = lift_trial(table, hand, closing(0.015, 0.0245, (squeeze, squeeze), height=CLEAR), STANDARD)
    assert lift.passed == lifted, lift


def test_until_it_is_touched_an_object_rests_as_it_was_seen(hand, cube, closing):
    # On a table of 25° a cube would slide or tip long before the fingers are there; firm fingers catch it.
    normal = np.array([np.sin(0.44), 0.0, -np.cos(0.44)])
    world = build_world(hand, cube, (cube.mesh,), replace(STANDARD, friction=(0.3, 0.02, 1e-4)), Plane(normal, -0.12))
    late = LiftSettings(approach_time=1.0)
    lift = lift_trial(world, hand, closing(0.02, 0.025, (0.04, 0.04), height=-0.06), STANDARD, settings=late)
    assert lift.passed, lift


def test_the_hand_keeps_out_of_neighbours_with_its_fingers_and_its_palm(hand, cube, closing):
    # Fingers at 50 mm from the middle when open, 10 mm thick; the palm ends at y = 80 mm, 72 mm above the table.
    beside_finger, under_palm = box((0.0, 0.06, 0.01), 0.01), box((0.0, 0.075, -0.055), 0.01)
    for neighbour in (beside_finger, under_palm):
        world = build_world(hand, cube, (cube.mesh,), STANDARD, TABLE, (box((0.5, 0, 0), 0.01), neighbour))
        lift = lift_trial(world, hand, closing(0.0, 0.025, (0.04, 0.04), height=CLEAR), STANDARD)
        assert not lift.passed
        assert "into neighbour 2" in lift.reason
    away = build_world(hand, cube, (cube.mesh,), STANDARD, TABLE, (box((0.0, 0.11, 0.01), 0.01),))
    assert lift_trial(away, hand, closing(*GOOD, height=CLEAR), STANDARD).passed


def test_without_a_support_the_object_is_drawn_back_the_way_the_hand_came(hand, cube, closing):
    world = build_world(hand, cube, (cube.mesh,), STANDARD, None, (box((0.5, 0, 0), 0.01),))
    assert world.up is None
    assert not world.model.opt.gravity.any()
    assert lift_trial(world, hand, closing(*GOOD), STANDARD).passed


def test_a_neighbour_that_touches_the_object_does_not_throw_it(hand, cube, closing):
    # 3 mm into the cube, from the side that no finger is on.
    world = build_world(hand, cube, (cube.mesh,), STANDARD, TABLE, (box((0.037, 0, 0), 0.02),))
    lift = lift_trial(world, hand, closing(0.015, 0.025, (0.04, 0.04), height=-0.08), STANDARD)
    assert "while closing" not in lift.reason
    assert "while squeezing" not in lift.reason


def test_an_object_rests_on_its_own_lowest_point(hand, cube):
    # A table seen 4 mm too low: hand and object each meet theirs.
    world = build_world(hand, cube, (cube.mesh,), STANDARD, replace(TABLE, offset=-0.024))
    data = mujoco.MjData(world.model)
    data.mocap_pos[0] = [0, 0, -1]
    mujoco.mj_step(world.model, data, 250)
    moved = data.qpos[world.object_address : world.object_address + 3]
    # Contacts give by a fraction of a millimetre.
    assert moved == pytest.approx([0, 0, 0], abs=5e-4)


def test_a_lift_can_be_stopped(table, hand, closing):
    lift = lift_trial(table, hand, closing(*GOOD, height=CLEAR), STANDARD, stop=lambda: True)
    assert lift == replace(lift, passed=False, reason="stopped before the trial ended")


def test_a_verdict_needs_every_trial(context, closing):
    held, lifted = TrialResult("hold", True, 0.0, 0.0), TrialResult("lift", True, 0.0, 0.0)
    grasp = closing(*GOOD)
    assert grasp.verdict is Verdict.UNVERIFIED
    assert replace(grasp, trials=(held,)).verdict is Verdict.VERIFIED
    assert replace(grasp, trials=(held, lifted)).verdict is Verdict.VERIFIED
    # This one holds in free space and reaches through the table.
    tried = replace(grasp, trials=grasp_trials(context, grasp))
    assert [(trial.name, trial.passed) for trial in tried.trials] == [("hold", True), ("lift", False)]
    assert (tried.verdict, tried.reason) == (Verdict.FAILED, tried.trials[1].reason)
    # Without a support there is no lift; after a failed trial there is no other.
    assert [trial.name for trial in grasp_trials(replace(context, around=None), grasp)] == ["hold"]
    (lost,) = grasp_trials(context, closing(*GOOD, height=-0.145))
    assert (lost.name, lost.passed) == ("hold", False)


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
    with pytest.raises(ConfigError, match="trial 'lift'; valid for this scene: hold"):
        record_trial(replace(context, around=None), closing(*GOOD), "lift")


@pytest.fixture(scope="module")
def block(cube):
    """The cube somewhere, turned about an axis (a scaled axis, [rad])."""
    from scipy.spatial.transform import Rotation

    def build(x: float, y: float, z: float, turn: Sequence[float] = (0.0, 0.0, 0.0)) -> FreeBody:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), (x, y, z)
        return FreeBody(cube, (cube.mesh,), pose)

    return build


def test_a_pile_settles_on_the_table_the_same_way_every_time(block):
    pile = [block(0.0, 0.005, 0.06, (0.4, 0.2, 0.0)), block(0.01, 0.0, 0.14, (0.1, 0.7, 0.3)), block(0, 0.012, 0.22)]
    poses = settle(pile, wall=0.06)
    assert np.array_equal(poses, settle(pile, wall=0.06))
    rest = settle([replace(body, pose=pose) for body, pose in zip(pile, poses, strict=True)])
    for body, pose in zip(pile, rest, strict=True):
        lowest = (body.model.mesh.vertices @ pose[:3, :3].T + pose[:3, 3])[:, 2].min()
        # On the table, on one other or on two.
        assert -0.002 < lowest < 2 * 0.04 + 0.002
    # What rests goes on resting.
    again = settle([replace(body, pose=pose) for body, pose in zip(pile, rest, strict=True)])
    assert np.allclose(again, rest, atol=1e-3)
    assert settle([]) == ()
