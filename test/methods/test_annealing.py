"""The GraspIt!-style planner: posture space, schedule, energy and ε against values by hand; and that it improves."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

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
from graspd_core.config import ProblemConfig
from graspd_core.optimize.candidates import PlannerInput, PlannerOutput
from graspd_core.optimize.finger_closing import finger_of
from graspd_core.optimize.grasp_postures import ContactSet, hand_distance
from graspd_core.optimize.initial_poses import draw_starts
from graspd_core.optimize.loop import Hooks, Poses, minimise
from graspd_core.optimize.losses import disturbance_directions
from graspd_core.optimize.plan_config import PlanConfig
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import Plane

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


def test_a_hand_of_few_joints_has_no_more_eigengrasps_than_joints(hand):
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
    assert (found.joints >= problem.hand.lower).all()
    assert (found.joints <= problem.hand.upper).all()


def search(scene, hand, *, seed: int = 0, hooks: Hooks | None = None) -> PlannerOutput:
    hooks = Hooks() if hooks is None else hooks
    return plan(PlannerInput(scene, hand, 4, seed, CONFIG, hooks, dtype=DOUBLE))


def test_what_it_finds_touches_reproducibly_and_is_reported(scenes, hand):
    heard: list[tuple[int, int]] = []
    hooks = Hooks(report=lambda step, steps, energy: heard.append((step, steps)), interval=0.0)
    first, again = search(scenes["cylinder"], hand, hooks=hooks), search(scenes["cylinder"], hand)
    assert (heard[0], heard[-1]) == ((1, 40), (40, 40))
    assert (first.interrupted, len(first.poses.joints)) == ("", 8)
    for name in ("translation", "quaternion", "joints"):
        assert torch.equal(getattr(first.poses, name), getattr(again.poses, name))
    nearest = hand_distance(first.problem, first.poses.base, first.poses.joints).amin(-1)
    # Even so short a run closes most hands onto the object; the hand's 60 points may miss the very spot.
    assert (nearest < 0.005).sum() >= 6


def test_chains_that_never_leave_a_collision_give_nothing(scenes, hand):
    # The support ends a metre above the object: in two steps no hand gets out of it.
    buried = replace(scenes["sphere"], support=Plane(np.array([0.0, 0.0, 1.0]), 1.0))
    short = replace(CONFIG, settings=replace(SETTINGS, steps=2))
    found = plan(PlannerInput(buried, hand, 2, 0, short, Hooks(), dtype=DOUBLE))
    assert (found.interrupted, len(found.poses.joints)) == ("", 0)


def test_it_stops_when_told_and_closes_what_the_deadline_left(scenes, hand):
    cancelled = search(scenes["cylinder"], hand, hooks=Hooks(stop=lambda: True))
    assert cancelled.interrupted == "cancelled"
    late = search(scenes["cylinder"], hand, hooks=Hooks(deadline=time.perf_counter()))
    assert late.interrupted == "deadline"
    assert isinstance(late.poses, Poses)
    assert torch.isfinite(late.poses.joints).all()
