"""The compiled search: as good as torch's, alike on all threads, ended by its hooks."""

import time
from dataclasses import replace

import pytest
import torch
from expected import some

from graspd_core.optimize.closed_form.closed_form import ClosedForm, minimise_compiled
from graspd_core.optimize.closed_form.closed_form_config import ClosedFormConfig, rows_kept
from graspd_core.optimize.initial_poses import draw_starts
from graspd_core.optimize.loop import Hooks, Poses, Solution, minimise, pack

CONFIG = ClosedFormConfig(explore_steps=12, refine_steps=8, polish_steps=10)


@pytest.fixture(scope="module")
def problem(problem_of):
    return problem_of("allegro_right", "crowded")


@pytest.fixture(scope="module")
def starts(hands, scenes) -> Poses:
    return draw_starts(scenes["crowded"], hands("allegro_right"), 10, 0, "cpu", torch.float32)


def search(problem, starts, keep: int = 10, config=CONFIG, **hooks) -> Solution:
    return minimise_compiled(ClosedForm(config, keep), problem, some(problem.compiled), starts, Hooks(**hooks))


def test_the_first_steps_are_torchs(problem, starts):
    """Rounding grows by a factor a step: few steps are alike to the digit, many only in what they come to."""
    config = ClosedFormConfig(explore_steps=1, refine_steps=1, polish_steps=2)
    mine, theirs = search(problem, starts, config=config), minimise(ClosedForm(config, 10), problem, starts, Hooks())
    assert pack(mine.poses).numpy() == pytest.approx(pack(theirs.poses).numpy(), abs=2e-4)
    assert mine.loss.tolist() == pytest.approx(theirs.loss.tolist(), rel=0.02)


def test_it_comes_as_far_as_torch(problem, starts):
    mine, theirs = search(problem, starts), minimise(ClosedForm(CONFIG, 10), problem, starts, Hooks())
    begun = search(problem, starts, config=replace(CONFIG, explore_steps=0, refine_steps=0, polish_steps=1))
    assert mine.loss.median() < 0.9 * begun.loss.median()
    assert float(mine.loss.median()) == pytest.approx(float(theirs.loss.median()), rel=0.1)


def test_threads_and_neighbours_change_no_bit(problem, starts):
    one = search(problem, starts)
    alone = search(problem, starts[torch.tensor([7])], keep=1)
    torch.set_num_threads(3)
    try:
        three = search(problem, starts)
    finally:
        torch.set_num_threads(1)
    assert torch.equal(pack(one.poses), pack(three.poses))
    assert torch.equal(one.loss, three.loss)
    assert torch.equal(pack(one.poses)[7], pack(alone.poses)[0])


def test_limits_hold_and_quaternions_are_unit(problem, starts):
    poses = search(problem, starts, config=replace(CONFIG, joint_rate=1.0)).poses
    assert ((problem.hand.lower <= poses.joints) & (poses.joints <= problem.hand.upper)).all()
    assert poses.quaternion.norm(dim=-1).tolist() == pytest.approx([1.0] * 10, abs=1e-6)


def test_a_start_that_is_not_a_number_never_wins(problem, starts):
    x = starts.translation.clone()
    x[3, 1] = torch.nan
    loss = search(problem, replace(starts, translation=x)).loss
    assert loss.isfinite().tolist() == [row != 3 for row in range(10)]


def test_it_reports_and_ends_at_its_last_step(problem, starts):
    seen: list[tuple[int, int, float]] = []
    solution = search(problem, starts, report=lambda *step: seen.append(step), interval=0.0)
    assert (solution.steps, solution.interrupted) == (30, "")
    assert seen[-1][:2] == (30, 30)
    assert [step for step, *_ in seen] == sorted(step for step, *_ in seen)
    assert seen[-1][2] < float("inf")


LONG = replace(CONFIG, refine_steps=10_000_000)


@pytest.mark.parametrize("threads", [1, 2])
def test_it_stops_in_the_midst_of_a_long_run(problem, starts, threads):
    """The run would take an hour: that it ends at all shows that it was stopped."""
    polls = iter([False] * 5)
    torch.set_num_threads(threads)
    try:
        solution = search(problem, starts, config=LONG, stop=lambda: next(polls, True))
    finally:
        torch.set_num_threads(1)
    assert solution.interrupted == "cancelled"
    assert solution.steps < LONG.refine_steps


def test_it_ends_at_its_deadline(problem, starts):
    assert search(problem, starts, config=LONG, deadline=time.perf_counter() + 0.1).interrupted == "deadline"
    late = search(problem, starts, deadline=time.perf_counter())
    assert (late.steps, late.interrupted) == (0, "deadline")
    assert not late.loss.isfinite().any()


def test_what_a_hook_raises_passes_through(problem, starts):
    polls = iter([False] * 3)

    def stop() -> bool:
        if next(polls, True):
            raise KeyboardInterrupt
        return False

    with pytest.raises(KeyboardInterrupt):
        search(problem, starts, config=LONG, stop=stop)


def test_dropping_by_halves_is_torchs(problem, starts):
    config = ClosedFormConfig(explore_steps=3, refine_steps=1, polish_steps=1, drops=3)
    assert [rows_kept(config, 1, rows, index) for rows, index in ((8, 1), (4, 2), (2, 3), (1, 4))] == [4, 2, 1, 1]
    mine = search(problem, starts, keep=2, config=config)
    theirs = minimise(ClosedForm(config, 2), problem, starts, Hooks())
    assert mine.loss.tolist() == pytest.approx(theirs.loss.tolist(), rel=0.02)
    assert pack(mine.poses).numpy() == pytest.approx(pack(theirs.poses).numpy(), abs=1e-3)
