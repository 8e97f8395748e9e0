"""Tell users why an object cannot be held: before any search, and after failed trials.

The check before the search is a necessary condition from statics. Balanced contact forces cannot all point into one
open half-space. The distance between two contacts is at most the hand's span. Consider all surface patches of this
size. If in every patch all friction-cone forces lie in one half-space, the hand cannot hold the object. Rims, handles,
walls and thin plates pass the check, because they have opposing normals next to each other.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist, pdist

from graspd_core.hands.kinematics import in_base, link_poses
from graspd_core.hands.model import HandModel
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.topology import packed_rows, scaled_normals
from graspd_core.perception.scene import Scene
from graspd_core.types import Grasp, Verdict

# Greatest friction that trials use (`verify.world.at_friction`).
_MOST_FRICTION = 0.6
# Number of surface samples in the check. All face centres are added, so that no small handle is missed.
_SAMPLES = 4000
# Greatest number of directions in which the object's width is measured.
_DIRECTIONS = 400
# Greatest number of steps in the search for a direction that separates the normals from the origin (`_separated`).
_STEPS = 60
# Greatest number of failure reasons in a message.
_REASONS_TOLD = 3
# Fingers press an object from above if the median cosine of contact normals to the vertical is at least `_FROM_ABOVE`.
# An object up to this height is low [m]: `_LOW`.
_FROM_ABOVE, _LOW = 0.5, 0.03


def out_of_reach(scene: Scene, hand: HandModel) -> str:
    """Return a sentence that says why the hand cannot hold the object anywhere. Return "" if no reason is known."""
    span, opening = reach_of(hand)
    vertices = scene.object.mesh.vertices
    # Most objects fit into the hand along an axis and need no further check.
    if float(np.ptp(vertices, axis=0).min()) <= span:
        return ""
    points, normals = _surface(scene)
    # A convex body is narrowest along a normal of its surface.
    narrowest = float(np.ptp(vertices @ normals[:: len(normals) // _DIRECTIONS + 1].T, axis=0).min())
    if narrowest <= span:
        return ""
    angle = np.arctan(min(scene.object.friction, _MOST_FRICTION))
    if not _one_sided(points, normals, span, float(np.sin(angle))):
        return ""
    return (
        f"the object is {_centimetres(narrowest)} across where it is narrowest, without edge or handle to hold it by, "
        f"and the fingertips of {hand.name} open to {_centimetres(opening)}; use a smaller object or a larger hand"
    )


def why_trials_failed(scene: Scene, grasps: Sequence[Grasp]) -> str:
    """Return a text with the reasons of failed trials, most frequent first, and advice. "" without failed trials."""
    failed = [grasp for grasp in grasps if grasp.verdict is Verdict.FAILED and grasp.reason]
    if not failed:
        return ""
    reasons = Counter(kind_of(grasp.reason) for grasp in failed).most_common(_REASONS_TOLD)
    text = f"{len(failed)} grasps failed their trials: {', '.join(f'{reason} ({count})' for reason, count in reasons)}"
    if scene.support is None:
        return text
    heights = scene.object.mesh.vertices @ scene.support.normal - scene.support.offset
    normals = np.array([contact.normal for grasp in failed for contact in grasp.contacts]).reshape(-1, 3)
    above = np.median(normals @ scene.support.normal) if len(normals) else 0.0
    if heights.max() > _LOW or above < _FROM_ABOVE:
        return text
    return (
        f"{text}; the object is {heights.max() * 1e3:.0f} mm high on its support, so the fingers press it from above; "
        "move a part of it over an edge, or use a hand with thinner fingers"
    )


def kind_of(reason: str) -> str:
    """Return a failure reason without its numbers and directions, to count equal kinds. Names keep their digits."""
    number = r"(by )?(?<!\w)[-+]?\d+(\.\d+)?(e[-+]?\d+)?( ?°| ?[cm]?m\b)?"
    for figures in (r"\([^()]*\d[^()]*\)", number, r"along [-+][xyz]"):
        reason = re.sub(figures, " ", reason)
    return re.sub(r" (?=[;,.:])", "", " ".join(reason.split()))


# The cache keeps the last eight hands. Hands are hashed by identity.
@lru_cache(maxsize=8)
def reach_of(hand: HandModel) -> tuple[float, float]:
    """Return the open hand's greatest distance between two contact candidates, and between two fingertips [m]."""
    points = in_base(link_poses(hand, hand.open_posture), hand.candidate_points, hand.candidate_link)
    groups = hand.link_group[hand.candidate_link]
    tips = [points[groups == group] for group in hand.fingertip_groups]
    gaps = [cdist(a, b).min() for k, a in enumerate(tips) for b in tips[:k] if len(a) and len(b)]
    return float(pdist(points).max(initial=0.0)), float(max(gaps, default=0.0))


def _surface(scene: Scene) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return points on the object's surface [m] and their outward unit normals."""
    mesh = scene.object.mesh
    points, normals = surface_samples(mesh, _SAMPLES, seed=0)
    across = scaled_normals(mesh.vertices, mesh.faces)
    doubled = np.linalg.norm(across, axis=-1)
    # A face with zero area has no normal.
    real = doubled > 1e-12
    middles, across = mesh.vertices[mesh.faces[real]].mean(1), across[real] / doubled[real, None]
    return np.concatenate([points, middles]), np.concatenate([normals, across])


def _one_sided(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], radius: float, least: float
) -> bool:
    """Return True if in every patch of `radius` [m], all friction-cone forces lie in one half-space (`_separated`)."""
    tree = KDTree(points)
    _, first = np.unique(packed_rows(np.round(points / (radius / 4)).astype(np.int64)), return_index=True)
    return all(_separated(normals[tree.query_ball_point(points[k], radius)], least) for k in first)


def _separated(normals: Float[np.ndarray, "n 3"], least: float) -> bool:
    """Return True if a unit direction a has n·a > `least` for all normals n. `least` is the sine of the friction angle.

    The best direction points to the point of the normals' convex hull that is nearest to the origin. Gilbert's
    algorithm (SIAM J. Control 1966) finds this point. The search ends early once no direction can exist.
    """
    nearest = normals.mean(0)
    for _ in range(_STEPS):
        along = normals @ nearest
        worst, length = along.argmin(), float(np.linalg.norm(nearest))
        if length <= least:
            return False
        if along[worst] > least * length:
            return True
        step = nearest - normals[worst]
        share = float(nearest @ step) / max(float(step @ step), 1e-12)
        nearest = nearest - min(max(share, 0.0), 1.0) * step
    return False


def _centimetres(metres: float) -> str:
    return f"{metres * 100:.0f} cm"
