"""Support and neighbours in the optimiser, patches of the hand that are drawn to the surface, a hand that gives."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from expected import some
from hypothesis import given, settings
from hypothesis import strategies as st
from made_meshes import box_between
from small_problem import small_problem

from graspd_core import PlanConfig, Scene, draw_starts, hand_names, load_hand, load_scene
from graspd_core.config import ProblemConfig
from graspd_core.hands.kinematics import RETREAT, forward, hand_mesh, in_base, link_poses, make_kinematics, place_points
from graspd_core.hands.link_distance import solid_distance
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.optimize.candidates import PlannerInput, find_candidates
from graspd_core.optimize.closed_form.closed_form_config import ClosedFormConfig
from graspd_core.optimize.loop import Hooks, Poses, pack, unpack
from graspd_core.optimize.obstacle_distance import (
    WIDE,
    gap_on_path,
    hand_reach,
    least_gap,
    make_obstacle_tensors,
    obstacle_gaps,
)
from graspd_core.optimize.problem import build_problem, evaluate, make_hand_tensors, make_object_tensors
from graspd_core.perception.obstacles import make_obstacles
from graspd_core.se3 import SE3, rotation_from_quaternion
from graspd_core.types import Plane, Posture

UP = np.array([0.0, 0.0, 1.0])
DOUBLE = torch.float64


def on_table(scene: Scene) -> Scene:
    """The scene with a table under the object."""
    return replace(scene, support=Plane(UP, float(scene.object.mesh.vertices[:, 2].min())))


def beside(scene: Scene, x: float) -> Scene:
    """The scene with a wall 100 mm wide and high at x [m]."""
    y, z = np.meshgrid(np.linspace(-0.05, 0.05, 15), np.linspace(-0.045, 0.055, 15))
    wall = np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()])
    return replace(scene, obstacles=make_obstacles([wall], scene.support, scene.object.mesh, 10.0))


def lowest(hand, posture: Posture, plane: Plane) -> float:
    """Height of the hand's lowest point over a plane, off the meshes of its solids [m]."""
    rotation = rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz)).numpy()
    vertices = hand_mesh(hand, posture.joint_positions).vertices @ rotation.T + posture.position
    return float((vertices @ plane.normal).min() - plane.offset)


def test_an_obstacle_near_the_middle_of_a_large_face_is_in_reach(hand):
    # A bar of 1.2 m has vertices only at its ends, farther from the wall than the hand reaches.
    scene = beside(load_scene(box_between((-0.02, -0.6, -0.02), (0.02, 0.6, 0.02)), mass=0.3), 0.05)
    obstacles = some(make_obstacle_tensors(scene, hand, "cpu", DOUBLE))
    assert len(obstacles.sdfs) == 1


@settings(max_examples=12)
@given(seed=st.integers(0, 2**31))
def test_depth_in_a_half_space_is_that_of_the_hands_meshes(hand, scenes, seed: int):
    rng = np.random.default_rng(seed)
    normal, quaternion = rng.normal(size=3), rng.normal(size=4)
    plane = Plane(normal / np.linalg.norm(normal), float(rng.normal() * 0.1))
    quaternion /= np.linalg.norm(quaternion)
    joints = hand.lower + (hand.upper - hand.lower) * rng.random(hand.num_joints)
    posture = Posture(rng.normal(size=3) * 0.1, quaternion, joints)
    obstacles = some(make_obstacle_tensors(replace(scenes["box"], support=plane), hand, "cpu", DOUBLE))
    base = SE3(rotation_from_quaternion(torch.as_tensor(quaternion)), torch.as_tensor(posture.position))[None]
    links = forward(small_problem(scenes["box"], hand).hand.kinematics, torch.as_tensor(joints)[None])
    gaps = obstacle_gaps(obstacles, base, links)
    # Meshes of round solids are inscribed: facets cut off up to half a millimetre of a fingertip.
    assert float(gaps.min()) == pytest.approx(lowest(hand, posture, plane), abs=5e-4)


def test_gaps_up_to_the_widest_are_exact_and_wider_ones_are_known_to_be(hand, scenes):
    scene = beside(scenes["box"], 0.05)
    obstacles = some(make_obstacle_tensors(scene, hand, "cpu", DOUBLE))
    starts = draw_starts(scenes["box"], hand, 6, 0, "cpu", DOUBLE)
    links = forward(small_problem(scene, hand).hand.kinematics, starts.joints)
    base = starts.base
    exact = sample_sdf(obstacles.sdfs[0], base.apply(place_points(obstacles.matrix, links)))[0] - obstacles.radii
    gaps = obstacle_gaps(replace(obstacles, normal=None, sdfs=obstacles.sdfs[:1]), base, links)
    close = exact < WIDE
    assert 0 < int(close.sum()) < close.numel()
    assert torch.equal(gaps[close], exact[close])
    assert bool((gaps[~close] >= WIDE).all())
    # Some are not looked at.
    assert bool((gaps == WIDE).any())


def test_the_hand_keeps_the_margin_of_the_support(hand, scenes):
    scene = on_table(scenes["box"])
    assert scene.support is not None
    raised = replace(scene, support=replace(scene.support, offset=scene.support.offset + 0.003))
    margin = replace(scene, support=replace(scene.support, margin=0.003))
    starts = draw_starts(scene, hand, 4, 0, "cpu", DOUBLE)
    gaps = []
    for one in (raised, margin):
        obstacles = some(make_obstacle_tensors(one, hand, "cpu", DOUBLE))
        gaps.append(gap_on_path(obstacles, small_problem(one, hand).hand.kinematics, starts, starts))
    assert torch.equal(*gaps)


def test_the_least_gap_is_the_least_of_all_gaps(hand, scenes):
    scene = on_table(beside(scenes["box"], 0.06))
    obstacles = some(make_obstacle_tensors(scene, hand, "cpu", DOUBLE))
    rng = np.random.default_rng(2)
    joints = hand.lower + (hand.upper - hand.lower) * rng.random((300, hand.num_joints))
    turns = rng.normal(size=(300, 4))
    rotation = rotation_from_quaternion(torch.as_tensor(turns / np.linalg.norm(turns, axis=1, keepdims=True)))
    base = SE3(rotation, torch.as_tensor(rng.normal(size=(300, 3)) * 0.1))
    links = forward(small_problem(scene, hand).hand.kinematics, torch.as_tensor(joints))
    every = obstacle_gaps(obstacles, base, links).amin(-1)
    assert bool((every < 0).any())
    assert bool((every > WIDE).any() or (every == WIDE).any())
    torch.testing.assert_close(least_gap(obstacles, base, links).clamp_max(WIDE), every.clamp_max(WIDE))


def test_a_free_object_pays_nothing(hand, scenes):
    free = small_problem(scenes["box"], hand)
    assert (free.obstacles, free.object.confidence) == (None, None)
    starts = draw_starts(scenes["box"], hand, 3, 0, "cpu", DOUBLE)
    terms = evaluate(free, starts, torch.zeros(3, dtype=DOUBLE), 0.004)
    assert terms.obstacle is None
    # A wall that no hand on the object could touch is no obstacle either. Fingertips on the object may reach one way
    # from the palm, and the wrist the other way.
    far = 2 * hand_reach(hand) + RETREAT + 0.05
    assert small_problem(beside(scenes["box"], far + 0.03), hand).obstacles is None
    assert small_problem(beside(scenes["box"], far - 0.1), hand).obstacles is not None


def test_obstacles_leave_the_other_terms_alone(hand, scenes):
    starts = draw_starts(scenes["box"], hand, 4, 0, "cpu", DOUBLE)
    arguments = (starts, torch.zeros(4, dtype=DOUBLE), 0.004)
    free = evaluate(small_problem(scenes["box"], hand), *arguments)
    among = evaluate(small_problem(beside(on_table(scenes["box"]), 0.1), hand), *arguments)
    for name in free._fields[:-1]:
        assert torch.equal(getattr(free, name), getattr(among, name))


@pytest.mark.parametrize("fine", [False, True])
@pytest.mark.parametrize("kind", ["table", "wall"])
def test_gradients_of_the_obstacle_term(hand, scenes, slope_errors, kind: str, fine: bool):
    scene = on_table(scenes["box"]) if kind == "table" else beside(scenes["box"], 0.06)
    built = small_problem(scene, hand)
    x = pack(draw_starts(scenes["box"], hand, 6, 3, "cpu", DOUBLE))

    def term(y: torch.Tensor) -> torch.Tensor:
        look = partial(evaluate, fine=fine, sharp=fine)
        obstacle = some(look(built, unpack(y), y.new_zeros(len(y)), 0.01).obstacle)
        return obstacle

    reaching = term(x) > 0
    assert reaching.sum() >= 2
    errors = slope_errors(term, x[reaching], step=1e-8, directions=6)
    # As for the whole evaluation: rounding over a step of 1e-8, and a rare crossing of a kink between cells.
    assert (errors > 1e-4).sum() <= 1, errors


def test_trust_scales_what_a_contact_counts(hand, scenes):
    x = draw_starts(scenes["box"], hand, 4, 0, "cpu", DOUBLE)
    arguments = (x, torch.zeros(4, dtype=DOUBLE), 0.02)
    ones = torch.ones_like(scenes["box"].sdf.field[0])
    known = evaluate(small_problem(scenes["box"], hand), *arguments)
    seen, guessed = (
        evaluate(small_problem(replace(scenes["box"], confidence=values), hand, confidence_floor=0.4), *arguments)
        for values in (ones, 0 * ones)
    )
    # Interpolating ones leaves rounding.
    assert seen.wrench_resistance.tolist() == pytest.approx(known.wrench_resistance.tolist(), rel=1e-12)
    # The support falls to 0.4 of itself, and its logarithm by −log 0.4, but for the floor that keeps it finite.
    assert (guessed.wrench_resistance > known.wrench_resistance).all()
    assert (guessed.wrench_resistance - known.wrench_resistance <= -np.log(0.4) + 1e-9).all()
    for name in known._fields[1:-1]:
        assert torch.equal(getattr(known, name), getattr(guessed, name))


@pytest.mark.parametrize("name", ["sphere", "box", "cylinder"])
def test_starts_lie_above_the_table_and_could_have_come_there(hand, scenes, name: str):
    scene = on_table(scenes[name])
    assert scene.support is not None
    starts = draw_starts(scene, hand, 24, 0, "cpu", DOUBLE)
    back = rotation_from_quaternion(starts.quaternion) @ torch.as_tensor(-RETREAT * hand.approach)
    depths = []
    for i in range(24):
        here = Posture(starts.translation[i].numpy(), starts.quaternion[i].numpy(), starts.joints[i].numpy())
        behind = replace(here, position=here.position + back[i].numpy())
        depths.append(-min(lowest(hand, here, scene.support), lowest(hand, behind, scene.support)))
    # A place is e times rarer for every 5 mm, and many are clear.
    assert max(depths) < 0.02
    assert np.mean(np.array(depths) < 0.003) > 0.6
    free = draw_starts(scenes[name], hand, 24, 0, "cpu", DOUBLE)
    under = [
        lowest(hand, Posture(p.numpy(), q.numpy(), j.numpy()), scene.support) < -0.02
        for p, q, j in zip(free.translation, free.quaternion, free.joints, strict=True)
    ]
    assert sum(under) > 4


def test_no_candidate_reaches_through_the_table_or_a_wall(hand, scenes):
    scene = beside(on_table(scenes["box"]), 0.09)
    short = ClosedFormConfig(explore_steps=15, refine_steps=10, polish_steps=15)
    config = PlanConfig(settings=short, problem=ProblemConfig(candidates=60, fine_candidates=120))
    found = find_candidates(PlannerInput(scene, hand, count=6, seed=0, config=config, hooks=Hooks()))
    assert found
    obstacles = some(make_obstacle_tensors(scene, hand, "cpu", DOUBLE))
    kinematics = small_problem(scene, hand).hand.kinematics
    for grasp in found:
        for posture in (grasp.pregrasp, grasp.grasp):
            assert lowest(hand, posture, some(scene.support)) > -0.0016
        ends = [
            Poses(*(torch.as_tensor(x)[None] for x in (p.position, grasp.grasp.quaternion_wxyz, p.joint_positions)))
            for p in (grasp.pregrasp, grasp.grasp)
        ]
        assert -float(gap_on_path(obstacles, kinematics, ends[0], ends[1])) < 0.0016


SETTINGS = ProblemConfig(candidates=200, features=24)


@pytest.mark.parametrize("name", hand_names())
def test_a_patch_is_part_of_one_rigid_group_and_all_have_a_coarse_candidate(name: str):
    hand = load_hand(name, candidates=400)
    tensors = make_hand_tensors(hand, 200, 4, "cpu", torch.float64)
    of_link = hand.link_group[hand.candidate_link]
    members = [np.unique(row) for row in tensors.fine.groups.numpy()]
    assert sorted(np.concatenate(members)) == sorted(np.flatnonzero(np.isin(of_link, of_link[:200])))
    assert all(len(set(of_link[some])) == 1 for some in members)
    coarse = [np.unique(row) for row in tensors.coarse.groups.numpy()]
    assert [set(some) for some in coarse] == [set(some[some < 200]) for some in members]
    assert 200 / 4 * 0.8 <= len(members) <= 200 / 4 * 1.2


def test_candidates_of_a_patch_lie_together():
    hand = load_hand("allegro_right", candidates=200)
    patches, links = (make_hand_tensors(hand, 200, size, "cpu", torch.float64) for size in (4, 0))

    def width(tensors) -> float:
        posture = link_poses(hand, (hand.lower + hand.upper) / 2)
        points = torch.as_tensor(in_base(posture, hand.candidate_points, hand.candidate_link))
        return float(torch.stack([points[row].std(0).norm() for row in tensors.coarse.groups]).mean())

    assert width(patches) < 0.7 * width(links)
    assert len(links.reach) == len(np.unique(hand.link_group[hand.candidate_link]))


def test_a_hand_that_gives_sees_a_thinner_object(scenes):
    firm, soft = (
        make_object_tensors(scenes["box"], replace(SETTINGS, softness=s), "cpu", torch.float64) for s in (0.0, 0.002)
    )
    assert torch.allclose(soft.sdf.field[0], firm.sdf.field[0] + 0.002)
    assert torch.equal(soft.sdf.field[1:], firm.sdf.field[1:])
    assert torch.equal(soft.features, firm.features)


def test_a_hand_that_gives_is_thinner_for_the_sharp_points_of_the_object(scenes):
    hand = load_hand("allegro_right")
    firm, soft = (
        build_problem(scenes["box"], hand, replace(SETTINGS, softness=s), seed=0).hand.solids for s in (0.0, 0.002)
    )
    points = torch.randn(1, 20, 3, generator=torch.Generator().manual_seed(0)) / 10
    links = forward(make_kinematics(hand), torch.as_tensor(hand.open_posture).float()[None])
    near, far = (solid_distance(solids, links, points) for solids in (firm, soft))
    torch.testing.assert_close(far, near + 0.002)
