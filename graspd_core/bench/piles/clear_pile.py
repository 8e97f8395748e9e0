"""Clear a pile: look, choose a thing, plan among the others, lift it on the truth, until nothing can be grasped.

What the robot knows is what the camera saw; what came of it is measured on the truth.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from graspd_core.bench.piles.pile_case import PileCase, drawn_things, dropped_pile, posed, seen_pile
from graspd_core.bench.study import Record, thing_name
from graspd_core.errors import GraspdError
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import HandModel
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.pointcloud.point_cloud import PointCloud
from graspd_core.scene.scene_from_views import scene_from_views
from graspd_core.segmentation.segment import find_things
from graspd_core.segmentation.target_selection import Target
from graspd_core.trials.bodies import FreeBody
from graspd_core.trials.free_bodies import Lifted, lift_out, settle
from graspd_core.trials.lift_trial import LiftSettings
from graspd_core.trials.world import PROTOCOLS
from graspd_core.types import Grasp, GraspResult, Posture, Verdict

# A thing that is seen within this of a place where one failed is that thing [m]; so often is one tried.
_SAME_PLACE, _TRIES = 0.03, 2
# A segment of which so much is of a second thing is two things taken for one.
_MERGED = 0.15
# A thing that went so far while another was taken was moved by it [m].
MOVED = 0.02
# What the hand takes out rises with it: it may slip and turn in the hand as long as it comes up.
_PROTOCOL = replace(PROTOCOLS["standard"], max_displacement=0.1, max_rotation=2 * np.pi)
_LIFT = LiftSettings(hold_time=1.0)
# Endings of an attempt.
CLEARED, DROPPED, BLOCKED, NO_GRASP, NO_SCENE = "cleared", "dropped", "blocked", "no verified grasp", "no scene"


@dataclass
class _Run:
    """What is left on the table, and what was tried.

    Attributes:
        present: numbers of the things that are left, in the order of `bodies`.
        bodies: these things, as they lie.
        failures: places where things were tried in vain.
        attempts: their records.
        frames: of the film strip.
    """

    present: list[int]
    bodies: tuple[FreeBody, ...]
    failures: list[Float[np.ndarray, "3"]] = field(default_factory=list)
    attempts: list[Record] = field(default_factory=list)
    frames: list[Record] = field(default_factory=list)

    def failed_before(self, place: Float[np.ndarray, "3"]) -> int:
        return sum(float(np.linalg.norm(place - failed)) < _SAME_PLACE for failed in self.failures)


def run_pile(case: PileCase) -> Record:
    """Everything that is reported of one scene."""
    hand = load_hand(case.hand, candidates=case.config.problem.fine_candidates)
    things, bodies = drawn_things(case), dropped_pile(case)
    run, look_s, looks = _Run(list(range(case.size)), bodies), [], 0
    run.frames.append(_frame(run))
    while run.present and looks < 3 * case.size:
        views, truth = seen_pile(case, run.bodies, looks)
        looks += 1
        began = time.process_time()
        seen = _seen(views)
        look_s.append(time.process_time() - began)
        if not _take_one(case, hand, run, views, truth, seen):
            break
    lifts = [attempt for attempt in run.attempts if "lift" in attempt]
    return {
        "things": [thing_name(thing) for thing in things],
        "cleared": case.size - len(run.present),
        "left": [thing_name(things[k]) for k in run.present],
        "attempts": run.attempts,
        "looks": looks,
        "look_s": look_s,
        "lifts": len(lifts),
        "held": sum(attempt["ended"] == CLEARED for attempt in lifts),
        "frames": run.frames,
    }


def _seen(views: Sequence[PointCloud]) -> list[Float[np.ndarray, "_ 3"]]:
    """The things that are seen; none where there is nothing, or nothing that is one."""
    try:
        return list(find_things(views))
    except GraspdError:
        return []


def _take_one(
    case: PileCase,
    hand: HandModel,
    run: _Run,
    views: Sequence[PointCloud],
    truth: Int[np.ndarray, "points"],
    seen: Sequence[Float[np.ndarray, "_ 3"]],
) -> bool:
    """Try things, those least tried in vain first, then the highest, until a grasp was executed; whether one was."""
    cloud = KDTree(np.vstack([view.points for view in views]))
    order = sorted(seen, key=lambda points: (run.failed_before(points.mean(0)), -float(points[:, 2].max())))
    for points in order:
        if run.failed_before(points.mean(0)) >= _TRIES:
            continue
        attempt = _truth_of(points, cloud, truth, run)
        run.attempts.append(attempt)
        grasp = _planned(case, hand, views, points, attempt, seed=1000 * case.seed + len(run.attempts))
        if grasp is not None:
            _execute(hand, run, grasp, attempt)
        if attempt["ended"] != CLEARED:
            run.failures.append(points.mean(0))
        if grasp is not None:
            return True
    return False


def _truth_of(
    points: Float[np.ndarray, "_ 3"], cloud: KDTree, truth: Int[np.ndarray, "points"], run: _Run
) -> dict[str, Any]:
    """Which thing a segment truly shows, by most of its points, and what share of them is of a second one."""
    labels = truth[cloud.query(points)[1]]
    of_things = np.bincount(labels[(labels >= 0) & (labels < len(run.present))], minlength=len(run.present))
    order = np.argsort(-of_things, kind="stable")
    second = float(of_things[order[1]] / max(of_things.sum(), 1)) if len(order) > 1 else 0.0
    return {"thing": run.present[int(order[0])], "second_share": second, "merged": second > _MERGED}


def _planned(
    case: PileCase,
    hand: HandModel,
    views: Sequence[PointCloud],
    points: Float[np.ndarray, "_ 3"],
    attempt: Record,
    seed: int,
) -> Grasp | None:
    """The surest verified grasp of a segment; where there is none, the attempt says why."""
    began = time.process_time()
    # A point of the thing itself: the middle of a ring is empty.
    middle = points[np.linalg.norm(points - points.mean(0), axis=1).argmin()]
    try:
        scene = scene_from_views(views, target=Target(point=middle))
    except GraspdError as error:
        attempt |= {"ended": NO_SCENE, "reason": str(error), "scene_s": time.process_time() - began}
        return None
    attempt["scene_s"] = time.process_time() - began
    began = time.process_time()
    result = plan_grasps(scene, hand, count=1, seed=seed, preset=case.preset, measure=False)
    attempt |= {"plan_s": time.process_time() - began, "neighbours": len(scene.obstacles)}
    best = result.grasps[0] if result.grasps else None
    if best is not None and best.verdict is Verdict.VERIFIED:
        attempt["probability"] = best.probability
        return best
    attempt |= {"ended": NO_GRASP, "reason": _why_none(result), "tried": len(result.grasps)}
    return None


def _why_none(result: GraspResult) -> str:
    """What most candidates failed of, numbers left out."""
    reasons = Counter(re.sub(r"-?\d+(\.\d+)?", "…", grasp.reason.split(" (")[0]) for grasp in result.grasps)
    told = "; ".join(f"{reason}: {count}" for reason, count in reasons.most_common(3))
    return told or result.message or str(result.outcome.value)


def _execute(hand: HandModel, run: _Run, grasp: Grasp, attempt: Record) -> None:
    """Lift on the truth; what came up is taken away, the rest comes to rest."""
    index = run.present.index(attempt["thing"])
    before = [body.pose for body in run.bodies]
    lifted = lift_out(hand, run.bodies, index, grasp, _PROTOCOL, _LIFT)
    shift = [float(np.linalg.norm(a[:3, 3] - b[:3, 3])) for a, b in zip(lifted.poses, before, strict=True)]
    up = _risen(lifted, before, index)
    standard = PROTOCOLS["standard"]
    result = lifted.result
    firm = result.displacement <= standard.max_displacement and result.rotation <= standard.max_rotation
    attempt |= {
        "ended": CLEARED if result.passed else DROPPED if lifted.hand else BLOCKED,
        "reason": result.reason,
        "lift": {"slipped": result.displacement, "turned": result.rotation, "firm": result.passed and firm},
        "along": [run.present[k] for k in up if k != index],
        "moved": sum(s > MOVED for k, s in enumerate(shift) if k not in up and k != index),
    }
    run.bodies = posed(run.bodies, lifted.poses)
    run.frames.append(_frame(run, lifted.hand))
    stay = [k for k in range(len(run.present)) if k not in up]
    run.present = [run.present[k] for k in stay]
    run.bodies = tuple(run.bodies[k] for k in stay)
    run.bodies = posed(run.bodies, settle(run.bodies))


def _risen(lifted: Lifted, before: Sequence[Float[np.ndarray, "4 4"]], index: int) -> list[int]:
    """What the hand took out: the thing that was meant, and what came up with it."""
    if not lifted.result.passed:
        return []
    rise = 0.5 * _LIFT.lift_height
    return [k for k, pose in enumerate(lifted.poses) if k == index or pose[2, 3] - before[k][2, 3] > rise]


def _frame(run: _Run, hand: Posture | None = None) -> Record:
    """What lies where, as a picture needs it."""
    poses = {str(k): np.round(body.pose[:3], 5).tolist() for k, body in zip(run.present, run.bodies, strict=True)}
    posture = None
    if hand is not None:
        posture = {name: np.round(value, 5).tolist() for name, value in vars(hand).items()}
    return {"poses": poses, "hand": posture}
