"""Starts are seeded, outside the object, within limits, and face what the hand can span."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from made_meshes import box_of
from torch import Tensor

from graspd_core import load_hand
from graspd_core.hands.fingers import find_fingers, placed_tips
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.mesh.shapes import BOWL_RADIUS, make_shape
from graspd_core.optimize.initial_poses import between_fingertips, closing_axis, convex_hull, draw_starts, half_widths
from graspd_core.se3 import aligning_rotation, reflection_onto, rotation_from_quaternion

EYE = torch.eye(3, dtype=torch.float64)
COUNT = 24


def units(seed: int, count: int) -> Tensor:
    x = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return x / x.norm(dim=-1, keepdim=True)


def with_special_cases(seed: int) -> tuple[Tensor, Tensor]:
    """A unit vector, and unit targets: drawn ones, itself, its opposite, and the axes."""
    source = units(seed, 1)[0]
    return source, torch.cat([units(seed + 1, 4), source[None], -source[None], EYE, -EYE])


@given(seed=st.integers(0, 2**31), axis=st.sampled_from([None, 0, 1, 2]))
def test_aligning_rotations_are_proper_and_map_the_source_to_its_targets(seed, axis):
    source, targets = with_special_cases(seed)
    if axis is not None:
        source = EYE[axis]
    rotation = aligning_rotation(source, targets)
    # Rounding of a few products of unit vectors.
    assert (rotation @ rotation.mT).numpy() == pytest.approx(EYE.expand_as(rotation).numpy(), abs=1e-12)
    assert torch.linalg.det(rotation).numpy() == pytest.approx(np.ones(len(targets)), abs=1e-12)
    assert (rotation @ source).numpy() == pytest.approx(targets.numpy(), abs=1e-12)


@given(seed=st.integers(0, 2**31))
def test_reflections_swap_their_vectors(seed):
    source, b = with_special_cases(seed)
    a = source.expand_as(b)
    mirror = reflection_onto(a, b)
    assert (mirror @ a[..., None]).squeeze(-1).numpy() == pytest.approx(b.numpy(), abs=1e-12)
    assert (mirror @ b[..., None]).squeeze(-1).numpy() == pytest.approx(a.numpy(), abs=1e-12)
    assert (mirror @ mirror).numpy() == pytest.approx(EYE.expand_as(mirror).numpy(), abs=1e-12)
    assert torch.linalg.det(mirror).numpy() == pytest.approx(-np.ones(len(b)), abs=1e-12)


@given(seed=st.integers(0, 2**31), exponent=st.floats(-12, -5))
def test_reflections_of_nearly_equal_vectors_stay_exact(seed, exponent):
    a = units(seed, 4)
    b = a + 10**exponent * units(seed + 1, 4)
    b = b / b.norm(dim=-1, keepdim=True)
    mirror = reflection_onto(a, b)
    # Below a difference of 1e-9 a is taken for b; above, lengths that are one but for rounding put the mirror plane off
    # by 1e-16 over the difference.
    error = ((mirror @ a[..., None]).squeeze(-1) - b).norm(dim=-1)
    assert (error < 2e-9 + 1e-15 / (a - b).norm(dim=-1).clamp_min(1e-9)).all()


@pytest.mark.parametrize("name", ["sphere", "box", "cylinder"])
def test_starts_face_the_object_from_outside_within_limits(hand, scenes, name):
    scene = scenes[name]
    starts = draw_starts(scene, hand, COUNT, 0, "cpu", torch.float64)
    rotation = rotation_from_quaternion(starts.quaternion)
    palm = (rotation @ torch.as_tensor(hand.palm_center)) + starts.translation
    normal = rotation @ torch.as_tensor(hand.palm_normal)
    distance, outward = sample_sdf(scene.sdf.to("cpu", torch.float64), palm)
    assert (distance > 0).all()
    # The stand-off is at most 50 mm along the hull's normal, and these objects are their own hulls.
    assert (distance < 0.052).all()
    # The palm looks along the inward normal but for a tilt of 0.35 rad; 60° leave room for normals near edges.
    assert ((normal * -outward).sum(-1) > np.cos(np.pi / 3)).all()
    assert ((torch.as_tensor(hand.lower) <= starts.joints) & (starts.joints <= torch.as_tensor(hand.upper))).all()
    assert starts.quaternion.norm(dim=-1).numpy() == pytest.approx(np.ones(COUNT), abs=1e-12)


def test_palms_look_at_the_middle_of_a_sphere(hand, scenes):
    starts = draw_starts(scenes["sphere"], hand, COUNT, 1, "cpu", torch.float64)
    rotation = rotation_from_quaternion(starts.quaternion)
    palm = (rotation @ torch.as_tensor(hand.palm_center)) + starts.translation
    cosine = ((rotation @ torch.as_tensor(hand.palm_normal)) * -palm).sum(-1) / palm.norm(dim=-1)
    # A tilt of 0.35 rad, and 3° of the sphere's facets.
    assert (cosine > np.cos(0.35 + 0.05)).all()


@pytest.mark.parametrize("name", ["allegro_right", "leap_right", "barrett_like", "parallel_gripper"])
def test_fingertips_start_on_both_sides_of_where_they_are_put(scenes, name):
    hand, sphere = load_hand(name), scenes["sphere"]
    starts = draw_starts(sphere, hand, COUNT, 0, "cpu", torch.float64, fingertips=1.0)
    rotation = rotation_from_quaternion(starts.quaternion)
    middle = (rotation @ between_fingertips(hand, starts.joints)[..., None]).squeeze(-1) + starts.translation
    distance, _ = sample_sdf(sphere.sdf.to("cpu", torch.float64), middle)
    # Up to 10 mm from the surface, and what a sphere of facets is off.
    assert (distance.abs() < 0.0115).all()
    fingers, closing = find_fingers(hand), torch.as_tensor(closing_axis(hand))
    for at, q in zip(between_fingertips(hand, starts.joints), starts.joints, strict=True):
        tips = torch.as_tensor(placed_tips(hand, fingers, q.numpy())) - at
        assert (tips @ closing).min() < 0 < (tips @ closing).max()
        assert (tips @ torch.as_tensor(hand.palm_normal)).abs().min() < 0.03  # not at the palm
    assert ((torch.as_tensor(hand.lower) <= starts.joints) & (starts.joints <= torch.as_tensor(hand.upper))).all()


def test_a_share_of_the_starts_is_put_there_with_the_fingertips(hand, scenes):
    def near(fingertips: float) -> float:
        starts = draw_starts(scenes["sphere"], hand, 200, 0, "cpu", torch.float64, fingertips=fingertips)
        middle = rotation_from_quaternion(starts.quaternion) @ between_fingertips(hand, starts.joints)[..., None]
        distance, _ = sample_sdf(scenes["sphere"].sdf.to("cpu", torch.float64), middle.squeeze(-1) + starts.translation)
        return float((distance.abs() < 0.0115).double().mean())

    assert near(1.0) == 1.0
    assert 0.1 < near(0.25) - near(0.0) < 0.6


def test_the_narrow_side_of_a_long_box_is_preferred(hand):
    surface = torch.as_tensor(surface_samples(box_of((0.02, 0.02, 0.1)), 800, 0)[0])
    normal, closing = torch.as_tensor(hand.palm_normal), torch.as_tensor(closing_axis(hand))
    across = torch.linalg.cross(normal, closing)
    hand_axes = torch.stack([normal, closing, across], 1)
    # The palm over the middle of a long side, looking in −x, closing along y (40 mm) or along z (200 mm).
    narrow = torch.stack([-EYE[0], EYE[1], -EYE[2]], 1) @ hand_axes.T
    wide = torch.stack([-EYE[0], EYE[2], EYE[1]], 1) @ hand_axes.T
    assert torch.linalg.det(torch.stack([narrow, wide])).numpy() == pytest.approx([1.0, 1.0])
    palm = torch.tensor([[0.03, 0.0, 0.0]], dtype=torch.float64).expand(2, 3)
    widths = half_widths(surface, palm, torch.stack([narrow, wide]), hand)
    # Half of 40 and of 200 mm; 800 samples leave gaps of a few millimetres at the far ends.
    assert widths.numpy() == pytest.approx([0.02, 0.1], abs=0.004)


def test_a_hull_closes_hollows():
    bowl = make_shape("bowl")
    hull = convex_hull(bowl)
    # The bowl's outer half sphere and the lid over it.
    inside = np.linalg.norm(bowl.vertices - [0.0, 0.0, BOWL_RADIUS / 2], axis=1) < BOWL_RADIUS - 0.001
    rim = bowl.vertices[:, 2] > BOWL_RADIUS / 2 - 1e-6
    assert len(hull.vertices) == len(bowl.vertices) - (inside | rim).sum() + 64
