"""The next object of a scene: of all objects seen, one with a sure grasp, else the surest ones.

Objects without failures come first, then the highest, since nothing lies on them. An object without failures gets one
round of the planner. The first verified grasp ends the search. Else it ends after `enough` objects if one
of them has a likely grasp, so that a request for any of many objects mostly costs no more than one for two of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from graspd_core.config import SceneConfig
from graspd_core.errors import CloudError, MeshError
from graspd_core.hands.model import HandModel
from graspd_core.mesh.surface_queries import make_surface, surface_distance
from graspd_core.optimize.plan_config import load_preset
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.obstacles import with_neighbours
from graspd_core.perception.scene import Scene
from graspd_core.perception.scene_from_views import scene_from_views
from graspd_core.perception.segment.segment import find_things
from graspd_core.perception.segment.target_selection import Target
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.types import Grasp, GraspResult, Plane, Posture, TriangleMesh, Verdict

# A grasp is like one that was lost where its base is this near to it and turned by less [m], [rad].
LIKE_DISTANCE, LIKE_TURN = 0.015, 0.26
# Why a thing is not looked at any more.
OUT_OF_TRIES = "tried in vain too often"
# What is seen within this of a place where something failed is that thing [m].
_SAME_PLACE = 0.04
# Of a likely grasp.
_LIKELY = 0.5
# Nearly all points of a known solid that stray off it are within this of its surface [m], also at edges.
_STRAY, _NEARLY_ALL = 0.016, 0.9


@dataclass(frozen=True, eq=False)
class Failure:
    """A grasp that failed, or an object without one.

    Attributes:
        place: the middle of the object's points [m].
        grasp: its posture at the grasp, None if none was tried.
    """

    place: Float[np.ndarray, "3"]
    grasp: Posture | None = None


@dataclass(frozen=True, eq=False)
class ThingPlan:
    """The plan for one object of a scene.

    Attributes:
        points: that show it [m].
        scene: the object among the others, None if none could be made.
        result: of planning, None without a scene.
        grasp: the best one, verified or not, None for none.
        reason: why there is no verified grasp, empty if there is one.
        looked_at: whether a grasp was looked for in this request.
    """

    points: Float[np.ndarray, "_ 3"]
    scene: Scene | None = None
    result: GraspResult | None = None
    grasp: Grasp | None = None
    reason: str = ""
    looked_at: bool = True

    @property
    def place(self) -> Float[np.ndarray, "3"]:
        """The middle of its points [m]."""
        return self.points.mean(0)

    @property
    def is_likely(self) -> bool:
        """Whether its grasp holds likelier than not, as far as anybody weighed that."""
        return self.grasp is not None and (self.grasp.probability is None or self.grasp.probability >= _LIKELY)

    @property
    def surety(self) -> float:
        """Probability that its grasp holds, more than one for a verified grasp, less than zero for none."""
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
    failures: Sequence[Failure] = (),
    tries: int = 4,
    seconds: float | None = None,
    enough: int = 2,
    on_thing: Callable[[ThingPlan], None] | None = None,
    **plan: Any,
) -> tuple[ThingPlan, ...]:
    """Plan for the objects seen until one has a verified grasp, and return all of them, the surest first.

    Args:
        views: what each camera saw [m].
        hand: that grasps.
        settings: of the way from clouds to scenes.
        surface: what all objects stand on, if it is known.
        solids: what else is known to stand there, by name, frame of the views [m]. It is not an object.
        failures: of before. An object is skipped after `tries` of them, and grasps like them are left out.
        tries: the most tries for an object.
        seconds: after which no further object is begun.
        enough: after so many objects, none with a verified grasp, the surest grasp is taken if it is likely.
        on_thing: called with each object that was looked at.
        plan: of `plan_grasps`. Its `seed` is advanced with every failure of an object.

    Raises:
        CloudError: empty, all NaN, or too few points.
        ConfigError: see `plan_grasps`.
    """
    began, things, over = time.perf_counter(), list[ThingPlan](), False
    seen = [p for p in find_things(views, settings and settings.segmentation) if not _is_solid(p, solids or {})]
    for points, failed in _in_order(seen, failures):
        if over or len(failed) >= tries:
            told = OUT_OF_TRIES if len(failed) >= tries else "not looked at"
            things.append(ThingPlan(points, reason=told, looked_at=False))
            continue
        scene = _scene_among(views, points, settings, surface, solids)
        things.append(_thing_plan(points, scene, hand, failed, plan))
        if on_thing is not None:
            on_thing(things[-1])
        likely = sum(thing.looked_at for thing in things) >= enough and any(thing.is_likely for thing in things)
        late = seconds is not None and time.perf_counter() - began > seconds
        over = likely or late or things[-1].surety > 1.0
    return tuple(sorted(things, key=lambda thing: -thing.surety))


def _is_solid(points: Float[np.ndarray, "_ 3"], solids: Mapping[str, Sequence[TriangleMesh]]) -> bool:
    """Whether some points are strays of a known solid."""
    meshes = [mesh for solid in solids.values() for mesh in solid]
    away = (surface_distance(make_surface(mesh), points) for mesh in meshes)
    return any(float(np.quantile(one, _NEARLY_ALL)) < _STRAY for one in away)


def _in_order(
    things: Sequence[Float[np.ndarray, "_ 3"]], failures: Sequence[Failure]
) -> list[tuple[Float[np.ndarray, "_ 3"], list[Failure]]]:
    rows = [
        (points, [f for f in failures if np.linalg.norm(points.mean(0) - f.place) < _SAME_PLACE]) for points in things
    ]
    return sorted(rows, key=lambda row: (len(row[1]), -float(row[0][:, 2].max())))


def _scene_among(
    views: Sequence[PointCloud],
    points: Float[np.ndarray, "_ 3"],
    settings: SceneConfig | None,
    surface: Plane | None,
    solids: Mapping[str, Sequence[TriangleMesh]] | None,
) -> Scene | str:
    """Return the scene of the object that some points show, or the error."""
    # A point of the thing itself: the middle of a ring is empty.
    middle = points[np.linalg.norm(points - points.mean(0), axis=1).argmin()]
    try:
        scene = scene_from_views(views, target=Target(point=middle), settings=settings)
    except (CloudError, MeshError) as error:
        return str(error)
    scene = scene if surface is None else replace(scene, support=surface)
    return with_neighbours(scene, solids, settings) if solids else scene


def _thing_plan(
    points: Float[np.ndarray, "_ 3"], scene: Scene | str, hand: HandModel, failed: Sequence[Failure], plan: Any
) -> ThingPlan:
    if isinstance(scene, str):
        return ThingPlan(points, reason=scene)
    lost = [failure.grasp for failure in failed if failure.grasp is not None]
    config = plan.get("preset", "balanced")
    config = load_preset(config) if isinstance(config, str) else config
    if not failed:
        config = replace(config, rounds=replace(config.rounds, most=1))
    count, seed = plan.get("count", 1) + 2 * len(lost), plan.get("seed", 0) + len(failed)
    plan = {**plan, "preset": config, "count": count, "seed": seed}
    result = plan_grasps(scene, hand, **plan)
    left = [grasp for grasp in unlike(result.tried, lost) if grasp.verdict is not Verdict.FAILED]
    if not left:
        reason = result.message or next((g.reason for g in result.tried if g.reason), "") or result.outcome.value
        return ThingPlan(points, scene, result, None, reason)
    best = max(left, key=lambda grasp: (grasp.verdict is Verdict.VERIFIED, grasp.probability or 0.0))
    reason = "" if best.verdict is Verdict.VERIFIED else result.message or "no grasp is sure enough"
    return ThingPlan(points, scene, result, best, reason)


def unlike(grasps: Sequence[Grasp], lost: Sequence[Posture]) -> list[Grasp]:
    """Return the grasps that are not like any of those that were lost."""
    return [grasp for grasp in grasps if not any(_alike(grasp.grasp, posture) for posture in lost)]


def _alike(a: Posture, b: Posture) -> bool:
    cosine = min(abs(float(a.quaternion_wxyz @ b.quaternion_wxyz)), 1.0)
    return bool(np.linalg.norm(a.position - b.position) < LIKE_DISTANCE and 2 * np.arccos(cosine) < LIKE_TURN)
