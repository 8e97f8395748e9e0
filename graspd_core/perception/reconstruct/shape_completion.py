"""Complete the unseen side of an object by the rule that fits the views best.

The rules are a body of revolution, one or two mirror planes, a centre of symmetry, and extrusion. Extrusion extends the
outline seen from above down to the support, alone or together with a symmetry. Guessed points in empty space, in the
support, or at seen surface are dropped. A rule must be largely confirmed by the views and hardly contradicted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from graspd_core.config import ReconstructionConfig
from graspd_core.perception.cloud.free_space import FreeSpace, empty_depth
from graspd_core.perception.reconstruct.extrusion import extrude, with_foot
from graspd_core.perception.reconstruct.merge_views import Surfels, join, nothing, take, thin
from graspd_core.perception.reconstruct.revolution import find_revolution
from graspd_core.perception.reconstruct.symmetry import Symmetry, find_centre, find_mirrors, image

REVOLUTION, MIRROR, POINT_SYMMETRY, EXTRUSION = "revolution", "mirror", "point symmetry", "extrusion"
# Weight of the contradicted fraction of a body of revolution, relative to the fraction of seen points on the body.
FAULT_WEIGHT = 5.0
# If the cameras contradict a symmetry at more than this fraction of its points, the symmetry is taken for chance.
MAX_SYMMETRY_FAULTS = 0.02
# A centre of symmetry is preferred if its worth is over this many times that of mirror planes.
TIE = 1.1
# Least distance between the guessed points of two rules [m].
RULE_DISTANCE_M = 0.008


@dataclass(frozen=True)
class Completion:
    """The guessed part of a surface.

    Attributes:
        method: the rule, e.g. "mirror and extrusion". Empty if no rule was used.
        surfels: the guessed points, without those that contradict or repeat the seen surface.
        openness: fraction of the surface that was missing before the guess.
    """

    method: str
    surfels: Surfels
    openness: float


def complete_shape(seen: Surfels, free_space: FreeSpace, step: float, settings: ReconstructionConfig) -> Completion:
    """Guess the unseen side by the rule that best explains the seen surface and adds most surface to it."""
    missing = openness(with_foot(seen, free_space, step), step)
    turned = find_revolution(seen, free_space, step)
    if turned is not None and turned.share - FAULT_WEIGHT * turned.wrong > settings.revolution_share:
        guess = plausible(turned.surfels, seen, free_space, step)
        # Small hidden parts, such as the back of a handle, are left to the Poisson surface.
        return Completion(REVOLUTION if _counts(guess, seen) else "", guess, missing)
    methods, guess = [], nothing()
    if missing < settings.open_share:
        return Completion("", guess, missing)
    if free_space.standing:
        guess = plausible(extrude(seen, free_space, step), seen, free_space, step)
        methods = [EXTRUSION] if _counts(guess, seen) else []
    known = join(seen, guess)
    if openness(with_foot(known, free_space, step), step) > settings.open_share:
        name, raw = _symmetric(seen, free_space, settings.symmetry_worth)
        images = plausible(raw, known, free_space, step)
        if len(guess.points):
            # Where both rules guess, walls beneath seen outlines are more certain.
            apart = KDTree(guess.points).query(images.points)[0] > RULE_DISTANCE_M
            images = take(images, apart)
        methods += [name] if _counts(images, seen) else []
        guess = join(guess, images)
    return Completion(" and ".join(methods), guess, missing)


def openness(surfels: Surfels, step: float) -> float:
    """Return the missing fraction of a surface: the length of its mean normal, zero for a closed surface."""
    return float(np.linalg.norm(thin(surfels, 2 * step).normals.mean(0)))


def _counts(guess: Surfels, seen: Surfels) -> bool:
    return len(guess.points) > 0.03 * len(seen.points)


def plausible(guess: Surfels, known: Surfels, free_space: FreeSpace, step: float) -> Surfels:
    """Return the guess, thinned to `step` [m], without points that contradict the cameras or repeat known surface."""
    guess = take(guess, empty_depth(free_space, guess.points) < free_space.slack)
    distance, nearest = KDTree(known.points).query(guess.points, distance_upper_bound=3 * step)
    alike = (guess.normals * known.normals[np.minimum(nearest, len(known.points) - 1)]).sum(1) > 0
    return thin(take(guess, distance > np.where(alike, 2.5, 1.2) * step), step)


def _symmetric(seen: Surfels, free_space: FreeSpace, least: float) -> tuple[str, Surfels]:
    mirrors, centre = find_mirrors(seen, free_space), find_centre(seen, free_space)
    mirror, point = (one.worth if one.wrong < MAX_SYMMETRY_FAULTS else 0.0 for one in (mirrors[0], centre))
    # Rounding must not decide a near tie.
    if point > TIE * mirror:
        return (POINT_SYMMETRY, image(centre, seen)) if point >= least else ("", nothing())
    return (MIRROR, _mirrored(mirrors, seen)) if mirror >= least else ("", nothing())


def _mirrored(mirrors: list[Symmetry], seen: Surfels) -> Surfels:
    images = [image(m, seen) for m in mirrors]
    if len(mirrors) == 2:
        images.append(image(mirrors[1], images[0]))
    return join(*images)


def guess_by(rule: str, seen: Surfels, free_space: FreeSpace, step: float) -> Surfels | None:
    """Return points that `REVOLUTION` or `MIRROR` guesses on the unseen side. None if the rule makes no guess.

    The guess may be unlikely.
    """
    assert rule in (MIRROR, REVOLUTION)
    if rule == MIRROR:
        raw = _mirrored(find_mirrors(seen, free_space), seen)
    elif (turned := find_revolution(seen, free_space, step)) is not None:
        raw = turned.surfels
    else:
        return None
    guess = plausible(raw, seen, free_space, step)
    return guess if _counts(guess, seen) else None
