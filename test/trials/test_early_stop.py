"""Trials that stop early give the verdict of the full length, sooner."""

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd_core.hands.library import load_hand
from graspd_core.methods.candidates import find_candidates
from graspd_core.methods.loop import Hooks
from graspd_core.methods.plan_config import load_preset
from graspd_core.scene.load_scene import load_scene
from graspd_core.scene.scene import Scene, object_parts
from graspd_core.trials.early_stop import (
    CHECK_EVERY,
    CREEPING,
    FIRM,
    LOOK_EVERY,
    ObjectPose,
    answer_known,
    drift,
    stop_rule,
)
from graspd_core.trials.gravity_trial import TOLERANCE, gravity_trial
from graspd_core.trials.hold_trial import hold_trial
from graspd_core.trials.lift_trial import lift_trial
from graspd_core.trials.noisy_trial import displaced, pose_errors
from graspd_core.trials.world import PROTOCOLS, Protocol, World, at_friction, build_world, trial_data
from graspd_core.types import Grasp, Plane

# On softer springs than the trials' own, so that a millimetre of squeeze is half a newton.
SOFT = {"slide_stiffness": 500.0, "slide_damping": 10.0}
STANDARD, HARD = (replace(PROTOCOLS[name], **SOFT) for name in ("standard", "hard"))
FAR = -0.145


def full(protocol: Protocol) -> Protocol:
    return replace(protocol, full_length=True)


@pytest.fixture
def steps(monkeypatch) -> list[int]:
    """Steps of every call of MuJoCo from now on."""
    import mujoco

    counts, step = [], mujoco.mj_step

    def counted(model: Any, data: Any, nstep: int = 1) -> None:
        counts.append(nstep)
        step(model, data, nstep)

    monkeypatch.setattr(mujoco, "mj_step", counted)
    return counts


def test_rules_follow_from_friction():
    assert stop_rule(PROTOCOLS["standard"]) is FIRM
    assert stop_rule(at_friction(PROTOCOLS["standard"], 0.3)) is FIRM
    assert stop_rule(at_friction(PROTOCOLS["standard"], 0.1)) is CREEPING
    assert stop_rule(PROTOCOLS["hard"]) is CREEPING
    assert stop_rule(PROTOCOLS["full"]) is stop_rule(PROTOCOLS["hard_full"]) is None
    for rule in (FIRM, CREEPING):
        assert not any(number % LOOK_EVERY for number in (rule.first, rule.window, CHECK_EVERY))
        assert rule.first > rule.window


@given(speed=st.floats(0.01, 10.0), done=st.integers(0, 499), spin=st.floats(0.0, 10.0))
def test_what_moves_evenly_to_a_limit_is_never_known_to_hold(speed, done, spin):
    # Speeds as shares of the limits over 500 steps.
    protocol, rule = PROTOCOLS["standard"], FIRM

    def pose(step: int) -> ObjectPose:
        half = spin * protocol.max_rotation * step / 500 / 2
        return ObjectPose(
            (speed * protocol.max_displacement * step / 500, 0.0, 0.0), (np.cos(half), 0.0, np.sin(half), 0.0)
        )

    now = pose(done + rule.window)
    turn, travel = spin * protocol.max_rotation * (done + rule.window) / 500, now.center[0]
    known = answer_known(protocol, travel, turn, drift(rule, pose(done), now, 500 - done - rule.window))
    if speed >= 1 or spin >= 1:
        assert not known
    elif max(speed, spin) * rule.safety < 0.99 and done + rule.window <= 500:
        assert known


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_never_known(bad):
    still = ObjectPose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    lost = ObjectPose((bad, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    assert answer_known(STANDARD, 0.0, 0.0, drift(FIRM, still, still, 100))
    assert not answer_known(STANDARD, 0.0, 0.0, drift(FIRM, still, lost, 100))
    assert not answer_known(STANDARD, bad, 0.0, (0.0, 0.0))
    assert not answer_known(STANDARD, 0.0, bad, (0.0, 0.0))


@pytest.mark.parametrize("protocol", [STANDARD, at_friction(STANDARD, 0.3), HARD], ids=["standard", "slippery", "hard"])
def test_verdicts_are_those_of_the_full_length_from_held_to_lost(protocol, gripper, cube, closing):
    world = build_world(gripper, cube, (cube.mesh,), protocol)
    # 0.5 N per millimetre and side: from nothing, over creeping and slipping, to several times Coulomb's limit.
    squeezes = [0.0252, 0.0256, 0.026, 0.0262, 0.0264, 0.0266, 0.0268, 0.0272, 0.028, 0.03, 0.034, 0.04]
    grasps = [closing(0.015, 0.025, (s, s)) for s in squeezes] + [closing(0.015, 0.025, (0.04, 0.04), height=FAR)]
    early = [hold_trial(world, grasp, protocol) for grasp in grasps]
    late = [hold_trial(world, grasp, full(protocol)) for grasp in grasps]
    assert [hold.passed for hold in early] == [hold.passed for hold in late]
    assert {hold.passed for hold in late} == {True, False}
    # Limits are checked when they were: a failure has the same reason.
    assert [hold.reason for hold in early] == [hold.reason for hold in late]
    assert all(a.displacement <= b.displacement for a, b in zip(early, late, strict=True))


def test_a_firm_grasp_takes_a_fraction_of_the_steps(gripper, cube, closing, steps):
    world, grasp = build_world(gripper, cube, (cube.mesh,), STANDARD), closing(0.015, 0.025, (0.04, 0.04))
    assert hold_trial(world, grasp, full(STANDARD)).passed
    long = sum(steps)
    assert long == 200 + 6 * 500
    steps.clear()
    assert hold_trial(world, grasp, STANDARD).passed
    assert 200 + 6 * FIRM.first <= sum(steps) <= long / 5


@pytest.mark.parametrize(("speed", "held"), [(0.02, True), (0.027, False)])
def test_a_slow_creep_that_breaks_a_limit_late_is_not_verified(speed, held, gripper, cube, closing):
    # In honey an object that nothing holds drifts evenly: 4 cm in 2 s, or 5 cm after 1.85 s.
    world = build_world(gripper, cube, (cube.mesh,), STANDARD)
    world.model.opt.viscosity = 1.0
    adrift, by_one = closing(0.0, 0.0, (0.0, 0.0), height=FAR), STANDARD.pull * cube.mass
    reached = hold_trial(world, adrift, replace(full(STANDARD), hold_time=0.4, max_displacement=1.0)).displacement
    world.model.opt.viscosity = 0.0
    assert reached > 0.1  # free, it falls 80 cm in that time; honey slows it
    world.model.opt.viscosity = by_one / (3 * np.pi * 0.04 * speed)
    late, early = (hold_trial(world, adrift, protocol) for protocol in (full(STANDARD), STANDARD))
    assert late.passed == early.passed == held
    if not held:
        assert early == late
        assert hold_trial(world, adrift, replace(full(STANDARD), hold_time=1.7)).passed


# Too far below for any hand that holds the object, which rests on a plane of its own.
TABLE = Plane(np.array([0.0, 0.0, 1.0]), -1.0)


@pytest.fixture(scope="module")
def real() -> tuple[Scene, Any, list[Grasp]]:
    """Grasps that the method found on a mug-sized box, and each once more out of place."""
    config, hand = load_preset("fast"), load_hand("allegro_right")
    scene = load_scene("shape:box", resolution=config.resolution)
    found = find_candidates(scene, hand, count=3, seed=0, config=config, hooks=Hooks()).grasps[:3]
    center = scene.object.center_of_mass
    return scene, hand, [*found, *(displaced(g, *e, center) for g, e in zip(found, pose_errors(1, 3), strict=True))]


@pytest.mark.parametrize("name", ["standard", "hard"])
def test_real_grasps_have_the_verdict_of_the_full_length(name, real):
    scene, hand, grasps = real
    protocol = PROTOCOLS[name]
    world = build_world(hand, scene.object, object_parts(scene.object), protocol)
    early, late = ([hold_trial(world, g, p) for g in grasps] for p in (protocol, full(protocol)))
    assert [(hold.passed, hold.reason) for hold in early] == [(hold.passed, hold.reason) for hold in late]


def test_a_lift_ends_early_with_the_same_verdict(real, steps):
    scene, hand, grasps = real
    protocol = PROTOCOLS["standard"]
    world = build_world(hand, scene.object, object_parts(scene.object), protocol, TABLE)
    early, late = [], []
    for verdicts, trial_protocol in ((early, protocol), (late, full(protocol))):
        for grasp in grasps:
            steps.clear()
            lift = lift_trial(world, hand, grasp, trial_protocol)
            verdicts.append((lift.passed, lift.reason, sum(steps)))
    assert [verdict[:2] for verdict in early] == [verdict[:2] for verdict in late]
    assert {passed for passed, *_ in late} == {True, False}
    assert all(a[2] <= b[2] - 500 for a, b in zip(early, late, strict=True) if b[0])


def test_gravity_is_known_to_its_tolerance(gripper, cube, closing, steps):
    world = build_world(gripper, cube, (cube.mesh,), STANDARD)
    firm = closing(0.015, 0.025, (0.04, 0.04))
    early, few = gravity_trial(world, firm, STANDARD), sum(steps)
    late = gravity_trial(world, firm, full(STANDARD))
    assert early == pytest.approx(late, abs=TOLERANCE)
    assert few < (sum(steps) - few) / 2
    # Nothing holds it: five directions lose it, the sixth rests it on the palm.
    lost = closing(0.015, 0.025, (0.04, 0.04), height=FAR)
    assert gravity_trial(world, lost, STANDARD) == pytest.approx(gravity_trial(world, lost, full(STANDARD)), abs=1e-9)


@pytest.fixture
def worlds(gripper, cube) -> Callable[[], World]:
    return lambda: build_world(gripper, cube, (cube.mesh,), STANDARD)


def test_kept_data_give_the_figures_of_fresh_data_bit_for_bit(worlds, closing):
    # Weak holds, whose slipping amplifies any difference; a lost object; one that is pushed into.
    squeezes = (0.0262, 0.04, 0.0264, 0.0262)
    grasps = [closing(0.015, 0.025, (s, s)) for s in squeezes]
    grasps[2:2] = [closing(0.034, 0.034, (0.04, 0.04)), closing(0.015, 0.025, (0.04, 0.04), height=FAR)]
    kept = worlds()
    with_kept = [hold_trial(kept, grasp, STANDARD) for grasp in grasps]
    assert len(kept.spare) == 1
    assert with_kept == [hold_trial(worlds(), grasp, STANDARD) for grasp in grasps]
    assert with_kept[0] == with_kept[-1]


def test_data_of_a_trial_that_broke_off_are_not_used_again(worlds):
    world = worlds()
    with trial_data(world) as first, trial_data(world) as second:
        assert first is not second
    assert len(world.spare) == 2
    with pytest.raises(RuntimeError), trial_data(world):
        raise RuntimeError
    assert len(world.spare) == 1
