"""All metrics of a grasp together: known cases, and independence of the frame."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from graspd_core.se3 import quaternion_from_rotation, random_rotations
from graspd_core.types import GraspMetrics, Posture, TriangleMesh
from graspd_core.verify.metrics import measure
from graspd_core.verify.prepared_grasp import PROTOCOL_CONTACTS, make_metrics_context, surface_normals


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
