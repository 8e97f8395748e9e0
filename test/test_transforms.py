"""Rigid transforms: round trips, gradients where norms vanish; the buffer of transforms against matrices."""

import math
import threading

import numpy as np
import pytest
import torch
from expected import refused, some
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck

from graspd_core.errors import TransformError
from graspd_core.se3 import (
    SE3,
    normalize,
    quaternion_from_rotation,
    random_rotations,
    rotation_from_axis_angle,
    rotation_from_quaternion,
    safe_norm,
)
from graspd_core.transforms import HISTORY, ROOT, SECOND, TransformBuffer

number = st.floats(-2, 2)
poses = st.tuples(st.tuples(number, number, number), st.tuples(number, number, number)).map(
    lambda drawn: pose(np.array(drawn[0]), np.array(drawn[1]))
)


def pose(position, turn=(0.0, 0.0, 0.0)) -> np.ndarray:
    """A transform from a position [m] and a rotation vector [rad]."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    matrix[:3, 3] = position
    return matrix


@st.composite
def trees(draw):
    """Up to eight frames: the parent of each, an earlier one, and its pose in it."""
    count = draw(st.integers(2, 8))
    return [(draw(st.integers(0, child - 1)), draw(poses)) for child in range(1, count)]


@given(trees(), st.data())
def test_any_two_frames_of_a_tree_agree_with_the_matrices(tree, data):
    world = [np.eye(4)]
    buffer = TransformBuffer()
    for child, (parent, T) in enumerate(tree, start=1):
        world.append(world[parent] @ T)
        buffer.add(f"f{parent}", f"f{child}", T, static=True)
    a, b = (data.draw(st.integers(0, len(tree))) for _ in range(2))
    expected = np.linalg.inv(world[a]) @ world[b]
    assert buffer.lookup(f"f{a}", f"f{b}") == pytest.approx(expected, abs=1e-9)
    assert buffer.frames() == tuple(f"f{i}" for i in range(len(tree) + 1))


@given(poses, poses, st.floats(0, 1), poses)
def test_between_samples_it_goes_straight_and_turns_evenly(first, second, share, offset):
    buffer = TransformBuffer()
    buffer.add("map", "base", first, 0)
    buffer.add("map", "base", second, SECOND)
    buffer.add("base", "camera", offset, static=True)
    stamp = round(share * SECOND)
    found = buffer.lookup("map", "camera", stamp) @ np.linalg.inv(offset)
    assert found[:3, 3] == pytest.approx(first[:3, 3] + stamp / SECOND * (second[:3, 3] - first[:3, 3]), abs=1e-9)
    whole = Rotation.from_matrix(first[:3, :3].T @ second[:3, :3]).magnitude()
    part = Rotation.from_matrix(first[:3, :3].T @ found[:3, :3]).magnitude()
    rest = Rotation.from_matrix(found[:3, :3].T @ second[:3, :3]).magnitude()
    assert part == pytest.approx(stamp / SECOND * whole, abs=1e-6)
    assert part + rest == pytest.approx(whole, abs=1e-6)


def test_without_a_time_it_is_the_newest_that_all_links_know():
    buffer = TransformBuffer()
    for second in range(4):
        buffer.add("map", "odom", pose((second, 0, 0)), second * SECOND)
    for second in range(1, 3):
        buffer.add("odom", "base", pose((0, second, 0)), second * SECOND)
    buffer.add("base", "camera", pose((0, 0, 1)), 99 * SECOND, static=True)
    assert buffer.lookup("map", "camera")[:3, 3] == pytest.approx([2, 2, 1])


def test_a_frame_is_looked_up_in_its_root():
    buffer = TransformBuffer()
    buffer.add("world", "arm", pose([1.0, 0.0, 0.0]), static=True)
    buffer.add("arm", "hand", pose([0.0, 2.0, 0.0]), static=True)
    np.testing.assert_allclose(buffer.lookup(ROOT, "hand")[:3, 3], [1.0, 2.0, 0.0])
    np.testing.assert_allclose(buffer.lookup(ROOT, "world"), np.eye(4))
    with refused(TransformError, "transform: a frame has no name"):
        buffer.lookup("", "hand")


def test_the_order_of_arrival_does_not_matter():
    buffer = TransformBuffer()
    for second in (3, 1, 2, 1):
        buffer.add("map", "base", pose((second, 0, 0)), second * SECOND)
    assert buffer.lookup("map", "base", SECOND * 5 // 2)[:3, 3] == pytest.approx([2.5, 0, 0])
    assert buffer.lookup("map", "base", SECOND)[:3, 3] == pytest.approx([1, 0, 0])


def test_outside_what_is_known_the_error_says_from_when_to_when():
    buffer = TransformBuffer()
    buffer.add("map", "base", pose((0, 0, 0)), 10 * SECOND)
    buffer.add("map", "base", pose((0, 0, 0)), 12 * SECOND)
    buffer.add("base", "camera", pose((0, 0, 0)), static=True)
    for stamp in (10 * SECOND - 1, 12 * SECOND + 1):
        with refused(
            TransformError, "transform camera -> map at ", "base in map is known from 10.000000000 s to 12.000000000 s"
        ):
            buffer.lookup("map", "camera", stamp)


def test_unknown_and_unconnected_frames_are_named():
    buffer = TransformBuffer()
    with pytest.raises(TransformError, match="unknown frame 'map'; no transform was received on /tf or /tf_static"):
        buffer.lookup("map", "base")
    buffer.add("map", "base", pose((0, 0, 0)), static=True)
    buffer.add("table", "cup", pose((0, 0, 0)), static=True)
    with pytest.raises(TransformError, match="unknown frame 'bsae'; known: base, cup, map, table"):
        buffer.lookup("map", "bsae")
    with pytest.raises(TransformError, match="cup -> base: not connected; the root of cup is table, that of base"):
        buffer.lookup("base", "cup")


def test_loops_are_refused_and_leave_the_tree_as_it_was():
    buffer = TransformBuffer()
    buffer.add("a", "b", pose((1, 0, 0)), static=True)
    buffer.add("b", "c", pose((1, 0, 0)), static=True)
    with pytest.raises(TransformError, match="c -> a: closes the loop a -> b -> c -> a"):
        buffer.add("c", "a", pose((0, 0, 0)), static=True)
    with pytest.raises(TransformError, match="a -> a: closes the loop a -> a"):
        buffer.add("a", "a", pose((0, 0, 0)), static=True)
    assert buffer.lookup("a", "c")[:3, 3] == pytest.approx([2, 0, 0])


@pytest.mark.parametrize(
    ("T", "parent", "culprit"),
    [
        (np.full((4, 4), np.nan), "map", "not rigid; valid: a rotation and a finite position"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "map", "not rigid"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "map", "not rigid"),
        (pose((np.inf, 0, 0)), "map", "not rigid"),
        (np.eye(4), "", "a frame has no name"),
    ],
)
def test_what_is_no_transform_is_refused(T, parent, culprit):
    buffer = TransformBuffer()
    with pytest.raises(TransformError, match=culprit):
        buffer.add(parent, "base", T)
    assert buffer.frames() == ()


def test_a_recording_that_restarts_is_heard_again():
    buffer = TransformBuffer()
    for second in (*range(20), 0, 1):
        buffer.add("map", "base", pose((second, 0, 0)), second * SECOND)
    assert buffer.lookup("map", "base", SECOND)[0, 3] == pytest.approx(1)
    with pytest.raises(TransformError, match="is known from 0"):
        buffer.lookup("map", "base", 19 * SECOND)


def test_history_is_bounded():
    buffer = TransformBuffer()
    for second in range(31):
        buffer.add("map", "base", pose((second, 0, 0)), second * SECOND)
    assert buffer.lookup("map", "base", 20 * SECOND)[0, 3] == pytest.approx(20)
    with pytest.raises(TransformError, match=r"known from 20\.0+ s to 30\.0+ s"):
        buffer.lookup("map", "base", 30 * SECOND - HISTORY - 1)
    endless = TransformBuffer(history=None)
    for second in (0, 1000):
        endless.add("map", "base", pose((second, 0, 0)), second * SECOND)
    assert endless.lookup("map", "base", 0)[0, 3] == 0


def test_a_new_parent_or_a_jump_in_time_forgets():
    buffer = TransformBuffer()
    buffer.add("/map", "base", pose((1, 0, 0)), SECOND)
    buffer.add("table", "base", pose((2, 0, 0)), 2 * SECOND)
    assert buffer.lookup("/table", "base", 2 * SECOND)[0, 3] == 2
    with pytest.raises(TransformError, match="unknown frame 'map'"):
        buffer.lookup("map", "base")
    buffer.clear()
    assert buffer.frames() == ()
    # What is static comes once only, and holds after the jump too.
    buffer.add("table", "base", pose((2, 0, 0)), 2 * SECOND)
    buffer.add("base", "camera", pose((3, 0, 0)), 2 * SECOND, static=True)
    buffer.clear()
    assert buffer.frames() == ("base", "camera")
    assert buffer.lookup("base", "camera", SECOND)[0, 3] == 3


def test_what_is_given_and_what_is_answered_can_be_changed_afterwards():
    buffer = TransformBuffer()
    given = pose((1, 0, 0))
    buffer.add("map", "base", given, static=True)
    given[0, 3] = 9
    buffer.lookup("map", "base")[0, 3] = 9
    assert buffer.lookup("map", "base")[0, 3] == 1


def test_one_thread_may_add_while_another_asks():
    buffer = TransformBuffer(history=SECOND)
    buffer.add("map", "base", pose((0, 0, 0)), 0)
    wrong: list[BaseException] = []

    def ask() -> None:
        try:
            for _ in range(2000):
                found = buffer.lookup("map", "base")
                assert found[0, 3] == found[1, 3]
        except BaseException as error:
            wrong.append(error)

    asking = threading.Thread(target=ask)
    asking.start()
    for tick in range(2000):
        buffer.add("map", "base", pose((tick, tick, 0)), tick * SECOND // 100)
    asking.join()
    assert not wrong


IDENTITY = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
quaternions = arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 1e-3)
vectors = arrays(np.float64, 3, elements=st.floats(-1, 1))


def unit(q: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(q / np.linalg.norm(q))


@given(q=quaternions)
def test_a_quaternion_comes_back_with_its_real_part_positive(q):
    there = rotation_from_quaternion(torch.as_tensor(q))
    back = quaternion_from_rotation(there)
    assert back[0] >= 0
    # q and −q are the same rotation.
    assert abs(float(back @ unit(q))) == pytest.approx(1.0, abs=1e-12)
    assert rotation_from_quaternion(back).numpy() == pytest.approx(there.numpy(), abs=1e-12)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("short", [0.0, 1e-9, 1e-5])
def test_half_turns_come_back_too(axis, short):
    direction = torch.eye(3, dtype=torch.float64)[axis]
    rotation = rotation_from_axis_angle(direction, torch.tensor(math.pi - short, dtype=torch.float64))
    back = rotation_from_quaternion(quaternion_from_rotation(rotation))
    assert back.numpy() == pytest.approx(rotation.numpy(), abs=1e-12)


@given(q=quaternions, scale=st.floats(0.01, 100.0))
def test_rotations_are_orthonormal_whatever_the_quaternions_length(q, scale):
    rotation = rotation_from_quaternion(scale * torch.as_tensor(q))
    assert (rotation @ rotation.T).numpy() == pytest.approx(np.eye(3), abs=1e-12)
    assert float(torch.linalg.det(rotation)) == pytest.approx(1.0, abs=1e-12)
    assert rotation.numpy() == pytest.approx(rotation_from_quaternion(torch.as_tensor(q)).numpy(), abs=1e-12)


@given(a=quaternions, b=quaternions, x=vectors, t=vectors)
def test_transforms_compose_and_keep_distances(a, b, x, t):
    first, second = (rotation_from_quaternion(torch.as_tensor(q)) for q in (a, b))
    point, shift = torch.as_tensor(x)[None], torch.as_tensor(t)
    outer, inner = SE3(first, shift), SE3(second, torch.ones(3, dtype=torch.float64))
    once, twice = outer.compose(inner).apply(point), outer.apply(inner.apply(point))
    assert once.numpy() == pytest.approx(twice.numpy(), abs=1e-12)
    assert outer.apply_inverse(outer.apply(point)).numpy() == pytest.approx(point.numpy(), abs=1e-12)
    assert float((outer.apply(point) - shift).norm()) == pytest.approx(float(point.norm()), abs=1e-12)


@given(axis=vectors.filter(lambda v: np.linalg.norm(v) > 1e-3), angle=st.floats(-3.0, 3.0))
def test_axis_and_angle_agree_with_scipys_rotation_vectors(axis, angle):
    n = axis / np.linalg.norm(axis)
    rotation = rotation_from_axis_angle(torch.as_tensor(n), torch.tensor(angle, dtype=torch.float64))
    # Not torch's matrix exponential, which is itself only good to 1e-11 for small angles.
    assert rotation.numpy() == pytest.approx(Rotation.from_rotvec(angle * n).as_matrix(), abs=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-13])
def test_the_norm_has_a_finite_gradient_at_and_about_zero(size, dtype):
    x = torch.full((3,), size, dtype=dtype, requires_grad=True)
    safe_norm(x).backward()
    assert some(x.grad).tolist() == [0.0, 0.0, 0.0]
    assert float(safe_norm(x).detach()) == 0.0


def test_the_norm_away_from_zero_is_the_norm():
    x = torch.tensor([[3.0, 4.0, 0.0], [1e-9, 0, 0], [-1e3, 0, 0]], dtype=torch.float64, requires_grad=True)
    assert safe_norm(x).tolist() == pytest.approx([5.0, 1e-9, 1e3])
    (gradient,) = torch.autograd.grad(safe_norm(x).sum(), x)
    assert gradient.numpy() == pytest.approx(np.array([[0.6, 0.8, 0], [1, 0, 0], [-1, 0, 0]]), abs=1e-12)


def test_zero_stays_zero_when_normalised_and_passes_no_nan_back():
    x = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    normalize(x).sum().backward()
    assert normalize(x).detach().tolist() == [[0.0] * 3] * 2
    assert some(x.grad).isfinite().all()


@given(offset=arrays(np.float64, 4, elements=st.sampled_from([0.0, 1e-12, -1e-8, 1e-4])))
def test_gradients_near_the_identity(offset):
    q = (IDENTITY + torch.as_tensor(offset)).requires_grad_(True)
    assert gradcheck(rotation_from_quaternion, (q,))
    # Turning by 2·offset: ∂R/∂x at the identity is twice the generator of a turn about x.
    (gradient,) = torch.autograd.grad(rotation_from_quaternion(q)[2, 1], q)
    assert gradient.numpy() == pytest.approx([0, 2, 0, 0], abs=1e-3)


def there_and_back(q: torch.Tensor) -> torch.Tensor:
    return quaternion_from_rotation(rotation_from_quaternion(q))


@given(seed=st.integers(0, 2**31))
def test_gradients_of_both_conversions_at_random_rotations(seed):
    rotation = random_rotations(1, torch.Generator().manual_seed(seed), torch.float64)[0]
    q = quaternion_from_rotation(rotation).requires_grad_(True)
    assert gradcheck(rotation_from_quaternion, (q,))
    jacobian = torch.autograd.functional.jacobian(there_and_back, q.detach())
    # There and back is the projection onto unit quaternions.
    q = q.detach().numpy()
    assert np.asarray(jacobian) == pytest.approx(np.eye(4) - np.outer(q, q), abs=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, math.pi])
def test_gradients_of_the_angle(angle):
    axis = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
    value = torch.tensor(angle, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda a: rotation_from_axis_angle(axis, a), (value,))


def test_random_rotations_are_uniform_and_reproducible():
    drawn = random_rotations(4000, torch.Generator().manual_seed(0), torch.float64)
    assert torch.equal(drawn, random_rotations(4000, torch.Generator().manual_seed(0), torch.float64))
    # Of uniform rotations every entry has mean 0 and variance 1/3: ±3 standard errors.
    assert drawn.mean(0).abs().max() < 3.5 * math.sqrt(1 / 3 / 4000)
    assert (drawn.square().mean(0) - 1 / 3).abs().max() < 3.5 * 0.3 / math.sqrt(4000)
