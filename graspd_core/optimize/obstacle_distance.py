"""Measure the hand's distance from the support plane and from the obstacles around the object.

The hand's primitives are convex. So a primitive is clear of the support if all its extreme points are clear: corners of
boxes and hulls, centres of spheres, ends of capsules, rim points of cylinders. Obstacles are also tested against the
collision spheres (`hands.self_collision`), which extend a little out of flat faces. Gradients are exact, except for the
interpolated distance to obstacles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from graspd_core.hands.kinematics import (
    RETREAT,
    Kinematics,
    drawn_back,
    forward,
    in_base,
    link_poses,
    place_points,
    placement,
)
from graspd_core.hands.model import HandModel, Primitive
from graspd_core.hands.self_collision import collision_spheres
from graspd_core.hands.surface_points import outermost
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.sdf import GridSDF, sample_sdf
from graspd_core.optimize.loop import Poses, Values
from graspd_core.perception.scene import Scene
from graspd_core.se3 import SE3, rotation_from_quaternion

# The hand is tested at these fractions of the path from pregrasp back to retreat, and from grasp back to pregrasp.
RETREAT_SHARES = (0.15, 0.3, 0.5, 0.75, 1.0)
_PATH_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
# Gaps of at least this make no difference to the optimiser [m].
WIDE = 0.005
# Number of points for each rim of a cylinder, greatest number for a hull, and number for the object's surface.
_RIM, _HULL, _SURFACE = 12, 32, 1000


@dataclass(frozen=True, eq=False)
class ObstacleTensors:
    """Support and obstacles, and the points of the hand that are tested against them.

    Attributes:
        normal: unit normal of the support, towards the free side. None without a support.
        offset: n·x on the support, raised by the margin of the support [m]. 0 without a support.
        sdfs: signed distance fields of the obstacles within the hand's reach.
        approach: unit direction in which the hand moves to its pregrasp, base frame.
        points, radii, links: centre in the link frame [m], radius [m] and link of each sphere: first the spheres about
            the extreme points of the hand's primitives (radius 0 about a corner), then the collision spheres.
        corners: number of spheres about extreme points.
        matrix: matrix from which `place_points` computes the centres of the spheres.
        around: for each link, a sphere that encloses all spheres of the link: centre in the link frame and radius [m].
    """

    normal: Float[Tensor, "3"] | None
    offset: float
    sdfs: tuple[GridSDF, ...]
    approach: Float[Tensor, "3"]
    points: Float[Tensor, "balls 3"]
    radii: Float[Tensor, "balls"]
    links: Int[Tensor, "balls"]
    corners: int
    matrix: Float[Tensor, "balls columns"]
    around: tuple[Float[Tensor, "links 3"], Float[Tensor, "links"]]


@lru_cache(maxsize=8)
def make_obstacle_tensors(
    scene: Scene, hand: HandModel, device: torch.device | str, dtype: torch.dtype
) -> ObstacleTensors | None:
    """Return the support and the obstacles that this hand can reach, None if there are none. Results are cached."""
    # The vertices alone are not enough, because an obstacle may be near the middle of a large face.
    samples = surface_samples(scene.object.mesh, _SURFACE, 0)[0]
    surface = torch.as_tensor(np.concatenate([scene.object.mesh.vertices, samples]))
    gaps = [float(sample_sdf(solid.sdf, surface.to(solid.sdf.field))[0].min()) for solid in scene.obstacles]
    # Fingertips may touch the object while the palm is between them and the farthest part of the hand.
    reach = 2 * hand_reach(hand) + RETREAT
    reached = [solid for solid, gap in zip(scene.obstacles, gaps, strict=True) if gap < reach]
    if scene.support is None and not reached:
        return None
    tensor = partial(torch.as_tensor, device=device, dtype=dtype)
    corners = extreme_points(hand)
    points, radii, links = map(np.concatenate, zip(corners, collision_spheres(hand), strict=True))
    around = _balls_about(hand.num_links, points, radii, links)
    centers, owners = tensor(points), torch.as_tensor(links, device=device, dtype=torch.long)
    return ObstacleTensors(
        normal=None if scene.support is None else tensor(scene.support.normal),
        offset=0.0 if scene.support is None else scene.support.offset + scene.support.margin,
        sdfs=tuple(n.sdf.to(device, dtype) for n in reached),
        approach=tensor(hand.approach),
        points=centers,
        radii=tensor(radii),
        links=owners,
        corners=len(corners[0]),
        matrix=placement(hand.num_links, centers, owners),
        around=(tensor(around[:, :3]), tensor(around[:, 3])),
    )


def _balls_about(count: int, points: np.ndarray, radii: np.ndarray, links: np.ndarray) -> Float[np.ndarray, "links 4"]:
    """Return centre and radius of a sphere around all spheres of each link [m]. The radius is −inf without spheres."""
    around = np.zeros((count, 4))
    around[:, 3] = -np.inf
    for link in np.unique(links):
        own = points[links == link]
        around[link, :3] = 0.5 * (own.min(0) + own.max(0))
        around[link, 3] = (np.linalg.norm(own - around[link, :3], axis=1) + radii[links == link]).max()
    return around


def hand_reach(hand: HandModel) -> float:
    """Return the distance from the middle of the palm to the farthest point of the open hand [m]."""
    corners, radii, links = extreme_points(hand)
    placed = in_base(link_poses(hand, hand.open_posture), corners, links)
    return float((np.linalg.norm(placed - hand.palm_center, axis=1) + radii).max())


def extreme_points(hand: HandModel) -> tuple[Float[np.ndarray, "corners 3"], Float[np.ndarray, "corners"], np.ndarray]:
    """Join the spheres of `extreme_points_of_solids` into arrays: centres in link frames [m], radii [m] and links."""
    solids = extreme_points_of_solids(hand)
    points, radii, links = zip(*((p, np.full(len(p), r), np.full(len(p), link)) for p, r, link in solids), strict=True)
    return np.concatenate(points), np.concatenate(radii), np.concatenate(links)


def extreme_points_of_solids(hand: HandModel) -> list[tuple[Float[np.ndarray, "n 3"], float, int]]:
    """Return for each primitive spheres with the primitive as convex hull: centres in link frame, radius [m], link."""
    found = ((*_extremes(primitive), primitive) for primitive in hand.primitives)
    return [(at @ solid.rotation.T + solid.translation, radius, solid.link) for at, radius, solid in found]


def _extremes(primitive: Primitive) -> tuple[Float[np.ndarray, "n 3"], float]:
    size = primitive.size
    if primitive.kind == "sphere":
        return np.zeros((1, 3)), size[0]
    if primitive.kind == "capsule":
        return np.array([[0.0, 0.0, size[1]], [0.0, 0.0, -size[1]]]), size[0]
    if primitive.kind == "box":
        return np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), -1).reshape(-1, 3) * np.asarray(size), 0.0
    if primitive.kind == "cylinder":
        turn = 2 * np.pi * np.arange(_RIM) / _RIM
        rim = size[0] * np.column_stack([np.cos(turn), np.sin(turn)])
        return np.vstack([np.column_stack([rim, np.full(_RIM, s * size[1])]) for s in (1, -1)]), 0.0
    corners = primitive.vertices
    return outermost(corners, _HULL) if len(corners) > _HULL else corners, 0.0


def obstacle_gaps(obstacles: ObstacleTensors, base: SE3, links: SE3) -> Float[Tensor, "batch gaps"]:
    """Return signed distances [m] of the hand's spheres to support and obstacles. `links` are poses in the base frame.

    Distances are negative inside. A distance of at least `WIDE` may be returned as `WIDE`.
    """
    gaps = [] if obstacles.normal is None else [_support_gaps(obstacles, obstacles.normal, base, links)]
    if obstacles.sdfs:
        points = base.apply(place_points(obstacles.matrix, links))
        gaps += [_gaps_to(sdf, points, obstacles.radii, WIDE) for sdf in obstacles.sdfs]
    return torch.cat(gaps, -1)


def _support_gaps(
    obstacles: ObstacleTensors, normal: Float[Tensor, "3"], base: SE3, links: SE3
) -> Float[Tensor, "batch corners"]:
    corners = base.apply(place_points(obstacles.matrix[: obstacles.corners], links))
    return corners @ normal - obstacles.offset - obstacles.radii[: obstacles.corners]


@torch.no_grad()
def least_gap(obstacles: ObstacleTensors, base: SE3, links: SE3, wide: float = WIDE) -> Values:
    """Return the least of `obstacle_gaps` of each hand [m].

    Obstacles beyond `wide` are ignored. Only links near an obstacle's grid are tested: in a bin, a tenth of all links.
    """
    least = base.translation.new_full(base.translation.shape[:1], wide)
    if obstacles.normal is not None:
        least = _support_gaps(obstacles, obstacles.normal, base, links).amin(-1)
    if obstacles.sdfs:
        points = base.apply(place_points(obstacles.matrix, links))
        middle, reach = obstacles.around
        middle = base.apply((links.rotation @ middle[..., None]).squeeze(-1) + links.translation)
    for sdf in obstacles.sdfs:
        off_grid = (middle - (sdf.origin + sdf.half)).abs() - sdf.half
        touched = torch.lt(off_grid, reach.add(wide).unsqueeze(1)).all(-1)
        row, ball = touched[:, obstacles.links].nonzero(as_tuple=True)
        gaps = _gaps_to(sdf, points[row, ball], obstacles.radii[ball], wide)
        least = least.scatter_reduce(0, row, gaps, "amin")
    return least


def _gaps_to(
    sdf: GridSDF, points: Float[Tensor, "*batch 3"], radii: Float[Tensor, "points"], wide: float
) -> Float[Tensor, "*batch"]:
    """Return the gaps of spheres to one obstacle [m]. Only spheres near the grid are sampled. Others get `wide`."""
    off_grid = (points.detach() - (sdf.origin + sdf.half)).abs() - sdf.half
    near = (off_grid < (radii + wide)[:, None]).all(-1)
    gaps = points.new_full(near.shape, wide)
    if bool(near.any()):
        gaps[near] = sample_sdf(sdf, points[near])[0] - radii.expand(near.shape)[near]
    return gaps


@torch.no_grad()
def gap_on_path(
    obstacles: ObstacleTensors, kinematics: Kinematics, pregrasp: Poses, grasp: Poses, wide: float = WIDE
) -> Values:
    """Return the hand's least signed distance [m] to obstacles on the path from retreat via pregrasp to grasp.

    Distances are negative inside, and may be cut at `wide`. The base must have the same orientation in both poses.
    """
    rotation = rotation_from_quaternion(grasp.quaternion)
    begun = [drawn_back(pregrasp.translation, rotation, obstacles.approach, RETREAT * s) for s in RETREAT_SHARES]
    between = lambda before, after: [a * before + (1 - a) * after for a in _PATH_SHARES]  # noqa: E731
    places = begun + between(pregrasp.translation, grasp.translation)
    joints = [pregrasp.joints] * len(begun) + between(pregrasp.joints, grasp.joints)
    # One call for the whole path is faster than one call for each posture.
    base = SE3(rotation.repeat(len(places), 1, 1), torch.cat(places))
    gaps = least_gap(obstacles, base, forward(kinematics, torch.cat(joints)), wide)
    return gaps.view(len(places), len(grasp.joints)).amin(0)
