"""The transform buffer against products of matrices, and what it says when it does not know."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from graspd_core.errors import TransformError
from graspd_core.transforms import HISTORY, SECOND, TransformBuffer

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


def test_a_quarter_turn_half_way_is_an_eighth():
    buffer = TransformBuffer()
    buffer.add("map", "base", pose((0, 0, 0)), 10 * SECOND)
    buffer.add("map", "base", pose((2, 0, 0), (0, 0, np.pi / 2)), 12 * SECOND)
    expected = pose((1, 0, 0), (0, 0, np.pi / 4))
    assert buffer.lookup("map", "base", 11 * SECOND) == pytest.approx(expected)


def test_without_a_time_it_is_the_newest_that_all_links_know():
    buffer = TransformBuffer()
    for second in range(4):
        buffer.add("map", "odom", pose((second, 0, 0)), second * SECOND)
    for second in range(1, 3):
        buffer.add("odom", "base", pose((0, second, 0)), second * SECOND)
    buffer.add("base", "camera", pose((0, 0, 1)), 99 * SECOND, static=True)
    assert buffer.lookup("map", "camera")[:3, 3] == pytest.approx([2, 2, 1])


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
        with pytest.raises(TransformError) as refused:
            buffer.lookup("map", "camera", stamp)
        assert "transform camera -> map at " in str(refused.value)
        assert "base in map is known from 10.000000000 s to 12.000000000 s" in str(refused.value)
        assert "\n" not in str(refused.value)


def test_unknown_and_unconnected_frames_are_named():
    buffer = TransformBuffer()
    with pytest.raises(TransformError, match="unknown frame 'map'; known: none"):
        buffer.lookup("map", "base")
    buffer.add("map", "base", pose((0, 0, 0)), static=True)
    buffer.add("table", "cup", pose((0, 0, 0)), static=True)
    with pytest.raises(TransformError, match="unknown frame 'bsae'; known: base, cup, map, table"):
        buffer.lookup("map", "bsae")
    with pytest.raises(TransformError, match="cup -> base: not connected; cup hangs under table, base under map"):
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
        (np.full((4, 4), np.nan), "map", "not a rotation and a position"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "map", "not a rotation"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "map", "not a rotation"),
        (pose((np.inf, 0, 0)), "map", "in finite numbers"),
        (np.eye(4), "", "a frame without a name"),
    ],
)
def test_what_is_no_transform_is_refused(T, parent, culprit):
    buffer = TransformBuffer()
    with pytest.raises(TransformError, match=culprit):
        buffer.add(parent, "base", T)
    assert buffer.frames() == ()


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
