"""Grasps of an object that cameras saw: what else may be true, how many survive it, what is said of it."""

import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from expected import some
from hypothesis import given
from hypothesis import strategies as st
from made_meshes import box_between

from graspd_bench.rendering.tabletop import CAMERA, ring_poses, tabletop, views_of
from graspd_core import PointCloud, load_hand, load_preset, load_scene, plan_grasps, scene_from_views, with_neighbours
from graspd_core.config import CertaintyConfig
from graspd_core.config.planning_config import (
    DOUBTED_SHARE,
    LEAST_LIGHT,
    MASS_ASSUMED,
    MASS_KNOWN,
    light_end,
    share_as_light,
)
from graspd_core.errors import ConfigError
from graspd_core.hands.surface_points import with_candidates
from graspd_core.mesh.convex_parts import convex_parts
from graspd_core.optimize.plan_config import method_row
from graspd_core.perception import scene as scene_module
from graspd_core.perception.reconstruct.merge_views import Evidence
from graspd_core.perception.scene import COARSE_CUTS, ObjectModel, Scene, moved_grasp, object_parts
from graspd_core.planning.rounds import rounds_of, run_rounds
from graspd_core.types import ROBUSTNESS, Grasp, GraspResult, Outcome, Posture, Stage, StopHook, TrialResult, Verdict
from graspd_core.verify import robustness as hypotheses
from graspd_core.verify import verification
from graspd_core.verify.hold_trial import STOPPED, hold_trial
from graspd_core.verify.limits import payload
from graspd_core.verify.robustness import (
    CheckStage,
    LaterWorld,
    RobustnessCheck,
    RobustnessChecks,
    begin_in_thread,
    begin_other_shapes,
    begin_other_worlds,
    less_sure,
    robustness_checks_of,
    try_robustness,
)
from graspd_core.verify.run_clock import Run
from graspd_core.verify.trial_registry import TrialContext, build_worlds
from graspd_core.verify.world import PROTOCOLS, World, altered, at_friction, build_world

POSTURE = Posture(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(1))
GRASP = Grasp(POSTURE, POSTURE, POSTURE, (), 0.0)
# As presets ask for.
SURE = CertaintyConfig().probability


@cache
def seen_from(shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Scene:
    """A cylinder on a table, seen by one camera, in coordinates moved by `shift` [m]."""
    views = views_of(tabletop("cylinder"), CAMERA, ring_poses(1, elevation=0.8))
    moved = [PointCloud(view.points + shift, view.viewpoint + np.array(shift)) for view in views]
    return scene_from_views(moved, mass=0.1)


@cache
def worlds_of_seen() -> TrialContext:
    """What grasps of the hand are tried with on the cylinder seen by one camera."""
    seen = seen_from()
    return build_worlds(seen, load_hand("allegro_right"), object_parts(seen.object), PROTOCOLS["standard"])


@cache
def seen_all_round() -> Scene:
    """The same cylinder, seen by eight cameras."""
    return scene_from_views(views_of(tabletop("cylinder"), CAMERA, ring_poses(8, elevation=0.8)), mass=0.1)


def plan(scene: Scene, probability: float, rounds: int = 3) -> GraspResult:
    config = replace(load_preset("fast"), certainty=CertaintyConfig(probability))
    config = replace(config, rounds=replace(config.rounds, most=rounds))
    return plan_grasps(scene, load_hand("allegro_right"), count=3, preset=config, measure=False)


@cache
def planned(shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> GraspResult:
    """As sure as presets ask for."""
    return plan(seen_from(shift), SURE)


# How likely a grasp holds that fails at each stage, and one that passes all.
FAILED, PASSED = (0.5, 0.6), 0.9


def under(*stages: Sequence[bool | None]) -> RobustnessChecks:
    """Hypotheses that a grasp passes, fails, or that cannot be tried."""

    def hypothesis(number: str, held: bool | None) -> RobustnessCheck:
        result = None
        if held is not None:
            result = TrialResult("hold", held, 0.01 * int(number[-1]), 0.0, "" if held else "the object moved")
        return RobustnessCheck(f"number {number}", lambda grasp, stop: result)

    made = [tuple(hypothesis(f"{i}.{j}", held) for j, held in enumerate(stage)) for i, stage in enumerate(stages)]
    return RobustnessChecks(tuple(map(CheckStage, made, FAILED)), PASSED)


@pytest.mark.parametrize(
    ("passed", "verified", "probability", "travel", "reason"),
    [
        (((True, True),), True, PASSED, 0.01, ""),
        (((True, True, True), (True,)), True, PASSED, 0.02, ""),
        (((True, None, True), (None,)), True, PASSED, 0.02, ""),
        (((True, False, True), (True,)), False, FAILED[0], 0.0, "number 0.1: the object moved"),
        (((True, True, True), (False,)), False, FAILED[1], 0.02, "number 1.0: the object moved"),
    ],
)
def test_a_grasp_must_hold_under_all_that_can_be_tried(passed, verified, probability, travel, reason):
    result, likely = try_robustness(under(*passed), GRASP, lambda: False)
    assert (result.name, result.passed, likely) == (ROBUSTNESS, verified, probability)
    assert result.reason == (f"fails with {reason}" if reason else "")
    assert result.displacement == travel


def test_another_shape_may_turn_less_than_the_likeliest(monkeypatch):
    monkeypatch.setattr(hypotheses, "_LESS_TURN", 1e-3)
    box = scene_from_views(views_of(tabletop("box"), CAMERA, ring_poses(1, elevation=0.8)), mass=0.1)
    reasons = [grasp.reason for grasp in plan(box, SURE, rounds=1).tried if grasp.trials[0].passed]
    assert reasons
    assert all(reason.startswith("fails with ") for reason in reasons)
    assert any("other shape" in reason and "turned" in reason for reason in reasons)


_STAGE = st.lists(st.sampled_from([True, True, True, False, None]), max_size=5)


@given(st.lists(_STAGE, min_size=1, max_size=2), st.integers(2, 4))
def test_several_at_a_time_come_to_the_same(passed, threads):
    asked = under(*passed)
    one = try_robustness(asked, GRASP, lambda: False)
    assert one == try_robustness(asked, GRASP, lambda: False, threads)
    assert one[0].passed == all(held is not False for stage in passed for held in stage)


def test_others_are_tried_once_the_best_waits_for_a_shape(monkeypatch):
    grasps = tuple(replace(GRASP, score=score) for score in (2.0, 1.0))
    second_begun, waited_for = threading.Event(), threading.Event()
    held = TrialResult("hold", True, 0.0, 0.0, "")

    def likeliest(context: TrialContext, grasp: Grasp, stop: StopHook) -> tuple[TrialResult]:
        if grasp is grasps[1]:
            assert waited_for.is_set()
            second_begun.set()
        return (held,)

    def waits(grasp: Grasp, stop: StopHook) -> TrialResult:
        assert not second_begun.is_set() or grasp is grasps[1]
        waited_for.set()
        assert second_begun.wait(60)
        return held

    monkeypatch.setattr(verification, "grasp_trials", likeliest)
    asked = RobustnessChecks((CheckStage((RobustnessCheck("a shape", waits),), 0.5),), PASSED, waited_for)
    box = load_scene("shape:box")
    worlds = build_worlds(box, load_hand("allegro_right"), object_parts(box.object), PROTOCOLS["standard"])
    context = verification.VerificationContext(worlds, None, asked)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        tried = verification.run_trials(Run(time.perf_counter(), None, None, None), context, grasps, 1, 0)
    finally:
        torch.set_num_threads(threads)
    assert [grasp.verdict for grasp in tried.grasps] == [Verdict.VERIFIED]


def test_a_shape_that_was_begun_with_the_scene_is_not_made_again(monkeypatch):
    made, begun_before_grid = [], []
    other, grid = hypotheses.other_scene, scene_module.object_sdf
    monkeypatch.setattr(hypotheses, "other_scene", lambda *given: made.append(given[1]) or other(*given))
    monkeypatch.setattr(
        scene_module, "object_sdf", lambda *given: begun_before_grid.append(bool(begun)) or grid(*given)
    )
    begun: list[str] = []

    def ahead(likeliest: ObjectModel, evidence: Evidence) -> None:
        begin_other_shapes(SURE, likeliest, evidence)
        begun.extend(hypotheses._begun(evidence))

    scene = scene_from_views(views_of(tabletop("cylinder"), CAMERA, ring_poses(1, elevation=0.8)), ahead=ahead)
    assert begun_before_grid[0]
    assert begun == ["mirror"]
    assert any(grasp.verdict is Verdict.VERIFIED for grasp in plan(scene, SURE).grasps)
    assert [made.count(rule) for rule in begun] == [1] * len(begun)


def test_no_shape_is_begun_where_none_is_needed():
    evidence = some(seen_all_round().evidence)
    for doubted, probability in ((evidence, SURE), (replace(evidence, hidden=True), MASS_KNOWN.places)):
        begin_other_shapes(probability, seen_all_round().object, doubted)
        assert not hypotheses._begun(doubted)


def test_nothing_is_tried_after_a_failure_and_what_was_stopped_is_not_verified():
    def never(grasp, stop):
        raise AssertionError("tried")

    late = RobustnessCheck("late", never)
    failing = under((True, False), (True,))
    first, second = failing.stages
    asked = replace(failing, stages=(replace(first, items=(*first.items, late)), replace(second, items=(late,))))
    assert not try_robustness(asked, GRASP, lambda: False)[0].passed
    for threads in (1, 2):
        result, _ = try_robustness(under((True, True, True)), GRASP, lambda: True, threads)
        assert (result.passed, result.reason) == (False, STOPPED)


def test_all_shapes_are_begun_and_with_another_mass_once_they_are_asked_for(monkeypatch):
    seen, hand, protocol = seen_from(), load_hand("allegro_right"), PROTOCOLS["standard"]
    world, made = build_world(hand, seen.object, object_parts(seen.object), protocol), []
    monkeypatch.setattr(
        "graspd_core.perception.reconstruct.hidden_side.other_rules",
        lambda _: ("mirror", "revolution"),
    )
    all_made = threading.Event()

    def make(*given: Any) -> World | None:
        made.append(given[-1])
        if len(made) == 2:
            all_made.set()
        return world if given[-1] == "mirror" else None

    monkeypatch.setattr(hypotheses, "_other_world", make)
    mirrored, turned = begin_other_worlds(Run(time.perf_counter(), None, None, None), seen, hand, protocol, SURE)
    assert all_made.wait(60)
    assert mirrored.begin().result() is world
    assert turned.begin().result() is None
    heavier = some(mirrored.altered(2.0).begin().result())
    assert heavier.model.body_mass[heavier.object_body] == 2.0
    assert turned.altered(2.0).begin().result() is None
    assert sorted(made) == ["mirror", "revolution"]


@pytest.mark.parametrize("assumed", [True, False])
def test_no_more_is_in_doubt_than_the_probability_asks_for(assumed):
    shares, seen = MASS_ASSUMED if assumed else MASS_KNOWN, seen_from()
    seen, hand = replace(seen, object=replace(seen.object, mass_assumed=assumed)), load_hand("allegro_right")
    for probability, stages in ((0.0, None), (shares.likeliest, None), (shares.places, 1), (shares.shapes, 2)):
        run = Run(time.perf_counter(), 0.0, None, None)
        others = begin_other_worlds(run, seen, hand, PROTOCOLS["standard"], probability)
        asked = robustness_checks_of(seen, others, worlds_of_seen(), probability)
        assert (None if asked is None else len(asked.stages)) == stages
        assert bool(others) == (stages == 2)
        if asked is not None and not others:
            # A grasp that fails the only checks is less likely to hold than one that was not checked.
            assert asked.stages[0].though_failed < shares.likeliest
        if asked is not None:
            assert asked.probability >= probability
            assert len(asked.stages[-1].items) == (3 if assumed else 4)


def test_at_less_than_the_assumed_mass_a_grasp_is_less_sure():
    seen, worlds = replace(seen_from(), object=replace(seen_from().object, mass_assumed=True)), worlds_of_seen()
    ahead = verification.Prefetched(begin_in_thread("worlds", lambda: worlds), (LaterWorld(lambda: None),))
    context = verification.VerificationContext(worlds, None)
    heavy = seen.object.mass
    half = verification.lighter(seen, ahead, context, CertaintyConfig(), 0.4 * heavy, 0.7 * heavy)
    assert half.trials.alone.model.body_mass[half.trials.alone.object_body] == 0.4 * heavy
    share = share_as_light(0.7, 1.0)
    assert LEAST_LIGHT < share < 1.0
    own = less_sure(some(half.checks), 0.7 * heavy, heavy)
    assert own.probability == pytest.approx(share * MASS_ASSUMED.shapes)
    assert [stage.though_failed for stage in own.stages] == pytest.approx(
        [share * MASS_ASSUMED.fails_shapes, share * MASS_ASSUMED.fails_places]
    )
    # Most objects of this volume are heavier than a tenth of the heavy end: no grasp is verified.
    tenth = verification.lighter(seen, ahead, context, CertaintyConfig(), 0.08 * heavy, 0.1 * heavy)
    result, probability = try_robustness(less_sure(some(tenth.checks), 0.1 * heavy, heavy), GRASP, lambda: False)
    assert not result.passed
    assert "too many objects of this volume weigh more" in result.reason
    assert probability == pytest.approx(share_as_light(0.1, 1.0) * MASS_ASSUMED.likeliest)
    # On a doubted scene too, a grasp of little payload is less sure.
    doubted = RobustnessChecks((), DOUBTED_SHARE, doubts=("are its numbers metres?",))
    lighter = less_sure(doubted, 0.1 * heavy, heavy)
    assert lighter.doubts == doubted.doubts
    assert lighter.probability == pytest.approx(share_as_light(0.1, 1.0) * DOUBTED_SHARE)


def test_what_cameras_saw_is_tried_at_the_light_end_of_the_assumed_mass():
    seen = replace(seen_from(), object=replace(seen_from().object, mass_assumed=True))
    result = plan_grasps(seen, load_hand("allegro_right"), count=2, preset="fast")
    tried = light_end(seen.object.mass)
    assert (result.mass, result.tried_mass) == (tried, tried)
    why = "because 80% of objects of this volume weigh no more"
    assert any(f"tried at {tried:.2g} kg, {why}" in told for told in result.warnings)
    verified = [grasp for grasp in result.grasps if grasp.verdict is Verdict.VERIFIED]
    assert verified
    for grasp in verified:
        share = some(grasp.probability) / MASS_ASSUMED.shapes
        assert LEAST_LIGHT - 1e-9 <= share <= 1.0
        # Only what also lifts the assumed mass is as sure as a grasp of a known mass.
        assert share < 1.0 or some(some(grasp.metrics)["payload"]) >= seen.object.mass / 1.1


@pytest.mark.parametrize("about", [{"piled": True}, {"doubts": ("are its numbers metres?",)}])
def test_in_a_pile_and_in_a_doubted_scene_the_assumed_mass_is_tried(about):
    seen, hand = seen_from(), load_hand("allegro_right")
    evidence = replace(some(seen.evidence), **about)
    scene = replace(seen, object=replace(seen.object, mass_assumed=True), evidence=evidence)
    run = Run(time.perf_counter(), None, None, None)
    ahead = verification.prefetch(run, scene, hand, "standard", CertaintyConfig())
    context = some(verification.make_trial_context(run, scene, hand, ahead, CertaintyConfig(), measure=False))
    assert (context.mass, context.heavy) == (pytest.approx(scene.object.mass), None)


def test_a_grasp_is_as_sure_as_objects_are_lighter_than_its_own_payload():
    worlds = worlds_of_seen()
    grasps = tuple(replace(grasp, trials=()) for grasp in planned().tried if grasp.verdict is not Verdict.FAILED)
    mass = verification.VerificationContext(worlds, None).mass
    payloads = {id(g.grasp): payload(worlds.alone, g, worlds.protocol, least=mass, held=True) for g in grasps}
    heavy = 1.42 * max(payloads.values())
    about = {"least": mass, "most": heavy, "held": True}
    payloads = {id(g.grasp): payload(worlds.alone, g, worlds.protocol, **about) for g in grasps}
    context = verification.VerificationContext(worlds, None, RobustnessChecks((), PASSED), heavy=heavy)
    tried = verification.run_trials(Run(0.0, None, None, None), context, grasps, len(grasps), 0).grasps
    for grasp in tried:
        share = share_as_light(payloads[id(grasp.grasp)], heavy)
        verified = grasp.verdict is Verdict.VERIFIED
        assert verified == (share >= LEAST_LIGHT)
        assert grasp.probability == pytest.approx(share * PASSED)
    assert {grasp.verdict for grasp in tried} == {Verdict.VERIFIED, Verdict.UNVERIFIED}


def rounds_at(times, preset, *, assumed):
    """What the rounds find of an object so many times as heavy as any planned grasp lifts, and their searches."""
    seen, config = seen_from(), load_preset(preset)
    hand = with_candidates(load_hand("allegro_right"), config.problem.fine_candidates)
    worlds = build_worlds(seen, hand, object_parts(seen.object), PROTOCOLS["standard"])
    context = verification.VerificationContext(worlds, None)
    heavy = times * max(verification.payloads(context, planned().tried, lambda: False))
    scene = replace(seen, object=replace(seen.object.at_mass(heavy), mass_assumed=assumed))
    steps = []
    run = Run(time.perf_counter(), None, lambda at: steps.append(at.step) if at.stage is Stage.OPTIMISE else None, None)
    ahead = verification.prefetch(run, scene, hand, "standard", config.certainty)
    rounds = rounds_of(scene, config, "standard")
    found = run_rounds(run, scene, hand, rounds, ahead, count=1, seed=0, device="cpu", measure=False)
    searches = 1 + sum(later <= earlier for earlier, later in pairwise(steps))
    first_round = method_row(config.method).searches(config.settings)
    return found, worlds, heavy, searches / first_round


def test_further_rounds_of_an_object_too_heavy_for_the_hand_look_for_grasps_that_lift_most_such_objects():
    found, worlds, heavy, _ = rounds_at(1.35, "fast", assumed=True)
    for grasp in found.grasps[: found.good]:
        assert payload(worlds.alone, grasp, worlds.protocol) > light_end(heavy) / 1.1
    assert found.context is not None


# The first round of `fast` tries too few grasps to end planning.
@pytest.mark.parametrize(("preset", "assumed", "most"), [("balanced", True, 1), ("fast", False, 2)])
def test_rounds_end_if_no_grasp_lifts_most_such_objects(preset, assumed, most):
    found, _, heavy, rounds = rounds_at(10.0, preset, assumed=assumed)
    assert found.good == 0
    assert rounds == most
    # A given mass is never lowered.
    assert (found.mass is not None) == assumed
    assert (found.mass or 0.0) < light_end(heavy)
    # A further round would try grasps at the least mass that counts.
    assert some(found.context).mass == pytest.approx(light_end(heavy) if assumed else heavy)


@pytest.mark.parametrize(("mass", "verified"), [(5.0, True), (12.0, False)])
def test_a_mesh_is_not_verified_at_a_mass_that_most_such_objects_exceed(mass: float, verified: bool):
    box = load_scene("shape:box")
    scene = replace(box, object=box.object.at_mass(mass))
    result = plan_grasps(scene, load_hand("parallel_gripper"), count=1, preset="fast")
    assert (result.outcome is Outcome.SUCCEEDED) == verified
    assert some(result.mass) < mass
    best = result.tried[0]
    if verified:
        assert some(some(best.metrics)["payload"]) >= light_end(mass)
        assert LEAST_LIGHT <= some(best.probability) < 1
    else:
        assert best.verdict is Verdict.UNVERIFIED
        assert "too many objects of this volume weigh more" in best.reason
        assert some(best.probability) < LEAST_LIGHT
        assert "but the object may weigh 12 kg; " in result.message


def test_a_solid_deep_in_what_cameras_saw_is_a_doubt():
    seen = seen_from()
    points = seen.known_points()
    low, high = points.min(0) - 0.3, points.max(0) + 0.3
    for share, doubts in ((0.01, 0), (0.5, 1)):
        top = float(np.quantile(points[:, 2], share))
        table = box_between(low, [high[0], high[1], top])
        found = some(with_neighbours(seen, {"table": [table]}).evidence).doubts
        assert len(found) == doubts
        assert all("collision object 'table' reaches" in doubt for doubt in found)


def test_what_is_tried_at_less_mass_begins_with_the_strongest():
    context, grasps = verification.VerificationContext(worlds_of_seen(), None), planned().tried[:4]
    lifted = verification.payloads(context, grasps, lambda: False)
    alone = [verification.payloads(context, [grasp], lambda: False)[0] for grasp in grasps]
    # Of what is no stronger than one before nothing is told. A payload is known to a tenth.
    assert all(one == 0 or own / 1.1 <= one <= 1.1 * own for one, own in zip(lifted, alone, strict=True))
    assert max(lifted) >= max(alone) / 1.1


def test_of_one_view_a_verified_grasp_is_as_sure_as_asked_for():
    result = planned()
    verified = [grasp for grasp in result.tried if grasp.verdict is Verdict.VERIFIED]
    assert verified
    for grasp in verified:
        assert [trial.name for trial in grasp.trials] == ["hold", "lift", ROBUSTNESS]
        assert grasp.probability is not None
        assert grasp.probability >= SURE
    for grasp in result.tried:
        if grasp.verdict is Verdict.UNVERIFIED:
            assert not grasp.usable
            assert some(grasp.probability) < SURE
    order = [grasp.verdict for grasp in result.tried]
    assert order == sorted(order, key=[Verdict.VERIFIED, Verdict.UNVERIFIED, Verdict.FAILED].index)


def test_who_asks_for_no_certainty_gets_the_trials_of_the_likeliest_shape_and_a_mesh_is_not_doubted():
    result = plan(seen_from(), 0.0)
    assert all(grasp.probability is None for grasp in result.tried)
    assert all(trial.name != ROBUSTNESS for grasp in result.tried for trial in grasp.trials)
    result = plan(load_scene("shape:cylinder"), SURE)
    assert all([trial.name for trial in grasp.trials] == ["hold"] for grasp in result.tried)


def test_what_speaks_against_a_scene_leaves_no_grasp_verified(monkeypatch):
    """A depth unit four times too large: no support is seen, and most of the scene is out of range."""
    monkeypatch.delattr("graspd_core.verify.robustness._other_world")
    seen = seen_from()
    assert seen.evidence is not None
    assert not seen.evidence.doubts
    doubted = replace(seen, evidence=replace(seen.evidence, doubts=("are its numbers metres?",)))
    for probability in (0.0, SURE):
        result = plan(doubted, probability)
        held = [grasp for grasp in result.tried if grasp.verdict is Verdict.UNVERIFIED]
        assert len(held) == 3
        assert not any(grasp.verdict is Verdict.VERIFIED for grasp in result.tried)
        assert all((grasp.probability, grasp.reason) == (DOUBTED_SHARE, "are its numbers metres?") for grasp in held)
        assert "none is robust enough: are its numbers metres?" in result.message
    monkeypatch.setattr(hypotheses, "displaced", lambda grasp, *error: moved_grasp(grasp, np.array([0.5, 0.0, 0.0])))
    held = [grasp for grasp in plan(doubted, SURE, rounds=1).tried if grasp.verdict is Verdict.UNVERIFIED]
    assert held
    for grasp in held:
        assert grasp.reason.startswith("fails with displaced pose")
        assert grasp.probability == pytest.approx(DOUBTED_SHARE * MASS_KNOWN.fails_shapes / MASS_KNOWN.places)


def test_given_grasps_of_a_view_pass_the_same_checks_as_planned_ones():
    seen, hand = seen_from(), load_hand("allegro_right")
    given = planned().tried
    assert given[0].verdict is Verdict.VERIFIED
    again = verification.verify_grasps(seen, hand, given, measure=False)
    told = [[(grasp.verdict, grasp.reason, grasp.probability) for grasp in grasps] for grasps in (again, given)]
    assert told[0] == told[1]
    doubted = replace(seen, evidence=replace(some(seen.evidence), doubts=("are its numbers metres?",)))
    (grasp,) = verification.verify_grasps(doubted, hand, given[:1])
    assert (grasp.verdict, grasp.reason) == (Verdict.UNVERIFIED, "are its numbers metres?")


def test_seen_all_round_only_place_and_friction_are_in_doubt(monkeypatch):
    monkeypatch.delattr("graspd_core.verify.robustness._other_world")
    verified = [grasp for grasp in plan(seen_all_round(), SURE).grasps if grasp.verdict is Verdict.VERIFIED]
    assert verified
    for grasp in verified:
        assert [trial.name for trial in grasp.trials] == ["hold", "lift", ROBUSTNESS]
        assert grasp.probability == MASS_KNOWN.shapes


def test_trials_with_less_friction_do_not_cut_the_object_again(monkeypatch):
    cut = []
    monkeypatch.setenv("GRASPD_CACHE", "off")
    monkeypatch.setattr(
        "graspd_core.perception.scene.convex_parts",
        lambda *given, **cuts: cut.append(cuts) or convex_parts(*given, **cuts),
    )
    result = plan(seen_from((0.001, 0.0, 0.0)), SURE)
    assert any(ROBUSTNESS in [trial.name for trial in grasp.trials] for grasp in result.tried)
    assert cut == [COARSE_CUTS]


def test_less_friction_and_another_mass_are_those_of_a_world_built_with_them():
    scene, hand = load_scene("shape:cylinder", mass=0.3), load_hand("allegro_right")
    parts, slippery = object_parts(scene.object), at_friction(PROTOCOLS["standard"], 0.2)
    usual = build_world(hand, scene.object, parts, PROTOCOLS["standard"])
    built = build_world(hand, scene.object.at_mass(0.9), parts, slippery)
    changed = altered(usual, mass=0.9, friction=slippery.friction)
    grasps = plan_grasps(scene, hand, count=4, preset="fast", verify="none", measure=False).grasps
    results = [[hold_trial(world, grasp, slippery) for grasp in grasps] for world in (built, changed)]
    assert results[0] == results[1]
    assert usual.model.geom_friction[0, 0] == PROTOCOLS["standard"].friction[0]
    assert usual.model.body_mass[usual.object_body] == pytest.approx(0.3)


@pytest.mark.parametrize(("seen", "hidden"), [(seen_from, True), (seen_all_round, False)])
def test_where_no_grasp_is_sure_enough_the_result_says_so_and_where_to_look_from(seen, hidden, monkeypatch):
    monkeypatch.setattr("graspd_core.verify.robustness._LESS_FRICTION", 0.01)
    monkeypatch.setattr(
        "graspd_core.verify.robustness.displaced", lambda grasp, *error: moved_grasp(grasp, np.array([0.5, 0.0, 0.0]))
    )
    result = plan(seen(), SURE, rounds=1)
    assert result.tried
    assert not any(grasp.usable for grasp in result.tried)
    assert result.tried[0].verdict is Verdict.UNVERIFIED
    assert "none is robust enough" in result.message
    assert ("was guessed" in result.message) == (result.next_view is not None) == hidden


def test_far_from_the_origin_the_other_shapes_are_where_the_object_is():
    near, far = planned(), planned((300.0, -200.0, 100.0))
    assert sum(grasp.usable for grasp in far.tried) == sum(grasp.usable for grasp in near.tried) == 3


@pytest.mark.parametrize("probability", [-0.1, 0.995, float("nan")])
def test_no_grasp_can_be_surer_than_was_ever_measured(probability):
    with pytest.raises(ConfigError, match=r"certainty.probability: .*; valid: 0 to"):
        CertaintyConfig(probability)
