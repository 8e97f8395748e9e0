"""Pregrasps and self-overlap by the kernel, against torch."""

from dataclasses import replace

import pytest
import torch
from expected import some

from graspd_core import draw_starts, hand_names
from graspd_core.config import GraspStagesConfig
from graspd_core.hands.kinematics import forward
from graspd_core.optimize import kernel_problem
from graspd_core.optimize.grasp_postures import find_pregrasp, nearest_features, self_overlap, settle
from graspd_core.optimize.loop import Poses, moved_along, pack, unpack
from graspd_core.optimize.obstacle_distance import least_gap


@pytest.fixture
def torch_alone(monkeypatch):
    return lambda: monkeypatch.setenv("GRASPD_KERNEL", "off")


# The left hand is the mirror image of the right. Without obstacles, one branch falls away, the same for every hand.
ON = [*((hand, "crowded") for hand in hand_names() if hand != "allegro_left"), ("barrett_like", "mug")]


def grasps_of(problem, rows) -> Poses:
    return moved_along(unpack(rows), -problem.hand.pivot)


@pytest.mark.parametrize(("hand", "scene"), ON)
def test_a_few_steps_are_torchs_and_all_come_as_far(problem_of, rows_of, torch_alone, hand, scene):
    problem = problem_of(hand, scene)
    poses = grasps_of(problem, rows_of(hand, scene, problem))
    few, whole = GraspStagesConfig(open_steps=2), GraspStagesConfig()
    mine, mine_share = find_pregrasp(problem, poses, few)
    end, end_share = find_pregrasp(problem, poses, whole)
    torch_alone()
    theirs, their_share = find_pregrasp(problem, poses, few)
    _, far_share = find_pregrasp(problem, poses, whole)
    # Adam's first steps go by the sign of a slope, which rounding decides where it is next to nothing.
    assert ((mine.translation - theirs.translation).abs() < 1e-4).float().mean() > 0.85
    assert ((mine.joints - theirs.joints).abs() < 2e-3).float().mean() > 0.95
    assert (mine_share - their_share).abs().median() < 0.01
    assert (end_share - far_share).abs().median() < 0.05
    assert ((end.joints >= problem.hand.lower) & (end.joints <= problem.hand.upper)).all()


@pytest.mark.parametrize("hand", ["allegro_right", "barrett_like", "parallel_gripper"])
@pytest.mark.parametrize("wide", [0.0, 0.02])
def test_the_least_gap_to_support_and_obstacles_is_torchs(problem_of, rows_of, hand, wide):
    problem = problem_of(hand, "crowded")
    poses = grasps_of(problem, rows_of(hand, "crowded", problem))
    shifts = 0.05 * torch.randn(40, len(poses.joints), 3, generator=torch.Generator().manual_seed(0))
    x = torch.cat([pack(moved) for moved in (replace(poses, translation=poses.translation + s) for s in shifts)])
    gap, rows = kernel_problem.least_gap(some(problem.compiled), x, wide), unpack(x)
    links = forward(problem.hand.kinematics, rows.joints)
    theirs = least_gap(some(problem.obstacles), rows.base, links, wide).clamp_max(wide)
    assert (gap == wide).any()
    assert (gap < 0).any()
    torch.testing.assert_close(gap, theirs, atol=2e-6, rtol=1e-4)


def test_starts_among_obstacles_are_those_of_torch(problem_of, scenes, hands):
    asked = scenes["crowded"], hands("allegro_right"), 40, 1, "cpu", torch.float32
    compiled = some(problem_of("allegro_right", "crowded").compiled)
    torch.testing.assert_close(pack(draw_starts(*asked, compiled=compiled)), pack(draw_starts(*asked)))


@pytest.mark.parametrize(("hand", "scene"), ON)
def test_settling_is_torchs(problem_of, rows_of, torch_alone, hand, scene):
    problem = problem_of(hand, scene)
    poses = grasps_of(problem, rows_of(hand, scene, problem))
    mine, again = settle(problem, poses), settle(problem, poses)
    torch_alone()
    theirs = settle(problem, poses)
    assert torch.equal(mine.joints, again.joints)
    # As for pregrasps: signs of what is next to nothing. Some starts lie so deep that their deepest points change.
    assert ((mine.translation - theirs.translation).abs() < 2e-4).float().mean() > 0.75
    assert ((mine.joints - theirs.joints).abs() < 4e-3).float().mean() > 0.75
    assert ((mine.joints >= problem.hand.lower) & (mine.joints <= problem.hand.upper)).all()


@pytest.mark.parametrize("hand", ["allegro_right", "leap_right"])
def test_a_pregrasp_comes_out_of_itself_as_torchs_does(problem_of, rows_of, torch_alone, hand):
    problem = problem_of(hand, "box")
    poses = grasps_of(problem, rows_of(hand, "box", problem))
    share = torch.rand(poses.joints.shape, generator=torch.Generator().manual_seed(2))
    tangled = replace(poses, joints=problem.hand.lower + share * (problem.hand.upper - problem.hand.lower))
    mine, _ = find_pregrasp(problem, tangled, GraspStagesConfig())
    torch_alone()
    theirs, _ = find_pregrasp(problem, tangled, GraspStagesConfig())
    before, after, reference = (self_overlap(problem, at.joints) for at in (tangled, mine, theirs))
    assert (before > 0.004).sum() >= 3
    assert after[before > 0.004].median() < 0.25 * before[before > 0.004].median()
    assert (after.median() - reference.median()).abs() < 0.001


def test_it_stops_when_asked(problem_of, rows_of):
    problem = problem_of("allegro_right", "crowded")
    poses = grasps_of(problem, rows_of("allegro_right", "crowded", problem))
    opened, _ = find_pregrasp(problem, poses, GraspStagesConfig(open_steps=10_000_000), lambda: True)
    assert torch.isfinite(opened.joints).all()


def test_a_pose_that_is_not_a_number_stays_alone(problem_of, rows_of):
    problem = problem_of("leap_right", "box")
    x = rows_of("leap_right", "box", problem)
    clean, _ = find_pregrasp(problem, grasps_of(problem, x), GraspStagesConfig())
    x = x.clone()
    x[4, 2] = torch.nan
    opened, share = find_pregrasp(problem, grasps_of(problem, x), GraspStagesConfig())
    others = torch.arange(len(x)) != 4
    assert torch.equal(opened.joints[others], clean.joints[others])
    assert share.isfinite().tolist() == others.tolist()


@pytest.mark.parametrize("hand", hand_names())
def test_overlap_is_torchs(problem_of, torch_alone, hand):
    problem = problem_of(hand, "box")
    share = torch.rand(24, len(problem.hand.lower), generator=torch.Generator().manual_seed(0))
    joints = problem.hand.lower + share * (problem.hand.upper - problem.hand.lower)
    mine = self_overlap(problem, joints)
    torch_alone()
    assert mine.tolist() == pytest.approx(self_overlap(problem, joints).tolist(), abs=1e-6)
    if hand.startswith("allegro"):
        assert mine.max() > 0.002


@pytest.mark.parametrize("scene", ["mug", "box"])
@pytest.mark.parametrize("hand", hand_names())
def test_the_sharp_points_nearest_to_solids_are_torchs(problem_of, rows_of, torch_alone, hand, scene):
    problem = problem_of(hand, scene)
    poses = grasps_of(problem, rows_of(hand, scene, problem))
    pick, distance, gradient = nearest_features(problem, poses)
    torch_alone()
    their_pick, their_distance, their_gradient = nearest_features(problem, poses)
    assert distance.flatten().tolist() == pytest.approx(their_distance.flatten().tolist(), abs=2e-6)
    same = (pick == their_pick).flatten()
    assert len(pick.unique()) > 4
    assert same.float().mean() > 0.99
    alike = (gradient - their_gradient).abs().amax(-1).flatten() < 1e-3
    # On an edge of a solid two slopes are right; whichever rounding chooses has length one.
    assert alike[same].float().mean() > 0.99
    assert gradient.norm(dim=-1).flatten().tolist() == pytest.approx([1.0] * pick.numel(), abs=1e-4)
