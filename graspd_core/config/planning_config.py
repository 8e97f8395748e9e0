"""Hold the planning settings of all methods, and the certainty that grasps need if cameras saw the object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graspd_core.errors import ConfigError


@dataclass(frozen=True)
class ProblemConfig:
    """Settings of the optimisation problem made from scene and hand. All methods rank grasps by this problem.

    Attributes:
        candidates: number of contact candidates (points on the hand) in most optimiser steps.
        fine_candidates: number of contact candidates in the last optimiser steps (polishing).
        patch_size: number of contact candidates in a patch. The optimiser pulls each patch to the surface separately,
            so that the whole hand touches. With zero, it pulls only the nearest candidate of each rigid group of links.
        softness: depth to which the hand's surface yields, as flesh does [m]. Planning makes object and hand thinner by
            this depth, for contact candidates and for sharp points. Trials do not model softness.
        features: number of sharp object points in the last optimiser steps. Objects with large thin walls get more.
        directions: number of disturbance wrenches that a grasp should resist.
        friction: friction coefficient for planning, below the object's friction, so that contacts keep a margin.
        confidence_floor: weight of a contact on guessed surface, relative to a contact on seen surface.
    """

    candidates: int = 256
    fine_candidates: int = 600
    patch_size: int = 4
    softness: float = 0.0
    features: int = 128
    directions: int = 24
    friction: float = 0.4
    confidence_floor: float = 0.4


@dataclass(frozen=True)
class GraspStagesConfig:
    """Settings of the pregrasp posture (just before contact) and the squeeze posture (which applies the grip force).

    Attributes:
        touch_reach: a link counts as touching up to this distance from the object [m].
        grip_force: sum of the normal forces of the squeeze [N]. `link_force` may limit the sum. Heavy objects get more.
        link_force: greatest planned normal force of one link [N]. In trials, links press with up to 9 N more, because
            fingers push until they reach their posture. For delicate objects, use less, or give the mass.
        stiffness: position gain of the controllers of the hand's revolute joints [N·m/rad].
        slide_stiffness: position gain of the controllers of the hand's prismatic joints [N/m].
        effort_share: fraction of a joint's effort limit that the squeeze may use.
        clearance: distance from the object to which the pregrasp opens [m].
        open_steps: number of steps in the search for the pregrasp.
        open_joint_rate: step size of revolute joints in the search [rad]. Prismatic joints move 0.05 m per radian.
        open_base_rate: step size of the hand's base in the search [m].
    """

    touch_reach: float = 0.002
    grip_force: float = 40.0
    link_force: float = 40.0
    stiffness: float = 5.0
    slide_stiffness: float = 2000.0
    effort_share: float = 1.0
    clearance: float = 0.012
    open_steps: int = 40
    open_joint_rate: float = 0.04
    open_base_rate: float = 0.002


@dataclass(frozen=True)
class RoundsConfig:
    """Settings for rounds of optimisation and trials. If too few grasps hold, a further round starts from other poses.

    An effort of 1 leaves the method's settings unchanged. An effort below 1 multiplies the number of steps. An effort
    above 1 multiplies the number of starting poses, and draws the whole hand to the surface.

    Attributes:
        most: maximum number of rounds.
        first_budget: effort of the first round for an object of known shape that stands alone. Other known objects get
            1. Objects that cameras saw get `growth`.
        growth: factor between the efforts of a round and the next round.
    """

    most: int = 3
    first_budget: float = 0.5
    growth: float = 2.0


@dataclass(frozen=True)
class RobustConfig:
    """Settings for further trials of verified grasps, with the hand misplaced by up to 5 mm and 5°.

    Attributes:
        rank: whether to run the further trials. Grasps that hold in more trials rank higher.
        trials: number of further trials for each verified grasp.
        hold_time: duration of the pull in each of the six directions of a trial [s].
        friction: whether to measure the least friction at which each verified grasp holds.
    """

    rank: bool = False
    trials: int = 8
    hold_time: float = 0.5
    friction: bool = False


@dataclass(frozen=True)
class HeldShares:
    """For groups of grasps, the fraction that holds on the true object with its true mass (docs/clouds.md).

    Attributes:
        likeliest: grasps that hold on the likeliest shape, the best guess from the view.
        places: grasps that also hold with the hand misplaced.
        shapes: grasps that hold with the hand misplaced and on other shapes. Stated, not measured.
        fails_places: grasps that hold on the likeliest and on other shapes, but not with the hand misplaced.
        fails_shapes: grasps that hold on the likeliest shape but not on other shapes.
    """

    likeliest: float
    places: float
    shapes: float
    fails_places: float
    fails_shapes: float


# Measured on 919 grasps on 133 single views without a mass, and 412 grasps on 57 views with the true mass. The interval
# of `shapes` is 0.90 to 0.97, and 0.85 to 0.95 with the mass. Both state 0.95 for the reasons in docs/clouds.md.
# Without a mass, trials use `light_end` of the assumed mass, which is more than most objects weigh.
MASS_ASSUMED = HeldShares(0.80, 0.87, 0.95, 0.81, 0.66)
MASS_KNOWN = HeldShares(0.77, 0.85, 0.95, 0.75, 0.61)
# Masses as fractions of the heavy end, and for each mass the fraction of objects that weigh at most this mass. Counted
# on 325 drawn household objects and ten scans.
_MASSES, _LIGHTER = (0.0, 0.25, 0.5, 0.7, 1.0), (0.0, 0.26, 0.64, 0.85, 1.0)
# A grasp with a payload below the heavy end is verified only if it can lift at least this fraction of objects.
LEAST_LIGHT = 0.8
# Fraction of grasps that hold if the scene has one doubt, e.g. about the camera position. For n doubts, its nth power.
DOUBTED_SHARE = 0.6


def share_as_light(mass: float, heavy: float) -> float:
    """Return the fraction of objects that weigh at most `mass` [kg], if the greatest plausible mass is `heavy` [kg]."""
    return float(np.interp(mass / heavy, _MASSES, _LIGHTER))


def light_end(heavy: float) -> float:
    """Return the least mass [kg] that a verified grasp must lift, if the greatest plausible mass is `heavy` [kg]."""
    return float(np.interp(LEAST_LIGHT, _LIGHTER, _MASSES)) * heavy


@dataclass(frozen=True)
class CertaintyConfig:
    """The certainty that a grasp needs to count as verified, if cameras saw the object.

    Attributes:
        probability: least probability that a grasp holds on the true object, if the object weighs no more than in the
            trials. With 0, only the likeliest shape is tried. Higher values require further trials (docs/clouds.md).

    Raises:
        ConfigError: the probability is higher than any trials can ensure.
    """

    probability: float = 0.95

    def __post_init__(self) -> None:
        most = min(MASS_ASSUMED.shapes, MASS_KNOWN.shapes)
        if not 0 <= self.probability <= most:
            raise ConfigError(f"certainty.probability: {self.probability}; valid: 0 to {most}")
