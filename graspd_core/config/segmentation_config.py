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
        max_voxels: larger scenes get larger voxels; this bounds the time.
        plane_tolerance: least height above the support that counts as above it, more where the camera is noisier [m].
        max_plane_tolerance: the most that this height may become where the camera is noisy [m].
        plane_search_width: half width of the slab in which a plane is searched; wider for noisy cameras [m].
        ransac_trials: planes that are tried; more where the support is a small share of the scene.
        support_size: the smaller side of a support's visible part is at least this [m].
        support_margin: a flat part goes on so far beyond what was seen of it [m].
        support_area_ratio: area of a support over the area of what stands on it, at least.
        contact: what stands on a support comes at least this near to it, occlusion and noise considered [m].
        gap: things at least this far apart are two [m].
        max_link: points farther apart than this are never one thing, however sparse the cloud is [m].
        neighbour_share: points with fewer neighbours than this share of the median are flying pixels.
        hanging_reach: a piece that ends above the support, a handle, belongs to what is this near [m].
        unsupported_reach: without a support, pieces this near that touch in an image are one thing [m].
        smallest_object: things smaller than this are noise [m].
        largest_object: things larger than this are background: walls, floors, furniture [m].
        min_points: things seen by fewer points than this are noise.
        border_width: what is this near to the edge of the image may go on beyond; some three pixels [rad].
        target_reach: a target point this near to a thing means that thing [m].
        target_share: a box or mask that covers this share of a thing means all of it.
        obstacle_range: other things are reported as far as this from the object [m].
    """

    roi_low: tuple[float, float, float] | None = None
    roi_high: tuple[float, float, float] | None = None
    max_range: float = 2.0
    voxel: float = 0.003
    max_voxels: int = 150_000
    plane_tolerance: float = 0.004
    max_plane_tolerance: float = 0.02
    plane_search_width: float = 0.01
    ransac_trials: int = 400
    support_size: float = 0.1
    support_margin: float = 0.05
    support_area_ratio: float = 2.0
    contact: float = 0.02
    gap: float = 0.008
    max_link: float = 0.05
    neighbour_share: float = 0.3
    hanging_reach: float = 0.03
    unsupported_reach: float = 0.15
    smallest_object: float = 0.008
    largest_object: float = 0.35
    min_points: int = 30
    border_width: float = 0.004
    target_reach: float = 0.05
    target_share: float = 0.8
    obstacle_range: float = 0.3
