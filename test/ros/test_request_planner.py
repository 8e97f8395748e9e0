"""Work on one request: what it gives, and that nobody waits for it once the request is over."""

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from expected import some
from trimesh.transformations import translation_matrix

from graspd_core import Steering, load_scene
from graspd_core.errors import MeshError, TransformError
from graspd_core.types import ArmPath, GraspResult, Outcome, Progress, Stage, Verdict
from graspd_ros.convert import matrix_of_posture
from graspd_ros.error_codes import RequestError
from graspd_ros.parameters import Settings
from graspd_ros.request import Request
from graspd_ros.request_planner import MOST_RUNS, Planned, Planner, RecentRuns, unlike

SETTINGS = Settings(num_grasps=1, preset="fast", deadline=100.0)


def request(load, settings: Settings = SETTINGS) -> Request:
    return Request("r", "mesh", "object", Time(), settings, load)


def planner(hand) -> Planner:
    def lookup(target: str, source: str, stamp: Time, stop) -> np.ndarray:
        raise TransformError(f"{source} -> {target}: not connected")

    return Planner(hand, lookup)


def never() -> bool:
    return False


def plan(plans: Planner, asked: Request) -> Planned:
    return plans.plan(asked, never, lambda _: None)


def sphere(**fields: Any) -> Request:
    asked = request(lambda: load_scene("shape:sphere"))
    return replace(asked, **{"id": "first", "object_key": "sphere", **fields})


@pytest.fixture(scope="module")
def planned(hand) -> Planned:
    return plan(planner(hand), sphere())


def test_a_request_is_steered_and_earlier_runs_do_not_answer_it(hand):
    plans, scene = planner(hand), load_scene("shape:bottle")
    asked = replace(request(lambda: scene), id="free", object_key="bottle")
    free = plan(plans, asked).result
    steering = Steering(approach_direction=(0.0, 0.0, -1.0), approach_angle=0.5)
    found = plan(plans, replace(asked, id="steered", exclude=("free/0",), steering=lambda: steering)).result
    assert found.outcome is Outcome.SUCCEEDED
    for grasp in found.tried:
        assert matrix_of_posture(grasp.grasp)[:3, :3][2] @ hand.approach < -np.cos(0.5) + 1e-6
    assert unlike(found.tried, [matrix_of_posture(free.tried[0].grasp)]) == list(found.tried)


def test_the_greatest_seed_is_valid_though_a_pose_is_excluded(hand):
    greatest = replace(SETTINGS, seed=2**63 - 1)
    found = plan(planner(hand), sphere(settings=greatest, exclude_poses=(("object", np.eye(4)),)))
    assert found.result.outcome is Outcome.SUCCEEDED


def test_a_result_is_told_in_the_frame_that_the_object_was_placed_in(hand):
    stages: list[Progress] = []
    asked = sphere(T_frame_object=translation_matrix([10.0, 0.0, 0.0]))
    found = planner(hand).plan(asked, never, stages.append)
    assert found.result.outcome is Outcome.SUCCEEDED
    best = found.result.tried[0]
    assert best.verdict is Verdict.VERIFIED
    assert np.linalg.norm(best.grasp.position - [10.0, 0.0, 0.0]) < 0.25
    assert {report.stage for report in stages} == set(Stage)


def test_trouble_on_the_way_comes_out_as_it_is(hand):
    def broken():
        raise MeshError("no such thing")

    with pytest.raises(MeshError, match="no such thing"):
        plan(planner(hand), request(broken))
    read = threading.Event()
    with pytest.raises(TransformError, match="object -> base"):
        plan(planner(hand), request(read.set, replace(SETTINGS, output_frame="base")))
    assert not read.is_set(), "the object was read before it was known that the result cannot be told"


@pytest.mark.parametrize(("timeless", "asked_for"), [(True, Time()), (False, Time(sec=7))])
def test_what_came_without_a_time_is_told_by_the_newest_transforms(hand, timeless, asked_for):
    asked: list[Time] = []

    def lookup(target: str, source: str, stamp: Time, stop) -> np.ndarray:
        asked.append(stamp)
        return np.eye(4)

    settings = replace(SETTINGS, output_frame="base", verify="none")
    plan(Planner(hand, lookup), sphere(stamp=Time(sec=7), settings=settings, timeless=timeless))
    assert asked == [asked_for]


@pytest.mark.parametrize("ends_by", [Outcome.CANCELLED, Outcome.DEADLINE])
def test_a_request_that_is_over_is_answered_while_its_object_is_still_being_read(hand, ends_by):
    reading, release, read, told = threading.Event(), threading.Event(), threading.Event(), []

    def slow():
        reading.set()
        release.wait()
        read.set()
        return load_scene("shape:sphere")

    plans = planner(hand)
    settings = replace(SETTINGS, deadline=100.0 if ends_by is Outcome.CANCELLED else 0.1)
    stop = reading.is_set if ends_by is Outcome.CANCELLED else never
    # Whoever waited for the object would wait for ever.
    assert plans.plan(request(slow, settings), stop, told.append).result.outcome is ends_by
    assert not read.is_set()
    before = len(told)
    # The next one waits until the first has ended, and then runs as ever.
    assert not plans.rest(0.05)
    threading.Timer(0.2, release.set).start()
    after: list[bool] = []

    def box():
        after.append(read.is_set())
        return load_scene("shape:box")

    fine = plan(plans, request(box))
    assert after == [True]
    assert fine.result.outcome is Outcome.SUCCEEDED
    assert len(told) == before, "the request that was over went on telling"
    assert plans.rest(0.0)


def test_the_next_best_grasp_comes_at_once_from_the_candidates_of_the_same_run(hand):
    loaded: list[bool] = []

    def load():
        loaded.append(True)
        return load_scene("shape:sphere")

    def ask(name: str, *exclude: str, key: str = "mesh sphere", wanted: int = 1, poses=()) -> GraspResult:
        settings = replace(SETTINGS, num_grasps=wanted)
        asked = replace(request(load, settings), id=name, object_key=key, exclude=exclude, exclude_poses=poses)
        return plan(plans, asked).result

    plans = planner(hand)
    first = ask("first", wanted=3)
    assert first.outcome is Outcome.SUCCEEDED
    second = ask("second", "first/0")
    assert len(loaded) == 1
    lost = [matrix_of_posture(grasp.grasp) for grasp in first.tried]
    assert list(second.tried) == unlike(first.tried, lost[:1])[:1]
    pose = matrix_of_posture(second.tried[0].grasp)
    third = ask("third", "first/0", poses=(("object", pose),))
    assert unlike(third.tried, [lost[0], pose]) == list(third.tried)
    # When all are lost, another run begins, and gives none like them.
    before = len(loaded)
    fourth = ask("fourth", *(f"first/{rank}" for rank in range(len(first.tried))), "third/0")
    assert len(loaded) == before + 1
    assert fourth.outcome is Outcome.SUCCEEDED
    assert unlike(fourth.tried, lost) == list(fourth.tried)
    # Seen anew, the object is another: a run, and still none like the lost one.
    fifth = ask("fifth", "first/0", key="cloud 2")
    assert len(loaded) == before + 2
    assert unlike(fifth.tried, lost[:1]) == list(fifth.tried)
    for unknown in ("nobody/0", "first/99", "first/" + "9" * 5000):
        with pytest.raises(
            RequestError, match=f"exclude: no grasp '{unknown[:100]}.* in the last 16 runs; stored runs: first, "
        ):
            ask("sixth", unknown)


def test_only_the_earlier_runs_that_tried_the_greatest_mass_answer(planned):
    runs = RecentRuns()
    light, heavy = (replace(planned.result, warnings=(f"tried at {mass}",)) for mass in (0.3, 0.5))
    runs.keep(sphere(id="heavy"), replace(planned, result=heavy, mass=0.5), np.eye(4))
    runs.keep(sphere(id="light"), replace(planned, result=light, mass=0.3), np.eye(4))
    found = some(runs.next_best(sphere(), []))
    assert found.mass == 0.5
    assert found.result.warnings == ("tried at 0.5",)
    assert found.result.tried == heavy.tried[: SETTINGS.num_grasps]


def test_too_few_earlier_grasps_are_no_answer_so_that_the_node_plans(planned):
    runs, left = RecentRuns(), len(planned.result.tried)
    runs.keep(sphere(), planned, np.eye(4))
    assert runs.next_best(sphere(settings=replace(SETTINGS, num_grasps=left)), []) is not None
    assert runs.next_best(sphere(settings=replace(SETTINGS, num_grasps=left + 1)), []) is None


def test_grasps_of_an_earlier_run_have_no_path_of_an_arm_that_is_switched_off(planned):
    runs = RecentRuns()
    reached = replace(planned.result.tried[0], arm=ArmPath(("a",), np.zeros((13, 1)), (0, 5, 7, 12)))
    runs.keep(sphere(), replace(planned, result=replace(planned.result, tried=(reached,))), np.eye(4))
    assert some(runs.next_best(sphere(), [])).result.tried[0].arm is None


def test_a_run_whose_id_was_used_before_is_the_newest(planned):
    runs = RecentRuns()
    for name in ("again", *(f"other {number}" for number in range(MOST_RUNS - 1)), "again", "last"):
        runs.keep(sphere(id=name), planned, np.eye(4))
    assert len(runs.excluded(sphere(exclude=("again/0", "last/0")), lambda *_: np.eye(4))) == 2


@pytest.mark.parametrize(
    "change", [{"closes_late": True}, {"settings": replace(SETTINGS, verify="none")}], ids=["arrival", "trials"]
)
def test_a_run_with_other_terms_does_not_answer(hand, change):
    plans = planner(hand)
    assert plan(plans, sphere(settings=replace(SETTINGS, num_grasps=3))).result.outcome is Outcome.SUCCEEDED
    asked = sphere(id="second", exclude=("first/0",))
    found = plan(plans, replace(asked, **change)).result
    assert "of an earlier run" not in found.message
    assert (found.tried[0].arrival is not None) == ("closes_late" in change)


def test_lost_grasps_are_placed_where_the_camera_stood_when_it_saw(hand):
    asked: list[tuple[str, str, int]] = []

    def lookup(target: str, source: str, stamp: Time, stop) -> np.ndarray:
        asked.append((target, source, stamp.sec))
        return np.eye(4)

    settings = replace(SETTINGS, verify="none")
    mesh = sphere(stamp=Time(sec=7), settings=settings, exclude_poses=(("map", np.eye(4)),))
    cloud = replace(mesh, region_points=lambda: np.zeros((0, 3)))
    for one in (mesh, cloud):
        plan(Planner(hand, lookup), one)
    assert asked == [("object", "map", 0), ("object", "map", 7)]


def test_an_excluded_id_stays_where_it_was_answered_though_the_camera_moved_since(hand):
    T_world_camera = {1: np.eye(4), 2: translation_matrix([1.0, 0.0, 0.0])}

    def lookup(target: str, source: str, stamp: Time, stop) -> np.ndarray:
        pose = T_world_camera[stamp.sec]
        return pose if target == "world" else np.linalg.inv(pose)

    settings, plans = replace(SETTINGS, output_frame="world", verify="none"), Planner(hand, lookup)
    cloud = sphere(settings=settings, object_key="", region_points=lambda: np.zeros((0, 3)))
    first = plan(plans, replace(cloud, stamp=Time(sec=1))).result.tried[0]
    again = replace(cloud, id="again", stamp=Time(sec=2), exclude=("first/0",))
    (excluded,) = plans._runs.excluded(again, lambda target, source: lookup(target, source, again.stamp, never))
    np.testing.assert_allclose(T_world_camera[2] @ excluded, matrix_of_posture(first.grasp), atol=1e-9)


def test_a_result_file_that_cannot_be_written_costs_no_grasp(hand, tmp_path):
    (tmp_path / "taken").touch()
    settings = replace(SETTINGS, output_dir=str(tmp_path / "taken"))
    found = plan(planner(hand), sphere(settings=settings))
    assert found.result.outcome is Outcome.SUCCEEDED
    assert found.file == ""
    assert any(told.startswith("output_dir: ") and "taken/first.json" in told for told in found.result.warnings)


def test_an_answer_of_an_earlier_run_keeps_the_warnings_about_the_object(hand):
    scene = load_scene("shape:sphere")
    scene = replace(scene, object=replace(scene.object, warnings=("half of it is guessed",)))
    plans, settings = planner(hand), replace(SETTINGS, num_grasps=3)
    first = sphere(load=lambda: scene, settings=settings)
    told = plan(plans, first).result.warnings
    found = plan(plans, replace(first, id="second", exclude=("first/0",), settings=SETTINGS)).result
    assert "of an earlier run" in found.message
    assert "half of it is guessed" in found.warnings
    assert found.warnings == told
