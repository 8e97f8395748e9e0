"""All metrics together, in known cases and any frame; the wrench hull by hand; copies that are counted once."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from graspd_core.hands.library import load_hand
from graspd_core.se3 import quaternion_from_rotation, random_rotations
from graspd_core.types import Grasp, GraspMetrics, Posture, TriangleMesh
from graspd_core.verify.metrics import distinct, measure
from graspd_core.verify.prepared_grasp import (
    PROTOCOL_CONTACTS,
    cone_wrenches,
    make_metrics_context,
    surface_normals,
    wrench_hull,
)


def some(value: float | None) -> float:
    """A metric that was measured."""
    assert value is not None
    return value


def test_a_gripper_about_a_box_closes_and_one_finger_does_not(gripper, box, as_object, at):
    context = make_metrics_context(as_object(box), gripper)
    # Inner faces 45 mm − q from the middle: at 14.5 mm half a millimetre from the box's 30 mm.
    both = measure(context, at((0, 0, -0.05), (0.0145, 0.0145)))
    assert both["contact_links"] == 2
    # Each inner face of 30 x 60 mm lies beside the box, and 1.5 mm of the four sides about it come within 2 mm too.
    # 1100 of 4000 samples are on them: three standard deviations are 8 %.
    assert both["contact_area"] == pytest.approx(2 * (0.03 * 0.06 + 0.18 * 0.0015), rel=0.08)
    assert some(both["epsilon"]) > 0
    assert both["penetration"] == both["intersection_volume"] == both["self_penetration"] == 0.0
    one = measure(context, at((0, 0, -0.05), (0.0145, 0.0)))
    assert one["contact_links"] == 1
    assert one["epsilon"] == 0.0


def test_nothing_touched_is_all_zero(gripper, box, as_object, at):
    metrics = measure(make_metrics_context(as_object(box), gripper), at((0, 0, 1.0), (0.0, 0.0)))
    assert all(value in (0.0, None) for value in metrics.values())


def test_the_same_posture_measures_the_same_by_any_judge(gripper, box, as_object, at):
    posture = at((0.003, 0.001, -0.05), (0.016, 0.015))
    contexts = [make_metrics_context(as_object(box), gripper) for _ in range(2)]
    assert measure(contexts[0], posture) == measure(contexts[0], posture) == measure(contexts[1], posture)


@settings(max_examples=8)
@given(seed=st.integers(0, 2**31))
def test_moving_object_and_hand_together_changes_nothing(seed, gripper, box, as_object, at):
    rotation = random_rotations(1, torch.Generator().manual_seed(seed), torch.float64)[0].numpy()
    shift = np.random.default_rng(seed).uniform(-0.5, 0.5, 3)
    # Not flush with anything, so that no sample or voxel sits on a border.
    posture = at((0.0012, 0.0007, -0.0511), (0.0163, 0.0151))
    moved = Posture(
        rotation @ posture.position + shift,
        quaternion_from_rotation(torch.as_tensor(rotation)).numpy(),
        posture.joint_positions,
    )
    here = measure(make_metrics_context(as_object(box), gripper), posture)
    there = measure(
        make_metrics_context(as_object(TriangleMesh(box.vertices @ rotation.T + shift, box.faces)), gripper), moved
    )
    assert there["contact_links"] == here["contact_links"]
    # Sums over samples and voxels: a few of thousands may change sides by float32 distances.
    assert there["contact_area"] == pytest.approx(here["contact_area"], rel=0.005)
    assert there["intersection_volume"] == pytest.approx(here["intersection_volume"], rel=0.005)
    assert there["penetration"] == pytest.approx(here["penetration"], abs=1e-7)
    # The edges of the cones start at other angles, which moves ε by up to 1 − cos(π/8).
    assert there["epsilon"] == pytest.approx(here["epsilon"], rel=0.09)


def test_normals_point_out_on_either_side_of_the_surface(gripper, box, as_object):
    context = make_metrics_context(as_object(box), gripper)
    points = np.array([[0.031, 0, 0], [0.029, 0, 0], [0, -0.031, 0.01], [0, 0, 0.046], [0.03, 0.01, 0.01]])
    expected = np.array([[1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 0, 1], [1, 0, 0]])
    # Differences of float32 distances (1e-8 m) over 0.4 mm.
    assert surface_normals(context.query, points) == pytest.approx(expected, abs=1e-4)


def test_wider_contacts_about_a_box(gripper, box, as_object, at):
    context = make_metrics_context(as_object(box), gripper)
    assert len(context.surface.points) >= 2000
    # Inner faces half a millimetre off. Within 5 mm of the box's planes: the inner faces, 4.5 mm of the sides about
    # them, nothing of the palm, whose face is 5 mm below the box's.
    metrics = measure(context, at((0, 0, -0.0501), (0.0145, 0.0145)))
    assert metrics["contact_area_5mm"] == pytest.approx(2 * (0.03 * 0.06 + 0.18 * 0.0045), rel=0.08)
    # Within 10 mm: 9.5 mm of the sides, and the palm's strip below the box, 60 mm and 8.6 mm about its edges wide.
    strip = 0.04 * (0.06 + 2 * 0.0086)
    assert metrics["contact_area_10mm"] == pytest.approx(2 * (0.03 * 0.06 + 0.18 * 0.0095) + strip, rel=0.08)


def test_area_over_volume_of_a_block_sunk_into_a_face(block, box, as_object, at):
    metrics = measure(make_metrics_context(as_object(box), block), at((0.045, 0, 0), (0.0,)))
    # 5 mm deep over 30 x 20 mm; a band of 4 mm about a perimeter of 100 mm is within 2 mm of the face.
    assert metrics["contact_per_volume"] == pytest.approx(0.1 * 0.004 / (0.005 * 0.03 * 0.02), rel=0.2)


def test_more_contacts_only_widen_the_wrench_hull(gripper, box, as_object, at):
    context, posture = make_metrics_context(as_object(box), gripper), at((0, 0, -0.05), (0.0145, 0.0145))
    few, many = (measure(context, posture, max_contacts=count) for count in (8, PROTOCOL_CONTACTS))
    # Farthest points are nested: the first eight are among the first 32. Joggled by 1e-10.
    assert some(many["epsilon"]) >= some(few["epsilon"]) - 1e-8
    assert some(many["volume"]) > some(few["volume"])
    assert GraspMetrics({**many, "epsilon": few["epsilon"], "volume": few["volume"]}) == few


@pytest.fixture(scope="module")
def hand():
    return load_hand("parallel_gripper", candidates=60)


def grasp(hand, position=(0.0, 0.0, 0.0), turn: float = 0.0) -> Grasp:
    """A hand turned about z through the middle of its palm, which stays at `position`."""
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    quaternion = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
    posture = Posture(np.array(position) - rotation @ hand.palm_center, quaternion, hand.open_posture)
    return Grasp(posture, posture, posture, (), 0.0)


def test_sixteen_copies_are_one_grasp(hand):
    first = grasp(hand)
    assert distinct([first, *(grasp(hand, (0.001 * i, 0.0, 0.0)) for i in range(16))], hand) == (first,)
    assert distinct([], hand) == ()


@pytest.mark.parametrize(
    ("other", "kept"),
    [({"position": (0.019, 0, 0)}, 1), ({"position": (0.021, 0, 0)}, 2), ({"turn": 0.34}, 1), ({"turn": 0.36}, 2)],
)
def test_far_enough_or_turned_enough_is_another(hand, other: dict, kept: int):
    assert len(distinct([grasp(hand), grasp(hand, **other)], hand)) == kept


@given(angle=st.floats(0.4, 2 * np.pi - 0.4))
def test_a_ball_held_from_another_side_is_held_otherwise(hand, angle: float):
    around = (0.05 * np.cos(angle), 0.05 * np.sin(angle), 0.0)
    assert len(distinct([grasp(hand, (0.05, 0.0, 0.0)), grasp(hand, around, angle)], hand)) == 2


FRICTION = 0.6

# Every edge of a cone is a unit force: its normal part, and its tangential part.
NORMAL, TANGENT = 1 / np.sqrt(1 + FRICTION**2), FRICTION / np.sqrt(1 + FRICTION**2)


def disc(radius: float = 1.0) -> np.ndarray:
    angles = 2 * np.pi * np.arange(3) / 3
    return radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(3)])


def plates() -> tuple[np.ndarray, np.ndarray]:
    """Four corners on either side of a cube of side 2, across y."""
    corners = np.array([[x, y, z] for y in (-1.0, 1.0) for x in (-1.0, 1.0) for z in (-1.0, 1.0)])
    return corners, np.array([0.0, 1.0, 0.0]) * corners


def support(wrenches: np.ndarray, direction: np.ndarray) -> float:
    return float((wrenches @ direction).max())


def test_one_contact_and_two_antipodal_ones_close_nothing():
    arms = np.array([[0.03, 0, 0], [-0.03, 0, 0]])
    assert np.abs(cone_wrenches(arms, arms / 0.03, FRICTION, 0.03)[:, 3]).max() == pytest.approx(0.0, abs=1e-15)
    assert wrench_hull(arms, arms / 0.03, FRICTION, 0.03) == (0.0, 0.0)
    one = np.array([[0.03, 0, 0]])
    assert wrench_hull(one, one / 0.03, FRICTION, 0.03) == (0.0, 0.0)
    assert wrench_hull(one[:0], one[:0], FRICTION, 0.03) == (0.0, 0.0)


def test_three_contacts_on_a_disc():
    wrenches = cone_wrenches(disc(), disc(), FRICTION, 1.0)
    axes = np.eye(6)
    # Along the disc's axis, and about it, there is friction at arm 1 only. About an axis in its plane too, at the arm
    # of the contact farthest from that axis: 1, or sin 60° where a contact lies on it.
    assert support(wrenches, axes[2]) == support(wrenches, axes[5]) == pytest.approx(TANGENT)
    assert support(wrenches, axes[4]) == pytest.approx(TANGENT)
    assert support(wrenches, axes[3]) == pytest.approx(TANGENT * np.sin(np.pi / 3))
    # Away from a contact (−x) there is its normal force; towards it (+x) the other two give half of theirs and their
    # friction's sin 60°.
    assert support(wrenches, -axes[0]) == pytest.approx(NORMAL)
    assert support(wrenches, axes[0]) == pytest.approx(0.5 * NORMAL + TANGENT * np.sin(np.pi / 3))
    # Against (force z; torque x, y) contact i has only its vertical edges, TANGENT · ±v_i with v_i = (1, y_i, −x_i).
    # The v have Gram matrix 2 on and 1/2 off its diagonal, so the octahedron of the ±v_i has faces at √(9/17): ε is no
    # more than that.
    epsilon, volume = wrench_hull(disc(), disc(), FRICTION, 1.0)
    assert 0 < epsilon <= TANGENT * np.sqrt(9 / 17)
    assert volume > 0


def test_six_contacts_on_the_axes_of_a_sphere():
    # Worst is a turn about a diagonal, (1, 1, 1)/√3: each contact gives friction times the part of it across its own
    # normal, √(2/3), which lies along an edge of the cone. All six are equal there, and any push mixed in adds.
    arms = np.vstack([np.eye(3), -np.eye(3)])
    assert wrench_hull(arms, arms, FRICTION, 1.0)[0] == pytest.approx(TANGENT * np.sqrt(2 / 3), rel=1e-6)


def test_contacts_on_one_side_only_hold_nothing():
    arms, normals = plates()
    # Every edge has the same part along the common normal, so that the hull is flat too.
    assert wrench_hull(arms[:4], normals[:4], FRICTION, 1.0) == (0.0, 0.0)
    tilted = normals[:4] + 0.1 * arms[:4] * [1, 0, 1]
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    epsilon, volume = wrench_hull(arms[:4], tilted, FRICTION, 1.0)
    assert epsilon == 0.0
    assert volume > 0


@given(seed=st.integers(0, 2**31))
def test_no_direction_is_supported_less_than_epsilon_and_one_no_more(seed):
    rng = np.random.default_rng(seed)
    arms = rng.normal(size=(6, 3))
    arms /= np.linalg.norm(arms, axis=1, keepdims=True)
    epsilon, _ = wrench_hull(arms, arms, FRICTION, 1.0)
    wrenches = cone_wrenches(arms, arms, FRICTION, 1.0)
    directions = rng.normal(size=(4000, 6))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    supports = (directions @ wrenches.T).max(1)
    # Where the origin is outside the hull, some support is negative and ε is zero.
    assert max(0.0, supports.min()) >= epsilon - 1e-9
    # Merged facets, not joggled ones: the nearest one's normal is supported by just ε.
    facets = ConvexHull(wrenches).equations
    nearest = facets[facets[:, -1].argmax(), :-1]
    assert max(0.0, support(wrenches, nearest)) == pytest.approx(epsilon, abs=1e-6)


@given(seed=st.integers(0, 2**31))
def test_turning_everything_changes_nothing_but_the_edges_places(seed):
    rotation = random_rotations(1, torch.Generator().manual_seed(seed), torch.float64)[0].numpy()
    arms, normals = plates()
    epsilon, volume = wrench_hull(arms, normals, FRICTION, 1.0)
    turned = wrench_hull(arms @ rotation.T, normals @ rotation.T, FRICTION, 1.0)
    # The eight edges stand for a circle and start elsewhere: cos(π/8) = 0.92 of its radius at worst.
    assert turned[0] == pytest.approx(epsilon, rel=0.09)
    assert turned[1] == pytest.approx(volume, rel=0.2)


def test_the_torque_scale_divides_the_volume_by_its_cube():
    arms, normals = plates()
    _, volume = wrench_hull(arms, normals, FRICTION, 1.0)
    assert wrench_hull(arms, normals, FRICTION, 2.0)[1] == pytest.approx(volume / 8, rel=1e-6)
    assert wrench_hull(2 * arms, normals, FRICTION, 2.0)[1] == pytest.approx(volume, rel=1e-6)
