"""The picker with real parts: from bin to bin, gates in order, a loss is noticed, a cancel stops everything."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from graspd_cell.grasp_held import after_squeeze, why_lost, why_not_gripped
from graspd_cell.grasp_source import EMPTY, ClearPath, InProcessGrasps, Offer
from graspd_cell.motion import SeenWorld, seen_world
from graspd_cell.picker import Cancelled, Ending, Picker
from graspd_cell.robot import DepthView, JointMotion, JointReading, MotionAborted
from graspd_cell.simulated_robot import SimulatedRobot
from graspd_core.arms.arm import arm_links
from graspd_core.optimize.restrictions import Refusal
from graspd_core.planning.any_thing import Failure

RobotOf = Callable[..., SimulatedRobot]
THING = "shape:box"
OFFERS: dict[tuple[str, str], Offer] = {}


class KeptGrasps:
    """Grasps of graspd, planned once for each robot, since all look at the same thing in the same place."""

    def __init__(self, robot: SimulatedRobot) -> None:
        self._world = robot.world

    def next(self, view: DepthView, failures: tuple[Failure, ...], world: SeenWorld | None = None) -> Offer:
        key = self._world.arm.name, self._world.hand.name
        if key not in OFFERS:
            source = InProcessGrasps(self._world.arm, self._world.hand, self._world.layout)
            OFFERS[key] = source.next(view, failures, world or SeenWorld(0.0))
        offer = OFFERS[key]
        known = tuple(replace(failure, place=offer.place, seen=offer.seen) for failure in failures)
        return replace(offer, failures=known, earlier=known)


def picker_of(robot: SimulatedRobot, source: object = None, **more) -> Picker:
    world = robot.world
    return Picker(robot, source or KeptGrasps(robot), world.arm, world.hand, world.layout, **more)  # pyright: ignore


@pytest.fixture
def robot(pair: tuple[str, str], robot_of: RobotOf) -> SimulatedRobot:
    ready = robot_of(*pair, THING, height=0.05)
    ready.wait(1.0)
    ready.clear_forces()
    return ready


def test_a_thing_goes_to_the_other_bin_and_the_gates_come_in_order(
    robot: SimulatedRobot, monkeypatch: pytest.MonkeyPatch
):
    ends: list[np.ndarray] = []
    follow = robot.follow

    def noted(motion: JointMotion, *more) -> object:
        if len(motion.names) == len(robot.world.joint_names):
            ends.append(motion.positions[-1])
        return follow(motion, *more)

    held_now, away = Picker._held_now, list[float]()

    def compared(self: Picker, *more) -> np.ndarray:
        """Note how far the middle of the hull in the hand is from the true thing's [m]."""
        points, pose = held_now(self, *more), robot.thing_poses()[0]
        true = robot.world.things[0].seen.vertices @ pose[:3, :3].T + pose[:3, 3]
        away.append(float(np.linalg.norm(points.min(0) + points.max(0) - true.min(0) - true.max(0)) / 2))
        return points

    monkeypatch.setattr(robot, "follow", noted)
    monkeypatch.setattr(Picker, "_held_now", compared)
    (attempt,) = picker_of(robot).empty_the_bin(most=1)
    assert (attempt.ending, attempt.reason) == (Ending.PICKED, "")
    assert len(away) == 1
    assert away[0] < 0.02
    report = robot.referee()
    assert dict(report.places) == {"box": "place bin"}
    assert report.hard("box") == {}
    grasp = OFFERS[robot.world.arm.name, robot.world.hand.name].grasp
    assert grasp is not None
    assert grasp.arm is not None
    count = len(robot.world.arm.joint_names)
    stages = [(grasp.arm.at("pregrasp"), grasp.pregrasp), (grasp.arm.at("grasp"), grasp.grasp)]
    stages += [(grasp.arm.at("grasp"), grasp.squeeze), (grasp.arm.at("lift"), grasp.squeeze)]
    assert len(ends) == len(stages)
    for end, (arm, posture) in zip(ends, stages, strict=True):
        np.testing.assert_allclose(end[:count], arm, atol=1e-9)
        limits = robot.world.hand.lower, robot.world.hand.upper
        np.testing.assert_allclose(end[count:], np.clip(posture.joint_positions, *limits), atol=1e-9)


def test_a_grasp_is_refused_if_something_outside_the_bin_is_in_the_arms_way(robot_of: RobotOf):
    robot = robot_of("ur5e_like", "parallel_gripper", THING, height=0.05)
    robot.wait(1.0)
    grasp, world = KeptGrasps(robot).next(robot.look(), ()).grasp, robot.world
    assert grasp is not None
    assert grasp.arm is not None
    links = arm_links(world.arm, torch.as_tensor(grasp.arm.at("grasp"))[None])
    wrist = links.translation[0, world.arm.chain.link_names.index("wrist_1")].numpy()
    post = seen_world(wrist + np.linspace(-0.02, 0.02, 9)[:, None] * np.array([0.0, 0.0, 1.0]), 0.0)
    for seen, refused in ((post, True), (SeenWorld(0.0), False), (SeenWorld(0.0, world.layout.solids[1:]), False)):
        (answer,) = ClearPath(picker_of(robot)._mover(seen)).admit([grasp])
        assert isinstance(answer, Refusal) == refused
        assert refused or answer is grasp
    # Without an arm path, nothing is known to collide.
    bare = replace(grasp, arm=None)
    assert ClearPath(picker_of(robot)._mover(post)).admit([bare]) == [bare]


def test_an_image_without_depth_shows_no_obstacle_but_the_known_solids(robot_of: RobotOf):
    robot = robot_of("ur5e_like", "parallel_gripper")
    view = robot.look()
    world = picker_of(robot).world_of(replace(view, depth=np.full_like(view.depth, np.nan)))
    assert (len(world.points), world.boxes) == (0, robot.world.layout.solids[1:])


@pytest.mark.parametrize("seed", [0, 1])
def test_an_empty_bin_ends_it_as_empty_though_walls_stray(robot_of: RobotOf, seed: int):
    world = robot_of("ur5e_like", "parallel_gripper").world
    robot = SimulatedRobot(world, seed=seed)
    source = InProcessGrasps(world.arm, world.hand, world.layout, preset="fast")
    picker = picker_of(robot, source)
    assert list(picker.empty_the_bin()) == []
    assert picker.why_ended == EMPTY


def test_a_thing_that_is_taken_away_is_noticed_while_lifting(robot_of: RobotOf, monkeypatch: pytest.MonkeyPatch):
    """The referee's hand: the thing is gone in the moment of the lift.

    Fingers of other hands may then press on each other, which joints do not always tell from a thing.
    """
    robot = robot_of("ur5e_like", "parallel_gripper", THING, height=0.05)
    robot.wait(1.0)
    follow, calls = robot.follow, 0

    def stolen(motion: JointMotion, *more) -> object:
        nonlocal calls
        calls += len(motion.names) == len(robot.world.joint_names)
        if calls == 4:
            robot._data.qpos[robot.world.thing_qpos[0]] += 3.0
            calls += 1
        return follow(motion, *more)

    monkeypatch.setattr(robot, "follow", stolen)
    (attempt,) = picker_of(robot).empty_the_bin(most=1)
    assert attempt.ending is Ending.LOST_LIFTING
    assert attempt.reason
    # The arm has come away from the bin, and the hand is open.
    hand = robot.world.hand
    now = robot.joints().of(hand.joint_names).positions
    assert (np.abs(now - hand.open_posture) / hand.joint_scale).max() < 0.1


def test_a_thing_that_the_arm_cannot_put_down_counts_as_taken(robot_of: RobotOf, monkeypatch: pytest.MonkeyPatch):
    robot = robot_of("ur5e_like", "parallel_gripper", THING, height=0.05)
    robot.wait(1.0)
    monkeypatch.setattr("graspd_cell.picker.release_posture", lambda *_: None)
    picker = picker_of(robot)
    (attempt,) = picker.empty_the_bin(most=1)
    assert attempt.ending is Ending.ABORTED
    assert "holds the object above place bin" in attempt.reason
    assert [failure.executed for failure in picker._failures] == [True]


@pytest.mark.parametrize("faults", [2, 3])
def test_the_way_home_is_tried_again_after_an_abort(robot_of: RobotOf, monkeypatch: pytest.MonkeyPatch, faults: int):
    robot, follow = robot_of("ur5e_like", "parallel_gripper"), SimulatedRobot.follow
    arm, start, left = robot.world.arm.joint_names, robot.world.layout.start, faults

    def blocked(self: SimulatedRobot, motion: JointMotion, *more) -> object:
        """The arm does not reach its start, as if something held it."""
        nonlocal left
        if motion.names == arm and np.abs(motion.positions[-1] - start).max() < 1e-3 and left:
            left -= 1
            raise MotionAborted("joint 'elbow' left its path")
        return follow(self, motion, *more)

    robot.follow(JointMotion(arm, np.array([2.0]), start[None] + 0.4, np.zeros((1, len(arm)))), 5.0)
    monkeypatch.setattr(SimulatedRobot, "follow", blocked)
    picker = picker_of(robot)
    if faults == 3:
        with pytest.raises(MotionAborted, match="left its path"):
            picker.go_home()
        return
    picker.go_home()
    assert left == 0
    np.testing.assert_allclose(robot.joints().of(arm).positions, start, atol=0.02)


@pytest.mark.parametrize("strength", [1.0, 3.0])
def test_fingers_that_close_on_nothing_or_on_each_other_are_told_from_fingers_that_press(
    pair: tuple[str, str], robot_of: RobotOf, strength: float
):
    robot = robot_of(*pair, THING, height=0.05)
    robot.wait(1.0)
    offer = KeptGrasps(robot).next(robot.look(), ())
    grasp, hand = offer.grasp, robot.world.hand
    assert grasp is not None
    touch, press = grasp.grasp.joint_positions, grasp.squeeze.joint_positions
    grasp = replace(grasp, squeeze=replace(grasp.squeeze, joint_positions=touch + strength * (press - touch)))
    # Far from everything, at the arm's start.
    for posture in (grasp.pregrasp, grasp.grasp, grasp.squeeze):
        goal = np.clip(posture.joint_positions, hand.lower, hand.upper)[None]
        robot.follow(JointMotion(hand.joint_names, np.array([1.5]), goal, np.zeros_like(goal)), 5.0)
    robot.wait(0.5)
    hold = after_squeeze(hand, grasp, robot.joints())
    assert why_not_gripped(hold, hand)


def test_jaws_that_close_further_as_a_thing_turns_between_them_still_hold_it(robot_of: RobotOf):
    robot = robot_of("ur5e_like", "parallel_gripper", THING, height=0.05)
    robot.wait(1.0)
    grasp, hand = KeptGrasps(robot).next(robot.look(), ()).grasp, robot.world.hand
    assert grasp is not None
    touch, target = (p.joint_positions for p in (grasp.grasp, grasp.squeeze))

    def reading(covered: float) -> JointReading:
        """A motor pushes the less, the nearer its joint is to the target."""
        return JointReading(0.0, hand.joint_names, touch + covered * (target - touch), (1 - covered) * (target - touch))

    hold = after_squeeze(hand, grasp, reading(0.0))
    assert why_lost(hold, hand, reading(0.5)) == ""
    assert why_lost(hold, hand, replace(reading(0.7), efforts=0.6 * (target - touch))) == ""
    assert why_lost(hold, hand, replace(reading(0.9), efforts=0.5 * (target - touch))) == ""
    assert why_lost(hold, hand, reading(0.95))
    # Some hands report no efforts. Then only the positions count.
    silent = replace(hold, efforts=np.zeros_like(hold.efforts))
    assert why_lost(silent, hand, replace(reading(0.95), efforts=np.zeros_like(touch)))
    assert why_lost(silent, hand, replace(reading(0.7), efforts=np.zeros_like(touch))) == ""


def test_a_thing_that_only_seemed_to_be_taken_counts_as_lost_each_time(
    robot_of: RobotOf, monkeypatch: pytest.MonkeyPatch
):
    robot = robot_of("ur5e_like", "parallel_gripper", THING, height=0.05)
    robot.wait(1.0)
    told, next_offer = list[list[Failure]](), KeptGrasps.next

    def noted(self: KeptGrasps, view: DepthView, failures: tuple[Failure, ...], world: SeenWorld) -> Offer:
        told.append(list(failures))
        return next_offer(self, view, failures, world)

    monkeypatch.setattr(KeptGrasps, "next", noted)
    picker = picker_of(robot)
    # The arm moves nothing, and the picker notices nothing.
    monkeypatch.setattr(Picker, "_steps", lambda *_: (Ending.PICKED, ""))
    assert [attempt.ending for attempt in picker.empty_the_bin(most=3)] == [Ending.PICKED] * 3
    assert [len(failures) for failures in told] == [0, 1, 2]
    offer = OFFERS["ur5e_like", "parallel_gripper"]
    assert offer.grasp is not None
    assert all((lost.grasp, lost.executed) == (offer.grasp.grasp, True) for lost in told[-1])
    # The last failure is known from the image to come: the thing may be in its place, a little away, or gone.
    beside = np.array([0.02, 0.0, 0.0])
    assert [picker._failures[-1].object_among(offer.place[None] + n * beside) for n in (0, 1, 3)] == [0, 0, None]
    # Once the thing is gone, its earlier failures are forgotten.
    robot._data.qpos[robot.world.thing_qpos[0]] += 3.0
    next(iter(picker.empty_the_bin(most=1)))
    assert len(told[-1]) == 1


def test_one_look_at_nothing_does_not_end_it(robot_of: RobotOf, monkeypatch: pytest.MonkeyPatch):
    robot = robot_of("ur5e_like", "parallel_gripper", THING, height=0.05)
    offers, next_offer = [True, False, True, True, False], KeptGrasps.next

    def sometimes(self: KeptGrasps, view: DepthView, failures: tuple[Failure, ...], world: SeenWorld) -> Offer:
        empty = Offer(None, reason=EMPTY, failures=tuple(failures), exhausted=True)
        return empty if offers.pop(0) else next_offer(self, view, failures, world)

    monkeypatch.setattr(KeptGrasps, "next", sometimes)
    monkeypatch.setattr(Picker, "_steps", lambda *_: (Ending.NOT_GRIPPED, "nothing"))
    picker = picker_of(robot)
    assert len(list(picker.empty_the_bin(most=9))) == 1
    assert (picker.why_ended, offers, len(picker._failures)) == (EMPTY, [False], 1)


@pytest.mark.parametrize("after", [0.5, 2.5, 4.5, 6.5])
def test_a_cancel_at_any_time_leaves_the_arm_still_and_the_hand_as_it_is(robot_of: RobotOf, after: float):
    robot = robot_of("ur5e_like", "parallel_gripper", THING, height=0.05)
    robot.wait(1.0)
    begun = robot.time
    picker = picker_of(robot, cancelled=lambda: robot.time > begun + after)
    with pytest.raises(Cancelled):
        list(picker.empty_the_bin(most=1))
    assert robot.time < begun + after + 1.0
    targets = robot.hand.targets.copy()
    before = robot.joints().positions
    robot.wait(1.0)
    assert np.abs(robot.joints().positions - before).max() < 5e-3
    np.testing.assert_array_equal(robot.hand.targets, targets)
