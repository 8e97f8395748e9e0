"""Trials that stop early give the verdict of the full length, sooner; one in fifty is tried at full length."""

# mujoco is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd_bench.trials import TOLERANCE, gravity_trial
from graspd_core import load_hand, load_preset, load_scene
from graspd_core.optimize.candidates import PlannerInput, find_candidates
from graspd_core.optimize.loop import Hooks
from graspd_core.perception.scene import Scene, object_parts
from graspd_core.types import Grasp, Plane
from graspd_core.verify.early_stop import (
    CHECK_EVERY,
    CREEPING,
    FIRM,
    LOOK_EVERY,
    ROUGH,
    SLIPPERY,
    ObjectState,
    answer_known,
    stop_rule,
)
from graspd_core.verify.hold_trial import displaced, hold_trial, pose_errors
from graspd_core.verify.lift_trial import lift_trial
from graspd_core.verify.limits import FINENESS, LEAST_PAYLOAD, payload
from graspd_core.verify.world import PROTOCOLS, Protocol, World, altered, at_friction, build_world, trial_data

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
    assert stop_rule(PROTOCOLS["standard"], 4) is FIRM
    assert stop_rule(at_friction(PROTOCOLS["standard"], 0.3), 4) is SLIPPERY
    assert stop_rule(at_friction(PROTOCOLS["standard"], 0.1), 4) is CREEPING
    assert stop_rule(PROTOCOLS["hard"], 4) is CREEPING
    assert stop_rule(PROTOCOLS["standard"], 2) is CREEPING
    assert stop_rule(PROTOCOLS["standard"], 4, rough=True) is ROUGH
    assert stop_rule(PROTOCOLS["hard"], 4, rough=True) is CREEPING
    assert stop_rule(PROTOCOLS["full"], 4) is stop_rule(PROTOCOLS["hard_full"], 4) is None
    for rule in (FIRM, SLIPPERY, CREEPING):
        assert not any(number % LOOK_EVERY for number in (rule.first, *rule.windows, CHECK_EVERY))
        assert rule.first > rule.windows[0]


SLOW = replace(PROTOCOLS["standard"], max_displacement=0.005, max_rotation=math.radians(5))


@given(
    speed=st.floats(0.01, 10.0),
    done=st.integers(0, 460),
    spin=st.floats(0.0, 10.0),
    rule=st.sampled_from((FIRM, ROUGH)),
)
def test_what_moves_evenly_to_a_limit_is_never_known_to_hold(speed, done, spin, rule):
    # Speeds as shares of the limits over 500 steps of 4 ms; the limits are such that all but the fastest are at rest.
    ends = (speed * SLOW.max_displacement, spin * SLOW.max_rotation)

    def state(step: int) -> ObjectState:
        travel, turn = (end * step / 500 for end in ends)
        turned = (math.cos(turn / 2), 0.0, math.sin(turn / 2), 0.0)
        return ObjectState((travel, 0.0, 0.0), turned, ends[0] / 2, ends[1] / 2)

    now = done + max(rule.windows)
    states = [state(step) for step in range(done, now + 1, LOOK_EVERY)]
    known = answer_known(rule, SLOW, states, (ends[0] * now / 500, ends[1] * now / 500), 500 - now)
    if speed >= 1 or spin >= 1:
        assert not known
    elif max(speed, spin) * rule.safety < 0.99:
        assert known


REST = ObjectState((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.0, 0.0)


@pytest.mark.parametrize("jitter", [replace(REST, speed=0.003), replace(REST, spin=0.04)])
def test_only_a_loose_hold_asks_for_rest(jitter):
    # Where friction is low or fingers are few, contacts that throw the object to and fro sooner or later throw it out.
    assert answer_known(CREEPING, STANDARD, [REST] * 11, (0.0, 0.0), 400)
    assert not answer_known(CREEPING, STANDARD, [*[REST] * 10, jitter], (0.0, 0.0), 400)
    assert answer_known(FIRM, STANDARD, [*[REST] * 10, jitter], (0.0, 0.0), 400)


def test_jitter_that_hides_the_drift_of_a_few_steps_cancels_over_more_of_them():
    # 0.2 mm to and fro within 10 steps comes to 8 times 8 mm in 400.
    jitter = [replace(REST, center=(0.0002 * (look % 4 == 0), 0.0, 0.0)) for look in range(9)]
    assert not answer_known(FIRM, STANDARD, jitter[-3:], (0.0, 0.0), 400)
    assert answer_known(FIRM, STANDARD, jitter, (0.0, 0.0), 400)
    assert not answer_known(FIRM, STANDARD, jitter[-4:], (0.0, 0.0), 400)
    # A steady drift is as fast over any span.
    creep = [replace(REST, center=(0.0001 * look, 0.0, 0.0)) for look in range(9)]
    assert not answer_known(FIRM, STANDARD, creep, (0.0, 0.0), 400)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_never_known(bad):
    for lost in (replace(REST, center=(bad, 0.0, 0.0)), replace(REST, speed=bad), replace(REST, spin=bad)):
        assert not answer_known(FIRM, STANDARD, [REST, REST, lost], (0.0, 0.0), 100)
    assert not answer_known(FIRM, STANDARD, [REST, REST, REST], (bad, 0.0), 100)
    assert not answer_known(FIRM, STANDARD, [REST, REST, REST], (0.0, bad), 100)
    assert answer_known(FIRM, STANDARD, [REST, REST, REST], (0.0, 0.0), 100)


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
    assert world.fingers == 2
    world = replace(world, fingers=3)
    assert hold_trial(world, grasp, full(STANDARD)).passed
    long = sum(steps)
    assert long == 200 + 6 * 500
    steps.clear()
    assert hold_trial(world, grasp, STANDARD).passed
    assert 200 + 6 * FIRM.first <= sum(steps) <= long / 5


@pytest.mark.parametrize(("speed", "held"), [(0.002, True), (0.0027, False)])
def test_a_slow_creep_that_breaks_a_limit_late_is_not_verified(speed, held, gripper, cube, closing):
    # In a fluid thicker than honey an object that nothing holds drifts evenly: 4 mm in 2 s, or 5 mm after 1.85 s.
    world = replace(build_world(gripper, cube, (cube.mesh,), STANDARD), fingers=3)
    world.model.opt.viscosity = STANDARD.pull * cube.mass / (3 * np.pi * 0.04 * speed)
    adrift, protocol = closing(0.0, 0.0, (0.0, 0.0), height=FAR), replace(STANDARD, max_displacement=0.005)
    late, early = (hold_trial(world, adrift, p) for p in (full(protocol), protocol))
    assert late.passed == early.passed == held
    if not held:
        assert early == late
        # Most of the way it is within the limit.
        assert hold_trial(world, adrift, replace(full(protocol), hold_time=1.7)).passed


# Too far below for any hand that holds the object, which rests on a plane of its own.
TABLE = Plane(np.array([0.0, 0.0, 1.0]), -1.0)


@pytest.fixture(scope="module")
def real() -> tuple[Scene, Any, list[Grasp]]:
    """Grasps that the method found on a mug-sized box, each once more out of place, and an open hand far above."""
    config, hand = load_preset("fast"), load_hand("allegro_right")
    scene = load_scene("shape:box", resolution=config.resolution)
    found = find_candidates(PlannerInput(scene, hand, count=3, seed=0, config=config, hooks=Hooks()))[:3]
    center = scene.object.center_of_mass
    away = [displaced(g, *e, center) for g, e in zip(found, pose_errors(1, 3), strict=True)]
    # An open hand may yet lift the box as a shovel does; this one is far above it.
    above = displaced(found[0], np.eye(3), np.array([0.0, 0.0, 0.4]), center)
    return scene, hand, [*found, *away, replace(above, grasp=above.pregrasp, squeeze=above.pregrasp)]


@pytest.mark.parametrize("name", ["standard", "hard"])
def test_real_grasps_have_the_verdict_of_the_full_length(name, real):
    scene, hand, grasps = real
    protocol = PROTOCOLS[name]
    world = build_world(hand, scene.object, object_parts(scene.object), protocol)
    early, late = ([hold_trial(world, g, p) for g in grasps] for p in (protocol, full(protocol)))
    assert [(hold.passed, hold.reason) for hold in early] == [(hold.passed, hold.reason) for hold in late]


@pytest.mark.parametrize("heavy", [False, True])
def test_payloads_are_those_of_the_full_length(heavy, real, steps):
    scene, hand, grasps = real
    protocol = PROTOCOLS["standard"]
    world = build_world(hand, scene.object, object_parts(scene.object), protocol)
    # A heavy object drifts so slowly that the rough rule would take twice the payload for held.
    world, least = (altered(world, mass=30.0), LEAST_PAYLOAD) if heavy else (world, scene.object.mass)
    early = [payload(world, g, protocol, least=least, held=not heavy) for g in grasps[:3]]
    few = sum(steps)
    late = [payload(world, g, full(protocol), least=least, held=not heavy) for g in grasps[:3]]
    assert few < (sum(steps) - few) / 3
    # Both are at most a tenth below the limit. Contacts that slip and stick again may hide a little more.
    assert all(b / FINENESS**2 < a <= FINENESS * b for a, b in zip(early, late, strict=True))
    assert heavy or payload(world, grasps[-1], protocol) == 0.0


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
