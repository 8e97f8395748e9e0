"""Bin picking loop: take an image, ask graspd for a grasp, carry the object to the other bin, until the bin is empty.

Use this module as a template. Each behaviour is one method of `Picker`. Every wait has a timeout. The picker uses only
joint readings and depth images. With another `Robot` it drives a real cell. When `cancelled` returns True, the arm
stops and the hand keeps its posture.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from graspd_cell.carrying import dropped_box, held_balls, release_posture, straight, tip_pose
from graspd_cell.grasp_held import Hold, after_squeeze, why_lost, why_not_gripped
from graspd_cell.grasp_source import GraspSource, Offer, cloud_of
from graspd_cell.layout import Box, CellLayout
from graspd_cell.motion import (
    Mover,
    NoMotionError,
    SeenWorld,
    Speeds,
    arm_shape,
    find_path,
    hand_balls,
    seen_world,
    timed,
    why_blocked,
)
from graspd_cell.robot import DepthView, JointMotion, JointReading, MotionAborted, Robot, never
from graspd_core.arms.arm import Arm, tip_hand
from graspd_core.arms.execution import Execution, ExecutionPace, execution_of
from graspd_core.errors import CloudError, GraspdError
from graspd_core.hands.model import HandModel
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.perception.obstacles import held_hull
from graspd_core.planning.any_thing import Failure

# An object is still in its place if more than `_STILL_THERE` of its points are within `_UNMOVED` of points seen [m].
_UNMOVED, _STILL_THERE = 0.006, 0.6
# Greatest error of an arm joint while the hand closes on the object [rad]. The object is not exactly where it seems, so
# the closing hand may press on it and stop the arm.
_TOUCHING = 0.08
# Tries to reach `start`, and collision checks for a path to `start`. The picker ends if the arm cannot reach `start`.
_TRIES_HOME, _WAY_HOME = 3, 20_000


class Ending(StrEnum):
    """Outcome of one attempt."""

    PICKED = "picked"
    NO_WAY = "no way for the arm"
    NOT_GRIPPED = "closed on nothing"
    LOST_LIFTING = "lost while lifting"
    LOST_CARRYING = "lost while carrying"
    ABORTED = "a motion was aborted"


class Cancelled(GraspdError):
    """The caller cancelled the picker. The arm has stopped and the hand keeps its posture."""


@dataclass(frozen=True, eq=False)
class Attempt:
    """One attempt at one object.

    Attributes:
        number: number of the attempt, from 1.
        ending: outcome.
        reason: why the attempt failed. Empty after success.
        place: centre of the object's points, base frame [m].
        verified: True if graspd verified the grasp.
        probability: graspd's success probability. None if graspd gave none.
        tries: number of earlier failures at this object.
        graspd_seconds: wall-clock time from the image to the grasp [s].
        closing_seconds: robot time from the image to the closed hand [s]. Simulated time stops while graspd plans.
        seconds: robot time of the whole attempt [s].
        things: number of objects seen before the attempt.
    """

    number: int
    ending: Ending
    reason: str
    place: Float[np.ndarray, "3"]
    verified: bool
    probability: float | None
    tries: int
    graspd_seconds: float
    closing_seconds: float
    seconds: float
    things: int


@dataclass(frozen=True)
class Pace:
    """Speeds, waits and thresholds of the picker.

    Attributes:
        free: speeds with an empty hand.
        loaded: speeds with an object in the hand.
        grasp: speeds of approach, closing and lift.
        patience: time allowed beyond a motion's duration [s].
        settle: wait after the squeeze and after the release [s].
        least_probability: least success probability of an unverified grasp that is tried.
    """

    free: Speeds = field(default_factory=lambda: Speeds(0.7, 5.0))
    loaded: Speeds = field(default_factory=lambda: Speeds(0.4, 2.5))
    grasp: ExecutionPace = field(default_factory=ExecutionPace)
    patience: float = 3.0
    settle: float = 0.4
    least_probability: float = 0.05


@dataclass(eq=False)
class _Taking:
    """State of the running attempt."""

    offer: Offer
    execution: Execution
    world: SeenWorld
    began: float
    closed: float = 0.0
    hold: Hold | None = None
    dropped: Box | None = None


class Picker:
    """Picker that empties one bin. It remembers the bin's objects, so make a new picker and source for each bin.

    Args:
        robot: the robot to drive.
        source: source of grasps.
        arm, hand: models of the robot.
        layout: layout of the cell. The arm waits at its `start`.
        pace: speeds and timeouts.
        cancelled: polled during motions and waits. True stops the picker.
    """

    def __init__(
        self, robot: Robot, source: GraspSource, arm: Arm, hand: HandModel, layout: CellLayout,
        *, pace: Pace | None = None, cancelled: Callable[[], bool] = never,
    ) -> None:  # fmt: skip
        self._robot, self._source, self._arm, self._hand, self._layout = robot, source, arm, hand, layout
        self._pace, self._cancelled = pace or Pace(), cancelled
        self._failures: list[Failure] = []
        self._picked = 0
        # The last offer, if its object seemed to arrive in the other bin.
        self._taken: Offer | None = None
        # Joint targets last sent to the hand. A squeezing hand does not reach its targets, because the object stops it.
        self._sent = hand.open_posture
        # Boxes of objects in the place bin, which the camera hardly sees.
        self._dropped: list[Box] = []
        self.offer: Offer | None = None
        self.why_ended = ""

    def empty_the_bin(self, most: int = 500) -> Iterator[Attempt]:
        """Take one object after another. Yield up to `most` attempts. Then `why_ended` says why the loop ended.

        Raises:
            Cancelled: the caller cancelled.
            MotionAborted, NoMotionError: the arm cannot return to `start`, where it does not occlude the camera.
        """
        attempts, ended = 0, False
        while attempts < most:
            self.go_home()
            view, began = self._robot.look(), self._robot.joints().time
            self._check_taken(view)
            world = self.world_of(view)
            offer = self.offer = self._source.next(view, self._failures, world)
            self._failures = list(offer.failures)
            likely = offer.grasp is not None and (offer.grasp.probability or 0.0) >= self._pace.least_probability
            if offer.grasp is None or not (offer.verified or likely):
                self.why_ended = offer.reason
                # One noisy image may show nothing, so two must agree.
                if ended and offer.exhausted:
                    return
                ended = offer.exhausted
                if offer.grasp is not None:
                    self._failures.append(Failure(offer.place, offer.grasp.grasp, executed=False, seen=offer.seen))
                continue
            attempts, ended = attempts + 1, False
            attempt = self.attempt(offer, world, began, attempts)
            self._learn(attempt, offer)
            yield attempt
        self.why_ended = f"{most} attempts"

    def attempt(self, offer: Offer, world: SeenWorld, began: float, number: int = 1) -> Attempt:
        """Carry one object to the place bin and return the outcome. `began` is the robot time of the image [s]."""
        taking: _Taking | None = None
        try:
            assert offer.grasp is not None
            speeds = self._pace.free.share * np.asarray(self._arm.chain.velocity)
            execution = execution_of(offer.grasp, self._hand, arm_speeds=speeds, mass=offer.mass, pace=self._pace.grasp)
            taking = _Taking(offer, execution, world, began)
            ending, reason = self._steps(taking)
        except NoMotionError as error:
            # Once the hand has closed, the grasp counts as executed, even if the arm then finds no path.
            closed = taking is not None and taking.closed > 0
            ending, reason = Ending.ABORTED if closed else Ending.NO_WAY, str(error)
        except MotionAborted as error:
            self._stop_if_cancelled()
            ending, reason = Ending.ABORTED, str(error)
        if ending is not Ending.PICKED:
            self.back_off(world)
        now, closed = self._robot.joints().time, taking.closed if taking else 0.0
        return Attempt(
            number, ending, reason, offer.place, offer.verified, offer.grasp and offer.grasp.probability,
            len(offer.earlier), offer.seconds, max(closed - began, 0.0), now - began, len(offer.seen),
        )  # fmt: skip

    def _steps(self, taking: _Taking) -> tuple[Ending, str]:
        self.go_to_retreat(taking)
        self.close(taking)
        if fault := self.squeeze(taking):
            return Ending.NOT_GRIPPED, fault
        self._follow_gate(taking.execution, "lifted")
        assert taking.hold is not None
        if fault := why_lost(taking.hold, self._hand, self._robot.joints()):
            return Ending.LOST_LIFTING, fault
        if fault := self.carry(taking):
            return Ending.LOST_CARRYING, fault
        self.let_go(taking)
        return Ending.PICKED, ""

    def world_of(self, view: DepthView) -> SeenWorld:
        """Build the obstacles from a view's points that are not on the robot, and from the known solids of the cell."""
        points = _points_of(view)
        if not len(points):
            return seen_world(points, 0.0, self._known)
        mover = self._mover(SeenWorld(0.0))
        balls, carried = mover.placed(self._arm_now())
        radius = np.concatenate([mover.shape.radius, mover.carried.radius])
        away, nearest = KDTree(np.concatenate([balls, carried])).query(points)
        return seen_world(points[away > radius[nearest] + 0.03], 0.0, self._known)

    def go_home(self) -> None:
        """Move the arm to `start`, out of the camera's view, and open the hand. Raise the arm after an abort."""
        world = SeenWorld(0.0, self._known)
        for left in reversed(range(_TRIES_HOME)):
            try:
                self._move_arm_home(world)
                break
            except MotionAborted:
                if not left:
                    raise
                self.back_off(world)
        self._move_hand(self._hand.open_posture)

    def _move_arm_home(self, world: SeenWorld) -> None:
        now = self._arm_now()
        if np.abs(now - self._layout.start).max() > 0.02:
            mover = self._mover(world)
            up = straight(mover, now, np.array([0.0, 0.0, 0.12]))
            self._follow_arm(up, self._pace.free)
            self._follow_arm(find_path(mover, up[-1], self._layout.start, _WAY_HOME), self._pace.free)

    def go_to_retreat(self, taking: _Taking) -> None:
        """Move the fingers to the pregrasp posture, then the arm to the start of graspd's path."""
        start = taking.execution.hand[0]
        self._move_hand(start)
        mover = self._mover(taking.world, start)
        if told := why_blocked(mover, taking.execution.arm):
            raise NoMotionError(f"motion: {self._arm.name} {told}; valid: a path without collision")
        goal = taking.execution.arm[0]
        # Approach straight down as far as the line is collision-free. The planner finds the rest of the path.
        above = straight(mover, goal, np.array([0.0, 0.0, 0.12]))[::-1]
        path = find_path(mover, self._arm_now(), above[0])
        self._follow_arm(np.concatenate([path, above[1:]]), self._pace.free)

    def close(self, taking: _Taking) -> None:
        """Follow graspd's path to the grasp: the arm first, then arm and fingers together."""
        self._follow_gate(taking.execution, "pregrasp")
        self._follow_gate(taking.execution, "closed")
        taking.closed = self._robot.joints().time

    def squeeze(self, taking: _Taking) -> str:
        """Squeeze. Return why the fingers closed on no object, or "" if they closed on one."""
        self._follow_gate(taking.execution, "squeezed")
        self._wait(self._pace.settle)
        assert taking.offer.grasp is not None
        taking.hold = after_squeeze(self._hand, taking.offer.grasp, self._robot.joints())
        return why_not_gripped(taking.hold, self._hand)

    def carry(self, taking: _Taking) -> str:
        """Carry the object above the place bin. Return why the object was lost, or "" if the hand still holds it."""
        hold, here = taking.hold, self._arm_now()
        assert hold is not None
        thing = self._held_now(taking, here)
        world = self._without_thing(taking)
        mover = self._mover(world, self._hand_now())
        mover = replace(mover, carried=held_balls(mover, here, thing))
        up = straight(mover, here, np.array([0.0, 0.0, 0.1]), freeing=True)
        risen = thing + np.array([0.0, 0.0, tip_pose(mover, up[-1])[2, 3] - tip_pose(mover, here)[2, 3]])
        goal = release_posture(mover, up[-1], risen, self._layout.place, self._picked)
        if goal is None:
            raise NoMotionError(
                f"motion: no posture of {self._arm.name} holds the object above {self._layout.place.name}"
            )
        path = find_path(mover, up[-1], goal)
        there = np.linalg.inv(tip_pose(mover, up[-1])), tip_pose(mover, goal)
        taking.dropped = dropped_box(risen @ (there[1] @ there[0])[:3, :3].T + (there[1] @ there[0])[:3, 3])
        lost = ""

        def slipped() -> bool:
            nonlocal lost
            lost = why_lost(hold, self._hand, self._robot.joints())
            return bool(lost) or self._cancelled()

        try:
            self._follow_arm(np.concatenate([up, path[1:]]), self._pace.loaded, slipped)
        except MotionAborted:
            self._stop_if_cancelled()
            if not lost:
                raise
        return lost or why_lost(hold, self._hand, self._robot.joints())

    def let_go(self, taking: _Taking) -> None:
        """Open the hand to the pregrasp. Store a box as an obstacle where the object was released."""
        self._move_hand(taking.execution.hand[0])
        self._wait(self._pace.settle)
        self._picked += 1
        self._dropped += [taking.dropped] if taking.dropped is not None else []

    def back_off(self, world: SeenWorld) -> None:
        """Open the hand and raise the arm after a failure. Stop early at a collision or an abort."""
        self._stop_if_cancelled()
        try:
            self._move_hand(self._hand.open_posture)
            mover = self._mover(world)
            self._follow_arm(straight(mover, self._arm_now(), np.array([0.0, 0.0, 0.15])), self._pace.loaded)
        except (MotionAborted, NoMotionError):
            self._stop_if_cancelled()

    def _learn(self, attempt: Attempt, offer: Offer) -> None:
        """Store the grasp as failed, even after success, in case the next image still shows the object.

        After an executed try, forget which objects had no grasp. They may have one now.
        """
        assert offer.grasp is not None
        picked, executed = attempt.ending is Ending.PICKED, attempt.ending is not Ending.NO_WAY
        self._taken = offer if picked else None
        if executed:
            self._failures = [failure for failure in self._failures if failure.grasp is not None]
        # Without `seen`, only an object in the same place takes over the failure.
        seen = None if picked else offer.seen
        self._failures.append(Failure(offer.place, offer.grasp.grasp, executed, seen))

    def _check_taken(self, view: DepthView) -> None:
        """Forget the earlier failures of the last object, unless the image shows it where it was."""
        taken, self._taken = self._taken, None
        if taken is None:
            return
        points = _points_of(view)
        if not len(points):
            return
        if (KDTree(points).query(taken.points)[0] < _UNMOVED).mean() > _STILL_THERE:
            self._dropped = self._dropped[:-1]
        else:
            self._failures = [failure for failure in self._failures if failure not in taken.earlier]

    # Helpers of the behaviours.

    @property
    def _known(self) -> tuple[Box, ...]:
        """Obstacles that the camera may not see: walls of the bins, and boxes of released objects."""
        return (*self._layout.solids[1:], *self._dropped)

    def _mover(self, world: SeenWorld, fingers: np.ndarray | None = None) -> Mover:
        fingers = self._hand_now() if fingers is None else fingers
        return Mover(arm_shape(self._arm), world, hand_balls(self._arm, self._hand, fingers))

    def _held_now(self, taking: _Taking, here: np.ndarray) -> np.ndarray:
        """Return surface points of the held object's hull, base frame [m], when the arm is at joint values `here`."""
        offer = taking.offer
        assert offer.surface is not None
        assert offer.grasp is not None
        points = surface_samples(held_hull(offer.surface, offer.grasp.grasp), 1500, 0)[0]
        mount, tip = tip_hand(self._arm, self._hand), tip_pose(self._mover(taking.world), here)
        local = points @ mount.rotation.numpy().T + mount.translation.numpy()
        return local @ tip[:3, :3].T + tip[:3, 3]

    def _without_thing(self, taking: _Taking) -> SeenWorld:
        assert taking.offer.surface is not None
        own = KDTree(surface_samples(taking.offer.surface, 1500, 0)[0])
        points = taking.world.points
        return seen_world(points[own.query(points)[0] > 0.02], 0.0, taking.world.boxes) if len(points) else taking.world

    def _arm_now(self) -> np.ndarray:
        return self._robot.joints().of(self._arm.joint_names).positions

    def _hand_now(self) -> np.ndarray:
        now = self._robot.joints().of(self._hand.joint_names).positions
        return np.clip(now, self._hand.lower, self._hand.upper)

    def _follow_arm(self, path: np.ndarray, speeds: Speeds, stop: Callable[[], bool] | None = None) -> None:
        if len(path) > 1:
            self._follow(timed(self._arm, path, speeds), stop)

    def _follow_gate(self, execution: Execution, gate: str) -> None:
        """Execute the grasp's trajectory from the previous gate to `gate`. All joints rest at gates."""
        rows = execution.rows_to(gate)
        times = execution.times[rows] - execution.times[rows.start]
        positions = np.concatenate([execution.arm[rows], execution.hand[rows]], 1)[1:]
        speeds = np.concatenate([execution.arm_speed[rows], execution.hand_speed[rows]], 1)[1:]
        touching = np.repeat([_TOUCHING, np.inf], [len(execution.arm_joints), len(execution.hand_joints)])
        self._follow(
            JointMotion(
                (*execution.arm_joints, *execution.hand_joints), times[1:], positions, speeds,
                goal_tolerance=touching if gate in ("closed", "squeezed") else None,
            )
        )  # fmt: skip

    def _move_hand(self, goal: np.ndarray) -> None:
        """Move all fingers to joint values [rad] or [m], so that they arrive together."""
        hand, now = self._hand, self._hand_now()
        speed = np.minimum(hand.joint_speeds(1.5, 0.1), 0.6 * hand.velocity)
        way = np.maximum(np.abs(goal - now), np.abs(goal - self._sent))
        seconds = max(0.3, 1.5 * float((way / speed).max()))
        if np.abs(goal - now).max() > 1e-3:
            goal = np.clip(goal, hand.lower, hand.upper)[None]
            self._follow(JointMotion(hand.joint_names, np.array([seconds]), goal, np.zeros_like(goal)))

    def _follow(self, motion: JointMotion, stop: Callable[[], bool] | None = None) -> JointReading:
        self._stop_if_cancelled()
        if set(self._hand.joint_names) <= set(motion.names):
            self._sent = motion.part(self._hand.joint_names).positions[-1]
        try:
            return self._robot.follow(motion, motion.duration + self._pace.patience, stop or self._cancelled)
        except MotionAborted:
            self._stop_if_cancelled()
            raise

    def _wait(self, seconds: float) -> None:
        self._stop_if_cancelled()
        self._robot.wait(seconds)

    def _stop_if_cancelled(self) -> None:
        if self._cancelled():
            raise Cancelled("the picker was cancelled; the arm does not move")


def _points_of(view: DepthView) -> Float[np.ndarray, "_ 3"]:
    """Return a view's points in the base frame [m]. The array is empty if the image is unusable."""
    try:
        return cloud_of(view).points
    except CloudError:
        return np.zeros((0, 3))


def summary(attempts: Sequence[Attempt]) -> str:
    """Return a one-line summary of attempts."""
    picked = [attempt for attempt in attempts if attempt.ending is Ending.PICKED]
    first = [attempt for attempt in attempts if attempt.tries == 0]
    good = sum(attempt.ending is Ending.PICKED for attempt in first)
    return f"{len(picked)} things in {len(attempts)} attempts; {good} of {len(first)} at the first attempt"
