"""Plan for any object of a scene: find an object with a verified grasp, else rank the objects by their best grasp.

Objects with fewer earlier failures come first. At equal numbers of failures, objects with more probable grasps in the
previous view come first, then higher objects, because nothing lies on them. An object is known if it has no likely
grasp, and nothing has changed around it since the previous view. Known objects come last. An object that has not moved
since the previous view keeps its plan if it has a likely grasp and nothing new is near the hand. Any other object gets
one round of the planner, but all rounds if an earlier grasp of this or an unknown object failed. It gets up to four
times the effort if earlier searches found no grasp. The first verified grasp ends the search. After `enough` objects, a
grasp with a probability of at least `likely` also ends the search, to limit the time. The search also ends if only
known objects are left, with grasps no better than the best one found. `result_of_things` returns the result of one
request.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import zip_longest
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from graspd_core.config import ObstacleConfig, SceneConfig
from graspd_core.errors import CloudError, ConfigError, MeshError, NoObjectError
from graspd_core.hands.kinematics import in_base, link_poses
from graspd_core.hands.model import HandModel
from graspd_core.hands.self_collision import collision_spheres
from graspd_core.mesh.surface_queries import make_surface, surface_distance
from graspd_core.optimize.plan_config import load_preset
from graspd_core.optimize.restrictions import BoundRestrictions
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.obstacles import with_neighbours
from graspd_core.perception.scene import Scene, on_support
from graspd_core.perception.scene_from_views import scene_from_views, things_from_views
from graspd_core.perception.segment.target_selection import Target
from graspd_core.planning.plan_grasps import MOST_GRASPS, SEEDS, check_request, plan_grasps
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import Grasp, GraspResult, Outcome, Plane, Posture, Timing, TriangleMesh, Verdict
from graspd_core.verify.robustness import begin_in_thread

Points = Float[np.ndarray, "_ 3"]

# Two grasps are alike if their bases differ by less than this distance [m] and this angle [rad].
LIKE_DISTANCE, LIKE_TURN = 0.015, 0.26
# Reasons why an object is skipped: too many failures, or the search ended before.
OUT_OF_TRIES, NOT_LOOKED_AT = "no tries left", "not tried before the search ended"
# An object this near to an earlier failure's place is the same object. No object slips farther than `_SLIPPED` [m].
_SAME_PLACE, _SLIPPED = 0.04, 0.2
# Doubt about the scene of an object if a robot executed a grasp of the object and the grasp failed.
_FAILED = "an earlier grasp of this object failed"
# Effort of a search for one grasp, after one failed search and after several, relative to the usual effort. A search
# for many grasps has the usual effort.
_HARDER = (2.0, 4.0)
# Greatest number of searches for one grasp in a scene with doubts, before a failure. Of 56 objects in four bins, a
# third search found a grasp for 2 more, of probability 0.25 and 0.35, and took a third of the time (seeds 316 to 319).
_SEARCHES = 2
# Probability of an object's best grasp before any search: the mean of 93 objects in eight full bins, for two hands.
_UNKNOWN = 0.2
# An object has not moved since the previous view if at least `_SHARED` of its points in each view are within `_STILL`
# [m] of those in the other view, and if their mean moved by less than `_SHIFT` [m]. In three bins, no vertex of such an
# object had moved by more than 7.1 mm. A plan is dropped if a new point is within `_NEAR` [m] of the hand.
_SHARED, _STILL, _SHIFT, _NEAR = 0.9, 0.005, 0.003, 0.015
# Nothing has changed around an object if at most the share `_NOISE` of the other points within `_AROUND` [m] of it, in
# each view, are farther than `_STILL` from all points of the other view.
_AROUND, _NOISE = 0.08, 0.1
# Points belong to a known solid if the fraction `_NEARLY_ALL` of them is within `_STRAY` of the solid's surface [m].
_STRAY, _NEARLY_ALL = 0.016, 0.9


@dataclass(frozen=True, eq=False)
class Failure:
    """An earlier failed try: a grasp that failed, or an object for which no grasp was found.

    Attributes:
        place: mean of the object's points [m]. None if the object is unknown. Then only the failed grasp is avoided.
        grasp: hand posture at the failed grasp. None if no grasp was found.
        executed: whether a robot executed the grasp. If so, the object gets a doubt, so that no grasp is verified.
        seen: places of all objects seen before the try [m]. They help to find the object after it has moved. None if
            unknown, or if the object may be gone.
    """

    place: Float[np.ndarray, "3"] | None
    grasp: Posture | None = None
    executed: bool = True
    seen: Points | None = None

    def object_among(self, places: Points, *, unsure: bool = False) -> int | None:
        """Return the index, among objects at `places` [m], of the object that failed. None if no object matches.

        The nearest object within 4 cm of `place` matches. If there is none and `seen` is known, the nearest object
        within 20 cm matches that is not within 4 cm of a place in `seen`. With `unsure`, it may be at such a place.
        """
        away = np.zeros(0) if self.place is None else np.linalg.norm(places - self.place, axis=1)
        if away.min(initial=np.inf) >= _SAME_PLACE:
            if self.seen is None or not len(away):
                return None
            was_seen = (cdist(places, self.seen) < _SAME_PLACE).any(1)
            away[(away > _SLIPPED) | (was_seen & (not unsure))] = np.inf
        return int(away.argmin()) if np.isfinite(away).any() else None


# Points of an object [m], and its earlier failures.
Row = tuple[Points, list[Failure]]


@dataclass(frozen=True, eq=False)
class ThingPlan:
    """The plan for one object of a scene.

    Attributes:
        points: points of the object [m].
        scene: scene with the object and the obstacles around it. None if the scene could not be built.
        result: result of planning. None if planning did not run.
        grasp: the best grasp, verified or unverified. None if no grasp was found.
        reason: why there is no verified grasp. Empty if there is a verified grasp.
        looked_at: whether this request tried to find a grasp for the object. If not, `points`, `scene`, `result` and
            `grasp` may be those of an earlier view.
        failures: earlier failures with this object.
    """

    points: Points
    scene: Scene | None = None
    result: GraspResult | None = None
    grasp: Grasp | None = None
    reason: str = ""
    looked_at: bool = True
    failures: Sequence[Failure] = ()

    @property
    def place(self) -> Float[np.ndarray, "3"]:
        """Mean of the object's points [m]."""
        return self.points.mean(0)

    def is_likely(self, least: float) -> bool:
        """Return whether the grasp's probability is at least `least` or unknown. False without a grasp."""
        return self.grasp is not None and (self.grasp.probability is None or self.grasp.probability >= least)

    @property
    def surety(self) -> float:
        """Probability that the grasp holds, plus 1 if the grasp is verified. -1 without a grasp."""
        if self.grasp is None:
            return -1.0
        return (self.grasp.probability or 0.0) + float(self.grasp.verdict is Verdict.VERIFIED)


def plan_any_thing(
    views: Sequence[PointCloud],
    hand: HandModel,
    *,
    settings: SceneConfig | None = None,
    surface: Plane | None = None,
    solids: Mapping[str, Sequence[TriangleMesh]] | None = None,
    mass: float | None = None,
    friction: float = 0.6,
    source: str = "cloud",
    failures: Sequence[Failure] = (),
    tries: int = 4,
    deadline: float | None = None,
    before: Sequence[ThingPlan] = (),
    enough: int = 2,
    likely: float = 0.5,
    **plan: Any,
) -> tuple[ThingPlan, ...]:
    """Plan for one object after the other until one has a verified grasp. Return all objects, planned ones first.

    Args:
        views: point cloud of each camera, all in the same frame [m].
        settings: settings for segmentation, reconstruction and obstacles.
        surface: support plane of all objects, if it is known.
        solids: known solids by name, in the frame of the views [m]: obstacles, padded by at least 5 mm, never grasped.
        mass: mass of each object [kg]. None assumes the greatest plausible mass for the object's volume (`heavy_mass`).
        friction: Coulomb friction coefficient between hand and objects.
        source: name of the views, for messages.
        failures: failures of earlier requests. Grasps like a failed grasp are left out (`unlike`).
        tries: number of failures after which an object is skipped.
        deadline: time after which the whole search ends [s]. None for no limit.
        before: plans for the previous view. Other arguments than `views` and `restrictions` must be the same.
        enough, likely: number of objects after which a grasp with at least the probability `likely` ends the search.
        plan: other arguments of `plan_grasps`. `seed` grows by 1 per failure with this object or an unknown object.

    Raises:
        CloudError: a cloud is empty, all NaN, or has too few points.
        ConfigError: see `plan_grasps`. If an object cannot meet a restriction, the object's `reason` says so instead.
    """
    end, over = time.perf_counter() + (np.inf if deadline is None else deadline), False
    asked = _checked(plan, deadline)
    about = {"settings": settings, "mass": mass, "friction": friction, "source": source, "surface": surface}
    objects = things_from_views(views, settings and settings.segmentation, surface)
    seen, lost = [p for p in objects if not _is_solid(p, solids)], [one for one in failures if one.place is None]
    rows = _in_order(seen, _up(views, surface), failures, before)
    things = [ThingPlan(p, reason=OUT_OF_TRIES, looked_at=False, failures=f) for p, f in rows if len(f) >= tries]
    rows, known = _known_last([row for row in rows if len(row[1]) < tries], seen, () if lost else before, likely)
    sure = [] if lost else [thing for thing in before if thing.is_likely(likely) and _allowed(thing, hand, asked)]
    kept = [_kept(row, seen, sure, before, hand) for row in rows]
    new = [row for row, thing in zip(rows, kept, strict=True) if not thing]
    scenes = _one_ahead(partial(_scene_among, views, solids, about), new)
    for k, ((points, failed), thing) in enumerate(zip(rows, kept, strict=True)):
        if over or _is_best(things, known[k:]):
            things += [replace(known[k] or ThingPlan(points), reason=NOT_LOOKED_AT, looked_at=False, failures=failed)]
            continue
        thing = thing or _thing_plan(points, next(scenes), hand, [*failed, *lost], asked, end)
        things.append(replace(thing, failures=failed))
        found = any(one.is_likely(likely) for one in things) and sum(one.looked_at for one in things) >= enough
        over = time.perf_counter() > end or asked["stop"]() or found or things[-1].surety >= 1.0
    return tuple(sorted(things, key=lambda thing: (not thing.looked_at, -thing.surety)))


def _checked(plan: dict[str, Any], deadline: float | None) -> dict[str, Any]:
    """Return arguments of `plan_grasps` with defaults and a loaded preset. Raises ConfigError: see `plan_grasps`."""
    asked = {"seed": 0, "count": 1, "verify": "standard", "device": "cpu", "preset": "balanced"} | plan
    check_request(deadline=deadline, **{name: asked[name] for name in ("count", "seed", "verify", "device")})
    preset, stop = asked["preset"], asked.get("stop") or (lambda: False)
    return {**asked, "preset": load_preset(preset) if isinstance(preset, str) else preset, "stop": stop}


def result_of_things(things: Sequence[ThingPlan], seed: int = 0) -> GraspResult:
    """Return the result of the first object. If no object has a grasp, the message gives the reason for each object.

    Raises:
        CloudError: `things` is empty (NoObjectError), or no object's scene can be built.
        ConfigError: no object can meet the restrictions.
    """
    if not things:
        raise NoObjectError("cloud: no object is seen, except known solids; valid: a cloud with a graspable object")
    best, results = things[0], [thing.result for thing in things if thing.looked_at and thing.result is not None]
    if best.grasp is not None and best.result is not None:
        return best.result
    told = f"none of {len(things)} objects has a grasp: {'; '.join(dict.fromkeys(thing.reason for thing in things))}"
    ended = [result for result in results if result.outcome in (Outcome.CANCELLED, Outcome.DEADLINE)]
    for result in (*ended, *results):
        return replace(result, message=told)
    if any(thing.looked_at for thing in things):
        raise (CloudError if all(thing.scene is None for thing in things) else ConfigError)(told)
    return GraspResult(Outcome.NO_CANDIDATES, (), Timing(), seed, "", told)


def _is_solid(points: Points, solids: Mapping[str, Sequence[TriangleMesh]] | None) -> bool:
    """Return True if nearly all points lie on the surface of a known solid."""
    meshes = [mesh for solid in (solids or {}).values() for mesh in solid]
    away = (surface_distance(make_surface(mesh), points) for mesh in meshes)
    return any(float(np.quantile(one, _NEARLY_ALL)) < _STRAY for one in away)


def _up(views: Sequence[PointCloud], surface: Plane | None) -> Float[np.ndarray, "3"]:
    """Return the upward direction: the support's normal, or towards a camera at the origin, else z."""
    if surface is not None:
        return surface.normal
    if any(view.viewpoint.any() for view in views):
        return np.array([0.0, 0.0, 1.0])
    points = np.concatenate([view.points for view in views])
    return -points[np.isfinite(points).all(1)].mean(0)


def _in_order(
    things: Sequence[Points],
    up: Float[np.ndarray, "3"],
    failures: Sequence[Failure],
    before: Sequence[ThingPlan],
) -> list[Row]:
    places = np.array([points.mean(0) for points in things]).reshape(-1, 3)
    rows = [(points, list[Failure]()) for points in things]
    lost = dict[int | None, Failure]()
    for failure in failures:
        if (index := failure.object_among(places)) is not None:
            rows[index][1].append(failure)
        elif failure.grasp is not None and failure.executed:
            lost[failure.object_among(places, unsure=True)] = failure
    # Images of a heap do not always show the same objects. So a failure of an object not found counts for the nearest
    # object, but only once, because another object must not run out of tries.
    for index, failure in lost.items():
        if index is not None and not rows[index][1]:
            rows[index][1].append(failure)
    known = [(thing.place, max(thing.surety, 0.0)) for thing in before if thing.looked_at or thing.result]

    def rank(row: Row) -> tuple[int, float, float]:
        place = row[0].mean(0)
        hopes = [surety for there, surety in known if np.linalg.norm(place - there) < _SAME_PLACE]
        return len(row[1]), -max(hopes, default=_UNKNOWN), -float((row[0] @ up).max())

    return sorted(rows, key=rank)


def _one_ahead(work: Callable[[Row], Scene | str], rows: Sequence[Row]) -> Iterator[Scene | str]:
    """Yield the scene of each object. A thread builds the next scene while the caller plans on the present scene."""
    begun = None
    for row, following in zip_longest(rows, rows[1:]):
        scene = work(row) if begun is None else begun.result()
        begun = following and begin_in_thread("graspd-scenes", partial(work, following))
        yield scene


def _allowed(thing: ThingPlan, hand: HandModel, asked: dict[str, Any]) -> bool:
    """Return True if the restrictions of this request admit the grasp of an earlier plan."""
    if thing.grasp is None or thing.scene is None:
        return False
    try:
        bound = BoundRestrictions(tuple(one.bind(thing.scene, hand) for one in asked.get("restrictions", ())))
    except ConfigError:
        return False
    return bool(bound.admit([thing.grasp])[0])


def _kept(
    row: Row, seen: Sequence[Points], sure: Sequence[ThingPlan], before: Sequence[ThingPlan], hand: HandModel
) -> ThingPlan | None:
    """Return the earlier plan for the object of a row. None if the plan may be wrong now.

    A plan may be wrong if the object has moved, a grasp of it has failed since, or a new point is near the hand. Only
    points of objects are compared. `sure` lists the plans that may be kept, `before` all plans of the previous view.
    """
    points, failed = row
    for plan in sure:
        if plan.grasp is None or _executed(plan.failures) != _executed(failed) or not _is_unmoved(plan.points, points):
            continue
        known = KDTree(np.concatenate([thing.points for thing in before]))
        others = np.concatenate([other for other in seen if other is not points] or [points[:0]])
        new = others[known.query(others, distance_upper_bound=_STILL)[0] > _STILL]
        again = not unlike([plan.grasp], [failure.grasp for failure in failed if failure.grasp is not None])
        # The plan keeps the points of its own view, so that an object that creeps from view to view gets a new plan.
        return None if again or _gap(new, plan.grasp, hand) <= _NEAR else plan
    return None


def _known_last(
    rows: Sequence[Row], seen: Sequence[Points], before: Sequence[ThingPlan], likely: float
) -> tuple[list[Row], list[ThingPlan | None]]:
    """Move objects with known plans behind those with as many failures. Return the plans, too."""
    known = [_known(row, seen, before, likely) for row in rows]
    order = sorted(range(len(rows)), key=lambda k: (len(rows[k][1]), known[k] is not None))
    return [rows[k] for k in order], [known[k] for k in order]


def _known(row: Row, seen: Sequence[Points], before: Sequence[ThingPlan], likely: float) -> ThingPlan | None:
    """Return the earlier plan for the object of a row if no grasp was likely, and nothing has changed around it."""
    points, failed = row
    for plan in before:
        ended = plan.result is not None and plan.result.outcome not in (Outcome.CANCELLED, Outcome.DEADLINE)
        same = not plan.is_likely(likely) and _executed(plan.failures) == _executed(failed)
        if ended and same and _is_unmoved(plan.points, points):
            then = np.concatenate([points[:0], *(thing.points for thing in before if thing is not plan)])
            now = np.concatenate([points[:0], *(other for other in seen if other is not points)])
            return plan if max(_changed(now, then, points), _changed(then, now, points)) <= _NOISE else None
    return None


def _changed(points: Points, before: Points, around: Points) -> float:
    """Return the share of the points near `around` that are far from all points in `before`."""
    near = points[KDTree(around).query(points, distance_upper_bound=_AROUND)[0] < _AROUND]
    if not len(near) or not len(before):
        return float(len(near) > 0)
    return float((KDTree(before).query(near, distance_upper_bound=_STILL)[0] > _STILL).mean())


def _is_best(things: Sequence[ThingPlan], rest: Sequence[ThingPlan | None]) -> bool:
    """Return True if a grasp was found, and the known plans of all other objects are no better."""
    best = max((thing.surety for thing in things if thing.looked_at), default=-1.0)
    return best > 0.0 and all(plan is not None and plan.surety <= best for plan in rest)


def _executed(failures: Sequence[Failure]) -> int:
    return sum(failure.executed and failure.grasp is not None for failure in failures)


def _is_unmoved(before: Points, now: Points) -> bool:
    """Return True if two views of an object show it in one place (`_SHARED`, `_STILL`, `_SHIFT`)."""
    if np.linalg.norm(before.mean(0) - now.mean(0)) >= _SHIFT:
        return False
    pairs = ((before, now), (now, before))
    return all((KDTree(to).query(of, distance_upper_bound=_STILL)[0] < _STILL).mean() >= _SHARED for of, to in pairs)


def _gap(points: Points, grasp: Grasp, hand: HandModel) -> float:
    """Return the least distance of the points from the hand at pregrasp and grasp [m]. Infinite without points."""
    if not len(points):
        return float("inf")
    tree, (local, radii, links) = KDTree(points), collision_spheres(hand)
    gaps = []
    for posture in (grasp.pregrasp, grasp.grasp):
        rotation = rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz, dtype=torch.float64)).numpy()
        centers = in_base(link_poses(hand, posture.joint_positions), local, links) @ rotation.T + posture.position
        gaps.append(float((tree.query(centers)[0] - radii).min()))
    return min(gaps)


def _scene_among(
    views: Sequence[PointCloud],
    solids: Mapping[str, Sequence[TriangleMesh]] | None,
    about: dict[str, Any],
    row: Row,
) -> Scene | str:
    """Return the scene of an object with its points and failures, or the error message if it cannot be built.

    `about` holds other arguments of `scene_from_views`. If an executed grasp failed, add a doubt to the scene.
    """
    points, failed = row
    again = any(failure.grasp is not None and failure.executed for failure in failed)
    # The target is a point on the object, because the middle of a ring is empty.
    middle = points[np.linalg.norm(points - points.mean(0), axis=1).argmin()]
    try:
        scene = scene_from_views(views, target=Target(point=middle), **about)
    except (CloudError, MeshError) as error:
        return str(error)
    if again and scene.evidence is not None:
        scene = replace(scene, evidence=replace(scene.evidence, doubts=(*scene.evidence.doubts, _FAILED)))
    if (surface := about["surface"]) is not None:
        try:
            scene = on_support(scene, surface)
        except ConfigError as error:
            return str(error)
    if not solids:
        return scene
    settings = about["settings"] or SceneConfig()
    # Unlike objects in a heap, known solids do not give way.
    padding = max(settings.obstacles.padding, ObstacleConfig().padding)
    return with_neighbours(scene, solids, replace(settings, obstacles=replace(settings.obstacles, padding=padding)))


def _thing_plan(
    points: Points, scene: Scene | str, hand: HandModel, failed: Sequence[Failure], plan: Any, end: float
) -> ThingPlan:
    """Plan for one object until the time `end` [s]. `plan` holds the keyword arguments of `plan_grasps`."""
    if isinstance(scene, str):
        return ThingPlan(points, reason=scene)
    lost, config = [failure.grasp for failure in failed if failure.grasp is not None], plan["preset"]
    count, seed = min(plan["count"] + 2 * len(lost), MOST_GRASPS), (plan["seed"] + len(failed)) % SEEDS
    if in_vain := sum(failure.grasp is None for failure in failed):
        config = config.at_budget(max(_HARDER[in_vain > 1] / count, 1.0))
    if not lost:
        config = replace(config, rounds=replace(config.rounds, most=1))
    doubted = scene.evidence is not None and bool(scene.evidence.doubts)
    if doubted and not failed and count == 1 and hasattr(config.settings, "searches"):
        config = replace(config, settings=replace(config.settings, searches=min(config.settings.searches, _SEARCHES)))
    left = None if end == np.inf else max(end - time.perf_counter(), 1e-3)
    try:
        result = plan_grasps(scene, hand, **{**plan, "preset": config, "count": count, "seed": seed, "deadline": left})
    except ConfigError as error:  # The object cannot meet a restriction.
        return ThingPlan(points, scene, reason=str(error))
    left = [grasp for grasp in unlike(result.tried, lost) if grasp.verdict is not Verdict.FAILED]
    if not left:
        reason = result.message or next((g.reason for g in result.tried if g.reason), "") or result.outcome.value
        return ThingPlan(points, scene, result, None, reason)
    best = max(left, key=lambda grasp: (grasp.verdict is Verdict.VERIFIED, grasp.probability or 0.0))
    reason = "" if best.verdict is Verdict.VERIFIED else result.message or "no grasp passes the robustness checks"
    return ThingPlan(points, scene, result, best, reason)


def unlike(grasps: Sequence[Grasp], lost: Sequence[Posture]) -> list[Grasp]:
    """Return the grasps that differ from every posture in `lost` by at least 15 mm or 0.26 rad."""
    return [grasp for grasp in grasps if not any(_alike(grasp.grasp, posture) for posture in lost)]


def _alike(a: Posture, b: Posture) -> bool:
    cosine = min(abs(float(a.quaternion_wxyz @ b.quaternion_wxyz)), 1.0)
    return bool(np.linalg.norm(a.position - b.position) < LIKE_DISTANCE and 2 * np.arccos(cosine) < LIKE_TURN)
