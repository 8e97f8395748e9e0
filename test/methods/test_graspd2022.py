"""Grasp'D as published and as released: multipliers, desired forces, starts, short runs, what its code does besides."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck

from graspd_core import PlanConfig, PlannerInput, load_preset, override, preset_names
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.optimize.graspd2022.graspd2022 import (
    Adamax,
    actual,
    adam_step,
    adamax,
    adamax_step,
    damped,
    excess,
    into_cone,
    motion_left,
    physics,
    plan,
    published_starts,
)
from graspd_core.optimize.graspd2022.graspd2022_config import Graspd2022Config
from graspd_core.optimize.loop import Hooks, minimise, pack, unpack
from graspd_core.optimize.problem import hand_forward
from graspd_core.se3 import rotation_from_quaternion


def short(changes: Mapping[str, Any]) -> Graspd2022Config:
    """The paper's settings in twelve steps, with some changed, each by its dotted name."""
    changes = {"steps": 12, "level_set.coarse_steps": 6, **changes}
    paper = PlanConfig(method="graspd2022")
    return override(paper, {f"graspd2022.{name}": value for name, value in changes.items()}).settings


VARIANTS = {
    "force": {},
    "wrench": {"relaxation.desired": "wrench"},
    "cone": {"relaxation.desired": "cone", "simulation.scaling": "object", "contact.stiffness": 1e3},
    "direct": {"relaxation.enabled": False},
    "code": {
        "relaxation.desired": "wrench",
        "pose_steps.optimiser": "adam",
        "pose_steps.in_turns": True,
        "pose_steps.within_limits": True,
        "warm_up": 3,
    },
}
SHORT = short({})


def draw(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize(
    ("step", "optimiser"), [(adam_step, torch.optim.Adam), (adamax_step, torch.optim.Adamax)], ids=["Adam", "Adamax"]
)
def test_steps_are_those_of_torch(step, optimiser):
    x = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    theirs, ours = optimiser([x], lr=0.1), adamax(torch.zeros(1, 3, dtype=torch.float64))
    for count, gradient in enumerate(draw(0, 5, 1, 3), 1):
        x.grad = gradient
        theirs.step()
        ours = step(ours, gradient, 0.1, count)
    assert ours.value.numpy() == pytest.approx(x.detach().numpy(), rel=1e-6)


def test_a_memory_fades_the_greatest_gradient():
    state = adamax_step(adamax(torch.zeros(1, 2, dtype=torch.float64)), draw(0, 1, 2), 0.1, 1)
    forgetful = adamax_step(state, torch.zeros(1, 2, dtype=torch.float64), 0.1, 2, memory=0.5)
    assert forgetful.top.numpy() == pytest.approx(0.5 * state.top.numpy())


@pytest.mark.parametrize("bound", [1.0, 10.0])
def test_multipliers_find_the_constrained_minimum(bound: float):
    # min (x − 2)² + (y − 1)² subject to x + y < C: at C = 1 on the border, (1, 0) with λ = 2; at C = 10 free, (2, 1).
    x, multiplier = adamax(torch.zeros(1, 2, dtype=torch.float64)), adamax(torch.zeros(1, 1, dtype=torch.float64))
    for count in range(1, 501):
        at = x.value.detach().requires_grad_(True)
        broken = excess(at.sum(-1, keepdim=True), bound)
        cost = ((at - at.new_tensor([2.0, 1.0])) ** 2).sum()
        (gradient,) = torch.autograd.grad(cost + damped(broken, multiplier.value, 1.0).sum(), at)
        fade = 1 - count / 501
        x = adamax_step(x, gradient, 0.03 * fade, count)
        multiplier = adamax_step(multiplier, broken.detach(), -0.1 * fade, count)
    # Adamax's steps do not shrink with the gradient; faded ones leave a few thousandths.
    assert x.value[0].tolist() == pytest.approx([1.0, 0.0] if bound == 1.0 else [2.0, 1.0], abs=0.02)
    # A multiplier of a broken inequality only climbs; from its known value on, the minimum is where it should be.
    assert multiplier.value.item() >= 1.95 if bound == 1.0 else multiplier.value.item() == 0.0


@given(seed=st.integers(0, 2**31), friction=st.floats(0.05, 2.0))
def test_the_cone_projection_is_nearest_and_stays(seed: int, friction: float):
    normals = draw(seed, 2, 5, 3)
    normals = normals / normals.norm(dim=-1, keepdim=True)
    forces = draw(seed + 1, 2, 5, 3, 3)
    inside = into_cone(forces, normals, friction)
    along = -(inside * normals[:, :, None]).sum(-1)
    side = (inside + along[..., None] * normals[:, :, None]).norm(dim=-1)
    assert (along >= -1e-12).all()
    assert (side <= friction * along + 1e-9).all()
    assert into_cone(inside, normals, friction).numpy() == pytest.approx(inside.numpy(), abs=1e-9)
    # Nearest in a convex cone: what was taken off is at right angles to what is left, and against all of the cone.
    off = forces - inside
    assert (off * inside).sum(-1).abs().max() < 1e-9
    assert ((off * -normals[:, :, None]).sum(-1) <= 1e-9).all()


def test_desired_forces_that_balance_the_momentum_leave_no_motion(solver_of):
    solver = solver_of(SHORT)
    body, velocities = solver.body, solver.velocities
    arms = 0.03 * draw(0, 1, 4, 3)
    arms = arms - arms.mean(1, keepdim=True)
    stopping = -body.mass * velocities / solver.time_step / 4
    forces = stopping.expand(1, 4, 3, 3)
    assert motion_left(body, 0 * forces, arms, velocities, solver.time_step)[0].tolist() == pytest.approx([0, 1.5, 1.5])
    assert motion_left(body, forces, arms, velocities, solver.time_step).abs().max() < 1e-20
    # As wrenches, with the torques that go with them: the same.
    wrenches = actual(forces, arms, body.length, 6)
    assert motion_left(body, wrenches, arms, velocities, solver.time_step).abs().max() < 1e-20
    assert physics(wrenches, 0 * wrenches).item() > physics(forces, 0 * forces).item() > 0


def test_gradients_of_motion_and_physics(solver_of):
    solver = solver_of(short({"simulation.scaling": "object"}))

    def cost(forces: Tensor, arms: Tensor) -> Tensor:
        left = motion_left(solver.body, forces, arms, solver.velocities, solver.time_step)
        return left.mean(-1) + physics(actual(forces, arms, 0.05, 6), torch.ones_like(actual(forces, arms, 0.05, 6)))

    assert gradcheck(cost, (draw(0, 1, 2, 3, 3).requires_grad_(True), (0.03 * draw(1, 1, 2, 3)).requires_grad_(True)))


@pytest.mark.parametrize("name", VARIANTS)
def test_gradients_of_the_whole_evaluation(name, problem, starts, solver_of, slope_errors):
    # Without a leak, and with the hand partly below the level set; the leak's own gradient is tested in test_forces.py.
    solver = solver_of(
        short({**VARIANTS[name], "contact.leak": 0.0, "simulation.scaling": "object", "contact.stiffness": 1e3})
    )
    x = pack(starts)
    components = 6 if solver.config.relaxation.desired == "wrench" else 3
    desired = 0.1 * draw(0, len(x), len(problem.hand.coarse.links), 3, components)
    radius = x.new_full((len(x),), 0.12)

    def lagrangian(y: Tensor) -> Tensor:
        found = solver.evaluate(problem, y, desired, radius)
        return found.cost + damped(excess(found.limit, 0.0), found.limit + 1.0, 1.0)

    assert (lagrangian(x) > 0).all()
    # As in test_gradients.py: the grid's cells have kinks that a step may cross, and values up to 1e4 round to 1e-12.
    assert (slope_errors(lagrangian, x, step=1e-8, directions=6) > 1e-4).sum() <= 1


def test_the_task_is_a_matter_of_the_forces_not_of_the_pose(problem, starts, solver_of):
    solver = solver_of(short(VARIANTS["cone"]))
    x = pack(starts).requires_grad_(True)
    desired = (0.1 * draw(0, len(x), len(problem.hand.coarse.links), 3, 3)).requires_grad_(True)
    task = solver.evaluate(problem, x, desired, x.detach().new_zeros(len(x))).task
    by_pose, by_force = torch.autograd.grad(task.sum(), (x, desired), allow_unused=True)
    assert by_pose is None
    assert (by_force.abs().amax((1, 2, 3)) > 0).all()


def test_published_starts_face_the_surface_from_ten_centimetres(problem, scenes, hand):
    starts = published_starts(problem, scenes["box"], hand, 6, 3, 0.1)
    rotation = rotation_from_quaternion(starts.quaternion)
    palm = starts.translation + rotation @ torch.as_tensor(hand.palm_center)
    distance, normal = sample_sdf(problem.object.sdf, palm)
    facing = rotation @ torch.as_tensor(hand.palm_normal)
    # The grid is 3 cm wider than the box; farther out its distance errs by little, its direction by a little more.
    assert distance.numpy() == pytest.approx(np.full(6, 0.1), abs=5e-3)
    assert ((facing * normal).sum(-1) < -0.95).all()
    assert torch.equal(starts.joints, torch.as_tensor(hand.open_posture).expand(6, -1))
    placed = hand_forward(problem, problem.hand.coarse, starts)
    assert (sample_sdf(problem.object.sdf, placed.points)[0] > 0).all()


def test_published_starts_come_from_all_sides(problem_of, scenes, hand):
    starts = published_starts(problem_of("sphere", torch.float64), scenes["sphere"], hand, 64, 0, 0.3)
    facing = rotation_from_quaternion(starts.quaternion) @ torch.as_tensor(hand.palm_normal)
    # The mean of 64 uniform directions is about an eighth long; that of a quarter of the sphere is three quarters.
    assert facing.mean(0).norm() < 0.35


def run(config, problem, starts, solver_of, **hooks) -> tuple[Tensor, Tensor]:
    solution = minimise(solver_of(config), problem, starts, Hooks(**hooks))
    return pack(solution.poses), solution.loss


@pytest.mark.parametrize("name", VARIANTS)
def test_the_same_seed_gives_the_same_bits_and_nothing_is_not_a_number(name, problem, starts, solver_of):
    once, loss = run(short(VARIANTS[name]), problem, starts, solver_of)
    again, _ = run(short(VARIANTS[name]), problem, starts, solver_of)
    assert torch.equal(once, again)
    assert torch.isfinite(once).all()
    assert torch.isfinite(loss).all()
    assert not torch.equal(once, pack(starts))
    assert once[:, 3:7].norm(dim=-1).tolist() == pytest.approx([1.0] * len(once))


@pytest.mark.parametrize("name", VARIANTS)
def test_it_brings_its_own_cost_down(name, problem, starts, solver_of):
    # On a fixed level set that the hands already touch.
    config = short(
        {
            **VARIANTS[name],
            "steps": 60,
            "level_set.coarse_steps": 0,
            "simulation.scaling": "object",
            "contact.stiffness": 1e3,
            "relaxation.force_rate": 0.05,
            "initial.kind": "hull",
        }
    )
    near = replace(starts, translation=0.6 * starts.translation)
    first = run(replace(config, steps=1), problem, near, solver_of)[1]
    last = run(config, problem, near, solver_of)[1]
    assert (last < first).all(), (first, last)


def test_desired_forces_of_the_cone_stay_in_it(problem, starts, solver_of):
    solver = solver_of(short({**VARIANTS["cone"], "relaxation.force_rate": 0.05}))
    state = solver.init(problem, starts)
    for index in range(5):
        before = state
        state = solver.step(problem, state, index)
    p = before.pose.value
    normals = sample_sdf(problem.object.sdf, hand_forward(problem, problem.hand.coarse, unpack(p)).points)[1]
    assert state.forces.value.abs().max() > 0
    kept = into_cone(state.forces.value, normals, 0.8)
    assert kept.numpy() == pytest.approx(state.forces.value.numpy(), abs=1e-9)


def test_the_level_set_falls_to_the_surface_and_only_then_is_judged(problem, starts, solver_of):
    solver = solver_of(SHORT)
    state = solver.init(problem, starts)
    assert state.radius.tolist() == [0.1] * 3
    for index in range(SHORT.level_set.coarse_steps):
        state = solver.step(problem, state, index)
        assert not torch.isfinite(state.best_loss).any()
    state = solver.step(problem, state, SHORT.level_set.coarse_steps)
    assert torch.isfinite(state.best_loss).all()
    by_code = solver_of(short({"level_set.schedule": "code"})).init(problem, starts).radius
    placed = hand_forward(problem, problem.hand.coarse, starts)
    nearest = sample_sdf(problem.object.sdf, placed.points)[0].amin(-1)
    assert by_code.numpy() == pytest.approx((nearest - 0.01).clamp_min(0.0).numpy())
    # A state is never changed in place.
    kept = Adamax(*(x.clone() for x in vars(state.pose).values()))
    solver.step(problem, state, 0)
    assert all(torch.equal(a, b) for a, b in zip(vars(kept).values(), vars(state.pose).values(), strict=True))


def test_the_best_iterate_is_kept_or_the_last(problem, starts, solver_of):
    wild = short({**VARIANTS["cone"], "steps": 20, "level_set.coarse_steps": 0, "pose_rate": 0.2})
    _, best = run(wild, problem, starts, solver_of)
    _, last = run(replace(wild, keep="last"), problem, starts, solver_of)
    assert (best <= last).all()
    assert (best < last).any()


def test_a_start_that_is_not_a_number_never_wins_and_harms_none(problem, starts, solver_of):
    broken = starts.translation.clone()
    broken[1] = torch.nan
    x, loss = run(SHORT, problem, replace(starts, translation=broken), solver_of)
    clean, _ = run(SHORT, problem, starts, solver_of)
    assert loss.isfinite().tolist() == [True, False, True]
    assert torch.equal(x[[0, 2]], clean[[0, 2]])


def test_the_search_obeys_limits_and_stop(hand, scenes):
    config = PlanConfig(method="graspd2022", settings=SHORT)
    task = PlannerInput(scenes["sphere"], hand, 2, 1, config, Hooks())
    found = plan(task)
    assert len(found.poses.translation) == 2
    assert ((task.problem.hand.lower <= found.poses.joints) & (found.poses.joints <= task.problem.hand.upper)).all()
    polls = iter([False, True])
    stopped = plan(replace(task, hooks=Hooks(stop=polls.__next__)))
    assert stopped.interrupted == "cancelled"


def test_presets_name_this_method_and_change_what_they_say():
    mine = {name: load_preset(name) for name in preset_names() if name.startswith("graspd2022")}
    assert {p.method for p in mine.values()} == {"graspd2022"}
    assert mine["graspd2022"].settings == Graspd2022Config()
    assert mine["graspd2022_no_coarse_to_fine"].settings.level_set.coarse_steps == 0
    assert not mine["graspd2022_no_relaxation"].settings.relaxation.enabled
    assert mine["graspd2022_no_leak"].settings.contact.leak == 0.0


def test_step_sizes_of_pose_and_forces_warm_up_but_not_of_the_multipliers(problem, starts, solver_of):
    solver = solver_of(short({"warm_up": 4}))
    assert [solver.rate(i) for i in (0, 1, 4, 9)] == pytest.approx([0.0, 0.25, 1.0, 1.0])
    assert solver_of(short({})).rate(0) == 1.0
    before = solver.init(problem, starts)
    after = solver.step(problem, before, 0)
    assert torch.equal(after.pose.value[:, :3], before.pose.value[:, :3])
    assert torch.equal(after.forces.value, before.forces.value)
    assert (after.multipliers.value[:, 0] > 0).all()


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
