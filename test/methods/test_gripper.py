"""A gripper that slides: its squeeze in newtons, its steps in metres, and a base frame that makes no difference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from graspd_core.config import GraspStagesConfig, ProblemConfig
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import METRES_PER_RADIAN, HandModel
from graspd_core.optimize.closed_form.closed_form import ClosedForm, adam_step
from graspd_core.optimize.closed_form.closed_form_config import ClosedFormConfig
from graspd_core.optimize.grasp_postures import find_contacts, squeeze
from graspd_core.optimize.initial_poses import draw_starts
from graspd_core.optimize.loop import Hooks, Poses, minimise, pack
from graspd_core.optimize.problem import Problem, build_problem
from graspd_core.perception.scene import Scene
from graspd_core.se3 import rotation_from_quaternion

DOUBLE = torch.float64
CONFIG = ClosedFormConfig(explore_steps=6, refine_steps=3, polish_steps=4)


@pytest.fixture(scope="module")
def gripper() -> HandModel:
    return load_hand("parallel_gripper", candidates=150)


def problem_with(hand: HandModel, scene: Scene) -> Problem:
    return build_problem(
        scene, hand, ProblemConfig(candidates=80, features=24, directions=12, friction=0.5), seed=0, dtype=DOUBLE
    )


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
    here = minimise(ClosedForm(CONFIG, 4), problem_with(gripper, scenes["box"]), starts, Hooks()).poses
    there = minimise(ClosedForm(CONFIG, 4), problem_with(moved, scenes["box"]), begun, Hooks()).poses
    assert not torch.allclose(here.translation, starts.translation, atol=1e-3)
    # 1e-6: Adam divides by gradients that may be as small as rounding.
    torch.testing.assert_close(base_of(there, 1.0), here.translation, atol=1e-6, rtol=0)
    torch.testing.assert_close(there.quaternion, here.quaternion, atol=1e-6, rtol=0)
    torch.testing.assert_close(there.joints, here.joints, atol=1e-6, rtol=0)


def test_a_hand_whose_base_lies_in_its_palm_turns_about_that(problem_of) -> None:
    assert problem_of("box").hand.pivot.tolist() == [0.0, 0.0, 0.0]


def test_a_first_step_of_a_sliding_joint_is_its_share_of_a_radian(gripper: HandModel, scenes: dict[str, Scene]) -> None:
    problem = problem_with(gripper, scenes["box"])
    solver = ClosedForm(CONFIG, 2)
    middle = Poses(
        torch.zeros(2, 3, dtype=DOUBLE),
        torch.tensor([[1.0, 0, 0, 0]] * 2, dtype=DOUBLE),
        torch.full((2, 1), 0.035, dtype=DOUBLE),
    )
    state = solver.init(problem, middle)
    stepped = adam_step(problem, state, torch.ones_like(pack(middle)), 1.0, 1, CONFIG)
    # Adam's first step is the rate itself, whatever the gradient's size.
    assert stepped.x[:, 7].tolist() == pytest.approx([0.035 - CONFIG.joint_rate * METRES_PER_RADIAN] * 2, rel=1e-6)


def test_a_sliding_joint_is_told_to_go_on_by_force_over_stiffness(gripper: HandModel, scenes: dict[str, Scene]) -> None:
    problem = problem_with(gripper, scenes["sphere"])
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
