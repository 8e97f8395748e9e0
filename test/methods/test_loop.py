"""The loop and the closed-form solver: it stops when told, keeps the best iterate, lets no broken start win."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest
import torch

from graspd_core.optimize.closed_form.closed_form import ClosedForm, weighted
from graspd_core.optimize.closed_form.closed_form_config import ClosedFormConfig
from graspd_core.optimize.initial_poses import draw_starts
from graspd_core.optimize.loop import Hooks, Poses, minimise, pack, unpack
from graspd_core.optimize.problem import evaluate

CONFIG = ClosedFormConfig(explore_steps=4, refine_steps=2, polish_steps=4)
STARTS = 4


@pytest.fixture(scope="module")
def starts(hand, scenes) -> Poses:
    return draw_starts(scenes["box"], hand, STARTS, 0, "cpu", torch.float64)


@pytest.fixture(scope="module")
def problem(problem_of):
    return problem_of("box", torch.float64)


def same(a: Poses, b: Poses) -> bool:
    return torch.equal(pack(a), pack(b))


def test_it_stops_at_the_step_it_is_told(problem, starts):
    polls = iter([False, False, False, True])
    solution = minimise(ClosedForm(CONFIG, STARTS), problem, starts, Hooks(stop=lambda: next(polls)))
    assert (solution.steps, solution.interrupted) == (3, "cancelled")
    assert len(solution.loss) == STARTS


def test_it_stops_at_the_deadline(problem, starts):
    late = minimise(ClosedForm(CONFIG, STARTS), problem, starts, Hooks(deadline=time.perf_counter()))
    assert (late.steps, late.interrupted) == (0, "deadline")
    assert same(late.poses, starts)
    assert not late.loss.isfinite().any()
    seen: list[int] = []
    deadline = time.perf_counter() + 1.0

    def report(step: int, *_: object) -> None:
        seen.append(step)
        if step == 3:
            time.sleep(max(0.0, deadline - time.perf_counter()))

    solution = minimise(ClosedForm(CONFIG, STARTS), problem, starts, Hooks(report, deadline=deadline, interval=0.0))
    assert (solution.steps, solution.interrupted) == (3, "deadline")
    assert seen == [1, 2, 3]


def test_it_reports_every_step_and_the_last_one_always(problem, starts):
    every: list[tuple[int, int, float]] = []
    minimise(ClosedForm(CONFIG, STARTS), problem, starts, Hooks(report=lambda *x: every.append(x), interval=0.0))
    assert [x[:2] for x in every] == [(i, 10) for i in range(1, 11)]
    assert all(x[2] < float("inf") for x in every)
    # Once iterates are judged, the best loss never rises.
    scored = [x[2] for x in every[-CONFIG.polish_steps :]]
    assert scored == sorted(scored, reverse=True)
    few: list[int] = []
    minimise(ClosedForm(CONFIG, STARTS), problem, starts, Hooks(report=lambda i, *_: few.append(i), interval=1e6))
    assert few == [1, 10]


@pytest.mark.parametrize("column", [0, 4, 9], ids=["translation", "quaternion", "joint"])
def test_a_start_that_is_not_a_number_stands_still_and_never_wins(problem, starts, column):
    x = pack(starts)
    x[1, column] = torch.nan
    solution = minimise(ClosedForm(CONFIG, STARTS), problem, unpack(x), Hooks())
    found = torch.isfinite(solution.loss)
    assert found.sum() == STARTS - 1
    assert torch.isfinite(pack(solution.poses)[found]).all()
    assert solution.loss[~found].tolist() == [float("inf")]
    # It is the first to be dropped, and the others do not notice it.
    kept = minimise(ClosedForm(CONFIG, STARTS - 1), problem, unpack(x), Hooks())
    assert torch.isfinite(kept.loss).all()
    clean = minimise(ClosedForm(CONFIG, STARTS), problem, starts, Hooks())
    others = torch.arange(STARTS) != 1
    assert same(solution.poses[others], clean.poses[others])


def test_a_start_far_away_never_wins(problem, starts):
    far = starts.translation.clone()
    far[2] += 1e6
    solution = minimise(ClosedForm(CONFIG, STARTS), problem, replace(starts, translation=far), Hooks())
    assert solution.loss.argmax() == 2
    assert solution.loss.isfinite()[[0, 1, 3]].all()


def test_the_loss_is_that_of_the_poses_returned(problem, starts):
    solution = minimise(ClosedForm(CONFIG, keep=3), problem, starts, Hooks())
    assert len(solution.loss) == 3
    p = solution.poses
    with torch.no_grad():
        terms = evaluate(
            problem,
            p.translation,
            p.quaternion,
            p.joints,
            torch.zeros_like(solution.loss),
            CONFIG.delta_end,
            fine=True,
            sharp=True,
        )
    # Same numbers through the same code: rounding only.
    assert weighted(terms, CONFIG.polish_weights).tolist() == pytest.approx(solution.loss.tolist(), rel=1e-9)


def test_it_improves_on_its_starts(problem, starts):
    config = replace(CONFIG, explore_steps=1, refine_steps=30, polish_steps=0)
    # Iterates are judged from the second step on, all at the same contact width.
    solver = ClosedForm(config, STARTS)
    first = minimise(solver, problem, starts, Hooks(stop=iter([False, False, True]).__next__))
    last = minimise(solver, problem, starts, Hooks())
    assert first.steps == 2
    assert (last.loss < first.loss - 0.1).all(), (last.loss, first.loss)


def test_joint_limits_hold_exactly(problem, starts):
    wild = replace(CONFIG, joint_rate=1.0)
    at_limit = replace(starts, joints=problem.hand.upper.expand_as(starts.joints).clone())
    solution = minimise(ClosedForm(wild, STARTS), problem, at_limit, Hooks())
    assert (solution.poses.joints >= problem.hand.lower).all()
    assert (solution.poses.joints <= problem.hand.upper).all()
    assert ((solution.poses.joints == problem.hand.lower) | (solution.poses.joints == problem.hand.upper)).any()
    assert solution.poses.quaternion.norm(dim=-1).tolist() == pytest.approx([1.0] * STARTS, abs=1e-12)


def test_the_same_seed_gives_the_same_bits(hand, scenes, problem_of):
    def run(seed: int) -> Poses:
        drawn = draw_starts(scenes["box"], hand, STARTS, seed, "cpu", torch.float32)
        return minimise(ClosedForm(CONFIG, 2), problem_of("box", torch.float32), drawn, Hooks()).poses

    assert same(run(5), run(5))
    assert not same(run(5), run(6))


def test_a_start_does_not_depend_on_its_neighbours(problem, starts):
    together = minimise(ClosedForm(CONFIG, STARTS), problem, starts, Hooks())
    alone = minimise(ClosedForm(CONFIG, 1), problem, starts[torch.tensor([2])], Hooks())
    # Products of other shapes sum in another order: 1e-16 relative, which ten Adam steps enlarge, but not to a micron.
    assert pack(alone.poses)[0].tolist() == pytest.approx(pack(together.poses)[2].tolist(), abs=1e-7)
    assert alone.loss[0].item() == pytest.approx(together.loss[2].item(), rel=1e-6)
