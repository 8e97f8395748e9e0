"""The loop and the closed-form solver: stops, best iterates, broken starts; grippers that slide."""

import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from small_problem import small_problem

from graspd_core import Outcome, Scene, build_problem, draw_starts, load_hand, plan_grasps
from graspd_core.config import GraspStagesConfig, ProblemConfig
from graspd_core.hands.model import METRES_PER_RADIAN, HandModel
from graspd_core.optimize import loop
from graspd_core.optimize.closed_form.closed_form import ClosedForm, adam_step, weighted
from graspd_core.optimize.closed_form.closed_form_config import ClosedFormConfig
from graspd_core.optimize.grasp_postures import find_contacts, squeeze
from graspd_core.optimize.loop import Hooks, Poses, minimise, pack, unpack
from graspd_core.optimize.problem import evaluate
from graspd_core.se3 import rotation_from_quaternion

CONFIG = ClosedFormConfig(explore_steps=4, refine_steps=2, polish_steps=4)
STARTS = 4


@pytest.fixture(scope="module")
def starts(hand, scenes) -> Poses:
    return draw_starts(scenes["box"], hand, STARTS, 0, "cpu", torch.float64)


def same(a: Poses, b: Poses) -> bool:
    return torch.equal(pack(a), pack(b))


def test_it_stops_at_the_step_it_is_told(problem, starts):
    polls = iter([False, False, False, True])
    solution = minimise(ClosedForm(CONFIG, STARTS), problem, starts, Hooks(stop=lambda: next(polls)))
    assert (solution.steps, solution.interrupted) == (3, "cancelled")
    assert len(solution.loss) == STARTS


def test_it_stops_at_the_deadline(problem, starts, monkeypatch):
    late = minimise(ClosedForm(CONFIG, STARTS), problem, starts, Hooks(deadline=time.perf_counter()))
    assert (late.steps, late.interrupted) == (0, "deadline")
    assert same(late.poses, starts)
    assert not late.loss.isfinite().any()
    seen: list[int] = []
    # A clock that shows the steps done.
    monkeypatch.setattr(loop, "time", SimpleNamespace(perf_counter=lambda: float(len(seen))))
    hooks = Hooks(lambda step, *_: seen.append(step), deadline=3.0, interval=0.0)
    solution = minimise(ClosedForm(CONFIG, STARTS), problem, starts, hooks)
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
        terms = evaluate(problem, p, torch.zeros_like(solution.loss), CONFIG.delta_end, fine=True, sharp=True)
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
    assert ((problem.hand.lower <= solution.poses.joints) & (solution.poses.joints <= problem.hand.upper)).all()
    assert ((solution.poses.joints == problem.hand.lower) | (solution.poses.joints == problem.hand.upper)).any()
    assert solution.poses.quaternion.norm(dim=-1).tolist() == pytest.approx([1.0] * STARTS, abs=1e-12)


DOUBLE = torch.float64
FEW_STEPS = ClosedFormConfig(explore_steps=6, refine_steps=3, polish_steps=4)


@pytest.fixture(scope="module")
def gripper() -> HandModel:
    return load_hand("parallel_gripper", candidates=150)


def rebased(hand: HandModel, shift: np.ndarray) -> HandModel:
    """The same hand with its base frame's origin moved by −shift [m]."""
    roots = hand.link_parent == 0
    base = hand.candidate_link == 0
    return replace(
        hand,
        palm_center=hand.palm_center + shift,
        link_offset_translation=hand.link_offset_translation + np.outer(roots, shift),
        link_com=hand.link_com + np.outer(np.arange(hand.num_links) == 0, shift),
        primitives=tuple(replace(p, translation=p.translation + shift) if p.link == 0 else p for p in hand.primitives),
        candidate_points=hand.candidate_points + np.outer(base, shift),
    )


def test_the_solver_does_not_see_where_a_far_base_frame_is(gripper: HandModel, scenes: dict[str, Scene]) -> None:
    shift = np.array([0.05, -0.02, 0.2])
    moved = rebased(gripper, shift)
    starts = draw_starts(scenes["box"], gripper, 4, 0, "cpu", DOUBLE)
    offset = torch.as_tensor(shift)

    def base_of(poses: Poses, sign: float) -> torch.Tensor:
        return poses.translation + sign * rotation_from_quaternion(poses.quaternion) @ offset

    begun = Poses(base_of(starts, -1.0), starts.quaternion, starts.joints)
    here = minimise(ClosedForm(FEW_STEPS, 4), small_problem(scenes["box"], gripper), starts, Hooks()).poses
    there = minimise(ClosedForm(FEW_STEPS, 4), small_problem(scenes["box"], moved), begun, Hooks()).poses
    assert not torch.allclose(here.translation, starts.translation, atol=1e-3)
    # 1e-6: Adam divides by gradients that may be as small as rounding.
    torch.testing.assert_close(base_of(there, 1.0), here.translation, atol=1e-6, rtol=0)
    torch.testing.assert_close(there.quaternion, here.quaternion, atol=1e-6, rtol=0)
    torch.testing.assert_close(there.joints, here.joints, atol=1e-6, rtol=0)


def test_a_hand_whose_base_lies_in_its_palm_turns_about_that(problem_of) -> None:
    assert problem_of("box").hand.pivot.tolist() == [0.0, 0.0, 0.0]


def test_a_first_step_of_a_sliding_joint_is_its_share_of_a_radian(gripper: HandModel, scenes: dict[str, Scene]) -> None:
    problem = small_problem(scenes["box"], gripper)
    solver = ClosedForm(FEW_STEPS, 2)
    middle = Poses(
        torch.zeros(2, 3, dtype=DOUBLE),
        torch.tensor([[1.0, 0, 0, 0]] * 2, dtype=DOUBLE),
        torch.full((2, 1), 0.035, dtype=DOUBLE),
    )
    state = solver.init(problem, middle)
    stepped = adam_step(problem, state, torch.ones_like(pack(middle)), 1.0, 1, FEW_STEPS)
    # Adam's first step is the rate itself, whatever the gradient's size.
    assert stepped.x[:, 7].tolist() == pytest.approx([0.035 - FEW_STEPS.joint_rate * METRES_PER_RADIAN] * 2, rel=1e-6)


def test_a_sliding_joint_is_told_to_go_on_by_force_over_stiffness(gripper: HandModel, scenes: dict[str, Scene]) -> None:
    problem = small_problem(scenes["sphere"], gripper)
    problem = replace(problem, object=replace(problem.object, mass=0.05))
    # Jaws on either side of the ball of 35 mm, the palm 7 mm off.
    poses = Poses(
        torch.tensor([[0.0, 0.0, -0.132]], dtype=DOUBLE),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=DOUBLE),
        torch.tensor([[0.035]], dtype=DOUBLE),
    )
    config = GraspStagesConfig(grip_force=10.0)
    contact_set = find_contacts(problem, poses, config.touch_reach)
    pressed = squeeze(problem, poses, contact_set, torch.as_tensor(gripper.effort), config)
    assert float(pressed.imbalance) < 0.05
    # Both jaws' forces add up on the one joint: all of the grip force, give or take the slant of cone edges.
    along = float(pressed.forces[0, :, 1].abs().sum())
    assert along == pytest.approx(config.grip_force, rel=0.05)
    assert float(poses.joints - pressed.joints) == pytest.approx(along / config.slide_stiffness, rel=1e-6)
    weak = squeeze(problem, poses, contact_set, torch.tensor([4.0], dtype=DOUBLE), config)
    assert float(poses.joints - weak.joints) == pytest.approx(4.0 / config.slide_stiffness, rel=1e-6)


@pytest.mark.gpu
def test_a_gpu_computes_what_the_cpu_computes(hand: HandModel, scenes: dict[str, Scene]) -> None:
    found = []
    for device in ("cpu", "cuda"):
        # The compiled kernel computes in float32, so both use torch.
        problem = build_problem(scenes["box"], hand, ProblemConfig(), seed=0, device=device, dtype=DOUBLE)
        x = pack(draw_starts(scenes["box"], hand, STARTS, 0, "cpu", DOUBLE)).to(device)
        radius = torch.full((STARTS,), 0.01, dtype=DOUBLE, device=device)
        loss, gradient = ClosedForm(CONFIG, STARTS).value_and_gradient(problem, x, radius, 0.01, fine=True, sharp=True)
        contacts = find_contacts(problem, unpack(x), 0.02)
        pressed = squeeze(problem, unpack(x), contacts, torch.as_tensor(hand.effort).to(x), GraspStagesConfig())
        found.append([value.cpu().numpy() for value in (loss, gradient, pressed.joints, pressed.forces)])
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-6, atol=1e-6 * np.abs(one).max())


@pytest.mark.gpu
def test_grasps_planned_on_a_gpu_hold(hand: HandModel, scenes: dict[str, Scene]) -> None:
    assert plan_grasps(scenes["box"], hand, count=4, device="cuda").outcome is Outcome.SUCCEEDED
