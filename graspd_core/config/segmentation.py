"""Settings of the segmentation of clouds."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SegmentationConfig:
    """How an object is cut out of a scene that depth cameras saw.

    Attributes:
        roi_low: lower corner of the workspace, in the cloud's frame [m]; None: no bound.
        roi_high: upper corner of the workspace, in the cloud's frame [m]; None: no bound.
        max_range: points farther than this from their camera are ignored [m].
        voxel: side of the voxels that the scene is thinned by; finer than half of `gap` [m].
        plane_tolerance: least height above the support that counts as above it, more where the camera is noisier [m].
        support_size: the smaller side of a support's visible part is at least this [m].
        contact: what stands on a support comes at least this near to it, occlusion and noise considered [m].
        gap: things at least this far apart are two [m].
        smallest_object: things smaller than this are noise [m].
        largest_object: things larger than this are background: walls, floors, furniture [m].
        min_points: things seen by fewer points than this are noise.
        target_reach: a target point this near to a thing means that thing [m].
        obstacle_range: other things are reported as far as this from the object [m].
    """

    roi_low: tuple[float, float, float] | None = None
    roi_high: tuple[float, float, float] | None = None
    max_range: float = 2.0
    voxel: float = 0.003
    plane_tolerance: float = 0.004
    support_size: float = 0.1
    contact: float = 0.02
    gap: float = 0.008
    smallest_object: float = 0.008
    largest_object: float = 0.35
    min_points: int = 30
    target_reach: float = 0.05
    obstacle_range: float = 0.3
