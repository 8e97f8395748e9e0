"""Measure one grasp. Quantities that several metrics need are computed once.

Dense samples of the hand's surface give the hand's contacts, its penetration of the object and its self-penetration.
The optimiser never sees these samples. The wrenches of unit contact forces give the grasp quality of Ferrari and Canny
(ICRA 1992).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from graspd_core.hands.kinematics import in_base, link_poses
from graspd_core.hands.link_distance import bounds, depth_inside, primitive_sdf
from graspd_core.hands.model import HandModel, Primitive
from graspd_core.hands.surface_points import samples_with_edges
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.sdf import sample_sdf
from graspd_core.mesh.sharp_features import crease_points, farthest_points, neighbours_together
from graspd_core.mesh.surface_queries import DistanceQuery
from graspd_core.mesh.topology import packed_rows
from graspd_core.optimize.kernel.builds import kernel
from graspd_core.perception.scene import ObjectModel, Obstacle
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import Grasp, Plane, Posture
from graspd_core.verify.compiled_overlap import (
    CompiledQuery,
    depth_in_hand,
    make_query,
    shared_volume,
    signed_distance,
)
from graspd_core.verify.hold_trial import place_hand, start_penetration
from graspd_core.verify.world import World, trial_data

# Postures that `arrival` tries: fraction of the closing motion, and distance back towards the pregrasp [m]. The hand
# may penetrate at most `_SUNK` [m], at the posture and at the fractions `_WAY_BACK` of the path to the pregrasp.
_CLOSED, _DRAWN_BACK, _SUNK, _WAY_BACK = (0.0, 0.25, 0.5, 0.75), (0.0, 0.001, 0.002, 0.003), 1e-5, (0.5, 1.0)
# Number of surface samples of hand and object, and their seed. The optimiser uses another seed.
_SAMPLES, _SEED = 4000, 20_000


@dataclass(frozen=True, eq=False)
class HandSurface:
    """Dense samples of a hand's collision surface, in link frames.

    Attributes:
        points: sample positions in the frame of their link [m].
        links: link index of each sample.
        areas: surface area that each sample represents [m²].
        order: int32 indices of the samples, sorted so that near samples follow each other.
    """

    points: Float[np.ndarray, "samples 3"]
    links: Int[np.ndarray, "samples"]
    areas: Float[np.ndarray, "samples"]
    order: Int[np.ndarray, "samples"]


@dataclass(frozen=True, eq=False)
class MetricsContext:
    """Precomputed data for measuring grasps of one object by one hand (`make_metrics_context`, `metrics.measure`).

    Attributes:
        query: the object's mesh, prepared for distance queries.
        points: points on the object's surface and edges [m].
        world: MuJoCo model of the hold trial. If it is None, the contact depth is not measured.
    """

    target: ObjectModel
    hand: HandModel
    surface: HandSurface
    query: CompiledQuery | DistanceQuery
    points: Float[np.ndarray, "points 3"]
    world: World | None = None


def make_metrics_context(target: ObjectModel, hand: HandModel) -> MetricsContext:
    """Sample hand and object and prepare distance queries, once for all grasps of this object by this hand."""
    creases = crease_points(target.mesh, _SAMPLES // 4, _SEED)
    points = np.concatenate([surface_samples(target.mesh, _SAMPLES, _SEED)[0], creases])
    query = make_query(target.mesh)
    return MetricsContext(target, hand, hand_surface(hand), query, points)


@lru_cache(maxsize=8)
def hand_surface(hand: HandModel) -> HandSurface:
    """Return dense samples of the hand's collision surface, and points on its edges, which may go deeper."""
    points, links, areas = samples_with_edges(hand, count=_SAMPLES, seed=_SEED)
    of_link = [np.flatnonzero(links == link) for link in range(hand.num_links)]
    order = np.concatenate([rows[neighbours_together(points[rows])] for rows in of_link]).astype(np.int32)
    return HandSurface(points, links, areas, order)


# A hand sample is in contact if it is at most this far from the object's surface, or inside the object [m].
CONTACT_DISTANCE = 0.002
# Distances above this are not exact, to save time [m]. No metric needs more than 10 mm (`contact_area_10mm`).
_REACH = 0.015


@dataclass(frozen=True, eq=False)
class PlacedHand:
    """Dense surface samples of a hand in the object frame.

    Attributes:
        points: sample positions [m].
        links: link index of each sample.
        areas: surface area that each sample represents [m²].
        distance: signed distance of each sample to the object [m]. Values above 15 mm are lower bounds.
        rotations: rotation `R_object_link` of each link.
        translations: origin of each link in the object frame [m].
    """

    points: Float[np.ndarray, "samples 3"]
    links: Int[np.ndarray, "samples"]
    areas: Float[np.ndarray, "samples"]
    distance: Float[np.ndarray, "samples"]
    rotations: Float[np.ndarray, "links 3 3"]
    translations: Float[np.ndarray, "links 3"]

    @property
    def poses(self) -> Float[np.ndarray, "links 12"]:
        """Poses of the links, as rows of 3 x 4 matrices."""
        return np.concatenate([self.rotations, self.translations[:, :, None]], -1).reshape(-1, 12)


def placed_hand(context: MetricsContext, posture: Posture) -> PlacedHand:
    """Return the hand's samples at a posture, with each sample's distance to the object."""
    surface = context.surface
    rotations, translations = link_poses(context.hand, posture.joint_positions)
    base = rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz, dtype=torch.float64)).numpy()
    rotations, translations = base @ rotations, translations @ base.T + posture.position
    placed = in_base((rotations, translations), surface.points, surface.links)
    distance = signed_distance(context.query, placed, order=surface.order, reach=_REACH)
    return PlacedHand(placed, surface.links, surface.areas, distance, rotations, translations)


def contact_area(placed: PlacedHand, within: float = CONTACT_DISTANCE) -> float:
    """Return the area [m²] of hand samples at most `within` [m] from the object's surface, with `within` ≤ 0.015."""
    return float(placed.areas[np.abs(placed.distance) <= within].sum())


def contact_links(placed: PlacedHand) -> int:
    """Count the links that touch the object (`CONTACT_DISTANCE`) or penetrate it."""
    return len(np.unique(placed.links[touching(placed)]))


def touching(placed: PlacedHand) -> Bool[np.ndarray, "samples"]:
    """Return for each sample whether it touches the object (`CONTACT_DISTANCE`) or is inside the object."""
    return placed.distance <= CONTACT_DISTANCE


# Width of the grid cells of the shared volume [m].
_CELL = 0.002


def penetration(context: MetricsContext, placed: PlacedHand) -> float:
    """Return the greatest depth of a hand sample inside the object, or of an object point inside a link [m]."""
    worst = float(max(0.0, -placed.distance.min()))
    if isinstance(context.query, CompiledQuery):
        return max(worst, depth_in_hand(context.query, context.hand, placed.poses, context.points))
    return max(worst, *(_depth_in_link(context, placed, link, context.points) for link in range(len(placed.rotations))))


def _depth_in_link(context: MetricsContext, placed: PlacedHand, link: int, points: Float[np.ndarray, "n 3"]) -> float:
    local = (points - placed.translations[link]) @ placed.rotations[link]
    return float(depth_inside(context.hand, link, local).max(initial=0.0))


def arrival(
    context: MetricsContext, grasp: Grasp, support: Plane | None, obstacles: Sequence[Obstacle] = ()
) -> Posture | None:
    """Return a posture near the grasp with open fingers and a collision-free path from the pregrasp.

    Some planners move the open hand to the grasp, then close the fingers. The open fingers may penetrate the object. So
    this function closes the fingers in part, or moves the hand back by at most 3 mm, or both. A small move has priority
    over open fingers. Return None if every tried posture collides with the object, the support or an obstacle.
    """
    open_joints, closing = grasp.pregrasp.joint_positions, grasp.grasp.joint_positions - grasp.pregrasp.joint_positions
    back = grasp.pregrasp.position - grasp.grasp.position
    length = float(np.linalg.norm(back))

    def gaps(placed: PlacedHand) -> Float[np.ndarray, "bodies"]:
        planes = [] if support is None else [(placed.points @ support.normal).min() - support.offset]
        fields = [sample_sdf(o.sdf, torch.as_tensor(placed.points).to(o.sdf.field))[0] for o in obstacles]
        return np.array([*planes, *(float(field.min()) for field in fields)])

    # Verified postures may be a little deep in an obstacle, whose hull is padded.
    low = np.minimum(*(gaps(placed_hand(context, posture)) for posture in (grasp.pregrasp, grasp.grasp))).clip(max=0)

    def moved(share: float, at: float) -> Posture:
        joints = open_joints + share * closing
        return replace(grasp.grasp, position=grasp.grasp.position + at * back, joint_positions=joints)

    def clear(posture: Posture) -> bool:
        placed = placed_hand(context, posture)
        return bool((gaps(placed) >= low - _SUNK).all()) and penetration(context, placed) <= _SUNK

    for drawn in (min(drawn / length, 1.0) if length else 0.0 for drawn in _DRAWN_BACK):
        for share in _CLOSED:
            if all(clear(moved(share, at)) for at in (drawn, *_WAY_BACK)):
                return moved(share, drawn)
    return None


def contact_depth(context: MetricsContext, posture: Posture) -> float | None:
    """Return the depth of MuJoCo's deepest contact of hand and object at a posture [m]. None without a world."""
    if context.world is None:
        return None
    with trial_data(context.world) as data:
        place_hand(context.world, data, posture)
        return start_penetration(context.world, data)


def self_penetration(context: MetricsContext, placed: PlacedHand) -> float:
    """Return the greatest depth of a hand sample inside a link that is not adjacent to the sample's link [m]."""
    hand = context.hand
    if isinstance(context.query, CompiledQuery):
        return depth_in_hand(context.query, hand, placed.poses, placed.points, placed.links)
    others = [placed.points[~hand.adjacent[link][placed.links]] for link in range(hand.num_links)]
    return max(_depth_in_link(context, placed, link, points) for link, points in enumerate(others))


def intersection_volume(context: MetricsContext, placed: PlacedHand) -> float:
    """Return the volume of the hand's part inside the object [m³], summed over 2 mm grid cells in the base frame.

    In each cell, hand and object count as two facing half-spaces. This is exact for flat overlaps of any thickness.
    Volume that several primitives share is counted once.
    """
    if isinstance(context.query, CompiledQuery):
        return shared_volume(context.query, context.hand, placed.poses, _CELL)
    found = [_cells_of(primitive, placed) for primitive in context.hand.primitives]
    cells, depth = (np.concatenate(parts) for parts in zip(*found, strict=True))
    _, first, same = np.unique(packed_rows(cells), return_index=True, return_inverse=True)
    deepest = np.full(len(first), -np.inf)
    np.maximum.at(deepest, same, depth)
    centers = (cells[first] + 0.5) * _CELL @ placed.rotations[0].T + placed.translations[0]
    depths = deepest, -signed_distance(context.query, centers, reach=_CELL)
    in_hand, in_object = (np.clip(0.5 + depth / _CELL, 0.0, 1.0) for depth in depths)
    return float(np.maximum(in_hand + in_object - 1.0, 0.0).sum()) * _CELL**3


def _cells_of(
    primitive: Primitive, placed: PlacedHand
) -> tuple[Int[np.ndarray, "cells 3"], Float[np.ndarray, "cells"]]:
    """Return the grid cells that a primitive may fill in part, and the depth of their centres inside it [m]."""
    low, high = bounds(primitive)
    rotation = placed.rotations[0].T @ placed.rotations[primitive.link]
    origin = (placed.translations[primitive.link] - placed.translations[0]) @ placed.rotations[0]
    center, reach = origin + rotation @ (low + high) / 2, np.abs(rotation) @ (high - low) / 2
    ends = np.floor((center - reach) / _CELL), np.ceil((center + reach) / _CELL)
    axes = [np.arange(start, end, dtype=np.int64) for start, end in zip(*ends, strict=True)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    local = torch.as_tensor(((cells + 0.5) * _CELL - origin) @ rotation)
    depth = -primitive_sdf(primitive, local).numpy()
    kept = depth > -_CELL / 2
    return cells[kept], depth[kept]


CONE_EDGES = 8
# Wrenches span no volume if their smallest extent is at most this fraction of their largest extent.
_FLAT = 1e-9

# Wrenches are perturbed by up to `_JOGGLE`, so that at most six wrenches lie on a facet. If the plane error of a
# compiled hull is `_PLANE_ERROR` or more, Qhull builds the hull again.
_JOGGLE, _PLANE_ERROR = 1e-9, 1e-9
# Greatest number of wrenches in a compiled hull, because the kernel stores wrench indices as bytes.
_MOST_WRENCHES = 256


@dataclass(frozen=True, eq=False)
class WrenchHull:
    """Grasp quality of Ferrari and Canny, from the convex hull of the wrenches of unit contact forces.

    Attributes:
        epsilon: radius of the largest ball about the origin inside the hull. 0 if the origin is outside.
        volume: volume of the hull.
        weakest_push: unit disturbance (force, torque over length) that the grasp resists least. It is the negative
            normal of the facet nearest to the origin. None if the origin is outside.
    """

    epsilon: float = 0.0
    volume: float = 0.0
    weakest_push: Float[np.ndarray, "6"] | None = None


def wrench_hull(
    arms: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], friction: float, length: float
) -> WrenchHull:
    """Return the grasp quality of a set of contacts.

    Args:
        arms: contact points relative to the centre of mass [m].
        normals: outward unit normals of the object.
        friction: Coulomb coefficient.
        length: length by which torques are divided: the object's largest radius [m].
    """
    if len(arms) < 2:
        return WrenchHull()
    wrenches = cone_wrenches(arms, normals, friction, length)
    extent = np.linalg.svd(wrenches - wrenches.mean(0), compute_uv=False)
    if extent[-1] <= _FLAT * extent[0]:
        return WrenchHull()
    offset, normal, volume = compiled_hull(wrenches) or qhull(wrenches)
    return WrenchHull(offset, volume, -normal) if offset > 0 else WrenchHull(volume=volume)


# Distance from the origin to the nearest facet, outward normal of that facet, and volume of the hull.
Hull = tuple[float, Float[np.ndarray, "6"], float]


def compiled_hull(wrenches: Float[np.ndarray, "n 6"]) -> Hull | None:
    """Build the convex hull of wrenches with the kernel. None without a kernel, above 256 wrenches, or on failure."""
    library = kernel().library
    if library is None or len(wrenches) > _MOST_WRENCHES:
        return None
    joggle = np.random.default_rng(0).uniform(-_JOGGLE, _JOGGLE, wrenches.shape)
    points, found = np.ascontiguousarray(wrenches + joggle), np.empty(9)
    failed = library.graspd_wrench_hull(len(points), points.ctypes.data, found.ctypes.data)
    return None if failed or not found[8] < _PLANE_ERROR else (float(found[0]), found[1:7], float(found[7]))


def qhull(wrenches: Float[np.ndarray, "n 6"]) -> Hull:
    """Build the convex hull of wrenches with Qhull."""
    from scipy.spatial import ConvexHull

    # QJ perturbs the input. The result is deterministic, and QJ takes half the time of Qhull's merging of facets.
    hull = ConvexHull(wrenches, qhull_options="QJ")
    nearest = hull.equations[:, -1].argmax()
    return -float(hull.equations[nearest, -1]), hull.equations[nearest, :-1], float(hull.volume)


def cone_wrenches(
    arms: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], friction: float, length: float
) -> Float[np.ndarray, "wrenches 6"]:
    """Return the wrenches (force, torque over length) of unit forces on the edges of each contact's friction cone."""
    reference = np.eye(3)[np.abs(normals).argmin(-1)]
    first = np.cross(normals, reference)
    first /= np.maximum(np.linalg.norm(first, axis=-1, keepdims=True), 1e-12)
    second = np.cross(normals, first)
    angles = np.arange(CONE_EDGES) * 2 * np.pi / CONE_EDGES
    tangents = np.cos(angles)[:, None] * first[:, None] + np.sin(angles)[:, None] * second[:, None]
    forces = (-normals[:, None] + friction * tangents) / np.sqrt(1 + friction**2)
    torques = np.cross(arms[:, None], forces) / length
    return np.concatenate([forces, torques], -1).reshape(-1, 6)


# Greatest number of contacts in the wrench hull. A hull of 32 contacts has some 22,000 facets. It takes five times as
# long and raises ε by a tenth (docs/metrics.md).
MAX_CONTACTS = 16
# Step of the central differences in `surface_normals` [m].
_STEP = 2e-4


@dataclass(frozen=True, eq=False)
class PreparedGrasp:
    """A hand at a grasp, with the quantities that several metrics need."""

    context: MetricsContext
    posture: Posture
    max_contacts: int = MAX_CONTACTS

    @cached_property
    def placed(self) -> PlacedHand:
        """Samples of the hand at the posture, with each sample's distance to the object."""
        return placed_hand(self.context, self.posture)

    @cached_property
    def wrench_hull(self) -> WrenchHull:
        """Grasp quality of at most `max_contacts` contacts. Torques are divided by the object's radius."""
        target, points = self.context.target, self.placed.points[touching(self.placed)]
        chosen = points[farthest_points(points, self.max_contacts)]
        normals = surface_normals(self.context.query, chosen)
        return wrench_hull(chosen - target.center_of_mass, normals, target.friction, target.radius)

    @cached_property
    def shared_volume(self) -> float:
        """Volume of the hand's part inside the object [m³]."""
        return intersection_volume(self.context, self.placed)


def surface_normals(query: CompiledQuery | DistanceQuery, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return outward unit normals of the object's surface near points, by central differences of the distance."""
    probes = points[:, None, None] + _STEP * np.stack([np.eye(3), -np.eye(3)])
    distance = signed_distance(query, probes.reshape(-1, 3)).reshape(len(points), 2, 3)
    gradient = distance[:, 0] - distance[:, 1]
    return gradient / np.maximum(np.linalg.norm(gradient, axis=-1, keepdims=True), 1e-12)
