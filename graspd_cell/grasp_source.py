"""Where a picker's grasps come from: graspd as a library, in the picker's own process, or `graspd_node` over ROS."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from jaxtyping import Float

from graspd_cell.layout import Bin, CellLayout
from graspd_cell.robot import DepthView
from graspd_cell.simulated_robot import box_mesh
from graspd_core.arms.arm import Arm
from graspd_core.arms.reach import Reach
from graspd_core.config import SceneConfig, SegmentationConfig
from graspd_core.errors import CloudError
from graspd_core.hands.model import HandModel
from graspd_core.perception.cloud.camera import PinholeCamera, cloud_from_depth
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.planning.any_thing import OUT_OF_TRIES, Failure, ThingPlan, plan_any_thing
from graspd_core.planning.plan_grasps import warm_up
from graspd_core.types import Grasp, Plane, TriangleMesh, Verdict

__all__ = ["Failure", "GraspSource", "InProcessGrasps", "Offer", "cloud_of"]


@dataclass(frozen=True, eq=False)
class Offer:
    """A grasp of one of the things seen, or why there is none; all in the base frame.

    Attributes:
        grasp: with its arm path; None where nothing can be grasped.
        place: the middle of the points of the thing [m].
        surface: of the thing, as it was made whole; None where there is none.
        mass: that it was tried with [kg].
        verified: whether the grasp is as sure as was asked for.
        things: how many were seen.
        reason: why there is no verified grasp.
        failures: things that were looked at and have no grasp at all.
        exhausted: whether each thing seen has been tried in vain too often.
        seconds: graspd's time, wall clock.
    """

    grasp: Grasp | None
    place: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    surface: TriangleMesh | None = None
    mass: float = 0.0
    verified: bool = False
    things: int = 0
    reason: str = ""
    failures: tuple[Failure, ...] = ()
    exhausted: bool = False
    seconds: float = 0.0


class GraspSource(Protocol):
    """Who is asked for the next grasp."""

    def next(self, view: DepthView, failures: Sequence[Failure]) -> Offer:
        """Return the surest grasp of the things that a view shows, unlike those that were lost."""
        ...


def cloud_of(view: DepthView) -> PointCloud:
    """Return what a view shows, base frame."""
    height, width = view.depth.shape
    k = view.intrinsics
    camera = PinholeCamera(width, height, float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
    return cloud_from_depth(view.depth, camera, view.T_base_camera)


# Why no thing is left.
EMPTY = "the bin is empty"
# Measured surfaces stray so far; things rise at most so far above the floor [m].
_STRAY, _RISE = 0.006, 0.3
# The table's top, and how far above it hands keep [m]: arms and cameras are no more exact.
TABLE = Plane(np.array([0.0, 0.0, 1.0]), 0.002)


def scene_config(source: Bin) -> SceneConfig:
    """Return settings under which clouds are cut down to what lies in a bin."""
    (x, y), half = source.center, source.half - _STRAY
    cut = SegmentationConfig(roi_low=(x - half, y - half, -0.02), roi_high=(x + half, y + half, _RISE), piled=True)
    return SceneConfig(segmentation=cut)


class InProcessGrasps:
    """graspd as a library.

    Args:
        arm, hand, layout: of the cell.
        preset: speed or accuracy.
        seconds: after which no further thing is looked at. One thing gets as many again.
        seed: of the optimiser.
        tries: grasps of a thing that may fail before it is given up.
    """

    def __init__(
        self, arm: Arm, hand: HandModel, layout: CellLayout, *, preset: str = "balanced", seconds: float = 3.0,
        seed: int = 0, tries: int = 4,
    ) -> None:  # fmt: skip
        self._hand, self._source = hand, layout.pick
        self._plan = {
            "settings": scene_config(layout.pick), "surface": TABLE, "tries": tries, "seconds": seconds,
            "solids": {f"wall {k}": [box_mesh(wall)] for k, wall in enumerate(layout.solids[1:])},
            "restrictions": (Reach(arm, (0.0, 0.0, 0.0)),), "measure": False, "preset": preset, "seed": seed,
            "deadline": seconds,
        }  # fmt: skip
        warm_up(hand)

    def next(self, view: DepthView, failures: Sequence[Failure]) -> Offer:
        """Return the surest grasp of the things in the source bin. See `GraspSource`."""
        began = time.perf_counter()
        try:
            found = plan_any_thing([cloud_of(view)], self._hand, failures=failures, **self._plan)
        except CloudError as error:
            return Offer(None, reason=str(error), exhausted=True, seconds=time.perf_counter() - began)
        return _offer(found, time.perf_counter() - began)


def _offer(found: Sequence[ThingPlan], seconds: float) -> Offer:
    failed = tuple(Failure(thing.place) for thing in found if thing.grasp is None and thing.looked_at)
    reasons = "; ".join(dict.fromkeys(thing.reason for thing in found if thing.reason))
    if not found or found[0].grasp is None:
        told, over = reasons or EMPTY, all(thing.reason == OUT_OF_TRIES for thing in found)
        return Offer(None, things=len(found), reason=told, failures=failed, exhausted=over, seconds=seconds)
    best = found[0]
    assert best.grasp is not None
    assert best.scene is not None
    assert best.result is not None
    return Offer(
        best.grasp,
        best.place,
        best.scene.object.mesh,
        best.result.mass or best.scene.object.mass,
        best.grasp.verdict is Verdict.VERIFIED,
        len(found),
        best.reason,
        failed,
        seconds=seconds,
    )
