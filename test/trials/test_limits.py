"""How much a grasp holds: payload and least friction against Coulomb's law, and runs whose object is too heavy."""

from dataclasses import replace

import pytest

from graspd_core import Outcome, Verdict, load_hand, load_preset, load_scene, plan_grasps, verify_grasps
from graspd_core.verify.hold_trial import hold_trial
from graspd_core.verify.limits import FINENESS, MOST_PAYLOAD, least_friction, payload
from graspd_core.verify.world import PROTOCOLS, altered

# On softer springs than the trials' own, so that a millimetre of squeeze is half a newton.
STANDARD = replace(PROTOCOLS["standard"], slide_stiffness=500.0, slide_damping=10.0)
# MuJoCo's friction is regularised, and pulls across the faces unload one of them (test_hold_trial.py).
NEAR = 0.3


def pressed(closing, normal: float):
    """The cube between two faces that press by so much each [N]."""
    squeeze = 0.025 + normal / STANDARD.slide_stiffness
    return closing(0.015, 0.0245, (squeeze, squeeze))


@pytest.mark.parametrize("normal", [2.0, 5.0])
def test_payload_and_least_friction_are_those_of_coulombs_law(normal, world, cube, closing):
    grasp = pressed(closing, normal)
    carried = 2 * STANDARD.friction[0] * normal / STANDARD.pull
    assert payload(world, grasp, STANDARD) == pytest.approx(carried, rel=NEAR)
    needed = STANDARD.pull * cube.mass / (2 * normal)
    assert least_friction(world, grasp, STANDARD) == pytest.approx(needed, rel=NEAR)


def test_the_payload_is_where_the_trial_s_verdict_changes(world, closing):
    grasp = pressed(closing, 4.0)
    found = payload(world, grasp, STANDARD)
    assert hold_trial(altered(world, mass=0.9 * found), grasp, STANDARD).passed
    assert not hold_trial(altered(world, mass=1.1 * FINENESS * found), grasp, STANDARD).passed
    assert payload(world, grasp, STANDARD, least=2 * found) == 0.0
    assert payload(world, grasp, STANDARD, least=2 * MOST_PAYLOAD, held=True) == 2 * MOST_PAYLOAD


def test_a_hand_that_a_trial_closed_is_not_closed_again(world, closing):
    grasp = pressed(closing, 4.0)
    alone = altered(world)
    found = payload(alone, grasp, STANDARD)
    assert not alone.closed
    assert hold_trial(alone, grasp, STANDARD).passed
    assert len(alone.closed) == 1
    assert payload(alone, grasp, STANDARD) == found
    # Another mass presses otherwise.
    assert not altered(alone, mass=0.5).closed


def test_what_does_not_close_carries_nothing(world, closing):
    assert payload(world, closing(0.04, 0.04, (0.04, 0.04)), STANDARD) == 0.0
    assert payload(world, closing(0.015, 0.025, (0.04, 0.04), height=-0.145), STANDARD) == 0.0
    assert payload(world, pressed(closing, 4.0), STANDARD, stop=lambda: True) == 0.0


@pytest.fixture(scope="module")
def scene():
    return load_scene("shape:box", mass=50.0)


def test_an_assumed_mass_that_the_hand_cannot_lift_is_lowered_and_told(scene):
    unknown = replace(scene, object=replace(scene.object.at_mass(5.0), mass_assumed=True))
    result = plan_grasps(unknown, load_hand("parallel_gripper"), count=2, preset="fast")
    assert result.outcome is Outcome.SUCCEEDED
    assert result.mass is not None
    assert 0.05 < result.mass < 5.0
    why = "because the hand cannot hold the 5 kg that were assumed"
    assert f"grasps were tried at {result.mass:.2g} kg, {why}" in result.warnings[-1]
    held = [g.metrics["payload"] for g in result.grasps if g.metrics and g.verdict is Verdict.VERIFIED]
    assert all(most is not None and result.mass / FINENESS < most <= MOST_PAYLOAD for most in held)


def test_a_known_mass_that_the_hand_cannot_lift_is_never_lowered(scene):
    result = plan_grasps(scene, load_hand("parallel_gripper"), count=1, preset="fast")
    assert not any(grasp.usable for grasp in result.grasps)
    assert result.mass is None
    assert "the strongest grasp would hold" in result.message


def test_the_least_friction_is_measured_where_it_was_asked_for():
    config = load_preset("fast")
    config = replace(config, robust=replace(config.robust, friction=True))
    box, hand = load_scene("shape:box", mass=0.1), load_hand("parallel_gripper")
    asked, plain = (plan_grasps(box, hand, count=1, preset=each).grasps[0] for each in (config, "fast"))
    measured, usual = (dict(grasp.metrics or {}) for grasp in (asked, plain))
    assert 0.0 < (measured["least_friction"] or 0.0) <= 0.6
    assert usual["least_friction"] is None
    assert usual["payload"] == measured["payload"]
    assert (usual["payload"] or 0.0) > 0.1
    # Grasps that come from elsewhere are weighed as well.
    (again,) = verify_grasps(box, hand, [plain])
    assert (again.metrics or {})["payload"] == usual["payload"]
