"""Trials on several threads: the same results in the same order as on one."""

import threading
import time
from collections.abc import Iterator
from contextlib import closing

import pytest
import torch

from graspd_core import load_hand, load_preset, load_scene
from graspd_core.config import RobustConfig
from graspd_core.optimize.candidates import PlannerInput, find_candidates
from graspd_core.optimize.loop import Hooks
from graspd_core.perception.scene import object_parts
from graspd_core.types import Grasp, GraspMetrics, Progress, StopHook, TrialResult, Verdict
from graspd_core.verify import verification
from graspd_core.verify.hold_trial import displaced, pose_errors
from graspd_core.verify.prepared_grasp import make_metrics_context
from graspd_core.verify.robustness import results_in_order
from graspd_core.verify.run_clock import Run
from graspd_core.verify.trial_registry import build_worlds
from graspd_core.verify.verification import VerificationContext, rank_by_robustness, run_trials
from graspd_core.verify.world import PROTOCOLS


def never() -> bool:
    return False


@pytest.fixture
def threads() -> Iterator[None]:
    """Puts the number of torch's threads back."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("number", [1, 2, 5])
def test_results_come_in_the_order_of_the_items(number):
    items = list(range(20))
    assert list(results_in_order(never, lambda item, stop: item * 2, items, number)) == [2 * item for item in items]
    assert list(results_in_order(never, lambda item, stop: item, [], number)) == []


def test_all_that_is_needed_is_worked_on_while_the_first_is_unfinished():
    begun, last_needed = [], threading.Event()

    def work(item: int, stop: StopHook) -> int:
        begun.append(item)
        if item == 9:
            last_needed.set()
        assert item or last_needed.wait(60)
        return item

    with closing(results_in_order(never, work, list(range(50)), 2, lambda: 10)) as results:
        assert next(results) == 0
        # No more than what is needed was begun until the first was there.
        assert sorted(begun) == list(range(10))


def test_who_has_enough_ends_the_work_that_was_begun_ahead():
    begun, ended = threading.Event(), []

    def work(item: int, stop: StopHook) -> int:
        if item > 0:
            begun.set()
            while not stop():
                time.sleep(0.001)
            ended.append(item)
        return item

    with closing(results_in_order(never, work, list(range(50)), 2)) as results:
        assert next(results) == 0
        assert begun.wait(60)
    # None is still at work, and none was begun afterwards.
    assert 1 <= len(ended) <= 3
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("graspd-trials")]


@pytest.mark.parametrize("number", [1, 2])
def test_the_end_of_the_run_ends_the_work_and_its_hook_is_asked_by_one_thread(number):
    over, askers = threading.Event(), set()

    def hook() -> bool:
        askers.add(threading.get_ident())
        return over.is_set()

    def work(item: int, stop: StopHook) -> int:
        over.set()
        while not stop():
            time.sleep(0.001)
        return item

    results = list(results_in_order(hook, work, list(range(50)), number))
    assert results in ([], [0])
    assert askers == {threading.get_ident()}


@pytest.mark.parametrize("number", [1, 2])
def test_an_exception_of_the_work_reaches_the_caller(number):
    def work(item: int, stop: StopHook) -> int:
        raise ZeroDivisionError(item)

    with pytest.raises(ZeroDivisionError, match="0"):
        list(results_in_order(never, work, [0, 1, 2], number))


@pytest.fixture(scope="module")
def candidates() -> tuple[VerificationContext, tuple[Grasp, ...]]:
    """Grasps of a box, good and bad by turns, and what they are tried with."""
    config, hand = load_preset("fast"), load_hand("allegro_right")
    scene = load_scene("shape:box", resolution=config.resolution)
    found = find_candidates(PlannerInput(scene, hand, count=4, seed=0, config=config, hooks=Hooks()))[:4]
    errors = pose_errors(1, len(found))
    moved = [displaced(g, *e, scene.object.center_of_mass) for g, e in zip(found, errors, strict=True)]
    worlds = build_worlds(scene, hand, object_parts(scene.object), PROTOCOLS["standard"])
    context = VerificationContext(worlds, lambda: make_metrics_context(scene.object, hand))
    return context, tuple(g for pair in zip(moved, found, strict=True) for g in pair)


def test_verdicts_and_order_do_not_depend_on_the_number_of_threads(candidates, threads):
    context, grasps = candidates
    outcomes = []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        run = Run(time.perf_counter(), None, None, None)
        tried = run_trials(run, context, grasps, 3, 0)
        ranked = rank_by_robustness(run, context, tried.grasps, RobustConfig(trials=2, hold_time=0.2), 0)
        assert any(grasp.verdict is Verdict.VERIFIED for grasp in tried.grasps)
        outcomes.append([(g.score, g.trials, dict(g.metrics or {})) for g in (*tried.grasps, *ranked)])
    assert outcomes[0] == outcomes[1] == outcomes[2]
    # Trials and the measuring beside them have as many data as threads each, kept for all of it.
    assert 1 <= len(context.trials.alone.spare) <= 6


@pytest.mark.parametrize("number", [1, 2])
def test_what_waits_to_be_measured_is_never_more_than_the_threads(number, candidates, threads, monkeypatch):
    begun, ended, most = [], [], 0

    def slow(*_: object) -> GraspMetrics:
        begun.append(threading.get_ident())
        time.sleep(0.3)
        ended.append(1)
        return GraspMetrics({})

    def count(progress: Progress) -> None:
        nonlocal most
        most = max(most, len(begun) - len(ended))

    context, grasps = candidates
    torch.set_num_threads(number)
    held = TrialResult("hold", True, 0.0, 0.0, "")
    monkeypatch.setattr(verification, "grasp_trials", lambda *_: (held,))
    monkeypatch.setattr(verification, "measure", slow)
    tried = run_trials(Run(time.perf_counter(), None, count, None), context, grasps, 3, 0)
    assert len(ended) == sum(grasp.metrics is not None for grasp in tried.grasps) == 3
    assert most < number
    # Beside the trials, not between them.
    assert threading.get_ident() not in begun
