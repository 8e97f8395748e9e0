"""The frozen values that folders pass to each other.

Metres, radians, newtons, kilograms throughout. A transform `T_a_b` maps coordinates in frame b to frame a. Quaternions
are wxyz. The object frame is the frame of the mesh as loaded (after scaling).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum, StrEnum

import numpy as np
from jaxtyping import Float, Int


class Verdict(StrEnum):
    """What is known of one grasp."""

    VERIFIED = "verified"
    UNVERIFIED = "unverified"
    FAILED = "failed"


class Outcome(Enum):
    """How a run ended, as a sentence. Numerical failure is one of these, not an exception."""

    SUCCEEDED = "as many grasps as asked for were found"
    TOO_FEW = "fewer grasps passed the trial than were asked for"
    NO_CANDIDATES = "no start came near a grasp: the object may be too large, too small or too flat for this hand"
    DEADLINE = "the deadline passed before enough grasps were found"
    CANCELLED = "the caller cancelled the run"


class Stage(StrEnum):
    """The stage of a run, as in progress reports."""

    LOAD = "load"
    OPTIMISE = "optimise"
    VERIFY = "verify"
    DONE = "done"


@dataclass(frozen=True)
class TriangleMesh:
    """A triangle soup. Immutable: functions return new meshes.

    Attributes:
        vertices: corner positions [m].
        faces: rows of three vertex indices, counter-clockwise seen from outside.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]


def joined(*meshes: TriangleMesh) -> TriangleMesh:
    """Return meshes as one, their vertices and faces in order."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]
    return TriangleMesh(np.vstack([mesh.vertices for mesh in meshes]), np.vstack(faces))


@dataclass(frozen=True)
class Plane:
    """A flat support that fills the half-space n·x < offset.

    Attributes:
        normal: unit normal, into the free side.
        offset: n·x of its points [m].
    """

    normal: Float[np.ndarray, "3"]
    offset: float


@dataclass(frozen=True)
class Contact:
    """One place where a link touches the object.

    Attributes:
        link: the hand link's name.
        position: the point on the object's surface, object frame [m].
        normal: outward unit normal of the object there, object frame.
    """

    link: str
    position: tuple[float, float, float]
    normal: tuple[float, float, float]


# Name of the trial under what else may be true of the scene: who fails it alone is neither verified nor failed.
HYPOTHESES = "hypotheses"


@dataclass(frozen=True)
class TrialResult:
    """What one trial of one grasp measured. `graspd_core.verify.trial_registry` lists the trials that planning runs.

    Attributes:
        name: of the trial.
        passed: whether the object stayed within the limits.
        displacement: greatest travel of the object's centre of mass from where the hand should have had it [m], until
            the trial ended: it ends when the answer is known, unless the full length was asked for.
        rotation: greatest turn of the object from its start [rad], likewise.
        reason: why the trial failed, empty when it passed.
    """

    name: str
    passed: bool
    displacement: float
    rotation: float
    reason: str = ""


@dataclass(frozen=True)
class GraspMetrics(Mapping[str, float | None]):
    """Static quality of one grasp by metric name, in SI units. None: the metric was not measured.

    `graspd_core.verify.metrics` lists the metrics, docs/metrics.md defines them.
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
        joint_positions: in the order of the hand's joint names [rad].
    """

    position: Float[np.ndarray, "3"]
    quaternion_wxyz: Float[np.ndarray, "4"]
    joint_positions: Float[np.ndarray, "joints"]


# Where an arm is on its way through a grasp, in this order.
ARM_STAGES = ("retreat", "pregrasp", "grasp", "lift")


@dataclass(frozen=True)
class ArmPath:
    """How an arm brings a hand to a grasp and lifts it: joint values of closely spaced waypoints.

    Attributes:
        joint_names: of the arm, base first.
        positions: joint values, a row a waypoint [rad] or [m].
        stages: the rows at which the hand is at the retreat, the pregrasp, the grasp and the lift (`ARM_STAGES`).
    """

    joint_names: tuple[str, ...]
    positions: Float[np.ndarray, "waypoints joints"]
    stages: tuple[int, int, int, int]

    def at(self, stage: str) -> Float[np.ndarray, "joints"]:
        """Return the joint values at one of `ARM_STAGES`."""
        return self.positions[self.stages[ARM_STAGES.index(stage)]]


@dataclass(frozen=True)
class Grasp:
    """One grasp: three postures, where it touches, how good it is, and what the trials measured.

    Attributes:
        pregrasp: open and clear of the object.
        grasp: the fingers just touch.
        squeeze: the position targets that press with balanced forces.
        contacts: one per touching link.
        score: the optimiser's own measure, larger is better. It ranks grasps before any trial.
        metrics: static quality, None until measured.
        trials: in the order that they were run. The first failure ends them.
        probability: of holding on the true object, if cameras saw it (docs/clouds.md), else None.
        arm: how the arm gets there, if one was given (docs/arms.md), else None.
        arrival: posture of a hand that closes only after it has arrived, open and clear. None: not looked for.
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
        """Verified if all trials passed, failed if one did not on the likeliest scene, otherwise unverified."""
        failed = {trial.name for trial in self.trials if not trial.passed}
        if self.trials and not failed:
            return Verdict.VERIFIED
        return Verdict.FAILED if failed - {HYPOTHESES} else Verdict.UNVERIFIED

    @property
    def usable(self) -> bool:
        """Whether it is as sure as was asked for: verified, or with a contact where no trial was asked for."""
        return self.verdict is Verdict.VERIFIED or bool(not self.trials and self.contacts)

    @property
    def reason(self) -> str:
        """Why the first failed trial failed, empty without one."""
        return next((trial.reason for trial in self.trials if not trial.passed), "")


@dataclass(frozen=True)
class Progress:
    """One progress report of a run.

    Attributes:
        stage: what is being done.
        step: steps done in this stage.
        of: steps planned in this stage.
        best: lowest loss so far while optimising, 0 otherwise.
        verified: grasps that passed the trial so far.
        elapsed: seconds since the run began.
        found: the grasp that has just passed, without metrics yet, None in all other reports.
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
    """The hands that a run works on at one moment, object frame: starts on their way, or candidates on trial.

    Attributes:
        positions: of their base links [m].
        quaternions_wxyz: of their base links, any non-zero length.
        joint_positions: [rad] or [m].
        verdicts: of candidates, in their order, unverified if not tried yet. Empty while optimising.
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
    """Wall-clock seconds of a run's stages. `first_verified` is None without a verified grasp.

    `load` and `sdf` are the times of building the scene. `total` counts them too.
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
    """Zero, kept for readers of version 0.1 until 0.3. `graspd bench early` tries both lengths."""

    audited: int = 0
    disagreed: int = 0


@dataclass(frozen=True)
class GraspResult:
    """The result of a run: always an outcome with its `message`, and what was tried in rank order, verified ones first.

    `grasps` has those that did not fail, at most the `count` that were asked for, and `failed` those that did. `tried`
    has both, and what was found beyond `count`. `support` is what the object stood on, None for a floating one.
    `audits` is always zero, and goes with 0.3. `next_view` is `T_object_camera` [m] of a further view of the hidden
    side. It is set if grasps hold on the likeliest shape and none is sure enough. `refused` counts by reason the
    candidates that a restriction did not admit. `mass` is the object's mass in the trials [kg] if the hand could not
    hold the assumed one, else None. `tried_mass` is its mass in all trials [kg].
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
        """The grasps that did not fail, verified ones first, at most as many as were asked for."""
        return tuple(grasp for grasp in self.tried if grasp.verdict is not Verdict.FAILED)[: self.count]

    @property
    def failed(self) -> tuple[Grasp, ...]:
        """The candidates that failed a trial, in rank order. Each has a `reason`."""
        return tuple(grasp for grasp in self.tried if grasp.verdict is Verdict.FAILED)
