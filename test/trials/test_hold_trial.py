"""The hold trial and the drop trial on grasps made by hand: good ones pass, bad ones fail for the right reason."""

from dataclasses import replace

import numpy as np
import pytest
from expected import some

from graspd_bench.trials import LOST, gravity_trial
from graspd_core import HandModel, Posture, Verdict
from graspd_core.verify import world as trial_world
from graspd_core.verify.hold_trial import displaced, hold_trial, noisy_share, pose_error, pose_errors
from graspd_core.verify.world import PROTOCOLS, Protocol, World, build_world

# On softer springs than the trials' own, so that a millimetre of squeeze is half a newton.
STANDARD = replace(PROTOCOLS["standard"], slide_stiffness=500.0, slide_damping=10.0)
GOOD = (0.015, 0.025, (0.04, 0.04))


def test_a_firm_squeeze_holds(world, closing):
    grasp = closing(*GOOD)
    hold = hold_trial(world, grasp, STANDARD)
    assert hold.passed
    assert hold.reason == ""
    # 7.5 N on either side against 1 N: it gives by the springs' 1 N / 1000 N/m.
    assert hold.displacement < 0.003
    assert hold.rotation < np.deg2rad(1)
    assert replace(grasp, trials=(hold,)).verdict is Verdict.VERIFIED


# From ten centimetres away. From one side the finger pushes it 15 mm, which is allowed, to where nothing presses back.
@pytest.mark.parametrize(("squeeze", "height"), [((0.04, 0.04), -0.145), ((0.04, 0.0), -0.045)])
def test_what_does_not_press_from_both_sides_holds_nothing(squeeze, height, world, closing):
    grasp = closing(0.015, 0.025, squeeze, height=height)
    hold = hold_trial(world, grasp, STANDARD)
    assert not hold.passed
    assert hold.reason.startswith("the object moved")
    assert hold.reason.endswith("under a pull along +x")
    scored = replace(grasp, trials=(hold,))
    assert (scored.verdict, scored.reason) == (Verdict.FAILED, hold.reason)


def test_a_start_fifteen_millimetres_deep_is_refused(world, closing):
    hold = hold_trial(world, closing(0.04, 0.04, (0.04, 0.04)), STANDARD)
    assert hold == replace(hold, passed=False, displacement=0.0, rotation=0.0)
    assert hold.reason == "the pregrasp penetrates the object by 15.0 mm"
    # Nine are allowed where the grasp itself is not as deep.
    assert "penetrates" not in hold_trial(world, closing(0.034, 0.029, (0.04, 0.04)), STANDARD).reason


def test_a_trial_can_be_stopped(world, closing):
    hold = hold_trial(world, closing(*GOOD), STANDARD, stop=lambda: True)
    assert not hold.passed
    assert hold.reason == "stopped before the trial ended"


def test_a_diverging_simulation_is_a_failure_not_an_exception(gripper, cube, closing, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wild = Protocol(pull=1e12)
    hold = hold_trial(build_world(gripper, cube, (cube.mesh,), wild), closing(*GOOD), wild)
    assert not hold.passed
    assert hold.reason.startswith("the simulation diverged")
    assert hold.displacement == np.inf
    # MuJoCo's own log of such things stays unwritten.
    assert list(tmp_path.iterdir()) == []


def crowded(gripper: HandModel, times: int) -> HandModel:
    """The gripper with each of its solids there many times, each a little larger than the last."""
    grown = [replace(p, size=tuple(x + 1e-6 * k for x in p.size)) for p in gripper.primitives for k in range(times)]
    return replace(gripper, primitives=tuple(grown))


def test_a_hand_of_hundreds_of_solids_is_tried_like_any(gripper, cube, closing):
    world = build_world(crowded(gripper, 40), cube, (cube.mesh,), STANDARD)
    assert hold_trial(world, closing(*GOOD), replace(STANDARD, hold_time=0.3)).reason == ""


def test_more_contacts_than_memory_are_a_failure_not_an_exception(gripper, cube, closing, monkeypatch):
    monkeypatch.setattr(trial_world, "_CROWD", 0)
    reasons = []
    # With too little for the contacts MuJoCo drops them; between that and enough it breaks off.
    for memory in (200_000, 300_000, 1_000_000):
        monkeypatch.setattr(trial_world, "_MEMORY", memory)
        world = build_world(crowded(gripper, 10), cube, (cube.mesh,), STANDARD)
        reasons.append(hold_trial(world, closing(*GOOD), replace(STANDARD, hold_time=0.1)).reason)
    assert any(reason.startswith("the simulation gave up: ") for reason in reasons)


@pytest.mark.parametrize(("share", "held"), [(1.3, True), (0.75, False)])
@pytest.mark.parametrize("friction", [0.3, 0.6, 1.0])
def test_friction_holds_above_coulombs_limit_and_slips_below(friction, share, held, gripper, cube, closing):
    # A pull of F along x against two faces: 2 μ N ≥ F. MuJoCo's friction is regularised, so that it creeps near the
    # limit, and the pulls across the faces unload one of them: a quarter to either side is left out.
    protocol = replace(STANDARD, friction=(friction, 0.02, 1e-4))
    force = protocol.pull * cube.mass
    normal = share * force / (2 * friction)
    squeeze = 0.025 + normal / protocol.slide_stiffness
    world = build_world(gripper, cube, (cube.mesh,), protocol)
    hold = hold_trial(world, closing(0.015, 0.0245, (squeeze, squeeze)), protocol)
    assert hold.passed == held, hold
    if not held:
        assert hold.reason.endswith("pull along +x")


def test_noise_is_survived_by_a_firm_squeeze_only(world, closing):
    errors = pose_errors(1, 8)
    good = some(noisy_share(world, closing(0.008, 0.025, (0.04, 0.04)), STANDARD, errors))
    assert good >= 0.75
    assert good == noisy_share(world, closing(0.008, 0.025, (0.04, 0.04)), STANDARD, errors)
    assert noisy_share(world, closing(*GOOD, height=-0.145), STANDARD, errors) == 0.0


def test_pose_errors_stay_within_their_bounds_and_move_all_postures_alike(closing):
    rng = np.random.default_rng(0)
    center = np.array([0.01, -0.02, 0.03])
    grasp = closing(*GOOD)
    for _ in range(50):
        rotation, offset = pose_error(rng)
        assert np.abs(offset).max() <= 0.005
        assert np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)) <= np.deg2rad(5) + 1e-7
        moved = displaced(grasp, rotation, offset, center)
        for before, after in zip(postures(grasp), postures(moved), strict=True):
            assert after.position == pytest.approx(rotation @ (before.position - center) + center + offset)
            assert after.joint_positions is before.joint_positions
            assert np.linalg.norm(after.quaternion_wxyz) == pytest.approx(1.0)


def postures(grasp) -> tuple[Posture, Posture, Posture]:
    return grasp.pregrasp, grasp.grasp, grasp.squeeze


USUAL = PROTOCOLS["standard"]


@pytest.fixture(scope="module")
def usual_world(gripper, cube) -> World:
    return build_world(gripper, cube, (cube.mesh,), USUAL)


def test_a_firm_squeeze_gives_no_more_than_its_springs(usual_world, closing):
    # Both fingers yield to 0.98 N along y by 0.98 N over both springs, and friction holds the rest.
    springs = 0.98 / (2 * USUAL.slide_stiffness)
    assert gravity_trial(usual_world, closing(0.015, 0.0249, (0.033, 0.033)), USUAL) < springs + 0.001


def test_an_object_out_of_reach_or_pushed_into_is_lost(usual_world, closing):
    assert gravity_trial(usual_world, closing(0.015, 0.025, (0.03, 0.03), height=-0.3), USUAL) == pytest.approx(LOST)
    assert gravity_trial(usual_world, closing(0.04, 0.04, (0.04, 0.04)), USUAL) == LOST


def test_an_open_hand_stops_the_object_in_the_directions_where_it_stands(usual_world, closing):
    # Fingers 5 mm off either side along y; the palm 10 mm below. Nothing along ±x and +z.
    moved = gravity_trial(usual_world, closing(0.02, 0.02, (0.02, 0.02), height=-0.03), USUAL)
    assert moved == pytest.approx((3 * LOST + 2 * 0.005 + 0.01) / 6, abs=0.002)


def test_the_same_trial_gives_the_same_figure_whatever_was_tried_between(usual_world, closing):
    grasp = closing(0.015, 0.025, (0.026, 0.026))
    first = gravity_trial(usual_world, grasp, USUAL)
    assert 0 < first < LOST
    assert gravity_trial(usual_world, closing(0.015, 0.025, (0.03, 0.03), height=-0.3), USUAL) > first
    assert gravity_trial(usual_world, grasp, USUAL) == first


def test_a_direction_that_is_cut_short_counts_with_what_it_came_to(usual_world, closing):
    far = closing(0.015, 0.025, (0.03, 0.03), height=-0.3)
    assert gravity_trial(usual_world, far, USUAL, stop=lambda: True) == 0.0
    # After 0.2 s, two looks, the object has fallen 20 cm and is lost; the other directions are not begun.
    looks = iter([False, False])
    assert gravity_trial(usual_world, far, USUAL, stop=lambda: next(looks, True)) == pytest.approx(LOST / 6)
