"""Of all things seen, one with a grasp that is sure enough; what failed is not asked again in the same way."""

import time
from dataclasses import replace

import numpy as np
import pytest
from expected import some

from graspd_bench.rendering.depth_noise import DEFAULT
from graspd_bench.rendering.tabletop import CAMERA, ring_poses, tabletop, views_of
from graspd_core import (
    Grasp,
    Outcome,
    PlanConfig,
    PointCloud,
    Posture,
    Sphere,
    Steering,
    Verdict,
    load_hand,
    load_preset,
)
from graspd_core.config.planning_config import DOUBTED_SHARE, CertaintyConfig
from graspd_core.errors import CloudError, ConfigError, NoObjectError
from graspd_core.planning import any_thing as module
from graspd_core.planning.any_thing import (
    NOT_LOOKED_AT,
    OUT_OF_TRIES,
    Failure,
    ThingPlan,
    plan_any_thing,
    result_of_things,
    unlike,
)

HAND = load_hand("parallel_gripper")
ASKED = {"preset": "fast", "measure": False, "seed": 0}


@pytest.fixture(scope="module")
def views() -> tuple[PointCloud, ...]:
    """A box, and a bowl beside it, from one place above."""
    scene = tabletop("box", obstacles=[("bowl", 0.16, 0.05)])
    return views_of(scene, CAMERA, ring_poses(1, elevation=np.deg2rad(55.0), distance=0.65), DEFAULT, 3)


@pytest.fixture(scope="module")
def first(views: tuple[PointCloud, ...]) -> tuple[ThingPlan, ...]:
    return plan_any_thing(views, HAND, **ASKED)


def test_the_first_verified_grasp_ends_the_search_and_all_things_are_told(first: tuple[ThingPlan, ...]):
    assert len(first) == 2
    best = first[0]
    assert some(best.grasp).verdict is Verdict.VERIFIED
    assert best.surety > 1.0
    assert best.reason == ""
    # The price is that of one thing wherever the first has a grasp.
    assert sum(thing.looked_at for thing in first) == 1
    assert first[1].reason == "not tried before the search ended"


def test_a_verified_grasp_of_unknown_probability_ends_the_search_too(views):
    preset = replace(load_preset("fast"), certainty=CertaintyConfig(0.0))
    found = plan_any_thing(views, HAND, mass=0.3, **{**ASKED, "preset": preset})
    assert found[0].grasp is not None
    assert (found[0].grasp.verdict, found[0].grasp.probability) == (Verdict.VERIFIED, None)
    assert [thing.looked_at for thing in found].count(True) == 1


@pytest.mark.parametrize("enough", [1, 2])
def test_without_a_verified_grasp_the_search_ends_after_some_objects(views, enough: int):
    found = plan_any_thing(views, HAND, enough=enough, verify="none", **ASKED)
    assert [thing.looked_at for thing in found].count(True) == enough
    assert some(found[0].grasp).verdict is Verdict.UNVERIFIED


def test_a_grasp_is_likely_from_a_given_probability_on(first):
    grasp = some(first[0].grasp)
    thing = replace(first[0], grasp=replace(grasp, probability=0.6))
    assert (thing.is_likely(0.6), thing.is_likely(0.7)) == (True, False)
    assert replace(thing, grasp=replace(grasp, probability=None)).is_likely(0.7)
    assert not replace(thing, grasp=None).is_likely(0.0)


def test_what_failed_comes_last_and_is_given_up_after_some_tries(views, first):
    place = first[0].place
    other = plan_any_thing(views, HAND, failures=[Failure(place)], **ASKED)
    assert np.linalg.norm(other[0].place - place) > 0.05
    over = plan_any_thing(views, HAND, failures=[Failure(thing.place) for thing in first] * 2, tries=2, **ASKED)
    assert [thing.reason for thing in over] == [OUT_OF_TRIES] * 2
    assert not any(thing.looked_at for thing in over)


def test_an_object_that_moved_keeps_its_failures():
    here, there, far = np.eye(3)
    failed = Failure(here, seen=np.array([here, there]))
    # It still lies there, or it is the nearest of those that lie where nothing was seen, or it is gone.
    assert failed.object_among(np.array([there, here + 0.02, here + 0.01])) == 2
    assert failed.object_among(np.array([there, far, 0.85 * here, far - here])) == 2
    part = replace(failed, seen=np.array([here, 0.9 * here, 0.85 * here]))
    assert part.object_among(np.array([0.91 * here, 0.86 * here])) is None
    assert part.object_among(np.array([0.91 * here, 0.86 * here]), unsure=True) == 0
    assert part.object_among(np.array([0.91 * here, 1.15 * here])) == 1
    assert part.object_among(np.array([0.7 * here]), unsure=True) is None
    assert failed.object_among(np.array([there + 0.01, 0.7 * here])) is None
    assert failed.object_among(np.zeros((0, 3))) is None
    # Without the places of the other objects nobody knows which one moved.
    assert replace(failed, seen=None).object_among(np.array([there, far])) is None
    assert Failure(None).object_among(np.array([here]), unsure=True) is None


def test_lost_failures_make_the_nearest_object_doubted_once(views, first):
    best = first[0]
    seen = np.array([thing.place for thing in first])
    lost = [Failure(best.place + np.array([0.0, 0.0, 0.06]), some(best.grasp).grasp, seen=seen)] * 4
    again = plan_any_thing(views, HAND, failures=lost, **ASKED)
    assert sorted(len(thing.failures) for thing in again) == [0, 1]
    (doubted,) = (thing for thing in again if thing.failures)
    np.testing.assert_allclose(doubted.place, best.place)
    assert doubted.grasp is None or doubted.grasp.verdict is not Verdict.VERIFIED
    # A grasp that no robot executed moved nothing.
    kept = plan_any_thing(views, HAND, failures=[replace(lost[0], executed=False)], **ASKED)
    assert not any(thing.failures for thing in kept)


def test_the_best_of_the_view_before_comes_first(views, first):
    quick = {**ASKED, "verify": "none", "enough": 1}
    # The object that comes first without a view before comes last if the other one had a surer grasp.
    sure, unsure = (replace(some(first[0].grasp), probability=p) for p in (0.9, 0.1))
    for best, worst in (first, first[::-1]):
        before = [replace(worst, grasp=unsure, looked_at=True), replace(best, grasp=sure, looked_at=True)]
        again = plan_any_thing(views, HAND, before=before, **quick)
        np.testing.assert_array_equal(again[0].points, best.points)
        assert [thing.looked_at for thing in again] == [True, False]


def test_objects_known_to_be_worse_are_not_looked_at_again_unless_something_changed_there(views, first):
    far = replace(some(first[0].grasp).grasp, position=np.array([9.0, 0.0, 0.0]))
    failed = [Failure(thing.place, far) for thing in first]
    for probability, looked in ((0.01, [True, False]), (0.99, [True, True])):
        grasp = replace(some(first[0].grasp), probability=probability, trials=())
        known = replace(first[1], result=first[0].result, grasp=grasp, failures=failed[1:])
        again = plan_any_thing(views, HAND, before=[known, *first[:1]], failures=failed, **{**ASKED, "likely": 2.0})
        assert [thing.looked_at for thing in again] == looked
        assert (again[1].reason == NOT_LOOKED_AT) == (probability < 0.5)
    # An object that is given up has no grasp, and does not keep others from being skipped.
    given_up = [Failure(first[0].place, far, executed=False)] * 2
    again = plan_any_thing(views, HAND, before=[known, *first[:1]], failures=[*failed[1:], *given_up], tries=2, **ASKED)
    assert [thing.reason == OUT_OF_TRIES for thing in again] == [False, True]
    again = plan_any_thing(views, HAND, before=[known], failures=[*failed[1:], *given_up[:1]] * 2, tries=2, **ASKED)
    assert [(thing.reason, thing.grasp) for thing in again] == [(OUT_OF_TRIES, None)] * 2
    (points, seen), failures = (known.points, [thing.points for thing in first]), failed[1:]
    beside = points + np.array([0.0, 0.0, 0.06])
    assert module._known((points, failures), [first[0].points, points], [known, *first[:1]], 2.0) is known
    # A grasp failed since, or the grasp is likely, or the object moved, or something came or went beside it.
    before = [known, *first[:1]]
    assert module._known((points, failed), seen, before, 2.0) is None
    assert module._known((points, failures), seen, before, 0.5) is None
    assert module._known((points + 0.01, failures), seen, before, 2.0) is None
    cut = replace(known, result=replace(some(known.result), outcome=Outcome.DEADLINE))
    assert module._known((points, failures), seen, [cut, *first[:1]], 2.0) is None
    assert module._known((points, failures), [*seen, beside], before, 2.0) is None
    assert module._known((points, failures), seen, [*before, replace(first[0], points=beside)], 2.0) is None


def test_an_object_that_has_not_moved_keeps_its_plan_unless_something_new_is_near_the_hand(views, first):
    scene = tabletop("box", obstacles=[("bowl", 0.16, 0.05)])
    camera = ring_poses(1, elevation=np.deg2rad(55.0), distance=0.65)
    again = plan_any_thing(views_of(scene, CAMERA, camera, DEFAULT, 4), HAND, before=first, **ASKED)
    assert again[0].result is some(first[0].result)
    np.testing.assert_array_equal(again[0].points, first[0].points)
    points, grasp = first[0].points, some(first[0].grasp)
    others, quick = [thing.points for thing in first[1:]], {**ASKED, "verify": "none", "enough": 1}
    assert module._kept((points, []), [points, *others], first[:1], first, HAND) is not None
    assert module._kept((points, []), [points], first[:1], first, HAND) is not None
    # Something came where the hand will be, or far from it.
    palm, up = grasp.grasp.position, np.array([0.0, 0.0, 1.0])
    for place, kept in ((palm, False), (palm + 0.3 * up, True)):
        new = place + 1e-3 * np.random.default_rng(0).normal(size=(50, 3))
        assert (module._kept((points, []), [points, new, *others], first[:1], first, HAND) is not None) == kept
    # The object moved, or was seen in part, or a grasp of it failed, or a grasp failed nobody knows where.
    assert module._kept((points + np.array([0.004, 0.0, 0.0]), []), [], first[:1], first, HAND) is None
    assert module._kept((points[points[:, 0] > np.median(points[:, 0])], []), [], first[:1], first, HAND) is None
    failed, other = Failure(first[0].place, grasp.grasp), replace(grasp.grasp, position=palm + 0.1 * up)
    assert module._kept((points, [failed]), [points], first[:1], first, HAND) is None
    assert module._kept((points, [replace(failed, executed=False)]), [points], first[:1], first, HAND) is None
    unlike_it = [replace(failed, grasp=other, executed=False), Failure(first[0].place)]
    assert module._kept((points, unlike_it), [points], first[:1], first, HAND) is not None
    lost = plan_any_thing(views, HAND, before=first, failures=[Failure(None, grasp.grasp)], **quick)
    assert lost[0].result is not first[0].result
    # A restriction of the new request refuses the earlier grasp.
    far = Steering(region=Sphere([9.0, 0.0, 0.0], 0.1))
    assert not module._allowed(first[0], HAND, {"restrictions": (far,)})
    assert module._allowed(first[0], HAND, {})


def test_one_result_answers_for_all_things(views, first, monkeypatch: pytest.MonkeyPatch):
    assert result_of_things(first) is some(first[0].result)
    # A grasp that failed nobody knows where is left out, and makes no object come later.
    loose = Failure(None, first[0].grasp.grasp)
    again = plan_any_thing(views, HAND, failures=[loose], verify="none", enough=1, **ASKED)
    assert [thing.reason for thing in again][1:] == [NOT_LOOKED_AT]
    np.testing.assert_array_equal(again[0].points, first[0].points)
    best = some(again[0].grasp)
    assert unlike([best], [first[0].grasp.grasp])
    # The deadline is that of the whole search, so that the second object is not begun.
    late = plan_any_thing(views, HAND, deadline=1e-3, **ASKED)
    result = result_of_things(late)
    assert (result.outcome, result.tried) == (Outcome.DEADLINE, ())
    assert result.message == "none of 2 objects has a grasp: " + "; ".join(thing.reason for thing in late)
    assert late[1].reason == NOT_LOOKED_AT
    left = list[float]()
    monkeypatch.setattr(module, "_scene_among", lambda *_: time.sleep(0.3) or some(first[0].scene))
    monkeypatch.setattr(
        module, "plan_grasps", lambda *_, deadline, **__: left.append(deadline) or some(first[0].result)
    )
    plan_any_thing(views, HAND, deadline=60.0, **ASKED)
    assert left[0] < 59.7
    monkeypatch.undo()
    far = Steering(region=Sphere([9.0, 0.0, 0.0], 0.1))
    with pytest.raises(ConfigError, match=r"none of 2 objects .*region: no part .*; region: "):
        result_of_things(plan_any_thing(views, HAND, restrictions=(far,), **ASKED))
    with pytest.raises(NoObjectError, match="no object is seen"):
        result_of_things(())


def test_a_grasp_like_one_that_was_lost_is_not_given_again(views: tuple[PointCloud, ...], first: tuple[ThingPlan, ...]):
    assert first[0].grasp is not None
    lost = Failure(first[0].place, first[0].grasp.grasp)
    # The other thing is out of tries.
    out = [Failure(first[1].place)] * 4
    again = plan_any_thing(views, HAND, failures=[lost, *out], **ASKED)
    assert again[0].grasp is not None
    assert unlike([again[0].grasp], [first[0].grasp.grasp])
    # A lost grasp speaks against the scene, so the object is doubted.
    assert first[0].grasp.verdict is Verdict.VERIFIED
    assert again[0].grasp.verdict is Verdict.UNVERIFIED
    assert "an earlier grasp of this object failed" in again[0].reason
    assert 0 < some(again[0].grasp.probability) <= DOUBTED_SHARE
    # A grasp that no robot executed says nothing about the scene.
    spared = plan_any_thing(views, HAND, failures=[replace(lost, executed=False), *out], **ASKED)
    assert spared[0].grasp is not None
    assert unlike([spared[0].grasp], [first[0].grasp.grasp])
    assert spared[0].grasp.verdict is Verdict.VERIFIED


def test_failures_make_no_valid_number_invalid_and_a_search_in_vain_is_followed_by_more_starts(
    views, first, monkeypatch: pytest.MonkeyPatch
):
    asked, starts = [], []

    def plan(scene, hand, *, count: int, seed: int, preset: PlanConfig, **others: object):
        asked.append((count, seed))
        starts.append(preset.settings.starts_per_grasp)
        raise ConfigError("no grasp is needed here")

    monkeypatch.setattr(module, "plan_grasps", plan)
    lost = [Failure(thing.place, thing.grasp.grasp if thing.grasp else None, executed=False) for thing in first]
    greatest = {**ASKED, "count": 1024, "seed": 2**63 - 1}
    plan_any_thing(views, HAND, failures=lost, **greatest)
    assert asked == [(1024, 0)] * len(first)
    usual, vain = min(starts), sum(failure.grasp is None for failure in lost)
    assert 0 < vain < len(lost)
    assert starts == [usual] * len(lost)
    for one, other, more in ((1, 2, [2 * usual, 4 * usual]), (0, 3, [usual, 4 * usual])):
        starts.clear()
        failed = [Failure(first[0].place)] * one + [Failure(first[1].place)] * other
        plan_any_thing(views, HAND, failures=failed, **ASKED)
        assert sorted(starts) == more


def test_nothing_on_the_table_is_no_thing_and_an_empty_cloud_is_told(views: tuple[PointCloud, ...]):
    bare = PointCloud(views[0].points[views[0].points[:, 2] < 0.003], views[0].viewpoint)
    assert plan_any_thing([bare], HAND, **ASKED) == ()
    with pytest.raises(CloudError, match="no points at all"):
        plan_any_thing([PointCloud(np.zeros((0, 3)), np.zeros(3))], HAND)


def test_what_is_known_to_stand_there_is_no_thing(views: tuple[PointCloud, ...], first: tuple[ThingPlan, ...]):
    known = {"known": [some(first[0].scene).object.mesh]}
    left = plan_any_thing(views, HAND, solids=known, failures=[Failure(first[1].place)] * 4, **ASKED)
    assert [thing.reason for thing in left] == [OUT_OF_TRIES]
    np.testing.assert_array_equal(left[0].points, first[1].points)


def test_alike_is_near_and_turned_by_little():
    def at(x: float, half_turn: float) -> Posture:
        return Posture(np.array([x, 0.0, 0.0]), np.array([np.cos(half_turn), 0.0, 0.0, np.sin(half_turn)]), np.zeros(1))

    def grasp(posture: Posture) -> Grasp:
        return Grasp(posture, posture, posture)

    assert unlike([grasp(at(0.01, 0.1))], [at(0.0, 0.0)]) == []
    assert unlike([grasp(at(0.01, np.pi + 0.1))], [at(0.0, 0.0)]) == []
    assert len(unlike([grasp(at(0.02, 0.0)), grasp(at(0.0, 0.2))], [at(0.0, 0.0)])) == 2
