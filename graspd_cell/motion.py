"""Collision-free motions of the arm between postures. Obstacles are the camera's points and the known solids.

Arm, hand and the held object are modelled as spheres. The arm's spheres come from its capsules (docs/arms.md). Hand
and object have spheres at surface points, which are fixed to the tip during a motion. Obstacles are a distance grid of
the points seen, a floor, and boxes. OMPL's RRTConnect finds paths and checks whole edges at once. toppra times the
paths within limits.

OMPL is used because its wheel has no dependencies. The alternative roboplan needs 25 other packages and its own model
of arm and scene. The alternative to toppra, Ruckig, connects only two states, and sends further waypoints to a server.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt

from graspd_cell.layout import Box
from graspd_cell.robot import JointMotion
from graspd_core.arms.arm import Arm, tip_hand
from graspd_core.arms.arm_collision import capsule_balls
from graspd_core.errors import Extra, GraspdError
from graspd_core.hands.kinematics import forward, in_base, link_poses, make_kinematics, place_points
from graspd_core.hands.model import HandModel
from graspd_core.hands.surface_points import dense_samples
from graspd_core.mesh.topology import voxel_keys
from graspd_core.se3 import SE3

Joints = Float[np.ndarray, "joints"]
Path = Float[np.ndarray, "rows joints"]
Points = Float[np.ndarray, "_ 3"]


class NoMotionError(GraspdError):
    """No collision-free path was found for the arm, or its goal is in collision."""


# Cell size of the distance grid, its margin around the points seen, and the greatest coordinate of these points [m].
_CELL, _AROUND, _FARTHEST = 0.01, 0.12, 2.0
# Points seen within this distance of a known solid belong to it [m].
_SLACK = 0.012


@dataclass(frozen=True, eq=False)
class SeenWorld:
    """Obstacles of a motion, base frame [m]. The arm's base and first moving link may touch them.

    Attributes:
        floor: height of the floor.
        boxes: known solids.
        points: points seen, without those on floor and boxes.
        origin: lowest corner of the grid `distances`.
        distances: distance of each grid cell to the nearest point seen. None without points.
    """

    floor: float
    boxes: tuple[Box, ...] = ()
    points: Points = field(default_factory=lambda: np.zeros((0, 3)))
    origin: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    distances: Float[np.ndarray, "x y z"] | None = None

    def clearance(self, at: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
        """Return the distance of positions `at` [m] to the nearest point seen or box [m]. The floor is left out."""
        away = np.full(at.shape[:-1], np.inf)
        for box in self.boxes:
            beyond = np.abs(at - box.center) - box.half
            outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
            away = np.minimum(away, outside + np.minimum(beyond.max(-1), 0.0))
        if self.distances is not None:
            cell = np.floor((at - self.origin) / _CELL).astype(int)
            inside = np.asarray(((cell >= 0) & (cell < self.distances.shape)).all(-1))
            cell = np.where(inside[..., None], cell, 0)
            away = np.minimum(away, np.where(inside, self.distances[tuple(np.moveaxis(cell, -1, 0))], _AROUND))
        return away


def seen_world(points: Points, floor: float, boxes: Sequence[Box] = ()) -> SeenWorld:
    """Build the obstacles from known solids and from a camera's points in the base frame [m].

    Points within `_SLACK` [m] of the floor or of a box, and points out of the arm's reach, are dropped.
    """
    known = SeenWorld(floor, tuple(boxes))
    points = points[(np.abs(points) < _FARTHEST).all(1)]
    points = points[points[:, 2] > floor + _SLACK]
    points = points[known.clearance(points) > _SLACK] if boxes else points
    if not len(points):
        return known
    origin = points.min(0) - _AROUND
    cell = ((points - origin) / _CELL).astype(int)
    shape = tuple(cell.max(0) + 2 + int(_AROUND / _CELL))
    free = np.ones(shape, dtype=bool)
    free[tuple(cell.T)] = False
    away: Any = distance_transform_edt(free)
    # The transform measures between cell centres. A point may be half a cell nearer.
    return replace(known, points=points, origin=origin, distances=(_CELL * (away - 0.5)).astype(np.float32))


@dataclass(frozen=True, eq=False)
class Balls:
    """Spheres fixed to a link: centres in the link's frame and radii [m]."""

    at: Points
    radius: Float[np.ndarray, "_"]


# Spacing of the surface points that are kept of hands and objects, and radius of the sphere at each point [m].
_SPACING, _BALL = 0.012, 0.004
# Side of the cubes whose enclosing spheres stand for hand and held object in the check against the arm [m].
_COARSE = 0.02
# Points sampled on a hand's surface.
_SAMPLES = 4000


def balls_about(points: Points) -> Balls:
    """Return spheres of radius `_BALL`: for every cube of side `_SPACING` that has points, one at such a point."""
    kept = np.unique(voxel_keys(points - points.min(0), _SPACING), return_index=True)[1]
    return Balls(points[kept], np.full(len(kept), _BALL))


def enclosing_balls(points: Points) -> Balls:
    """Return spheres that enclose all points: one about every cube of side `_COARSE` that has points."""
    cubes = np.unique(np.floor(points / _COARSE), axis=0)
    return Balls((cubes + 0.5) * _COARSE, np.full(len(cubes), 0.5 * np.sqrt(3.0) * _COARSE))


@lru_cache(maxsize=4)
def _hand_surface(hand: HandModel) -> tuple[Points, Int[np.ndarray, "_"]]:
    return dense_samples(hand, count=_SAMPLES)[:2]


def hand_points(hand: HandModel, joints: Joints) -> tuple[Points, Int[np.ndarray, "_"]]:
    """Return surface points of the hand at joint values, in the hand's base frame [m], and each point's link index."""
    points, links = _hand_surface(hand)
    return in_base(link_poses(hand, joints), points, links), links


def hand_balls(arm: Arm, hand: HandModel, joints: Joints) -> Balls:
    """Return the spheres of the hand at joint values, in the frame of the arm's tip."""
    local, mount = hand_points(hand, joints)[0], tip_hand(arm, hand)
    return balls_about(local @ mount.rotation.numpy().T + mount.translation.numpy())


@dataclass(frozen=True, eq=False)
class ArmShape:
    """Collision model of an arm as spheres.

    Attributes:
        arm: the arm.
        balls: centres of the spheres as a matrix for `place_points`.
        radius: radius of each sphere [m]. The spheres of a capsule cover the whole capsule.
        link: link index of each sphere.
    """

    arm: Arm
    balls: Float[torch.Tensor, "_ columns"]
    radius: Float[np.ndarray, "_"]
    link: Int[np.ndarray, "_"]

    def links(self, q: Path) -> SE3:
        """Return `T_base_link` [m] of every link at joint values."""
        return forward(make_kinematics(self.arm.chain, dtype=torch.float64), torch.as_tensor(q))

    @cached_property
    def beyond_shoulder(self) -> Bool[np.ndarray, "_"]:
        """Mask of the spheres to check against obstacles: all except those of the base and the first moving link."""
        group = self.arm.chain.link_group
        return (group[self.link] != 0) & (group[self.link] != group[self.arm.moved_link[0]])


@lru_cache(maxsize=4)
def arm_shape(arm: Arm) -> ArmShape:
    """Return the arm with spheres along its capsules. They exceed a capsule by less than an eighth of its radius."""
    balls, radius, capsule = capsule_balls(arm)
    return ArmShape(arm, balls, radius.numpy(), arm.capsules.link[capsule])


# Pairs of spheres that are nearer than this in the seed posture are not checked against each other [m].
_TOUCHING = 0.01


@dataclass(frozen=True, eq=False)
class Mover:
    """Collision checker of an arm with a hand, and perhaps a held object, among obstacles.

    Attributes:
        shape: the arm.
        world: the obstacles.
        carried: collision spheres of the hand and the held object, tip frame.
        margin: distance that a motion keeps from obstacles [m]. A start or goal nearer than this lowers the distance.
    """

    shape: ArmShape
    world: SeenWorld
    carried: Balls
    margin: float = 0.015

    @cached_property
    def _own(self) -> tuple[Balls, np.ndarray, np.ndarray]:
        """Return coarse spheres of hand and object, and index pairs to check: arm with arm, arm with coarse spheres."""
        shape, arm = self.shape, self.shape.arm
        coarse = enclosing_balls(self.carried.at)
        group = arm.chain.link_group
        parent = np.where(arm.chain.link_parent[group] < 0, -1, group[arm.chain.link_parent[group]])
        own, above = group[shape.link], parent[shape.link]
        first, second = np.triu_indices(len(own), 1)
        near = (own[first] == own[second]) | (above[first] == own[second]) | (above[second] == own[first])
        pairs = np.stack([first, second], 1)[~near]
        balls, carried = self._placed(np.asarray(arm.seed)[None], coarse)
        gap = np.linalg.norm(balls[0, pairs[:, 0]] - balls[0, pairs[:, 1]], axis=-1)
        pairs = pairs[gap - shape.radius[pairs].sum(1) > _TOUCHING]
        gap = np.linalg.norm(balls[0, :, None] - carried[0], axis=-1) - shape.radius[:, None] - coarse.radius
        return coarse, pairs, np.argwhere(gap > _TOUCHING)

    def _placed(self, q: Path, *carried: Balls) -> list[np.ndarray]:
        links = self.shape.links(q)
        tip = links[:, self.shape.arm.tip]
        balls = place_points(self.shape.balls, links).numpy()
        return [balls, *(tip.apply(torch.as_tensor(some.at)).numpy() for some in carried)]

    def placed(self, q: Joints) -> tuple[Points, Points]:
        """Return the centres of the arm's collision spheres, and of those of hand and object, in the base frame [m]."""
        balls, carried = self._placed(q[None], self.carried)
        return balls[0], carried[0]

    def clearances(self, q: Path) -> Float[np.ndarray, "rows balls"]:
        """Return distances of the robot's spheres to obstacles, then distances of the sphere pairs from `_own` [m].

        `margin` is added to the distances of pairs, because two spheres of the robot may come close, but not overlap.
        """
        shape = self.shape
        coarse, pairs, with_carried = self._own
        balls, carried, rough = self._placed(q, self.carried, coarse)
        held = shape.beyond_shoulder
        at = np.concatenate([balls[:, held], carried], 1)
        radius = np.concatenate([shape.radius[held], self.carried.radius])
        away = self._from_obstacles(at, radius)
        between = np.linalg.norm(balls[:, pairs[:, 0]] - balls[:, pairs[:, 1]], axis=-1) - shape.radius[pairs].sum(1)
        parts = [away, between + self.margin]
        if len(with_carried):
            a, b = with_carried.T
            gap = np.linalg.norm(balls[:, a] - rough[:, b], axis=-1) - shape.radius[a] - coarse.radius[b]
            parts.append(gap + self.margin)
        return np.concatenate(parts, 1)

    @property
    def carried_columns(self) -> slice:
        """Columns of `clearances` for the spheres of hand and object."""
        arm = int(self.shape.beyond_shoulder.sum())
        return slice(arm, arm + len(self.carried.radius))

    def arm_clearances(self, q: Path) -> Float[np.ndarray, "rows balls"]:
        """Return the distances of the arm's spheres (not of hand and object) to floor, boxes and points seen [m]."""
        held = self.shape.beyond_shoulder
        return self._from_obstacles(self._placed(q)[0][:, held], self.shape.radius[held])

    def _from_obstacles(self, at: np.ndarray, radius: np.ndarray) -> Float[np.ndarray, "rows balls"]:
        return np.minimum(self.world.clearance(at), at[..., 2] - self.world.floor) - radius

    def allowed(self, ends: Path) -> Float[np.ndarray, "balls"]:
        """Return the distance that each sphere must keep [m]: the margin, or less if nearer at one of `ends`."""
        return np.minimum(self.margin, self.clearances(ends).min(0) - 1e-3)

    def clear(self, path: Path, allowed: Float[np.ndarray, "balls"]) -> bool:
        """Return True if straight lines in joint space between the rows of `path` keep the allowed distances [m]."""
        return bool((self.clearances(dense(path)) >= allowed).all())


# Greatest joint step between rows of a checked path [rad].
_STEP = 0.04


def dense(path: Path) -> Path:
    """Return the path with rows inserted on straight lines, so that no joint moves more than `_STEP` per row."""
    if len(path) < 2:
        return path
    counts = [max(1, int(np.ceil(np.abs(b - a).max() / _STEP))) for a, b in pairwise(path)]
    parts = [a + np.arange(n)[:, None] / n * (b - a) for (a, b), n in zip(pairwise(path), counts, strict=True)]
    return np.concatenate([*parts, path[-1:]])


# Deepest penetration allowed at a motion's goal [m]. `DEEPEST` is for the whole robot, because the grid is coarse.
# `ARM_DEEPEST` is for the arm alone, because its capsules are larger than its links.
DEEPEST, ARM_DEEPEST = -0.02, -0.01


def why_blocked(mover: Mover, path: Path) -> str:
    """Return by how much the arm's links (not the hand) penetrate an obstacle on a path. "" if the path is clear."""
    depth = -mover.arm_clearances(dense(path)).min()
    return "" if depth <= -ARM_DEEPEST else f"penetrates an obstacle by {1e3 * depth:.0f} mm on the grasp's path"


# Greatest number of checks of postures and straight lines to find a path, and then to shorten the path. Limits of time
# would give other paths on a busy machine.
_CHECKS, _SHORTENING = 3000, 150


def find_path(mover: Mover, start: Joints, goal: Joints, checks: int = _CHECKS) -> Path:
    """Return waypoints from one posture to another. Straight lines between the waypoints are collision-free.

    Raises:
        NoMotionError: the goal is in collision, or no path was found with `checks` collision checks.
    """
    ends = np.stack([start, goal])
    # Only the goal is checked. The arm is already at the start, even if it touches something there.
    whole, own = mover.clearances(ends)[1].min(), mover.arm_clearances(ends)[1].min()
    if whole < DEEPEST or own < ARM_DEEPEST:
        told = f"penetrates an obstacle by {-1e3 * min(whole, own):.0f} mm at its goal; valid: a goal without collision"
        raise NoMotionError(f"motion: {mover.shape.arm.name} {told}")
    allowed = mover.allowed(ends)
    if mover.clear(ends, allowed):
        return ends
    found = _planned(mover, start, goal, allowed, checks)
    if found is None:
        raise NoMotionError(f"motion: {checks} checks found no collision-free path of {mover.shape.arm.name}")
    return _rounded(mover, found, allowed)


@cache
def _seed_ompl() -> None:
    """Fix the seed of OMPL's random numbers. OMPL takes a seed only once, before its first random number."""
    with Extra("cell"):
        from ompl import util

    util.setLogLevel(util.LogLevel.LOG_ERROR)
    util.RNG.setSeed(1)


def _planned(mover: Mover, start: Joints, goal: Joints, allowed: np.ndarray, checks: int) -> Path | None:
    _seed_ompl()
    from ompl import base, geometric

    arm, count = mover.shape.arm, len(start)
    space, bounds = base.RealVectorStateSpace(count), base.RealVectorBounds(count)
    for joint in range(count):
        # Search at most half a turn beyond either end.
        low, high = min(start[joint], goal[joint]) - np.pi, max(start[joint], goal[joint]) + np.pi
        bounds.setLow(joint, float(max(arm.lower[joint], low)))
        bounds.setHigh(joint, float(min(arm.upper[joint], high)))
    space.setBounds(bounds)
    about = base.SpaceInformation(space)

    done = 0

    def values(state: Any) -> Joints:
        return np.array([state[joint] for joint in range(count)])

    def is_clear(*states: Any) -> bool:
        nonlocal done
        done += 1
        return mover.clear(np.stack([values(state) for state in states]), allowed)

    class Edges(base.MotionValidator):
        def checkMotion(self, first: Any, second: Any, *_: Any) -> bool:
            return is_clear(first, second)

    about.setStateValidityChecker(is_clear)
    about.setMotionValidator(Edges(about))
    about.setup()
    ends: list[Any] = [space.allocState() for _ in range(2)]
    for state, q in zip(ends, (start, goal), strict=True):
        for joint in range(count):
            state[joint] = float(q[joint])
    problem = base.ProblemDefinition(about)
    problem.setStartAndGoalStates(*ends)
    planner = geometric.RRTConnect(about)
    planner.setRange(0.6)
    planner.setProblemDefinition(problem)
    planner.setup()
    if str(planner.solve(base.PlannerTerminationCondition(lambda: done > checks))) != "Exact solution":
        return None
    path: Any = problem.getSolutionPath()
    most = done + _SHORTENING
    geometric.PathSimplifier(about).simplify(path, base.PlannerTerminationCondition(lambda: done > most))
    return np.stack([values(state) for state in path.getStates()])


def _rounded(mover: Mover, path: Path, allowed: np.ndarray) -> Path:
    """Return the path with its corners cut twice (Chaikin), or the path itself if the cut path collides."""
    smooth = path
    for _ in range(2):
        inner = [row for a, b in pairwise(smooth) for row in (0.75 * a + 0.25 * b, 0.25 * a + 0.75 * b)]
        smooth = np.stack([smooth[0], *inner[1:-1], smooth[-1]]) if len(smooth) > 2 else smooth
    return smooth if mover.clear(smooth, allowed) else path


@dataclass(frozen=True)
class Speeds:
    """Speed limits of an arm motion.

    Attributes:
        share: fraction of the arm's joint speed limits that the motion may use.
        acceleration: greatest joint acceleration [rad/s²].
    """

    share: float = 0.6
    acceleration: float = 4.0


# Time between two rows of a motion [s].
_PERIOD = 0.02


def timed(arm: Arm, path: Path, speeds: Speeds) -> JointMotion:
    """Return the fastest motion from rest to rest along a path within the limits. Raises NoMotionError: none found."""
    import toppra
    from toppra.algorithm import TOPPRA
    from toppra.constraint import JointAccelerationConstraint, JointVelocityConstraint

    rows = dense(path)
    # Drop repeated rows, because the path has no direction there.
    rows = rows[np.r_[True, np.abs(np.diff(rows, axis=0)).max(1) > 1e-6]]
    if len(rows) < 2:
        return JointMotion(arm.joint_names, np.array([_PERIOD]), path[-1:], np.zeros_like(path[-1:]))
    toppra.setup_logging("ERROR")
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(rows, axis=0), axis=1))]
    most = speeds.share * np.asarray(arm.chain.velocity)
    push = np.full(len(most), speeds.acceleration)
    limits = [
        JointVelocityConstraint(np.stack([-most, most], 1)),
        JointAccelerationConstraint(np.stack([-push, push], 1)),
    ]
    trajectory: Any = TOPPRA(
        limits, toppra.SplineInterpolator(along, rows), parametrizer="ParametrizeConstAccel"
    ).compute_trajectory()
    if trajectory is None:
        raise NoMotionError(f"motion: toppra cannot time a path of {len(rows)} postures of {arm.name}")
    times = np.linspace(0.0, trajectory.duration, max(2, 1 + int(np.ceil(trajectory.duration / _PERIOD))))
    # The spline may exceed a limit that the path touches.
    rows = np.clip(trajectory(times)[1:], arm.lower, arm.upper)
    return JointMotion(arm.joint_names, times[1:], rows, trajectory(times, 1)[1:])
