"""The frozen values that rooms hand to each other.

Metres, radians, newtons, kilograms throughout. A transform `T_a_b` maps coordinates in frame b to frame a;
quaternions are wxyz. The object frame is the frame of the mesh as loaded (after scaling).
"""

from __future__ import annotations

from collections.abc import Callable
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
    """Where a run is, as told by progress reports."""

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


@dataclass(frozen=True)
class HoldResult:
    """What a hold trial measured (worst over its six directions).

    Attributes:
        passed: whether every direction stayed within the limits.
        max_displacement: object travel from the start of the trial [m].
        max_rotation: object turn from the start of the trial [rad].
        reason: why it failed, empty when it passed.
    """

    passed: bool
    max_displacement: float
    max_rotation: float
    reason: str = ""


@dataclass(frozen=True)
class LiftResult:
    """What a lift trial measured.

    Attributes:
        passed: whether the hand came, closed and lifted without reaching through anything or losing the object.
        max_displacement: how far the object's centre of mass was at most from where the hand should have had it [m].
        max_rotation: object turn from how it stood [rad].
        reach_through: greatest depth of the hand's postures in the support or a neighbour, zero where clear [m].
        reason: why it failed, empty when it passed.
    """

    passed: bool
    max_displacement: float
    max_rotation: float
    reach_through: float
    reason: str = ""


@dataclass(frozen=True)
class GraspMetrics:
    """Static quality of one grasp, measured by `graspd_core.metrics` (definitions: docs/metrics.md).

    Attributes:
        contact_area: hand surface within 2 mm of the object [m²].
        contact_links: number of hand links within 2 mm of the object.
        intersection_volume: hand volume inside the object [m³].
        penetration: greatest depth of a dense hand sample inside the object [m].
        self_penetration: greatest overlap of non-adjacent links [m].
        epsilon: Ferrari-Canny radius, torque scaled by the object's largest radius.
        volume: volume of the grasp wrench hull.
        displacement: the papers' simulation displacement [m], None where it was not run.
        contact_area_5mm: hand surface within 5 mm of the object [m²], None where nobody measured.
        contact_area_10mm: hand surface within 10 mm of the object [m²], None where nobody measured.
        robustness: share of hold trials held with the hand out of place, None where nobody asked.
    """

    contact_area: float
    contact_links: int
    intersection_volume: float
    penetration: float
    self_penetration: float
    epsilon: float
    volume: float
    displacement: float | None = None
    contact_area_5mm: float | None = None
    contact_area_10mm: float | None = None
    robustness: float | None = None


@dataclass(frozen=True)
class Posture:
    """A hand somewhere: base pose in the object frame and joint values.

    Attributes:
        position: origin of the hand's base link [m].
        quaternion_wxyz: unit quaternion of the base link.
        joint_positions: in the order of the hand's joint names [rad].
    """

    position: Float[np.ndarray, "3"]
    quaternion_wxyz: Float[np.ndarray, "4"]
    joint_positions: Float[np.ndarray, "joints"]


@dataclass(frozen=True)
class Grasp:
    """One grasp: three postures, where it touches, how good it is, and what the trial said.

    Attributes:
        pregrasp: open and clear of the object.
        grasp: the fingers just touch.
        squeeze: the position targets that press with balanced forces.
        contacts: one per touching link.
        score: the optimiser's own measure, larger is better; ranks grasps before any trial.
        metrics: static quality, None until measured.
        hold: the hold trial's figures, None until run.
        verdict: verified, unverified (no trial asked) or failed.
        reason: why it failed, empty otherwise.
        lift: the lift trial's figures; None until run, and in scenes with nothing but the object.
    """

    pregrasp: Posture
    grasp: Posture
    squeeze: Posture
    contacts: tuple[Contact, ...]
    score: float
    metrics: GraspMetrics | None = None
    hold: HoldResult | None = None
    verdict: Verdict = Verdict.UNVERIFIED
    reason: str = ""
    lift: LiftResult | None = None


@dataclass(frozen=True)
class Progress:
    """One progress report of a run.

    Attributes:
        stage: what is being done.
        step: steps done in this stage.
        of: steps planned in this stage.
        best: lowest loss so far while optimising; 0 elsewhere.
        verified: grasps that passed the trial so far.
        elapsed: seconds since the run began.
    """

    stage: Stage
    step: int
    of: int
    best: float
    verified: int
    elapsed: float


ProgressHook = Callable[[Progress], None]
StopHook = Callable[[], bool]


@dataclass(frozen=True)
class Timing:
    """Wall-clock seconds of a run's stages; `first_verified` is None when none was.

    `load` and `sdf` are what building the scene took, whenever that was; `total` counts them too.
    """

    load: float = 0.0
    sdf: float = 0.0
    compile: float = 0.0
    optimise: float = 0.0
    verify: float = 0.0
    first_verified: float | None = None
    total: float = 0.0


@dataclass(frozen=True)
class GraspResult:
    """What a run gives back: an outcome, always, and the grasps in rank order, verified ones first.

    `support` is what the object stood on, None where it floated.
    """

    outcome: Outcome
    grasps: tuple[Grasp, ...]
    timing: Timing
    seed: int
    method: str
    message: str = ""
    warnings: tuple[str, ...] = field(default=())
    support: Plane | None = None
