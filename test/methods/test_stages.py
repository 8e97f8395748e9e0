"""Contacts, balanced forces and the open posture on cases worked out by hand; the score that ranks candidates."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import ranking as benchmark
import torch
from scipy.optimize import nnls

from graspd_core import Problem, draw_starts, load_preset
from graspd_core.config import GraspStagesConfig
from graspd_core.hands.kinematics import link_poses, point_jacobian
from graspd_core.mesh.shapes import SPHERE_RADIUS
from graspd_core.optimize.candidates import PlannerInput, find_candidates, staged
from graspd_core.optimize.grasp_postures import (
    ContactSet,
    Squeeze,
    _cone_edges,
    balanced_forces,
    by_link,
    find_contacts,
    find_pregrasp,
    joint_torques,
    self_overlap,
    squeeze,
)
from graspd_core.optimize.loop import Hooks, Poses
from graspd_core.optimize.problem import hand_distance
from graspd_core.optimize.ranking import Staged, log_odds, ranking_figures, score
from graspd_core.se3 import rotation_from_quaternion

FRICTION, LENGTH = 0.5, 0.035


def forces_at(directions: list[list[float]], active: list[bool] | None = None) -> tuple[np.ndarray, float]:
    """Balanced forces of contacts on a sphere of 35 mm in these directions from its middle."""
    normals = np.array([directions], dtype=float)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    on = np.array([active if active is not None else [True] * len(directions)])
    forces, imbalance = balanced_forces(LENGTH * normals, normals, on, LENGTH, FRICTION)
    return forces[0], float(imbalance[0])


@pytest.mark.parametrize(("count", "tolerance"), [(2, 1e-9), (3, 0.02)])
def test_contacts_around_a_sphere_share_the_load(count: int, tolerance: float):
    turn = 2 * np.pi * np.arange(count) / count
    directions = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(count)])
    forces, imbalance = forces_at(directions.tolist())
    # The eight cone edges are no multiple of three, so that the ridge pulls a little off the symmetric answer.
    assert imbalance < tolerance
    assert forces == pytest.approx(-directions / count, abs=tolerance)


def test_one_contact_or_one_side_does_not_balance():
    alone, imbalance = forces_at([[1, 0, 0], [-1, 0, 0]], [True, False])
    assert imbalance == 1.0
    assert not alone.any()
    # 20° apart: the forces of cones of 27° can never cancel their normal parts, which add up to cos 10°.
    _, same_side = forces_at([[1, 0.18, 0], [1, -0.18, 0]])
    assert same_side > 0.7


def closed_on(problem, hand, scene, count: int) -> Poses:
    """Starts with the fingers closed until something touches."""
    starts = draw_starts(scene, hand, count, 0, "cpu", torch.float64)
    closed = torch.as_tensor(hand.closed_posture)
    share = torch.zeros(count, 1, dtype=torch.float64)
    moving = torch.ones(count, dtype=torch.bool)
    for step in torch.linspace(0, 1, 41)[1:].tolist():
        joints = starts.joints + step * (closed - starts.joints)
        moving &= hand_distance(problem, starts.base, joints).amin(-1) > 0
        share[moving] = step
    return replace(starts, joints=starts.joints + share * (closed - starts.joints))


def test_open_clear_opens_around_a_cylinder(problem_of, hand, scenes):
    problem, config = problem_of("cylinder"), GraspStagesConfig()
    grasps = closed_on(problem, hand, scenes["cylinder"], 6)
    before = hand_distance(problem, grasps.base, grasps.joints).amin(-1)
    touching = before < 0.004
    assert touching.sum() >= 3
    opened, clearance = find_pregrasp(problem, grasps, config)
    after = hand_distance(problem, opened.base, opened.joints).amin(-1)
    assert (clearance > 0.5).all()
    # The share is that of the worst place of the way, so the open end has at least this much.
    assert (after >= clearance * config.clearance - 1e-9).all()
    assert (after > before)[touching].all()
    assert torch.equal(opened.quaternion, grasps.quaternion)
    assert ((opened.joints >= problem.hand.lower) & (opened.joints <= problem.hand.upper)).all()


def fingertip_on_sphere(hand) -> tuple[Poses, int, torch.Tensor, torch.Tensor]:
    """The open hand, unturned, with one candidate of a fingertip on the sphere: its link, the point and the normal."""
    link = hand.link_index["link_3.0_tip"]
    rotations, translations = link_poses(hand, hand.open_posture)
    of_tip = np.flatnonzero(hand.candidate_link == link)
    normals = hand.candidate_normals[of_tip] @ rotations[link].T
    # The palm looks along x, and so does the inside of the fingertip.
    best = normals[:, 0].argmax()
    point = rotations[link] @ hand.candidate_points[of_tip[best]] + translations[link]
    contact = torch.as_tensor(-SPHERE_RADIUS * normals[best])
    poses = Poses(
        (contact - torch.as_tensor(point))[None],
        torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
        torch.as_tensor(hand.open_posture)[None],
    )
    return poses, link, contact, torch.as_tensor(-normals[best])


def test_a_known_contact_is_found(problem_of, hand):
    poses, link, contact, normal = fingertip_on_sphere(hand)
    contact_set = find_contacts(problem_of("sphere"), poses, reach=0.002)
    found = torch.nonzero(contact_set.active[0] & (contact_set.link == link)).flatten()
    assert len(found)
    away = (contact_set.position[0, found] - contact).norm(dim=-1)
    slot = found[away.argmin()]
    # Facets and grid cells of 2 mm flatten a sphere of 35 mm by less than 0.1 mm, and turn its normal by less than 3°.
    assert away.min() < 1e-4
    assert abs(float(contact_set.distance[0, slot])) < 1e-4
    assert contact_set.normal[0, slot] @ normal > np.cos(0.05)
    assert (contact_set.distance[contact_set.active].abs() <= 0.002).all()


def test_torques_are_the_transposed_jacobian_times_forces(problem_of, hand, scenes):
    problem = problem_of("box")
    poses = closed_on(problem, hand, scenes["box"], 2)
    contact_set = find_contacts(problem, poses, reach=0.02)
    generator = torch.Generator().manual_seed(0)
    forces = torch.randn(contact_set.position.shape, generator=generator, dtype=torch.float64)
    torques = joint_torques(problem, poses, contact_set, forces)
    links = contact_set.link.numpy()
    for row in range(2):
        rotation = rotation_from_quaternion(poses.quaternion[row]).numpy()
        in_base = (contact_set.position[row] - poses.translation[row]).numpy() @ rotation
        joints = poses.joints[row].numpy()
        rotations, translations = link_poses(hand, joints)
        in_link = np.einsum("pij,pi->pj", rotations[links], in_base - translations[links])
        jacobian = point_jacobian(hand, joints, in_link, links)
        expected = np.einsum("pij,pi->j", jacobian, forces[row].numpy() @ rotation)
        # Two ways to the same sum: rounding only.
        assert torques[row].numpy() == pytest.approx(expected, abs=1e-10)


def test_the_squeeze_presses_within_effort_and_limits(problem_of, hand, scenes):
    problem, config = problem_of("cylinder"), GraspStagesConfig()
    problem = replace(problem, object=replace(problem.object, mass=0.1))
    poses = closed_on(problem, hand, scenes["cylinder"], 4)
    contact_set = find_contacts(problem, poses, reach=0.02)
    effort = torch.as_tensor(hand.effort)
    pressed = squeeze(problem, poses, contact_set, effort, config)
    assert ((pressed.joints >= problem.hand.lower) & (pressed.joints <= problem.hand.upper)).all()
    assert not pressed.forces[~contact_set.active].any()
    grip = normal_forces(contact_set, pressed).sum(-1)
    assert grip.numpy() == pytest.approx(config.grip_force)
    weak = squeeze(problem, poses, contact_set, effort / 10, config)
    assert (weak.forces == pressed.forces).all()
    most = effort / 10 * config.effort_share / config.stiffness
    assert float(((weak.joints - poses.joints).abs() / most).max()) == pytest.approx(1.0)
    strongest = float(normal_forces(contact_set, pressed).max())
    gentle = squeeze(problem, poses, contact_set, effort, replace(config, link_force=strongest / 2))
    assert float(normal_forces(contact_set, gentle).max()) == pytest.approx(strongest / 2)


def normal_forces(contact_set: ContactSet, pressed: Squeeze) -> torch.Tensor:
    """Return the sum of the normal forces of each link [N]."""
    return by_link(contact_set, -(pressed.forces * contact_set.normal).sum(-1, keepdim=True))[..., 0]


def test_the_squeeze_of_a_heavy_or_slippery_object_is_stronger(problem_of, hand, scenes):
    problem, config = problem_of("cylinder"), GraspStagesConfig(link_force=1000.0)
    poses = closed_on(problem, hand, scenes["cylinder"], 4)
    contact_set = find_contacts(problem, poses, reach=0.02)

    def grip(mass: float, friction: float) -> float:
        one = replace(problem, object=replace(problem.object, mass=mass), friction=friction)
        pressed = squeeze(one, poses, contact_set, torch.as_tensor(hand.effort), config)
        return float(normal_forces(contact_set, pressed).sum(-1).max())

    assert grip(0.1, 0.6) == pytest.approx(config.grip_force)
    # Two opposing contacts hold the weight m g with normal forces of m g / μ in all.
    assert grip(1.0, 0.6) > 5 * 9.81 / 0.6
    assert grip(1.0, 0.3) == pytest.approx(2 * grip(1.0, 0.6))
    assert grip(2.0, 0.6) == pytest.approx(2 * grip(1.0, 0.6))


def test_an_open_hand_is_clear_of_itself_and_crossed_fingers_are_not(problem_of, hand):
    problem = problem_of("sphere")
    joint = {name: i for i, name in enumerate(hand.joint_names)}
    upright = torch.as_tensor(hand.open_posture)
    crossed = []
    for sign in (1, -1):
        q = upright.clone()
        # First and second finger lean towards each other, or away from each other.
        q[joint["joint_0.0"]], q[joint["joint_4.0"]] = 0.47 * sign, -0.47 * sign
        crossed.append(q)
    overlap = self_overlap(problem, torch.stack([upright, *crossed]))
    assert overlap[0] == 0.0
    # Fingers are 45 mm apart and 27 mm wide; leaning 27° each way they meet within 45 mm of their roots.
    assert overlap[1:].max() > 0.004
    # Leaning apart, the second finger just brushes the third.
    assert overlap[1:].min() < 0.002


@pytest.mark.parametrize("seed", range(6))
def test_balanced_forces_are_those_of_non_negative_least_squares(seed):
    """Against Lawson and Hanson's algorithm on the same system, row by row, with some contacts switched off."""
    rng = np.random.default_rng(seed)
    slots = int(rng.integers(2, 16))
    normals = rng.normal(size=(3, slots, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    arms = 0.03 * normals + 0.005 * rng.normal(size=normals.shape)
    active = rng.random((3, slots)) < 0.8
    active[:, :2] = True
    forces, imbalance = balanced_forces(arms, normals, active, LENGTH, FRICTION)
    for row in range(3):
        on = np.flatnonzero(active[row])
        edges = _cone_edges(normals[row : row + 1, on], FRICTION)[0]
        torques = np.cross(arms[row, on][:, None], edges) / LENGTH
        wrenches = np.concatenate([edges, torques], -1).reshape(-1, 6).T
        count = wrenches.shape[1]
        system = np.concatenate([wrenches, np.full((1, count), 10.0), 0.5 * np.eye(count)])
        weights, _ = nnls(system, np.concatenate([np.zeros(6), [10.0], np.zeros(count)]))
        weights /= weights.sum()
        expected = np.zeros((slots, 3))
        expected[on] = (weights.reshape(-1, 8, 1) * edges).sum(1)
        assert forces[row] == pytest.approx(expected, abs=1e-9)
        assert imbalance[row] == pytest.approx(np.linalg.norm(wrenches @ weights), abs=1e-9)


def test_forces_of_contacts_that_are_not_numbers_are_not_numbers_and_end():
    normals = np.full((1, 3, 3), np.nan)
    forces, imbalance = balanced_forces(normals, normals, np.ones((1, 3), dtype=bool), LENGTH, FRICTION)
    assert np.isnan(forces).any() or np.isnan(imbalance).any()
    nobody, alone = balanced_forces(normals, normals, np.zeros((1, 3), dtype=bool), LENGTH, FRICTION)
    assert not nobody.any()
    assert alone.tolist() == [1.0]


CONFIG = load_preset("fast")


@pytest.fixture(scope="module")
def some(problem_of, hand, scenes) -> tuple[Problem, Staged]:
    """Eight good poses on a box, and a few that were only drawn."""
    problem = problem_of("box", torch.float32)
    found = find_candidates(PlannerInput(scenes["box"], hand, count=8, seed=0, config=CONFIG, hooks=Hooks()))[:8]
    rows = [(g.grasp.position, g.grasp.quaternion_wxyz, g.grasp.joint_positions) for g in found]
    good = [torch.as_tensor(np.stack(part)).float() for part in zip(*rows, strict=True)]
    drawn = vars(draw_starts(scenes["box"], hand, 4, 0, "cpu", torch.float32)).values()
    poses = Poses(*(torch.cat(parts) for parts in zip(good, drawn, strict=True)))
    return problem, staged(problem, hand, poses, CONFIG)


def test_hands_that_were_only_drawn_come_after_all_that_grasp(some: tuple[Problem, Staged]):
    assert torch.isfinite(ranking_figures(*some)).all()
    scores = score(*some)
    assert scores[:8].min() > scores[8:].max()


def test_without_a_force_no_contact_shares_the_load(some: tuple[Problem, Staged]):
    problem, before = some
    loose = before._replace(pressed=replace(before.pressed, forces=torch.zeros_like(before.pressed.forces)))
    assert ranking_figures(problem, loose).abs().max() < 100.0


def test_the_commands_make_a_network(tmp_path: Path):
    tried, network = tmp_path / "tried", tmp_path / "network.npz"
    few = ["--objects", "shape:sphere", "--hands", "parallel_gripper", "--variants", "1", "--count", "1"]
    benchmark.main(["try", *few, "--out", str(tried)])
    (block,) = tried.glob("*.npz")
    benchmark.main(["fit", "--out", str(tried), "--to", str(network)])
    with np.load(network) as arrays, np.load(block) as rows:
        fitted = {name: torch.as_tensor(arrays[name]).double() for name in arrays.files}
        odds = log_odds(fitted, torch.as_tensor(rows["figures"]))
        assert len(odds) == len(rows["standard"]) == len(rows["hard"]) == 8
    assert torch.isfinite(odds).all()


def test_one_at_a_time_is_as_all_at_once(some: tuple[Problem, Staged]):
    problem, all_rows = some
    rows = torch.arange(3, 4)
    contact_set, pressed = all_rows.contact_set, all_rows.pressed
    one = Staged(
        all_rows.poses[rows],
        all_rows.opened[rows],
        all_rows.clearance[rows],
        replace(contact_set, **{k: v[rows] for k, v in vars(contact_set).items() if k != "link"}),
        replace(pressed, **{k: v[rows] for k, v in vars(pressed).items()}),
        all_rows.overlap[rows],
    )
    assert score(problem, one) == pytest.approx(score(*some)[rows], abs=1e-4)


@pytest.mark.parametrize("what", ["overlap", "depth"])
def test_what_a_trial_forgives_costs(some: tuple[Problem, Staged], what: str):
    problem, before = some
    if what == "overlap":
        after = before._replace(overlap=before.overlap + 0.005)
    else:
        distance = before.contact_set.distance.clone()
        distance[:, 0] = -0.012
        after = before._replace(contact_set=replace(before.contact_set, distance=distance))
    assert (score(problem, after) < score(problem, before) - 3.0).all()


def test_what_is_no_number_ranks_without_an_error(some: tuple[Problem, Staged]):
    problem, before = some
    spoilt = replace(before.pressed, imbalance=torch.full_like(before.pressed.imbalance, torch.nan))
    assert torch.isfinite(score(problem, before._replace(pressed=spoilt))).all()
