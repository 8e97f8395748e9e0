"""One grasp ready to be measured: what several metrics need is computed once.

Dense samples of the hand, which no optimiser ever sees, tell where it touches the object, and how far it reaches into
the object or into itself. The wrench space of unit contact forces gives the quality figures of Ferrari and Canny (ICRA
1992).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from graspd_core.hands.kinematics import Kinematics, forward, make_kinematics
from graspd_core.hands.link_distance import (
    CollisionTensors,
    bounds,
    depth_inside,
    hull_planes,
    local_distance,
    make_collision_tensors,
)
from graspd_core.hands.model import HandModel, Primitive
from graspd_core.hands.surface_points import kept_dense_samples
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.sharp_features import crease_points, farthest_points
from graspd_core.mesh.surface_queries import (
    DistanceQuery,
    inside,
    make_distance_query,
    signed_distance,
    unsigned_distance,
)
from graspd_core.mesh.topology import packed_rows
from graspd_core.optimize.kernel.builds import kernel
from graspd_core.perception.scene import ObjectModel
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import Grasp, Plane, Posture
from graspd_core.verify.hold_trial import place_hand, start_penetration
from graspd_core.verify.world import World, trial_data

# Where a hand may wait that closes only after it has arrived: how far it is closed, and how far it is drawn back to the
# pregrasp [m]. Where it sinks in by more than `_SUNK` [m], there or at these shares of the way back, it may not.
_CLOSED, _DRAWN_BACK, _SUNK, _WAY_BACK = (0.0, 0.25, 0.5, 0.75), (0.0, 0.001, 0.002, 0.003), 1e-5, (0.5, 1.0)
# Samples and a seed that the optimiser's candidates never see.
_SAMPLES, _SEED = 4000, 20_000


@dataclass(frozen=True, eq=False)
class HandSurface:
    """Dense samples of a hand's collision surface, link frames.

    Attributes:
        points: [m].
        links: link of each sample.
        areas: surface that each sample stands for [m²].
        kinematics: float64.
    """

    points: Float[np.ndarray, "samples 3"]
    links: Int[np.ndarray, "samples"]
    areas: Float[np.ndarray, "samples"]
    kinematics: Kinematics


@dataclass(frozen=True, eq=False)
class MetricsContext:
    """An object and a hand, ready to measure grasps: build with `make_metrics_context`, ask with `metrics.measure`.

    Attributes:
        points: of the object's surface and edges [m].
        tree: of these points, a `scipy.spatial.KDTree`.
        world: of the hold trial. None where there is none, and then no contact depth is measured.
    """

    target: ObjectModel
    hand: HandModel
    surface: HandSurface
    query: DistanceQuery
    points: Float[np.ndarray, "points 3"]
    tree: Any
    world: World | None = None


def make_metrics_context(target: ObjectModel, hand: HandModel) -> MetricsContext:
    """Sample the hand and prepare the object's distance, once for all grasps of that object by that hand."""
    from scipy.spatial import KDTree

    creases = crease_points(target.mesh, _SAMPLES // 4, _SEED)
    points = np.concatenate([surface_samples(target.mesh, _SAMPLES, _SEED)[0], creases])
    query = make_distance_query(target.mesh)
    return MetricsContext(target, hand, hand_surface(hand), query, points, KDTree(points))


@lru_cache(maxsize=8)
def hand_surface(hand: HandModel) -> HandSurface:
    """Dense samples of a hand."""
    points, links, areas = kept_dense_samples(hand, count=_SAMPLES, seed=_SEED)
    return HandSurface(points, links, areas, make_kinematics(hand, "cpu", torch.float64))


# Hand surface nearer than this to the object's is in contact [m].
CONTACT_DISTANCE = 0.002
# Samples farther than this from the object's bounding box have no exact distance [m]; the widest contact is 10 mm.
_REACH = 0.015


@dataclass(frozen=True, eq=False)
class PlacedHand:
    """Dense surface samples of a hand in the object frame.

    Attributes:
        points: [m].
        links: link of each sample.
        areas: surface that each sample stands for [m²].
        distance: signed distance of each sample to the object [m], a lower bound beyond 15 mm.
        rotations: `R_object_link`.
        translations: link origins in the object frame [m].
    """

    points: Float[np.ndarray, "samples 3"]
    links: Int[np.ndarray, "samples"]
    areas: Float[np.ndarray, "samples"]
    distance: Float[np.ndarray, "samples"]
    rotations: Float[np.ndarray, "links 3 3"]
    translations: Float[np.ndarray, "links 3"]


def placed_hand(context: MetricsContext, posture: Posture) -> PlacedHand:
    """Put the hand's samples where a posture puts them, and measure every sample's distance to the object."""
    surface = context.surface
    joints = torch.as_tensor(posture.joint_positions, dtype=torch.float64)[None]
    links = forward(surface.kinematics, joints)[0]
    base = rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz, dtype=torch.float64)).numpy()
    rotations = base @ links.rotation.numpy()
    translations = links.translation.numpy() @ base.T + posture.position
    placed = np.einsum("nij,nj->ni", rotations[surface.links], surface.points) + translations[surface.links]
    distance = signed_distance(context.query, placed, reach=_REACH)
    return PlacedHand(placed, surface.links, surface.areas, distance, rotations, translations)


def contact_area(placed: PlacedHand, within: float = CONTACT_DISTANCE) -> float:
    """Measure the hand's surface within a distance of the object's, of at most 15 mm, on either side of it [m²]."""
    return float(placed.areas[np.abs(placed.distance) <= within].sum())


def contact_links(placed: PlacedHand, within: float = CONTACT_DISTANCE) -> int:
    """Count the links that come within a distance of the object, penetrating ones included."""
    return len(np.unique(placed.links[touching(placed, within)]))


def touching(placed: PlacedHand, within: float = CONTACT_DISTANCE) -> Bool[np.ndarray, "samples"]:
    """Tell which samples count as contacts."""
    return placed.distance <= within


# Cells are halved until they are 2 mm wide: 16 mm, 8, 4, 2. Lengths of cells are counted in the smallest.
_CELL, _HALVINGS = 0.002, 3
# Half the diagonal of a cube of side 1, with room for rounding.
_HALF_DIAGONAL = 0.5 * np.sqrt(3.0) * 1.001


def penetration(context: MetricsContext, placed: PlacedHand) -> float:
    """Return the greatest depth of a hand sample inside the object, or of a point of the object inside a link [m]."""
    worst = float(max(0.0, -placed.distance.min()))
    centers, radii = _link_balls(context.hand)
    centers = np.einsum("nij,nj->ni", placed.rotations, centers) + placed.translations
    for link, near in enumerate(context.tree.query_ball_point(centers, radii)):
        local = (context.points[near] - placed.translations[link]) @ placed.rotations[link]
        worst = max(worst, float(depth_inside(context.hand, link, local).max(initial=0.0)))
    return worst


@lru_cache(maxsize=8)
def _link_balls(hand: HandModel) -> tuple[Float[np.ndarray, "links 3"], Float[np.ndarray, "links"]]:
    """Return centers, in link frames, and radii of balls about the solids of each link [m]. A bare link's are zero."""
    centers, radii = np.zeros((hand.num_links, 3)), np.zeros(hand.num_links)
    for link, primitives in enumerate(hand.primitives_of):
        if primitives:
            low, high = zip(*map(bounds, primitives), strict=True)
            low, high = np.min(low, axis=0), np.max(high, axis=0)
            centers[link], radii[link] = (low + high) / 2, np.linalg.norm(high - low) / 2
    return centers, radii


def arrival(context: MetricsContext, grasp: Grasp, support: Plane | None) -> Posture | None:
    """Return an open posture at the grasp whose straight way from the pregrasp is clear of object and support.

    graspd's trial closes the fingers on the way. Some planners do so only after the hand has arrived, where fingers as
    open as the pregrasp's may be in the object. The hand is closed in part, else drawn back by at most 3 mm. None:
    neither helps.
    """
    open_joints, closing = grasp.pregrasp.joint_positions, grasp.grasp.joint_positions - grasp.pregrasp.joint_positions
    back = grasp.pregrasp.position - grasp.grasp.position
    length = float(np.linalg.norm(back))

    def height(placed: PlacedHand) -> float:
        return 0.0 if support is None else float((placed.points @ support.normal).min()) - support.offset

    low = min(0.0, *(height(placed_hand(context, posture)) for posture in (grasp.pregrasp, grasp.grasp)))

    def clear(share: float, at: float) -> bool:
        joints = open_joints + share * closing
        posture = replace(grasp.grasp, position=grasp.grasp.position + at * back, joint_positions=joints)
        placed = placed_hand(context, posture)
        return height(placed) >= low - _SUNK and penetration(context, placed) <= _SUNK

    for drawn in (min(drawn / length, 1.0) if length else 0.0 for drawn in _DRAWN_BACK):
        for share in _CLOSED:
            if clear(share, drawn) and all(clear(share, part) for part in _WAY_BACK):
                joints = open_joints + share * closing
                return replace(grasp.grasp, position=grasp.grasp.position + drawn * back, joint_positions=joints)
    return None


def contact_depth(context: MetricsContext, posture: Posture) -> float | None:
    """MuJoCo's deepest contact of hand and object at a posture [m], or None without a world."""
    if context.world is None:
        return None
    with trial_data(context.world) as data:
        place_hand(context.world, data, posture)
        return start_penetration(context.world, data)


def self_penetration(context: MetricsContext, placed: PlacedHand) -> float:
    """Return the greatest depth of a hand sample inside a link that is not adjacent to its own [m]."""
    hand, worst = context.hand, 0.0
    centers, radii = _link_balls(hand)
    centers = np.einsum("nij,nj->ni", placed.rotations, centers) + placed.translations
    apart = np.linalg.norm(centers[:, None] - centers, axis=-1) - radii[:, None] - radii
    # Samples of a link lie on its solids, so that links whose balls are apart cannot meet.
    meet = (apart < 0) & ~hand.adjacent
    for link in np.flatnonzero(meet.any(1)).tolist():
        others = placed.points[meet[link][placed.links]]
        others = others[np.linalg.norm(others - centers[link], axis=1) < radii[link]]
        local = (others - placed.translations[link]) @ placed.rotations[link]
        worst = max(worst, float(depth_inside(hand, link, local).max(initial=0.0)))
    return worst


def intersection_volume(context: MetricsContext, placed: PlacedHand) -> float:
    """Return the volume of the hand inside the object [m³], summed over 2 mm cells of a lattice in the base frame.

    An octree of each solid finds the cells, so no overlap is too small or too thin to be visited. A cell counts by the
    thickness of what hand and object share in it, as of two flat faces that meet: exact for a flat overlap of any
    thickness. What solids share is counted once.
    """
    solids = _placed_solids(context.hand, placed)
    cells, which = _root_cells(solids, placed)
    size = 2**_HALVINGS
    while len(cells):
        half_diagonal = _HALF_DIAGONAL * size * _CELL
        centers = (cells + 0.5 * size) * _CELL @ placed.rotations[0].T + placed.translations[0]
        kept = _near_box(context.query, centers, half_diagonal)
        cells, which, centers = cells[kept], which[kept], centers[kept]
        depth = -_solid_distance(solids, which, centers)
        kept = depth > -half_diagonal
        cells, which, centers, depth = cells[kept], which[kept], centers[kept], depth[kept]
        # Solids overlap, and share cells.
        _, first, same = np.unique(packed_rows(cells), return_index=True, return_inverse=True)
        if size == 1:
            deepest = np.full(len(first), -np.inf)
            np.maximum.at(deepest, same, depth)
            depths = deepest, -signed_distance(context.query, centers[first])
            in_hand, in_object = (np.clip(0.5 + depth / _CELL, 0.0, 1.0) for depth in depths)
            return float(np.maximum(in_hand + in_object - 1.0, 0.0).sum()) * _CELL**3
        kept = unsigned_distance(context.query, centers[first]) < half_diagonal
        kept[~kept] = inside(context.query, centers[first[~kept]])
        kept = kept[same]
        size //= 2
        cells, which = _halve(cells[kept], size), np.repeat(which[kept], 8)
    return 0.0


def _near_box(query: DistanceQuery, points: Float[np.ndarray, "n 3"], margin: float) -> Bool[np.ndarray, "n"]:
    return np.all((points > query.tree.low - margin) & (points < query.tree.high + margin), axis=1)


@dataclass(frozen=True, eq=False)
class _PlacedSolids:
    """The collision primitives of a hand at its grasp, hulls last.

    Attributes:
        primitives: those of the hand.
        rotations: `R_object_primitive`.
        translations: primitive origins in the object frame [m].
        smooth: those that are no hulls, for distances.
    """

    primitives: tuple[Primitive, ...]
    rotations: Float[np.ndarray, "solids 3 3"]
    translations: Float[np.ndarray, "solids 3"]
    smooth: CollisionTensors


def _placed_solids(hand: HandModel, placed: PlacedHand) -> _PlacedSolids:
    primitives = tuple(sorted(hand.primitives, key=lambda primitive: primitive.kind == "hull"))
    rotations = np.array([placed.rotations[p.link] @ p.rotation for p in primitives]).reshape(-1, 3, 3)
    origins = [placed.rotations[p.link] @ p.translation + placed.translations[p.link] for p in primitives]
    smooth = make_collision_tensors(hand, "cpu", torch.float64)
    return _PlacedSolids(primitives, rotations, np.reshape(origins, (-1, 3)), smooth)


def _root_cells(
    solids: _PlacedSolids, placed: PlacedHand
) -> tuple[Int[np.ndarray, "cells 3"], Int[np.ndarray, "cells"]]:
    """Return the coarsest cells over the boxes of all solids, base frame, and the solid of each, rising."""
    size, base, cells = 2**_HALVINGS, placed.rotations[0], [np.zeros((0, 3), dtype=np.int64)]
    for primitive in solids.primitives:
        low, high = bounds(primitive)
        rotation = base.T @ placed.rotations[primitive.link]
        center = (placed.translations[primitive.link] - placed.translations[0]) @ base + rotation @ (low + high) / 2
        reach = np.abs(rotation) @ (high - low) / 2
        ends = np.floor((center - reach) / (size * _CELL)), np.ceil((center + reach) / (size * _CELL))
        cells.append(size * _lattice(*(end.astype(np.int64) for end in ends)))
    return np.concatenate(cells), np.repeat(np.arange(len(solids.primitives)), [len(some) for some in cells[1:]])


def _solid_distance(
    solids: _PlacedSolids, which: Int[np.ndarray, "n"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n"]:
    """Measure how far each point of the object frame is from one solid [m], `which` rising. At least that of hulls."""
    local = np.einsum("nji,nj->ni", solids.rotations[which], points - solids.translations[which])
    hulls = int(np.searchsorted(which, len(solids.smooth.link)))
    smooth = local_distance(solids.smooth, torch.as_tensor(local[:hulls]), torch.as_tensor(which[:hulls])).numpy()
    parts = [smooth]
    for hull in np.unique(which[hulls:]):
        normals, offsets = hull_planes(solids.primitives[hull])
        parts.append((local[which == hull] @ normals.T - offsets).max(1))
    return np.concatenate(parts)


def _halve(cells: Int[np.ndarray, "cells 3"], size: int) -> Int[np.ndarray, "children 3"]:
    return (cells[:, None] + size * _lattice(np.zeros(3, dtype=int), np.full(3, 2))).reshape(-1, 3)


def _lattice(low: Int[np.ndarray, "3"], high: Int[np.ndarray, "3"]) -> Int[np.ndarray, "n 3"]:
    return np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), -1).reshape(-1, 3)


CONE_EDGES = 8
# A set of wrenches whose smallest extent is below this share of its largest spans no volume.
_FLAT = 1e-9


# Wrenches are moved by up to this, so that no more than six lie on a facet. A compiled hull whose planes are farther
# off than the second number is built again by Qhull.
_JOGGLE, _PLANE_ERROR = 1e-9, 1e-9
# The compiled hull numbers wrenches by bytes.
_MOST_WRENCHES = 256


@dataclass(frozen=True, eq=False)
class WrenchHull:
    """The convex hull of unit-force friction-cone wrenches, quality figures of Ferrari and Canny.

    Attributes:
        epsilon: radius of the largest ball about the origin in the hull, 0 where the origin is outside.
        volume: of the hull.
        weakest_push: the unit disturbance (force, torque over length) that is resisted least, against the nearest
            facet. None where the origin is outside.
    """

    epsilon: float = 0.0
    volume: float = 0.0
    weakest_push: Float[np.ndarray, "6"] | None = None


def wrench_hull(
    arms: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], friction: float, length: float
) -> WrenchHull:
    """Return the hull of the wrenches of contacts.

    Args:
        arms: contact points about the centre of mass [m].
        normals: outward unit normals of the object.
        friction: Coulomb coefficient.
        length: torque scale, the object's largest radius [m].
    """
    if len(arms) < 2:
        return WrenchHull()
    wrenches = cone_wrenches(arms, normals, friction, length)
    extent = np.linalg.svd(wrenches - wrenches.mean(0), compute_uv=False)
    if extent[-1] <= _FLAT * extent[0]:
        return WrenchHull()
    offset, normal, volume = compiled_hull(wrenches) or qhull(wrenches)
    return WrenchHull(offset, volume, -normal) if offset > 0 else WrenchHull(volume=volume)


# Distance from the origin and outward normal of the nearest facet, and volume.
Hull = tuple[float, Float[np.ndarray, "6"], float]


def compiled_hull(wrenches: Float[np.ndarray, "n 6"]) -> Hull | None:
    """Return the hull by the compiled kernel, or None where there is no kernel or it fails."""
    library = kernel().library
    if library is None or len(wrenches) > _MOST_WRENCHES:
        return None
    joggle = np.random.default_rng(0).uniform(-_JOGGLE, _JOGGLE, wrenches.shape)
    points, found = np.ascontiguousarray(wrenches + joggle), np.empty(9)
    failed = library.graspd_wrench_hull(len(points), points.ctypes.data, found.ctypes.data)
    return None if failed or not found[8] < _PLANE_ERROR else (float(found[0]), found[1:7], float(found[7]))


def qhull(wrenches: Float[np.ndarray, "n 6"]) -> Hull:
    """Return the hull by Qhull."""
    from scipy.spatial import ConvexHull

    # Joggled: takes half the time of merging facets, and is the same every time.
    hull = ConvexHull(wrenches, qhull_options="QJ")
    nearest = hull.equations[:, -1].argmax()
    return -float(hull.equations[nearest, -1]), hull.equations[nearest, :-1], float(hull.volume)


def cone_wrenches(
    arms: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], friction: float, length: float
) -> Float[np.ndarray, "wrenches 6"]:
    """Wrenches (force, torque over length) of unit forces along the edges of each contact's friction cone."""
    reference = np.eye(3)[np.abs(normals).argmin(-1)]
    first = np.cross(normals, reference)
    first /= np.maximum(np.linalg.norm(first, axis=-1, keepdims=True), 1e-12)
    second = np.cross(normals, first)
    angles = np.arange(CONE_EDGES) * 2 * np.pi / CONE_EDGES
    tangents = np.cos(angles)[:, None] * first[:, None] + np.sin(angles)[:, None] * second[:, None]
    forces = (-normals[:, None] + friction * tangents) / np.sqrt(1 + friction**2)
    torques = np.cross(arms[:, None], forces) / length
    return np.concatenate([forces, torques], -1).reshape(-1, 6)


# Contacts that the wrench hull is made of. The protocol allows 32, whose hull in six dimensions has some 22,000 facets
# and takes five times as long; that raises ε by a tenth (docs/metrics.md). Benchmarks ask for 32, planning does not.
MAX_CONTACTS, PROTOCOL_CONTACTS = 16, 32
# Half the distance of a central difference [m].
_STEP = 2e-4


@dataclass(frozen=True, eq=False)
class PreparedGrasp:
    """A hand at its grasp, about to be measured.

    Attributes:
        context: the object and the hand.
        posture: of the hand.
        placed: the hand's samples in the object frame.
        max_contacts: contacts that the wrench hull is made of at most.
    """

    context: MetricsContext
    posture: Posture
    placed: PlacedHand
    max_contacts: int

    @cached_property
    def wrench_hull(self) -> WrenchHull:
        """Hull of the wrenches of at most `max_contacts` contacts, torques over the object's radius."""
        target, points = self.context.target, self.placed.points[touching(self.placed)]
        chosen = points[farthest_points(points, self.max_contacts)]
        normals = surface_normals(self.context.query, chosen)
        return wrench_hull(chosen - target.center_of_mass, normals, target.friction, target.radius)

    @cached_property
    def shared_volume(self) -> float:
        """Volume of the hand inside the object [m³]."""
        return intersection_volume(self.context, self.placed)


def prepare_grasp(context: MetricsContext, posture: Posture, max_contacts: int = MAX_CONTACTS) -> PreparedGrasp:
    """Put the hand at a posture."""
    return PreparedGrasp(context, posture, placed_hand(context, posture), max_contacts)


def surface_normals(query: DistanceQuery, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Outward unit normals of the object's surface next to points, by central differences of the exact distance."""
    probes = points[:, None, None] + _STEP * np.stack([np.eye(3), -np.eye(3)])
    distance = signed_distance(query, probes.reshape(-1, 3)).reshape(len(points), 2, 3)
    gradient = distance[:, 0] - distance[:, 1]
    return gradient / np.maximum(np.linalg.norm(gradient, axis=-1, keepdims=True), 1e-12)
