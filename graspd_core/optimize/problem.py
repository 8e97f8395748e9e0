"""Convert hand, object and obstacles to tensors on one device, and evaluate the loss terms of the problem."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from graspd_core.config import ProblemConfig
from graspd_core.hands.kinematics import (
    Kinematics,
    forward,
    in_base,
    link_poses,
    make_kinematics,
    place_points,
    placement,
)
from graspd_core.hands.link_distance import CollisionTensors, make_collision_tensors, pair_distance, solid_bound
from graspd_core.hands.model import HandModel
from graspd_core.hands.self_collision import collision_spheres, solid_overlaps, solid_pairs
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.sdf import GridSDF, sample_sdf
from graspd_core.mesh.sharp_features import THIN_WALLED, crease_points, neighbours_together
from graspd_core.optimize import losses
from graspd_core.optimize.kernel.builds import kernel
from graspd_core.optimize.loop import Distances, Joints, Points, Poses, Values
from graspd_core.optimize.losses import disturbance_directions, wrench_support
from graspd_core.optimize.obstacle_distance import ObstacleTensors, make_obstacle_tensors, obstacle_gaps
from graspd_core.perception.scene import Scene, object_sharp_points, sample_confidence
from graspd_core.se3 import SE3

if TYPE_CHECKING:
    from graspd_core.optimize.kernel_problem import KernelProblem

# A group of candidates is attracted to the surface from this distance [m]. Fingertips are attracted from afar, other
# links only if nearly touching. The third value is for patches, which are used if `patch_size` is set.
_REACH_OF_TIPS, _REACH_OF_OTHERS, _REACH_OF_PATCHES = 0.1, 0.004, 0.03
REACH_WHEN_SHARP = 0.01
# If the palm centre is farther than this from the base origin, solvers turn the hand about the palm centre [m].
_PALM_RADIUS = 0.05
# Number of candidates in the wrench resistance term, and of pairs of sharp point and primitive in the penetration term.
TASK_POINTS, FEATURE_PAIRS = 96, 96
# Number of points on the surface and on its edges that measure how deep a grasp penetrates.
_SURFACE, _CREASES = 3000, 1000
# Distance that the hand keeps from obstacles [m]. It is small, because fingertips at a low object almost touch a table.
OBSTACLE_MARGIN = 0.001


@dataclass(frozen=True)
class PointSet:
    """Contact candidates of a hand.

    Attributes:
        matrix: matrix from which `place_points` computes the candidates' positions, given the link poses.
        links: link of each candidate.
        groups: rows of candidate indices, by rigid group of links or by patch (`_patches`). Short rows repeat an index.
    """

    matrix: Float[Tensor, "points columns"]
    links: Int[Tensor, "points"]
    groups: Int[Tensor, "groups members"]


@dataclass(frozen=True)
class SphereTensors:
    """Spheres that fill the hand's links, for self-collision.

    Attributes:
        matrix: matrix from which `place_points` computes the centres, given the link poses.
        radii: radii of the spheres [m].
        weight: 1 / 2R for checked pairs [1/m], where R is the sum of both radii. Zero for other pairs.
    """

    matrix: Float[Tensor, "spheres columns"]
    radii: Float[Tensor, "spheres"]
    weight: Float[Tensor, "spheres spheres"]


@dataclass(frozen=True, eq=False)
class HandTensors:
    """A hand as tensors.

    Attributes:
        model: the hand model.
        kinematics: forward kinematics.
        coarse: the first contact candidates, evenly spread. Used in most steps.
        fine: all contact candidates. Used in the last steps.
        reach: attraction range of each group of candidates [m].
        solids: collision primitives. A hull counts as a box inside it.
        group_of_solid: first candidate group on the rigid group of each primitive. If none, the number of groups.
        solid_pairs: pairs of `solids` whose links are not adjacent.
        spheres: spheres for self-collision.
        lower, upper: joint limits [rad] or [m].
        pivot: point about which a solver turns the hand, base frame [m].
        joint_scale: joint travel that counts as one radian: 1 rad if revolute, a length [m] if prismatic.
    """

    model: HandModel
    kinematics: Kinematics
    coarse: PointSet
    fine: PointSet
    reach: Float[Tensor, "groups"]
    solids: CollisionTensors
    group_of_solid: Int[Tensor, "solids"]
    solid_pairs: Int[Tensor, "pairs 2"]
    spheres: SphereTensors
    lower: Float[Tensor, "joints"]
    upper: Float[Tensor, "joints"]
    pivot: Float[Tensor, "3"]
    joint_scale: Float[Tensor, "joints"]

    @property
    def has_hulls(self) -> bool:
        """True if the hand has convex hulls. Near their surface, only contact candidates and spheres detect overlap."""
        return any(primitive.kind == "hull" for primitive in self.model.primitives)


@dataclass(frozen=True, eq=False)
class ObjectTensors:
    """An object as tensors, in the object frame.

    Attributes:
        sdf: signed distance field.
        features: sharp points of the surface [m]. They could penetrate the hand between two contact candidates.
        surface: many points on the surface and its edges [m], to measure how deep a grasp penetrates.
        coarse_features: number of leading `features` used in the coarse steps, 0 if the object has no thin walls.
        center: centre of mass [m].
        mass: mass [kg].
        length: characteristic length that torques are divided by [m].
        confidence: confidence in the surface near each `sdf` node, `confidence_floor` to 1. None if nothing is guessed.
    """

    sdf: GridSDF
    features: Float[Tensor, "features 3"]
    surface: Float[Tensor, "surface 3"]
    coarse_features: int
    center: Float[Tensor, "3"]
    mass: float
    length: float
    confidence: Float[Tensor, "x y z"] | None


@lru_cache(maxsize=8)
def make_hand_tensors(
    hand: HandModel, candidates: int, patch_size: int, device: str, dtype: torch.dtype
) -> HandTensors:
    """Convert a hand to tensors. Coarse steps use only the first `candidates` of the hand's contact candidates.

    The candidates of each rigid group of links form one group. If `patch_size` is not 0, each group is split into
    patches of about `patch_size` coarse candidates. The tensors of recent hands are cached.
    """

    tensor, index = (partial(torch.as_tensor, device=device, dtype=kind) for kind in (dtype, torch.long))
    kinematics, of_link = make_kinematics(hand, device, dtype), hand.link_group[hand.candidate_link]
    groups = _patches(hand, candidates, patch_size) if patch_size else of_link
    present, first = np.unique(groups[:candidates], return_index=True)
    reach = np.where(np.isin(of_link[first], hand.fingertip_groups), _REACH_OF_TIPS, _REACH_OF_OTHERS)

    def point_set(count: int) -> PointSet:
        links = hand.candidate_link[:count]
        points = tensor(hand.candidate_points[:count])
        members = _members(groups[:count], present)
        return PointSet(placement(hand.num_links, points, index(links)), index(links), index(members))

    far = np.linalg.norm(hand.palm_center) > _PALM_RADIUS
    solids = make_collision_tensors(hand, device, dtype)
    same = hand.link_group[solids.link.cpu().numpy()][:, None] == of_link[first]
    place = np.where(same.any(1), same.argmax(1), len(present))
    return HandTensors(
        model=hand,
        kinematics=kinematics,
        coarse=point_set(candidates),
        fine=point_set(len(hand.candidate_link)),
        reach=tensor(np.full(len(present), _REACH_OF_PATCHES) if patch_size else reach),
        solids=solids,
        group_of_solid=index(place),
        solid_pairs=index(solid_pairs(hand)),
        spheres=_sphere_tensors(hand, device, dtype),
        lower=tensor(hand.lower),
        upper=tensor(hand.upper),
        pivot=tensor(hand.palm_center if far else np.zeros(3)),
        joint_scale=tensor(hand.joint_scale),
    )


def _sphere_tensors(hand: HandModel, device: str, dtype: torch.dtype) -> SphereTensors:
    centers, radii, links = collision_spheres(hand)
    checked = ~hand.adjacent[np.ix_(links, links)]
    weight = np.triu(checked, 1) * 0.5 / (radii[:, None] + radii[None, :])
    points, radius, pairs = (torch.as_tensor(x, device=device, dtype=dtype) for x in (centers, radii, weight))
    at = torch.as_tensor(links, device=device, dtype=torch.long)
    return SphereTensors(placement(hand.num_links, points, at), radius, pairs)


@lru_cache(maxsize=4)
def make_object_tensors(scene: Scene, settings: ProblemConfig, device: str, dtype: torch.dtype) -> ObjectTensors:
    """Convert the scene's object to tensors. A cache keeps the tensors of the last scenes, by scene identity."""
    tensor = partial(torch.as_tensor, device=device, dtype=dtype)
    sharp, thin_share = object_sharp_points(scene.object, 2 * settings.features)
    thin = thin_share > THIN_WALLED
    floor, confidence = settings.confidence_floor, None
    if scene.confidence is not None:
        confidence = floor + (1 - floor) * scene.confidence.to(device, dtype)
    sdf = scene.sdf.to(device, dtype)
    samples = surface_samples(scene.object.mesh, _SURFACE, 0)[0], crease_points(scene.object.mesh, _CREASES, 0)
    surface = np.concatenate([sharp, *samples])
    surface = surface[neighbours_together(surface)]
    if settings.softness:
        sdf = replace(sdf, field=torch.cat([sdf.field[:1] + settings.softness, sdf.field[1:]]))
    # Each sharp point was chosen farthest from all earlier points, so the first half is spread over the object too.
    coarse = max(settings.features, len(sharp) // 2) if thin else 0
    features = [part[neighbours_together(part)] for part in (sharp[:coarse], sharp[coarse:])]
    return ObjectTensors(
        sdf=sdf,
        features=tensor(np.concatenate(features) if thin else sharp[: settings.features]),
        surface=tensor(surface),
        coarse_features=coarse,
        center=tensor(scene.object.center_of_mass),
        mass=scene.object.mass,
        length=scene.object.radius,
        confidence=confidence,
    )


def _patches(hand: HandModel, candidates: int, size: int) -> Int[np.ndarray, "points"]:
    """Return for each contact candidate the index of the nearest patch in the same rigid group of links.

    The first `candidates` are coarse. A group has about one patch per `size` of these. Patch centres are far apart.
    In a group without coarse candidates, the index is −1.
    """
    posture = link_poses(hand, (hand.lower + hand.upper) / 2)
    points = in_base(posture, hand.candidate_points, hand.candidate_link)
    of_link, patch, count = hand.link_group[hand.candidate_link], np.zeros(len(points), dtype=int), 0
    for group in np.unique(of_link[:candidates]):
        members = np.flatnonzero(of_link == group)
        coarse = members[members < candidates]
        # Rounding makes the choice between two equal distances independent of the base frame.
        gaps = np.linalg.norm(points[members][:, None] - points[coarse], axis=-1).round(6)
        centres = [0]
        while len(centres) < round(len(coarse) / size):
            centres.append(int(gaps[np.searchsorted(members, coarse)][:, centres].min(1).argmax()))
        patch[members] = count + gaps[:, centres].argmin(1)
        count += len(centres)
    patch[~np.isin(of_link, of_link[:candidates])] = -1
    return patch


def _members(group_of: Int[np.ndarray, "n"], present: Int[np.ndarray, "groups"]) -> Int[np.ndarray, "groups width"]:
    members = [np.flatnonzero(group_of == group) for group in present]
    width = max(map(len, members))
    return np.stack([np.resize(m if len(m) else [0], width) for m in members])


@dataclass(frozen=True)
class Problem:
    """A hand, an object and a set of disturbances, on one device and dtype.

    Attributes:
        hand, object: tensors of hand and object.
        directions: unit disturbance wrenches.
        friction: friction coefficient for planning, never above the object's friction.
        obstacles: support and obstacles within the hand's reach, None if there are none.
    """

    hand: HandTensors
    object: ObjectTensors
    directions: Float[Tensor, "directions 6"]
    friction: float
    obstacles: ObstacleTensors | None = None

    @cached_property
    def of_surface(self) -> Problem:
        """The same problem with points of the whole surface in place of the sharp points."""
        return replace(self, object=replace(self.object, features=self.object.surface, coarse_features=0))

    @property
    def compiled(self) -> KernelProblem | None:
        """The problem for the compiled kernel. None if there is no kernel, or the data is not float32 on the CPU."""
        field = self.object.sdf.field
        fits = field.device.type == "cpu" and field.dtype == torch.float32 and field.numel() < 2**31
        return self._in_kernel if fits and min(field.shape[1:]) > 1 and kernel().library is not None else None

    @cached_property
    def _in_kernel(self) -> KernelProblem:
        # kernel_problem imports this module, so it is imported here and not at the top.
        from graspd_core.optimize.kernel_problem import kernel_problem

        return kernel_problem(self)


class Terms(NamedTuple):
    """Unweighted loss terms of a batch of starts, named as in `LossWeights`. `obstacle` is None without obstacles."""

    wrench_resistance: Values
    distance: Values
    penetration: Values
    self_collision: Values
    posture: Values
    obstacle: Values | None = None


def build_problem(
    scene: Scene,
    hand: HandModel,
    settings: ProblemConfig,
    *,
    seed: int,
    device: str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> Problem:
    """Convert scene and hand to tensors.

    The disturbances are the 12 signed axes of wrench space, then random directions drawn with `seed`.
    """
    tensors = make_hand_tensors(hand, settings.candidates, settings.patch_size, device, dtype)
    if settings.softness:
        yielding = replace(tensors.solids, radius=tensors.solids.radius - settings.softness)
        tensors = replace(tensors, solids=yielding)
    return Problem(
        hand=tensors,
        object=make_object_tensors(scene, settings, device, dtype),
        directions=disturbance_directions(settings.directions, seed).to(device=device, dtype=dtype),
        friction=min(settings.friction, scene.object.friction),
        obstacles=make_obstacle_tensors(scene, hand, device, dtype),
    )


# Contact weights from distances of points [m], and the padding of the object [m].
Activation = Callable[..., Distances]


class HandPlacement(NamedTuple):
    """A batch of hands: `T_object_base`, `T_base_link` of every link, contact candidates in the object frame [m]."""

    base: SE3
    links: SE3
    points: Points


def hand_forward(problem: Problem, points: PointSet, poses: Poses) -> HandPlacement:
    """Compute the positions of links and contact candidates for a batch of poses."""
    base, links = poses.base, forward(problem.hand.kinematics, poses.joints)
    return HandPlacement(base, links, base.apply(place_points(points.matrix, links)))


def self_collision(problem: Problem, links: SE3) -> Values:
    """Return the self-collision loss of the hand. `links` are link poses in the base frame."""
    spheres = problem.hand.spheres
    return losses.self_collision(place_points(spheres.matrix, links), spheres.radii, spheres.weight)


def solid_collision(problem: Problem, links: SE3) -> Values:
    """Return a tenth of the sum of squared overlaps of hand primitives with each other [mm²], exact for boxes."""
    row, depth = solid_overlaps(problem.hand.solids, problem.hand.solid_pairs, links)
    return depth.new_zeros(len(links.translation)).index_add(0, row, (1e3 * depth) ** 2 / 10.0)


def obstacle_depth(obstacles: ObstacleTensors, base: SE3, links: SE3) -> Values:
    """Return the penetration loss of the hand in support and obstacles. `links` are poses in the base frame."""
    gaps = obstacle_gaps(obstacles, base, links)
    return losses.penetration(gaps, torch.full_like(gaps[:, 0], OBSTACLE_MARGIN))


def feature_distance(
    problem: Problem, features: Float[Tensor, "features 3"], placed: HandPlacement
) -> tuple[Float[Tensor, "batch pairs"], Int[Tensor, "batch pairs"]]:
    """Return distance [m] and primitive index of `FEATURE_PAIRS` close pairs of a sharp point and a hand primitive."""
    in_base = placed.base.apply_inverse(features)
    with torch.no_grad():
        every = solid_bound(problem.hand.solids, placed.links, in_base)
    count = len(problem.hand.solids.link)
    pairs = every.flatten(1).topk(min(FEATURE_PAIRS, every[0].numel()), largest=False).indices
    solids = pairs % count
    rows = torch.arange(len(pairs), device=pairs.device)[:, None]
    return pair_distance(problem.hand.solids, placed.links, in_base[rows, pairs // count], solids), solids


def _wrench_resistance(
    problem: Problem, points: Points, distance: Distances, normal: Points, radius: Values, activate: Activation
) -> Values:
    """Return the wrench resistance loss from the `TASK_POINTS` points nearest to the padded surface."""
    near = (distance.detach() - radius[:, None]).abs().topk(min(TASK_POINTS, distance.shape[-1]), largest=False).indices
    rows = torch.arange(len(near), device=near.device)[:, None]
    target, position = problem.object, points[rows, near]
    activation = activate(distance[rows, near], radius)
    if target.confidence is not None:
        activation = activation * sample_confidence(target.confidence, target.sdf, position)
    arms = (position - target.center) / target.length
    support = wrench_support(arms, normal[rows, near], activation, problem.directions, problem.friction)
    return losses.wrench_resistance(support, problem.friction)


def evaluate(
    problem: Problem,
    poses: Poses,
    radius: Values,
    delta: float,
    *,
    fine: bool = False,
    sharp: bool = False,
    activate: Activation = losses.soft_contact,
) -> Terms:
    """Compute all loss terms of a batch of poses at padding `radius` [m] and contact width `delta` [m].

    Args:
        fine: use all contact candidates, not only the coarse ones.
        sharp: use all sharp points of the object. Attract only candidate groups nearer than `REACH_WHEN_SHARP`.
        activate: contact weight of a candidate as a function of its distance, `radius` and `delta`.
    """
    points = problem.hand.fine if fine else problem.hand.coarse
    placed = hand_forward(problem, points, poses)
    distance, normal = sample_sdf(problem.object.sdf, placed.points)
    gap = (distance - radius[:, None])[:, points.groups].amin(-1)
    sunk = losses.penetration(distance, radius)
    features = problem.object.features if sharp else problem.object.features[: problem.object.coarse_features]
    if len(features):
        edge, solids = feature_distance(problem, features, placed)
        sunk = sunk + losses.penetration(edge, torch.zeros_like(radius))
        # The extra last column is for solids without a group.
        start = gap.new_full((len(gap), gap.shape[-1] + 1), torch.inf)
        nearest = start.scatter_reduce(1, problem.hand.group_of_solid[solids], edge, "amin")
        gap = torch.minimum(gap, nearest[:, :-1])
    active = partial(activate, delta=delta)
    reach = torch.full_like(problem.hand.reach, REACH_WHEN_SHARP) if sharp else problem.hand.reach
    return Terms(
        wrench_resistance=_wrench_resistance(problem, placed.points, distance, normal, radius, active),
        distance=losses.touch(gap, reach),
        penetration=sunk,
        self_collision=self_collision(problem, placed.links),
        posture=losses.posture(poses.joints, problem.hand.lower, problem.hand.upper),
        obstacle=None if problem.obstacles is None else obstacle_depth(problem.obstacles, placed.base, placed.links),
    )


def hand_distance(problem: Problem, base: SE3, joints: Joints) -> Distances:
    """Return the signed distance of every coarse contact candidate to the object [m]."""
    points = place_points(problem.hand.coarse.matrix, forward(problem.hand.kinematics, joints))
    return sample_sdf(problem.object.sdf, base.apply(points))[0]


def least_distance(problem: Problem, poses: Poses) -> Values:
    """Return the least distance of any coarse contact candidate to the object [m]."""
    return hand_distance(problem, poses.base, poses.joints).amin(-1)
