"""Measure the hand's distance from what the object stands on and from the obstacles around it.

A solid is convex, so it is clear of a half-space exactly when its extreme points are: boxes and hulls by their corners,
spheres and capsules by their ends less their radius, cylinders by points of their rims. Against neighbours the
collision spheres (`hands.self_collision`), which bulge a little out of flat faces, stand in for what lies between
the corners. Gradients are exact but for that of the neighbours' interpolated distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

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
from graspd_core.mesh.sdf import GridSDF, sample_sdf
from graspd_core.optimize.loop import Poses, Values
from graspd_core.perception.scene import Scene
from graspd_core.se3 import SE3, rotation_from_quaternion

# Shares of the straight way from the retreat to the pregrasp at which the hand is looked at, and of that to the grasp.
RETREAT_SHARES = (0.15, 0.3, 0.5, 0.75, 1.0)
_WAY_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
# What the optimiser makes of gaps ends below this [m].
WIDE = 0.005
# Points that stand for a cylinder's rim, and for a hull with more corners than this.
_RIM, _HULL = 12, 32


@dataclass(frozen=True)
class ObstacleTensors:
    """Support and neighbours, and the points of the hand that are held against them.

    Attributes:
        corner_matrix: places the extreme points of the hand's solids, see `hands.kinematics.placement`.
        corner_radii: of the balls about them [m].
        sphere_matrix: places the proxy spheres likewise.
        sphere_radii: of the proxy spheres [m].
        normal: of the support, into the free side, None without a support.
        offset: n·x of the support's points [m].
        sdfs: signed distances of the things that this hand can reach.
        approach: unit direction in which the hand comes to its pregrasp, base frame.
        points, radii, links: all of these balls, link frames [m], and the link of each.
        around: of each link a ball about all of its own: its middle, link frame, and its radius [m].
    """

    corner_matrix: Float[Tensor, "corners columns"]
    corner_radii: Float[Tensor, "corners"]
    sphere_matrix: Float[Tensor, "spheres columns"]
    sphere_radii: Float[Tensor, "spheres"]
    normal: Float[Tensor, "3"] | None
    offset: float
    sdfs: tuple[GridSDF, ...]
    approach: Float[Tensor, "3"]
    points: Float[Tensor, "balls 3"]
    radii: Float[Tensor, "balls"]
    links: Int[Tensor, "balls"]
    around: tuple[Float[Tensor, "links 3"], Float[Tensor, "links"]]


@lru_cache(maxsize=8)
def make_obstacle_tensors(
    scene: Scene, hand: HandModel, device: torch.device | str, dtype: torch.dtype
) -> ObstacleTensors | None:
    """Lay the obstacles out as this hand meets them, None if it meets none. Kept for the last few scenes and hands."""
    vertices = torch.as_tensor(scene.object.mesh.vertices)
    gaps = [float(sample_sdf(thing.sdf, vertices.to(thing.sdf.field))[0].min()) for thing in scene.obstacles]
    reached = [thing for thing, gap in zip(scene.obstacles, gaps, strict=True) if gap < hand_reach(hand) + RETREAT]
    if scene.support is None and not reached:
        return None

    def tensor(values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, device=device, dtype=dtype)

    def placed(points: np.ndarray, links: np.ndarray) -> Tensor:
        return placement(hand.num_links, tensor(points), torch.as_tensor(links, device=device, dtype=torch.long))

    corners, radii, links = extreme_points(hand)
    centers, sphere_radii, sphere_links = collision_spheres(hand)
    points, widths = np.concatenate([corners, centers]), np.concatenate([radii, sphere_radii])
    owners = np.concatenate([links, sphere_links])
    around = _balls_about(hand.num_links, points, widths, owners)
    return ObstacleTensors(
        corner_matrix=placed(corners, links),
        corner_radii=tensor(radii),
        sphere_matrix=placed(centers, sphere_links),
        sphere_radii=tensor(sphere_radii),
        normal=None if scene.support is None else tensor(scene.support.normal),
        offset=0.0 if scene.support is None else scene.support.offset,
        sdfs=tuple(n.sdf.to(device, dtype) for n in reached),
        approach=tensor(hand.approach),
        points=tensor(points),
        radii=tensor(widths),
        links=torch.as_tensor(owners, device=device, dtype=torch.long),
        around=(tensor(around[:, :3]), tensor(around[:, 3])),
    )


def _balls_about(count: int, points: np.ndarray, radii: np.ndarray, links: np.ndarray) -> Float[np.ndarray, "links 4"]:
    """Return middle and radius of a ball about the balls of each link. Of a link without any the radius is negative."""
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
    """Return points in link frames [m] and radii [m] of balls whose convex hull is each solid, and their links."""
    solids = extreme_points_of_solids(hand)
    points, radii, links = zip(*((p, np.full(len(p), r), np.full(len(p), link)) for p, r, link in solids), strict=True)
    return np.concatenate(points), np.concatenate(radii), np.concatenate(links)


def extreme_points_of_solids(hand: HandModel) -> list[tuple[Float[np.ndarray, "n 3"], float, int]]:
    """Return for each solid of the hand the points of `extreme_points` and their radius [m], and its link."""
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


def obstacle_gaps(obstacles: ObstacleTensors, base: SE3, links: SE3, wide: float = WIDE) -> Float[Tensor, "batch gaps"]:
    """Return signed distances [m] of the hand's points to every obstacle. Link poses are in the base frame.

    Distances are negative inside. One of at least `wide` may be given as `wide`.
    """
    corners = base.apply(place_points(obstacles.corner_matrix, links))
    gaps = []
    if obstacles.normal is not None:
        gaps.append(corners @ obstacles.normal - obstacles.offset - obstacles.corner_radii)
    if obstacles.sdfs:
        spheres = base.apply(place_points(obstacles.sphere_matrix, links))
        points = torch.cat([corners, spheres], 1)
        radii = torch.cat([obstacles.corner_radii, obstacles.sphere_radii])
        gaps.extend(_gaps_to(sdf, points, radii, wide) for sdf in obstacles.sdfs)
    return torch.cat(gaps, -1)


@torch.no_grad()
def least_gap(obstacles: ObstacleTensors, base: SE3, links: SE3, wide: float = WIDE) -> Values:
    """Return the least of `obstacle_gaps` of each hand [m].

    An obstacle farther away than `wide` does not count. Only links near an obstacle's grid are looked at: in a bin, of
    a hand and five obstacles, a tenth of all.
    """
    least = base.translation.new_full(base.translation.shape[:1], wide)
    if obstacles.normal is not None:
        corners = base.apply(place_points(obstacles.corner_matrix, links))
        least = (corners @ obstacles.normal - obstacles.offset - obstacles.corner_radii).amin(-1)
    if obstacles.sdfs:
        rotation = base.rotation[:, None] @ links.rotation
        place = base.apply(links.translation)
        middle, reach = obstacles.around
        middle = (rotation @ middle[..., None]).squeeze(-1) + place
    for sdf in obstacles.sdfs:
        off_grid = (middle - (sdf.origin + sdf.half)).abs() - sdf.half
        touched = torch.lt(off_grid, reach.add(wide).unsqueeze(1)).all(-1)
        row, ball = touched[:, obstacles.links].nonzero(as_tuple=True)
        link = obstacles.links[ball]
        points = (rotation[row, link] @ obstacles.points[ball][..., None]).squeeze(-1) + place[row, link]
        least = least.scatter_reduce(0, row, _gaps_to(sdf, points, obstacles.radii[ball], wide), "amin")
    return least


def _gaps_to(
    sdf: GridSDF, points: Float[Tensor, "*batch 3"], radii: Float[Tensor, "points"], wide: float
) -> Float[Tensor, "*batch"]:
    """Return gaps of balls to one obstacle. Only the balls near its grid are sampled, which are few of all."""
    off_grid = (points.detach() - (sdf.origin + sdf.half)).abs() - sdf.half
    near = (off_grid < (radii + wide)[:, None]).all(-1)
    gaps = points.new_full(near.shape, wide)
    if bool(near.any()):
        gaps[near] = sample_sdf(sdf, points[near])[0] - radii.expand(near.shape)[near]
    return gaps


@torch.no_grad()
def gap_on_the_way(
    obstacles: ObstacleTensors, kinematics: Kinematics, pregrasp: Poses, grasp: Poses, wide: float = WIDE
) -> Values:
    """Return the least signed distance [m] of the hand to any obstacle, from the retreat over pregrasp to grasp.

    It is negative inside. One of at least `wide` may be given as `wide`. The base has one orientation in both poses.
    """
    rotation = rotation_from_quaternion(grasp.quaternion)
    begun = [drawn_back(pregrasp.translation, rotation, obstacles.approach, RETREAT * s) for s in RETREAT_SHARES]
    way = [(at, pregrasp.joints) for at in begun]
    ends = (pregrasp.translation, grasp.translation), (pregrasp.joints, grasp.joints)
    way += [tuple(a * before + (1 - a) * after for before, after in ends) for a in _WAY_SHARES]
    placed = [(SE3(rotation, at), forward(kinematics, joints)) for at, joints in way]
    gaps = [least_gap(obstacles, base, links, wide) for base, links in placed]
    return torch.stack(gaps).amin(0)
