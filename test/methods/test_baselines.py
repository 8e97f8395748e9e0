"""The baselines, GraspIt!'s annealing and random closure, and the closing of fingers until contact that both use."""

import math
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from expected import some
from hypothesis import given
from hypothesis import strategies as st
from made_meshes import box_of
from small_problem import small_problem

from graspd_bench.baselines.annealing import (
    AnnealingConfig,
    cooling,
    inner_contacts,
    jump,
    make_annealing,
    plan,
    posture_space,
    quaternion_product,
    sampled_epsilon,
)
from graspd_bench.baselines.random_closure import RandomClosureConfig, advance, draw_approaches, touching_groups
from graspd_bench.baselines.random_closure import plan as plan_closure
from graspd_core import HandModel, PlanConfig, Problem, draw_starts, hand_names, load_hand, load_scene
from graspd_core.config import ProblemConfig
from graspd_core.hands.kinematics import forward
from graspd_core.optimize.candidates import PlannerInput, PlannerOutput
from graspd_core.optimize.grasp_postures import ContactSet
from graspd_core.optimize.loop import Hooks, Poses, minimise
from graspd_core.optimize.losses import disturbance_directions
from graspd_core.optimize.obstacle_distance import obstacle_gaps
from graspd_core.optimize.problem import hand_distance
from graspd_core.perception.scene import Scene, build_scene
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import Plane
from graspd_dataset.finger_closing import Closing, finger_of, link_gaps, make_closing, moved_links

DOUBLE = torch.float64
SETTINGS = AnnealingConfig(steps=40, close_steps=20, chains_per_grasp=4.0, directions=64)
CONFIG = PlanConfig(
    method="annealing", settings=SETTINGS, problem=ProblemConfig(candidates=60, features=24, directions=12)
)


def test_the_first_eigengrasp_closes_the_hand_and_they_stay_within_limits(hand):
    space = posture_space(hand, 2, 0)
    travel = hand.closed_posture - hand.open_posture
    closing = np.abs(travel) > 0.3
    assert (space.basis[0][closing] * travel[closing] > 0).all()
    # The mean posture is half closed; the ends of the first amplitude are a more open and a more closed hand.
    span = hand.upper - hand.lower
    ends = [((space.center + a * space.basis[0] - hand.open_posture) @ travel) / (travel @ travel) for a in
            (space.low[0], 0.0, space.high[0])]  # fmt: skip
    assert ends[0] < 0.1 < 0.45 < ends[1] < 0.55 < 0.9 < ends[2]
    np.testing.assert_allclose((space.basis / span) @ (space.basis / span).T, np.eye(2), atol=1e-12)
    # There are no more of them than joints.
    assert len(posture_space(hand, 100, 0).basis) == hand.num_joints


def test_contact_locations_are_on_the_inside_of_palm_and_fingers(hand):
    chosen = inner_contacts(hand, 2)
    assert len(set(chosen.tolist())) == len(chosen)
    links = {hand.link_names[hand.candidate_link[i]] for i in chosen}
    assert hand.base_link in links
    # All four fingers take part, and of the palm only what faces where it faces.
    joints = {int(finger_of(hand)[hand.link_joint[hand.candidate_link[i]]]) for i in chosen
              if hand.link_joint[hand.candidate_link[i]] >= 0}  # fmt: skip
    assert joints == {0, 1, 2, 3}
    on_palm = [i for i in chosen if hand.candidate_link[i] == 0]
    assert (hand.candidate_normals[on_palm] @ hand.palm_normal > 0.8).all()


def test_the_schedule_is_that_of_graspit():
    # T = 10⁶ exp(−7 k^⅛) by hand: k = 30,000 gives 9.4 mm of accepted energy, k = 100,000 gives 0.15 mm.
    assert cooling(0.0) * 1e3 == pytest.approx(1e9 * math.exp(-7 * 30_000**0.125))
    assert cooling(0.0) * 1e6 == pytest.approx(9.4, abs=0.1)
    assert cooling(1.0) * 1e6 == pytest.approx(0.15, abs=0.01)


@given(st.floats(0.0, 0.999999), st.floats(1e-7, 1.0))
def test_jumps_are_odd_bounded_and_grow_with_the_draw(u, temperature):
    drawn = torch.tensor([u, 1 - u, 0.5, min(u + 1e-3, 1.0)], dtype=DOUBLE)
    y = jump(drawn, temperature)
    assert y.abs().max() <= 1 + 1e-9
    assert y[0].item() == pytest.approx(-y[1].item(), abs=1e-9)
    assert y[2] == 0
    assert y[3] >= y[0]


def test_quaternions_multiply_as_rotations_do():
    a, b = torch.randn(2, 5, 4, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    product = rotation_from_quaternion(quaternion_product(a, b))
    # Rounding only.
    assert torch.allclose(product, rotation_from_quaternion(a) @ rotation_from_quaternion(b), atol=1e-12)


def test_epsilon_of_contacts_worked_by_hand(problem_of):
    # Six contacts on the axes of a unit sphere about the centre of mass, friction μ: no contact resists a torque
    # about an axis by more than μ (its arm is one), and a force along an axis is resisted by the one contact behind it.
    problem = problem_of("sphere", DOUBLE)
    unit = replace(problem.object, center=torch.zeros(3, dtype=DOUBLE), length=1.0)
    problem = replace(problem, object=unit, friction=0.5)
    axes = torch.cat([torch.eye(3, dtype=DOUBLE), -torch.eye(3, dtype=DOUBLE)])[None]
    contact_set = ContactSet(
        torch.arange(6), axes, axes, torch.zeros(1, 6, dtype=DOUBLE), torch.ones(1, 6, dtype=torch.bool)
    )
    signed_axes = disturbance_directions(12, 0)
    assert sampled_epsilon(problem, contact_set, signed_axes).item() == pytest.approx(0.5, abs=1e-3)
    assert sampled_epsilon(problem, contact_set, signed_axes[torch.tensor([0])]).item() == pytest.approx(1.0, abs=1e-3)
    # A single contact closes nothing: whatever pulls away from it is not resisted.
    alone = replace(contact_set, active=torch.tensor([[True] + [False] * 5]))
    assert sampled_epsilon(problem, alone, signed_axes).item() < 2e-3


def test_the_energy_is_distance_and_facing_and_refuses_collisions(hand, problem_of):
    problem = problem_of("sphere", DOUBLE)
    annealing = make_annealing(problem, hand, SETTINGS, 0)
    far = torch.zeros(1, 7 + len(annealing.low), dtype=DOUBLE)
    far[0, :4] = torch.tensor([1.0, 2.0, 3.0, 1.0])
    poses = annealing.poses(far)
    # From metres away the sphere is a point, its direction the same for all contact locations within the hand's size.
    chosen = inner_contacts(hand, SETTINGS.contacts_per_link)
    every = hand_distance(
        replace(problem, hand=replace(problem.hand, coarse=problem.hand.fine)), poses.base, poses.joints
    )[0, chosen]
    energy = annealing.energy(problem, far).item()
    assert every.mean().item() < energy < every.mean().item() + 2 * SETTINGS.normal_weight
    inside = far.clone()
    inside[0, :3] = problem.object.center
    assert annealing.energy(problem, inside).item() == math.inf


def test_every_valid_seed_will_do(hand, scenes, problem_of):
    problem = problem_of("box", DOUBLE)
    annealing = make_annealing(problem, hand, replace(SETTINGS, steps=2), 2**63 - 1)
    state = annealing.init(problem, draw_starts(scenes["box"], hand, 2, 0, "cpu", DOUBLE))
    assert torch.isfinite(annealing.step(problem, state, 1).x).all()


def test_annealing_lowers_the_energy_and_never_enters_the_object(hand, scenes, problem_of):
    problem = problem_of("box", DOUBLE)
    annealing = make_annealing(problem, hand, replace(SETTINGS, steps=120), 0)
    starts = draw_starts(scenes["box"], hand, 6, 0, "cpu", DOUBLE)
    begun = annealing.init(problem, starts).best_energy
    solution = minimise(annealing, problem, starts, Hooks())
    legal = torch.isfinite(solution.loss)
    assert legal.sum() >= 4
    assert (solution.loss <= begun.nan_to_num(posinf=1e9)).all()
    assert solution.loss[legal].median() < begun[torch.isfinite(begun)].median() - 0.002
    found = solution.poses[legal]
    distance = hand_distance(problem, found.base, found.joints)
    assert distance.min() >= 0
    assert ((problem.hand.lower <= found.joints) & (found.joints <= problem.hand.upper)).all()


def task_of(scene, hand, **hooks) -> PlannerInput:
    return PlannerInput(scene, hand, 4, 0, CONFIG, Hooks(**hooks), dtype=DOUBLE)


def search(scene, hand, **hooks) -> PlannerOutput:
    return plan(task_of(scene, hand, **hooks))


def test_what_it_finds_touches_reproducibly_and_is_reported(scenes, hand):
    heard: list[tuple[int, int]] = []
    hooks = {"report": lambda step, steps, energy: heard.append((step, steps)), "interval": 0.0}
    first, again = search(scenes["cylinder"], hand, **hooks), search(scenes["cylinder"], hand)
    assert (heard[0], heard[-1]) == ((1, 40), (40, 40))
    assert (first.interrupted, len(first.poses.joints)) == ("", 8)
    for name in ("translation", "quaternion", "joints"):
        assert torch.equal(getattr(first.poses, name), getattr(again.poses, name))
    nearest = hand_distance(task_of(scenes["cylinder"], hand).problem, first.poses.base, first.poses.joints).amin(-1)
    # Even so short a run closes most hands onto the object; the hand's 60 points may miss the very spot.
    assert (nearest < 0.005).sum() >= 6


def test_chains_that_never_leave_a_collision_give_nothing(scenes, hand):
    # The support ends a metre above the object: in two steps no hand gets out of it.
    buried = replace(scenes["sphere"], support=Plane(np.array([0.0, 0.0, 1.0]), 1.0))
    short = replace(CONFIG, settings=replace(SETTINGS, steps=2))
    found = plan(PlannerInput(buried, hand, 2, 0, short, Hooks(), dtype=DOUBLE))
    assert (found.interrupted, len(found.poses.joints)) == ("", 0)


def test_it_stops_when_told_and_closes_what_the_deadline_left(scenes, hand):
    cancelled = search(scenes["cylinder"], hand, stop=lambda: True)
    assert cancelled.interrupted == "cancelled"
    late = search(scenes["cylinder"], hand, deadline=time.perf_counter())
    assert late.interrupted == "deadline"
    assert isinstance(late.poses, Poses)
    assert torch.isfinite(late.poses.joints).all()


CLOSURE = PlanConfig(
    method="random_closure",
    settings=RandomClosureConfig(close_steps=30),
    problem=ProblemConfig(candidates=60, features=24, directions=12),
)


def closure_task(scene, hand, *, count: int = 4, seed: int = 0, config=CLOSURE, **hooks) -> PlannerInput:
    return PlannerInput(scene, hand, count, seed, config, Hooks(**hooks), dtype=DOUBLE)


def close_at_random(scene, hand, **asked) -> PlannerOutput:
    return plan_closure(closure_task(scene, hand, **asked))


def test_what_it_finds_touches_with_enough_links_and_sinks_nowhere(scenes, hand):
    task = closure_task(scenes["cylinder"], hand, count=3)
    found, closing = plan_closure(task), make_closing(task.problem, hand, 30)
    assert len(found.poses.joints) == 3
    assert link_gaps(task.problem, found.poses, closing.sphere_links)[:, 0].min() >= 0
    reach = CLOSURE.grasp_stages.touch_reach
    assert (touching_groups(task.problem, closing, hand, found.poses, reach) >= 3).all()


def test_approaches_come_from_all_sides_with_the_palm_facing_the_object(problem_of, hand):
    problem = problem_of("box", DOUBLE)
    tries = draw_approaches(problem, hand, 2000, 0)
    normal = rotation_from_quaternion(tries.quaternion) @ torch.as_tensor(hand.palm_normal)
    palm = tries.translation + rotation_from_quaternion(tries.quaternion) @ torch.as_tensor(hand.palm_center)
    off = problem.object.center - palm
    assert ((off * normal).sum(-1) / off.norm(dim=-1)).min() == pytest.approx(1.0, abs=1e-9)
    # 2000 uniform directions: each mean is zero within four standard errors (1 / √(3 · 2000) = 0.013).
    assert normal.mean(0).abs().max() < 0.052
    assert (normal * normal).mean(0).tolist() == pytest.approx([1 / 3] * 3, abs=0.03)


def test_the_advance_ends_at_the_first_touch(problem_of, hand):
    problem = problem_of("sphere", DOUBLE)
    closing = make_closing(problem, hand, 30)
    tries = draw_approaches(problem, hand, 8, 1)
    there = advance(problem, closing, hand, tries)
    gap = link_gaps(problem, there, closing.sphere_links)[:, 0].amin(-1)
    assert link_gaps(problem, tries, closing.sphere_links)[:, 0].min() > 0.01
    assert gap.min() >= 0
    # The palm meets a sphere head on: nothing is grazed, so the tracing comes to its end.
    assert gap.max() < 1e-3


def test_the_same_seed_gives_the_same_hands_and_another_seed_others(scenes, hand):
    first, again, other = (close_at_random(scenes["box"], hand, count=1, seed=seed).poses for seed in (3, 3, 4))
    assert torch.equal(first.joints, again.joints)
    assert torch.equal(first.translation, again.translation)
    assert not torch.equal(first.translation, other.translation)


def test_it_stops_when_told_and_at_the_deadline(scenes, hand):
    cancelled = close_at_random(scenes["box"], hand, stop=lambda: True)
    late = close_at_random(scenes["box"], hand, deadline=time.perf_counter())
    assert (cancelled.interrupted, len(cancelled.poses.joints)) == ("cancelled", 0)
    assert (late.interrupted, len(late.poses.joints)) == ("deadline", 0)


def test_what_asks_for_more_links_than_touch_gives_nothing(scenes, hand):
    strict = replace(CLOSURE, settings=replace(CLOSURE.settings, touching=12, rounds=1))
    found = close_at_random(scenes["sphere"], hand, count=2, config=strict)
    assert (found.interrupted, len(found.poses.joints)) == ("", 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", hand_names())
def test_it_works_with_every_hand(scenes, name):
    found = close_at_random(scenes["sphere"], load_hand(name, candidates=120), count=3)
    assert len(found.poses.joints) >= 1


def test_obstacles_are_kept_clear_of(hand, scenes):
    scene = scenes["cylinder"]
    low = float(scene.object.mesh.vertices[:, 2].min())
    task = closure_task(replace(scene, support=Plane(np.array([0.0, 0.0, 1.0]), low)), hand, count=3)
    found, obstacles = plan_closure(task), task.problem.obstacles
    gaps = obstacle_gaps(some(obstacles), found.poses.base, forward(task.problem.hand.kinematics, found.poses.joints))
    assert len(gaps) >= 1
    assert gaps.min() >= 0


# Two slabs that slide towards each other over a palm: 60 mm apart when open, and their inner faces 4 mm nearer.
SLAB = """<link name="{}"><collision><origin xyz="0 0 0.02"/><geometry><box size="0.008 0.02 0.04"/></geometry>
  </collision></link>"""
SLIDE = """<joint name="slide_{0}" type="prismatic"><parent link="palm"/><child link="{0}"/><origin xyz="{1}0.03 0 0"/>
  <axis xyz="{2}1 0 0"/><limit lower="0" upper="0.03" effort="10" velocity="1"/></joint>"""
PALM = """<link name="palm"><collision><origin xyz="0 0 -0.01"/><geometry><box size="0.1 0.02 0.02"/></geometry>
  </collision></link>"""
PARTS = (PALM, SLAB.format("left"), SLAB.format("right"), SLIDE.format("left", "-", ""), SLIDE.format("right", "", "-"))
GRIPPER = f'<robot name="pincher">{"".join(PARTS)}</robot>'
DESCRIPTION = """urdf: pincher.urdf
palm: {link: palm, center: [0.0, 0.0, 0.0], normal: [0.0, 0.0, 1.0]}
approach: [0.0, 0.0, 1.0]
open: {slide_left: 0.0, slide_right: 0.0}
closed: {slide_left: 0.025, slide_right: 0.025}
"""


@pytest.fixture(scope="module")
def pincher(tmp_path_factory: pytest.TempPathFactory) -> HandModel:
    folder = tmp_path_factory.mktemp("pincher")
    (folder / "pincher.urdf").write_text(GRIPPER)
    (folder / "pincher.yaml").write_text(DESCRIPTION)
    return load_hand(folder / "pincher.yaml", candidates=300)


def cube_scene(half: float, shift: float = 0.0) -> Scene:
    return build_scene(box_of(half, (shift, 0.0, 0.02)), resolution=48)


def closed(scene: Scene, hand: HandModel, starts: Poses) -> tuple[Problem, Closing, Poses]:
    problem = small_problem(scene, hand)
    closing = make_closing(problem, hand, 30)
    return problem, closing, minimise(closing, problem, starts, Hooks()).poses


def at_home(hand: HandModel) -> Poses:
    identity = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=DOUBLE)
    return Poses(torch.zeros(1, 3, dtype=DOUBLE), identity, torch.as_tensor(hand.open_posture)[None])


def test_fingers_stop_where_they_touch_and_each_for_itself(pincher):
    # A cube of 20 mm, 4 mm off the middle: the inner faces are at ±26 mm, so they travel 20 and 12 mm.
    _, _, poses = closed(cube_scene(0.01, shift=0.004), pincher, at_home(pincher))
    # A step is 25/30 mm and halved four times before it is given up.
    assert poses.joints[0].tolist() == pytest.approx([0.020, 0.012], abs=6e-5)


def test_fingers_go_past_their_closed_value_and_stop_at_the_limit_or_at_each_other(pincher):
    # Far from any object the slabs meet: their faces are 52 mm apart, and the limit of 30 mm each is not reached.
    far = replace(at_home(pincher), translation=torch.tensor([[0.0, 0.0, 1.0]], dtype=DOUBLE))
    _, _, poses = closed(cube_scene(0.01), pincher, far)
    assert (poses.joints <= torch.as_tensor(pincher.upper)).all()
    # Proxy spheres bulge by up to a fifth of the slabs' half thickness and one millimetre of overlap is allowed.
    assert poses.joints.sum().item() == pytest.approx(0.052, abs=3e-3)


def test_a_hand_that_is_sunk_in_already_sinks_no_deeper(pincher):
    deep = replace(at_home(pincher), joints=torch.tensor([[0.018, 0.0]], dtype=DOUBLE))
    problem, closing, poses = closed(cube_scene(0.01), pincher, deep)
    before, after = (link_gaps(problem, p, closing.sphere_links)[:, 0].amin() for p in (deep, poses))
    assert before < -1e-3
    assert after >= before - 1e-9


def test_no_link_of_a_real_hand_sinks_in_and_every_joint_stops_for_a_reason(hand):
    problem = small_problem(load_scene("shape:cylinder"), hand)
    closing = make_closing(problem, hand, 30)
    starts = advance(problem, closing, hand, draw_approaches(problem, hand, 6, 0))
    state = closing.init(problem, starts)
    for index in range(closing.steps):
        state = closing.step(problem, state, index)
    joints = state.poses.joints
    gaps = link_gaps(problem, state.poses, closing.sphere_links)
    assert gaps[:, 0].min() >= 0
    assert ((problem.hand.lower <= joints) & (joints <= problem.hand.upper)).all()
    # A joint that a contact stopped moves a link that touches: half a millimetre is many times the last, halved step.
    arrived = state.stopped & (closing.rate != 0.0) & (joints != closing.target)
    touching = (gaps[:, 0] < 5e-4) | (gaps[:, 1] < -5e-4)
    assert arrived.any()
    assert closing.some(touching, closing.moves)[arrived].all()


def test_fingers_are_the_chains_of_joints(hand, pincher):
    assert np.unique(finger_of(hand)).tolist() == [0, 1, 2, 3]
    assert len(set(finger_of(hand)[:4])) == 1
    assert np.unique(finger_of(pincher)).tolist() == [0, 1]
    # The first joint of a finger moves all of its links, the last one only the last.
    moves = moved_links(hand)
    assert moves[0].sum() == 5
    assert moves[3].sum() == 2
