"""Define the immutable value types that the packages exchange.

Units are metres, radians, newtons and kilograms. A transform `T_a_b` maps coordinates in frame b to frame a.
Quaternions are wxyz. The object frame is the frame of the mesh as loaded (after scaling).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, StrEnum

import numpy as np
from jaxtyping import Bool, Float, Int

from graspd_core.errors import ConfigError, short_repr


class Verdict(StrEnum):
    """Result of all trials of one grasp."""

    VERIFIED = "verified"
    UNVERIFIED = "unverified"
    FAILED = "failed"


class Outcome(Enum):
    """Outcome of a run. The enum's value is the message. A run that finds no grasp does not raise."""

    SUCCEEDED = "as many grasps as asked for were found"
    TOO_FEW = "fewer grasps passed the trial than were asked for"
    NO_CANDIDATES = "no start came near a grasp: the object may be too large, too small or too flat for this hand"
    DEADLINE = "the deadline passed before enough grasps were found"
    CANCELLED = "the caller cancelled the run"


class Stage(StrEnum):
    """Stage of a run, for progress reports."""

    LOAD = "load"
    OPTIMISE = "optimise"
    VERIFY = "verify"
    DONE = "done"


@dataclass(frozen=True)
class TriangleMesh:
    """An immutable triangle mesh. Functions that change a mesh return a new one.

    Attributes:
        vertices: corner positions [m].
        faces: three vertex indices per face, counter-clockwise as seen from outside.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]


def joined(*meshes: TriangleMesh) -> TriangleMesh:
    """Return one mesh with the vertices and faces of all meshes, in order."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]
    return TriangleMesh(np.vstack([mesh.vertices for mesh in meshes]), np.vstack(faces))


# Greatest deviation of a unit vector's length from 1.
_UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Plane:
    """A flat support surface. The half-space n·x < offset below it is solid.

    Attributes:
        normal: unit normal n, pointing away from the solid side.
        offset: n·x of every point x on the plane [m].
        margin: least height of the hand above the plane [m], equal to the noise of the camera that saw the plane.

    Raises:
        ConfigError: the normal is not a unit vector, a number is not finite, or the margin is below 0.
    """

    normal: Float[np.ndarray, "3"]
    offset: float
    margin: float = 0.0

    def __post_init__(self) -> None:
        normal, given = np.asarray(self.normal, dtype=float), short_repr(np.asarray(self.normal).tolist())
        if normal.shape != (3,) or not abs(np.linalg.norm(normal) - 1.0) <= _UNIT_TOLERANCE:
            raise ConfigError(f"plane normal: {given}; valid: three numbers x, y, z of length 1")
        if not math.isfinite(self.offset):
            raise ConfigError(f"plane offset: {self.offset} m; valid: a finite number")
        if not 0.0 <= self.margin < math.inf:
            raise ConfigError(f"plane margin: {self.margin} m; valid: a finite number, 0 or more")


@dataclass(frozen=True)
class Contact:
    """One contact between a hand link and the object.

    Attributes:
        link: name of the hand link.
        position: contact point on the object's surface, object frame [m].
        normal: outward unit normal of the object at the contact, object frame.
        force: planned force of the link on the object when the hand squeezes, object frame [N]. If joints reach their
            effort limits, the real force is smaller. None if unknown.
    """

    link: str
    position: tuple[float, float, float]
    normal: tuple[float, float, float]
    force: tuple[float, float, float] | None = None


# Name of the trial that runs the robustness checks. A grasp that fails only this trial is unverified, not failed.
ROBUSTNESS = "hypotheses"


@dataclass(frozen=True)
class TrialResult:
    """The result of one trial of one grasp. `graspd_core.verify.trial_registry` lists the trials that planning runs.

    Attributes:
        name: name of the trial.
        passed: whether the object stayed within the limits.
        displacement: greatest travel of the object's centre of mass during the trial [m]. In a lift trial, the travel
            is measured relative to the moving hand. A trial may end early (`early_stop`).
        rotation: greatest rotation of the object during the trial [rad].
        reason: why the trial failed. Empty if it passed.
    """

    name: str
    passed: bool
    displacement: float
    rotation: float
    reason: str = ""


@dataclass(frozen=True)
class GraspMetrics(Mapping[str, float | None]):
    """Static quality metrics of one grasp by name, in SI units. A value is None if the metric was not measured.

    `graspd_core.verify.metrics` lists the metrics. docs/metrics.md defines them.
    """

    values_si: Mapping[str, float | None]

    def __getitem__(self, name: str) -> float | None:
        return self.values_si[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.values_si)

    def __len__(self) -> int:
        return len(self.values_si)


@dataclass(frozen=True)
class Posture:
    """A hand's base pose in the object frame and its joint values.

    Attributes:
        position: origin of the hand's base link [m].
        quaternion_wxyz: unit quaternion of the base link.
        joint_positions: values in the order of the hand's joint names [rad] or [m].
    """

    position: Float[np.ndarray, "3"]
    quaternion_wxyz: Float[np.ndarray, "4"]
    joint_positions: Float[np.ndarray, "joints"]


def stacked(
    postures: Sequence[Posture],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"], Float[np.ndarray, "n joints"]]:
    """Return positions [m], quaternions and joint values [rad] or [m] of postures as float64, one row each."""
    rows = ((p.position, p.quaternion_wxyz, p.joint_positions) for p in postures)
    positions, quaternions, joints = (np.stack(part).astype(float, copy=False) for part in zip(*rows, strict=True))
    return positions, quaternions, joints


# Named waypoints of an arm path, in this order.
ARM_STAGES = ("retreat", "pregrasp", "grasp", "lift")


@dataclass(frozen=True)
class ArmPath:
    """Arm path that brings the hand to a grasp and lifts it, as joint values of closely spaced waypoints.

    Attributes:
        joint_names: names of the arm's joints, base first.
        positions: joint values, one row per waypoint [rad] or [m].
        stages: row indices of the retreat, the pregrasp, the grasp and the lift (`ARM_STAGES`).
        velocity: greatest speed of each joint that the arm allows [rad/s] or [m/s]. None if unknown, as from a file.
        slides: True for each joint that is prismatic. None if unknown.
    """

    joint_names: tuple[str, ...]
    positions: Float[np.ndarray, "waypoints joints"]
    stages: tuple[int, int, int, int]
    velocity: Float[np.ndarray, "joints"] | None = None
    slides: Bool[np.ndarray, "joints"] | None = None

    def at(self, stage: str) -> Float[np.ndarray, "joints"]:
        """Return the arm's joint values at `stage`, one of `ARM_STAGES`."""
        return self.positions[self.stages[ARM_STAGES.index(stage)]]


@dataclass(frozen=True)
class Grasp:
    """One grasp: its hand postures, contacts, quality and trial results.

    Attributes:
        pregrasp: open posture, clear of the object.
        grasp: posture in which the fingers just touch the object.
        squeeze: position targets that press the fingers on the object.
        contacts: one contact per touching link.
        score: the optimiser's score. A larger score is better. The score ranks grasps before any trial.
        metrics: static quality metrics. None until they are measured.
        trials: trial results in the order of the trials. No trial runs after a failed trial.
        probability: probability that the grasp holds on the true object (docs/clouds.md). None without camera data.
        arm: arm path to the grasp (docs/arms.md). None without an arm.
        arrival: collision-free open posture at the grasp, for planners that close the fingers only after the hand has
            arrived. None if no such posture was computed or found.
    """

    pregrasp: Posture
    grasp: Posture
    squeeze: Posture
    contacts: tuple[Contact, ...] = ()
    score: float = 0.0
    metrics: GraspMetrics | None = None
    trials: tuple[TrialResult, ...] = ()
    probability: float | None = None
    arm: ArmPath | None = None
    arrival: Posture | None = None

    @property
    def verdict(self) -> Verdict:
        """VERIFIED if all trials passed. FAILED if a trial other than the robustness checks failed. Else UNVERIFIED."""
        failed = {trial.name for trial in self.trials if not trial.passed}
        if self.trials and not failed:
            return Verdict.VERIFIED
        return Verdict.FAILED if failed - {ROBUSTNESS} else Verdict.UNVERIFIED

    @property
    def usable(self) -> bool:
        """Whether the grasp is verified. If it has no trials, whether it has a contact."""
        return self.verdict is Verdict.VERIFIED or bool(not self.trials and self.contacts)

    @property
    def reason(self) -> str:
        """Reason of the first failed trial. Empty if none failed."""
        return next((trial.reason for trial in self.trials if not trial.passed), "")


@dataclass(frozen=True)
class Progress:
    """One progress report of a run.

    Attributes:
        stage: current stage.
        step: steps done in this stage.
        of: steps planned in this stage.
        best: lowest loss so far while optimising, otherwise 0.
        verified: number of grasps verified so far.
        elapsed: time since the run began [s].
        found: grasp that was just verified, still without metrics. None in all other reports.
    """

    stage: Stage
    step: int
    of: int
    best: float
    verified: int
    elapsed: float
    found: Grasp | None = None


@dataclass(frozen=True)
class Snapshot:
    """Current hand poses of a run, object frame: the starting poses while optimising, the candidates during trials.

    Attributes:
        positions: positions of the base links [m].
        quaternions_wxyz: orientations of the base links, quaternions of any non-zero length.
        joint_positions: joint values [rad] or [m].
        verdicts: verdict of each candidate, UNVERIFIED before the candidate's trials. Empty while optimising.
    """

    positions: Float[np.ndarray, "hands 3"]
    quaternions_wxyz: Float[np.ndarray, "hands 4"]
    joint_positions: Float[np.ndarray, "hands joints"]
    verdicts: tuple[Verdict, ...] = ()


ProgressHook = Callable[[Progress], None]
WatchHook = Callable[[Snapshot], None]
StopHook = Callable[[], bool]


@dataclass(frozen=True)
class Timing:
    """Wall-clock times of a run's stages [s]. `first_verified` is None without a verified grasp.

    `load` and `sdf` are the times for building the scene. `total` includes both times. `compile` is always 0.
    """

    load: float = 0.0
    sdf: float = 0.0
    compile: float = 0.0
    optimise: float = 0.0
    verify: float = 0.0
    first_verified: float | None = None
    total: float = 0.0


@dataclass(frozen=True)
class AuditCount:
    """Deprecated counts, always zero. Version 0.3 removes them. `graspd bench early` checks trials that stop early."""

    audited: int = 0
    disagreed: int = 0


@dataclass(frozen=True)
class GraspResult:
    """The result of a run: its outcome, a `message` and all tried grasps.

    `tried` holds every tried grasp in rank order, verified grasps first. `support` is the plane on which the object
    stands, None for a floating object. `audits` is always zero, and version 0.3 removes it. `next_view` is the camera
    pose `T_object_camera` [m] that shows more of the object's hidden side. It is None unless grasps hold on the
    likeliest shape but none is verified. `refused` counts the candidates that restrictions refused, by reason.
    `tried_mass` is the object's mass in the trials [kg]. If graspd assumed a greater mass, `mass` equals
    `tried_mass`. Else `mass` is None. `count` is the requested number of grasps.
    """

    outcome: Outcome
    tried: tuple[Grasp, ...]
    timing: Timing
    seed: int
    method: str
    message: str = ""
    warnings: tuple[str, ...] = field(default=())
    support: Plane | None = None
    audits: AuditCount = AuditCount()
    next_view: Float[np.ndarray, "4 4"] | None = None
    refused: Mapping[str, int] = field(default_factory=dict)
    mass: float | None = None
    tried_mass: float | None = None
    count: int | None = None

    @property
    def grasps(self) -> tuple[Grasp, ...]:
        """The grasps that did not fail, verified grasps first, at most `count`."""
        return tuple(grasp for grasp in self.tried if grasp.verdict is not Verdict.FAILED)[: self.count]

    @property
    def failed(self) -> tuple[Grasp, ...]:
        """The grasps that failed a trial, in rank order. Each has a `reason`."""
        return tuple(grasp for grasp in self.tried if grasp.verdict is Verdict.FAILED)
