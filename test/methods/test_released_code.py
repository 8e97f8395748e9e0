"""What the released code of Grasp'D does and the paper does not: Adam, turns, warm-up, a fading leak; its preset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch

from graspd_core.optimize.candidates import PlannerInput
from graspd_core.optimize.graspd2022.graspd2022 import adam_step, adamax, move_shares, plan
from graspd_core.optimize.graspd2022.graspd2022_config import Graspd2022Config, PoseStepsConfig
from graspd_core.optimize.loop import Hooks, minimise, pack
from graspd_core.optimize.plan_config import PlanConfig, load_preset, override

PAPER = PlanConfig(method="graspd2022")


def short(changes: Mapping[str, Any]) -> Graspd2022Config:
    """The paper's settings in twelve steps, with some changed, each by its dotted name."""
    changes = {"steps": 12, "level_set.coarse_steps": 6, **changes}
    return override(PAPER, {f"graspd2022.{name}": value for name, value in changes.items()}).settings


def test_adam_is_that_of_torch():
    gradients = torch.randn(5, 1, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    x = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    theirs, ours = torch.optim.Adam([x], lr=0.1), adamax(torch.zeros(1, 3, dtype=torch.float64))
    for count, gradient in enumerate(gradients, 1):
        x.grad = gradient
        theirs.step()
        ours = adam_step(ours, gradient, 0.1, count)
    assert ours.value.numpy() == pytest.approx(x.detach().numpy(), rel=1e-6)


def test_the_level_set_of_the_code_starts_short_of_the_hand(problem, starts, solver_of):
    radii = [
        solver_of(short({"level_set.schedule": "code", "level_set.clearance": gap})).init(problem, starts).radius
        for gap in (0.01, 0.005)
    ]
    assert (radii[1] - radii[0]).tolist() == pytest.approx([0.005] * 3)


def test_step_sizes_of_pose_and_forces_warm_up_but_not_of_the_multipliers(problem, starts, solver_of):
    solver = solver_of(short({"warm_up": 4}))
    assert [solver.rate(i) for i in (0, 1, 4, 9)] == pytest.approx([0.0, 0.25, 1.0, 1.0])
    assert solver_of(short({})).rate(0) == 1.0
    before = solver.init(problem, starts)
    after = solver.step(problem, before, 0)
    assert torch.equal(after.pose.value[:, :3], before.pose.value[:, :3])
    assert torch.equal(after.forces.value, before.forces.value)
    assert (after.multipliers.value[:, 0] > 0).all()


def test_position_and_the_rest_of_the_pose_are_moved_in_turns():
    steps = PoseStepsConfig(translation_share=0.25, rotation_share=0.5, in_turns=True)
    assert move_shares(steps, 0, 2) == [0.25] * 3 + [0.0] * 6
    assert move_shares(steps, 1, 2) == [0.0] * 3 + [0.5] * 4 + [1.0] * 2
    assert move_shares(replace(steps, in_turns=False), 0, 2) == [0.25] * 3 + [0.5] * 4 + [1.0] * 2


def test_in_turns_orientation_and_joints_answer_to_where_the_base_went(problem, starts, solver_of):
    plain = {"level_set.coarse_steps": 0, "pose_steps.optimiser": "adam", "relaxation.force_rate": 0.1}
    together, in_turns = (solver_of(short({**plain, "pose_steps.in_turns": x})) for x in (False, True))
    # A second step has desired forces to follow.
    state = together.step(problem, together.init(problem, starts), 0)
    one, two = together.step(problem, state, 0).pose, in_turns.step(problem, state, 0).pose
    # The position is moved first, from the same pose and by the same gradient; Adam remembers both gradients.
    assert torch.equal(one.value[:, :3], two.value[:, :3])
    assert not torch.equal(one.value[:, 3:], two.value[:, 3:])
    assert not torch.equal(one.mean, two.mean)


def test_joints_stay_within_their_limits_where_that_is_asked(problem, starts, solver_of):
    low, high = problem.hand.lower, problem.hand.upper
    for asked in (False, True):
        wild = short({"pose_rate": 0.5, "pose_steps.within_limits": asked, "keep": "last"})
        joints = minimise(solver_of(wild), problem, starts, Hooks()).poses.joints
        assert ((joints >= low) & (joints <= high)).all() == asked


def test_the_released_code_s_preset_plans_a_small_problem(hand, scenes):
    preset = load_preset("graspd2022_code")
    assert (preset.settings.steps, preset.settings.level_set.coarse_steps, preset.settings.keep) == (
        10000,
        5000,
        "last",
    )
    config = override(preset, {"graspd2022.steps": 4, "graspd2022.level_set.coarse_steps": 2, "graspd2022.warm_up": 1})
    found = plan(PlannerInput(scenes["sphere"], hand, 2, 1, config, Hooks()))
    assert len(found.poses.translation) == 2
    assert torch.isfinite(pack(found.poses)).all()
