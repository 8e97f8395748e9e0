"""Sources of grasps for a picker: the interface, and graspd as a library in the picker's process."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Protocol

import numpy as np
from jaxtyping import Float

from graspd_cell.layout import Bin, CellLayout
from graspd_cell.motion import Mover, SeenWorld, arm_shape, hand_balls, why_blocked
from graspd_cell.robot import DepthView
from graspd_cell.simulated_robot import box_mesh
from graspd_core.arms.arm import Arm
from graspd_core.arms.reach import Reach
from graspd_core.config import ObstacleConfig, SceneConfig, SegmentationConfig
from graspd_core.errors import CloudError
from graspd_core.hands.model import HandModel
from graspd_core.optimize.restrictions import BoundRestriction, Refusal
from graspd_core.perception.cloud.camera import PinholeCamera, cloud_from_depth
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.scene import Scene
from graspd_core.planning.any_thing import OUT_OF_TRIES, Failure, ThingPlan, plan_any_thing
from graspd_core.planning.plan_grasps import warm_up
from graspd_core.types import Grasp, Plane, TriangleMesh, Verdict


@dataclass(frozen=True, eq=False)
class Offer:
    """Grasp of one of the objects seen, or the reason why there is no grasp. All poses are in the base frame.

    Attributes:
        grasp: the grasp with its arm path. None if no object can be grasped.
        points: seen points of the object [m]. One point at the origin without a grasp.
        surface: object's surface with the reconstructed hidden side. None without a grasp.
        mass: mass used in the trials [kg].
        verified: True if the grasp's verdict is `VERIFIED`.
        seen: places of all objects seen [m].
        reason: why there is no verified grasp.
        failures: the given failures, moved to their objects' present places, and one for each object without a grasp.
        earlier: those of the given failures that happened at the grasp's object.
        exhausted: True if no further try is worthwhile: every object seen failed too often, or the cloud is unusable.
        seconds, cpu_seconds: graspd's wall-clock time and CPU time [s].
    """

    grasp: Grasp | None
    points: Float[np.ndarray, "_ 3"] = field(default_factory=lambda: np.zeros((1, 3)))
    surface: TriangleMesh | None = None
    mass: float = 0.0
    verified: bool = False
    seen: Float[np.ndarray, "_ 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    reason: str = ""
    failures: tuple[Failure, ...] = ()
    earlier: Sequence[Failure] = ()
    exhausted: bool = False
    seconds: float = 0.0
    cpu_seconds: float = 0.0

    @property
    def place(self) -> Float[np.ndarray, "3"]:
        """Centre of the object's points [m]."""
        return self.points.mean(0)


class GraspSource(Protocol):
    """Interface of a source of grasps."""

    def next(self, view: DepthView, failures: Sequence[Failure], world: SeenWorld) -> Offer:
        """Return the most reliable grasp of an object in the view. Grasps similar to `failures` are excluded.

        `world` has the obstacles of the arm. The picker does not try a grasp if the arm's path collides with them.
        """
        ...


class ReportingSource:
    """Grasp source that passes every view, and every answer of another source, to a callback."""

    def __init__(self, source: GraspSource, tell: Callable[[DepthView, Offer], object]) -> None:
        self._source, self._tell = source, tell

    def next(self, view: DepthView, failures: Sequence[Failure], world: SeenWorld) -> Offer:
        """Return the offer of the wrapped source. See `GraspSource`."""
        offer = self._source.next(view, failures, world)
        self._tell(view, offer)
        return offer


def cloud_of(view: DepthView) -> PointCloud:
    """Return the point cloud of a view in the base frame [m]."""
    height, width = view.depth.shape
    k = view.intrinsics
    camera = PinholeCamera(width, height, float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
    return cloud_from_depth(view.depth, camera, view.T_base_camera)


# Reason if no object is left.
EMPTY = "the bin is empty"
# Distance of the crop box from the walls, which allows for camera errors, and height of its top above the table [m].
_STRAY, _RISE = 0.006, 0.3
# Thickness added to objects in the bin [m]. It is less than the default, because these objects give way.
_GIVES_WAY = 0.0015
# A grasp of at least this probability ends the search. In a full bin, the best object is often the last one looked at.
# With a look at all objects, the first grasp had a mean probability of 0.57 instead of 0.42 (LEAP hand, eight bins).
# With 0.65 instead of 0.6, four bins of five took 15 % longer, with as many objects out (seeds 270 and 271).
_LIKELY = 0.6
# Plane that hands keep above. Its offset above the table top [m] allows for errors of arm and camera.
TABLE = Plane(np.array([0.0, 0.0, 1.0]), 0.002)


def scene_config(source: Bin) -> SceneConfig:
    """Return scene settings that crop clouds to the inside of a bin."""
    (x, y), half = source.center, source.half - _STRAY
    cut = SegmentationConfig(roi_low=(x - half, y - half, -0.02), roi_high=(x + half, y + half, _RISE), piled=True)
    return SceneConfig(segmentation=cut, obstacles=ObstacleConfig(padding=_GIVES_WAY))


@dataclass(frozen=True, eq=False)
class ClearPath(BoundRestriction):
    """The restriction to grasps whose arm path is clear of obstacles, also of those outside the cropped cloud.

    The hand is not checked. The restriction follows `Reach`, which adds the path to each grasp.

    Attributes:
        mover: the arm among its obstacles.
    """

    mover: Mover

    @property
    def description(self) -> str:
        """Name of the restriction: a clear path of the arm."""
        return "a clear path of the arm"

    def bind(self, scene: Scene, hand: HandModel) -> ClearPath:
        """Return this restriction, which does not depend on the scene."""
        return self

    def admit(self, grasps: Sequence[Grasp]) -> Sequence[Grasp | Refusal]:
        """Refuse grasps whose arm path collides. See `why_blocked`."""
        blocked = [grasp.arm is not None and bool(why_blocked(self.mover, grasp.arm.positions)) for grasp in grasps]
        refusal = Refusal("with the arm's path blocked by an obstacle")
        return [refusal if hit else grasp for grasp, hit in zip(grasps, blocked, strict=True)]


class InProcessGrasps:
    """Grasp source that runs graspd as a library.

    Args:
        arm, hand, layout: parts of the cell.
        preset: name of graspd's preset.
        seed: seed of the optimiser.
    """

    def __init__(
        self, arm: Arm, hand: HandModel, layout: CellLayout, *, preset: str = "balanced", seed: int = 0
    ) -> None:
        self._hand = hand
        self._plan = {
            "settings": scene_config(layout.pick), "surface": TABLE, "enough": 1, "likely": _LIKELY,
            "solids": {f"wall {k}": [box_mesh(wall)] for k, wall in enumerate(layout.solids[1:])},
            "measure": False, "preset": preset, "seed": seed,
        }  # fmt: skip
        self._reach = Reach(arm, (0.0, 0.0, 0.0))
        self._before: Sequence[ThingPlan] = ()
        warm_up(hand)

    def next(self, view: DepthView, failures: Sequence[Failure], world: SeenWorld) -> Offer:
        """Return the most reliable grasp of an object in the pick bin. See `GraspSource`."""
        wall, cpu, told = time.perf_counter(), time.process_time(), EMPTY
        arm, hand = self._reach.arm, self._hand
        clear = ClearPath(Mover(arm_shape(arm), world, hand_balls(arm, hand, hand.open_posture)))
        asked = {"failures": failures, "before": self._before, "restrictions": (self._reach, clear), **self._plan}
        try:
            found = plan_any_thing([cloud_of(view)], self._hand, **asked)
        except CloudError as error:
            found, told = (), str(error)
        self._before = found or self._before
        offer = _offer(found) if found else Offer(None, reason=told, failures=tuple(failures), exhausted=True)
        return replace(offer, seconds=time.perf_counter() - wall, cpu_seconds=time.process_time() - cpu)


def _offer(found: Sequence[ThingPlan]) -> Offer:
    seen = np.array([thing.place for thing in found])
    # Each failure follows its object from view to view. Failures of no object seen are dropped.
    known = [tuple(replace(failure, place=thing.place, seen=seen) for failure in thing.failures) for thing in found]
    failed = [Failure(thing.place) for thing in found if thing.grasp is None and thing.looked_at]
    failures = (*chain.from_iterable(known), *failed)
    reasons = "; ".join(dict.fromkeys(thing.reason for thing in found if thing.reason))
    if found[0].grasp is None:
        over = all(thing.reason == OUT_OF_TRIES for thing in found)
        return Offer(None, seen=seen, reason=reasons, failures=failures, exhausted=over)
    best = found[0]
    assert best.grasp is not None
    assert best.scene is not None
    assert best.result is not None
    target, verified = best.scene.object, best.grasp.verdict is Verdict.VERIFIED
    return Offer(
        best.grasp, best.points, target.mesh, best.result.mass or target.mass, verified, seen, best.reason, failures,
        known[0],
    )  # fmt: skip
