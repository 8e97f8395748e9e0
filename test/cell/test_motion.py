"""Motions of the arm keep clear of what was seen and known, stay within the limits, and say where there is no way."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from graspd_cell.carrying import held_balls, release_posture, straight, tip_pose
from graspd_cell.layout import Box, layout_of
from graspd_cell.motion import (
    Mover,
    NoMotionError,
    SeenWorld,
    Speeds,
    arm_shape,
    dense,
    enclosing_balls,
    find_path,
    hand_balls,
    seen_world,
    timed,
)
from graspd_core.arms.arm import arm_links, load_arm
from graspd_core.hands.library import load_hand

ARMS = ("ur5e_like", "panda_like")
HAND = load_hand("parallel_gripper")


def mover_of(arm_name: str, points: np.ndarray | None = None, boxes: tuple[Box, ...] = ()) -> Mover:
    arm = load_arm(arm_name)
    world = seen_world(np.zeros((0, 3)) if points is None else points, 0.0, boxes)
    return Mover(arm_shape(arm), world, hand_balls(arm, HAND, HAND.open_posture))


@pytest.mark.parametrize("name", ARMS)
def test_links_are_where_the_arms_own_kinematics_have_them(name: str):
    arm = load_arm(name)
    q = arm.seed + np.random.default_rng(0).uniform(-0.5, 0.5, (20, len(arm.seed)))
    links, true = arm_shape(arm).links(q), arm_links(arm, torch.as_tensor(q))
    np.testing.assert_allclose(links.rotation.numpy(), true.rotation.numpy(), atol=1e-12)
    np.testing.assert_allclose(links.translation.numpy(), true.translation.numpy(), atol=1e-12)


@pytest.mark.parametrize("name", ARMS)
def test_a_way_around_a_pillar_of_points_keeps_clear_of_every_one_of_them(name: str):
    arm = load_arm(name)
    middle = mover_of(name)
    start, goal = arm.seed.copy(), arm.seed.copy()
    start[0], goal[0] = arm.seed[0] - 0.7, arm.seed[0] + 0.7
    tip = tip_pose(middle, arm.seed)[:3, 3]
    # In the way of the straight connection, as high as the hand.
    points = tip + np.random.default_rng(1).uniform([-0.02, -0.02, -0.35], [0.02, 0.02, -0.02], (4000, 3))
    mover = mover_of(name, points)
    way = dense(np.stack([start, goal]))
    assert mover.clearances(way).min() < 0
    np.testing.assert_allclose(mover.arm_clearances(way), mover.clearances(way)[:, : mover.carried_columns.start])
    path = find_path(mover, start, goal)
    np.testing.assert_allclose(path[[0, -1]], [start, goal])
    motion = timed(arm, path, Speeds())
    for q in np.vstack([start, motion.positions])[::3]:
        balls, carried = mover.placed(q)
        away = np.linalg.norm(points[:, None] - np.concatenate([balls, carried])[None], axis=-1)
        assert (away.min(0) > np.concatenate([mover.shape.radius, mover.carried.radius])).all()


@pytest.mark.parametrize("share", [0.0, 0.2, 0.4, 0.6, 0.8])
def test_a_palm_on_the_forearm_is_seen_at_every_posture_of_the_fingers(share: float):
    """In this posture MuJoCo presses the Allegro's base and the forearm together with 71 N (bin 238 of the study)."""
    arm, hand = load_arm("ur5e_like"), load_hand("allegro_right")
    fingers = hand.open_posture + share * (hand.closed_posture - hand.open_posture)
    mover = Mover(arm_shape(arm), SeenWorld(-1.0), hand_balls(arm, hand, fingers))
    own = slice(mover.carried_columns.stop, None)
    q = np.array([[-0.054, -1.764, 1.66, -1.019, -3.202, -0.235], arm.seed])
    assert mover.clearances(q)[0, own].min() < 0 < mover.clearances(q)[1, own].min()
    balls = enclosing_balls(mover.carried.at)
    away = np.linalg.norm(mover.carried.at[:, None] - balls.at, axis=-1) - balls.radius
    assert away.min(1).max() <= 0


def test_points_far_away_need_no_memory():
    near = np.array([[0.4, 0.0, 0.1], [0.3, 0.2, 0.2]])
    far = np.array([[9.0, 8.0, 5.0], [np.nan, 0.0, 1.0], [0.0, 0.0, np.inf]])
    one, other = seen_world(near, 0.0), seen_world(np.vstack([near, far]), 0.0)
    np.testing.assert_array_equal(other.points, near)
    np.testing.assert_array_equal(one.distances, other.distances)


def test_times_keep_to_speed_and_acceleration():
    arm = load_arm("panda_like")
    goal = arm.seed + np.array([0.8, 0.3, -0.5, 0.4, 0.2, -0.6, 0.9])
    speeds = Speeds(0.5, 3.0)
    motion = timed(arm, np.stack([arm.seed, 0.5 * (arm.seed + goal) + 0.1, goal]), speeds)
    assert motion.velocities is not None
    assert (np.abs(motion.velocities) <= 0.5 * arm.chain.velocity * 1.02).all()
    change = np.abs(np.diff(motion.velocities, axis=0)) / np.diff(motion.times)[:, None]
    # Splines are held to their limits at the points of a grid, not between them.
    assert change.max() < 1.3 * speeds.acceleration
    np.testing.assert_allclose(motion.positions[-1], goal, atol=1e-6)
    np.testing.assert_allclose(motion.velocities[-1], 0.0, atol=1e-6)


def test_a_way_that_touches_a_limit_is_not_sent_beyond_it():
    arm = load_arm("panda_like")
    at, away = arm.seed.copy(), arm.seed.copy()
    at[4], away[4], away[0] = arm.upper[4], arm.upper[4] - 1.0, arm.seed[0] + 0.4
    motion = timed(arm, np.stack([away, at, away + at - arm.seed, arm.seed]), Speeds())
    assert (motion.positions <= arm.upper).all()
    assert motion.positions[:, 4].max() > arm.upper[4] - 0.01


def test_an_end_in_something_and_a_walled_in_goal_are_told_by_name():
    arm = load_arm("ur5e_like")
    tip = tip_pose(mover_of("ur5e_like"), arm.seed)[:3, 3]
    block = Box("block", (float(tip[0]), float(tip[1]), float(tip[2])), (0.1, 0.1, 0.1))
    mover = mover_of("ur5e_like", boxes=(block,))
    away = arm.seed.copy()
    away[0] += 1.5
    with pytest.raises(NoMotionError, match=r"ur5e_like penetrates an obstacle by \d+ mm at its goal; valid: a goal"):
        find_path(mover, away, arm.seed)
    # A wall from the floor to above all of the arm.
    start, goal = arm.seed.copy(), arm.seed.copy()
    start[0], goal[0] = arm.seed[0] - 0.8, arm.seed[0] + 0.8
    way = tip[:2] / np.linalg.norm(tip[:2])
    reach, height = np.meshgrid(np.linspace(0.13, 1.4, 150), np.linspace(0.02, 1.6, 150))
    wall = np.stack([reach.ravel() * way[0], reach.ravel() * way[1], height.ravel()], 1)
    with pytest.raises(NoMotionError, match="100 checks found no collision-free path of ur5e_like"):
        find_path(mover_of("ur5e_like", wall), start, goal, checks=100)


@pytest.mark.parametrize("name", ARMS)
def test_a_thing_is_raised_straight_and_let_go_above_the_other_bin(name: str):
    arm = load_arm(name)
    layout = layout_of(arm)
    mover = mover_of(name, boxes=layout.solids[1:])
    up = straight(mover, arm.seed, np.array([0.0, 0.0, 0.1]))
    lifted = tip_pose(mover, up[-1])[:3, 3] - tip_pose(mover, arm.seed)[:3, 3]
    np.testing.assert_allclose(lifted, [0.0, 0.0, 0.1], atol=1e-3)
    tip = tip_pose(mover, up[-1])
    thing = np.random.default_rng(0).uniform(-0.03, 0.03, (300, 3)) + tip[:3, 3] + 0.15 * tip[:3, 2]
    loaded = Mover(mover.shape, mover.world, held_balls(mover, up[-1], thing))
    goal = release_posture(loaded, up[-1], thing, layout.place, 0)
    assert goal is not None
    moved = (thing - tip[:3, 3]) @ tip[:3, :3] @ tip_pose(loaded, goal)[:3, :3].T + tip_pose(loaded, goal)[:3, 3]
    assert layout.place.holds(moved.mean(0))
    assert moved[:, 2].min() > 0.05
    assert loaded.clearances(goal[None]).min() >= loaded.margin


def test_a_hand_that_touches_a_heap_is_raised_out_of_it():
    arm, up = load_arm("ur5e_like"), np.array([0.0, 0.0, 0.1])
    hand = mover_of("ur5e_like").placed(arm.seed)[1]
    low, high = hand[hand[:, 2].argmin()], hand[hand[:, 2].argmax()]
    # One point touches the hand, and one is in its way upwards.
    heap = mover_of("ur5e_like", np.array([low, high + 0.5 * up]))
    assert len(straight(heap, arm.seed, up)) < 6
    assert len(straight(heap, arm.seed, up, freeing=True)) == 6
    # A hand that touches nothing does not rise into something.
    above = mover_of("ur5e_like", np.array([high + 0.9 * up]))
    assert len(straight(above, arm.seed, up, freeing=True)) < 6
