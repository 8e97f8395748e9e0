"""Planning settings of all methods, and the certainty required of grasps on objects seen by cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graspd_core.errors import ConfigError


@dataclass(frozen=True)
class ProblemConfig:
    """Settings of the optimisation problem made from scene and hand. All methods rank their grasps by this problem.

    Attributes:
        candidates: number of contact candidates that most steps use.
        fine_candidates: number of contact candidates that polishing uses.
        patch_size: number of contact candidates in a patch. Each patch is drawn to the surface separately, so that all
            of the hand touches. Zero draws only the nearest candidate of each rigid group of links.
        softness: depth to which the hand's surface yields, as flesh does [m]. Planning makes the object thinner by this
            depth and ignores the object's sharp points. Trials do not model softness.
        features: number of sharp object points that polishing uses. Large thin walls get more.
        directions: number of disturbance wrenches.
        friction: friction coefficient for planning, below the object's own, so that contacts keep a margin.
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
    """Settings of the pregrasp and squeeze postures.

    Attributes:
        touch_reach: links this near to the object count as touching [m].
        grip_force: sum of the normal forces of the squeeze, unless `link_force` limits it [N]. Heavy objects get more.
        link_force: greatest planned normal force of one link [N]. Lower it for delicate objects, or give the mass.
        stiffness: position gain of the controllers of the hand's revolute joints [N·m/rad].
        slide_stiffness: position gain of the controllers of the hand's prismatic joints [N/m].
        effort_share: fraction of a joint's effort limit that the squeeze may use.
        clearance: distance from the object to which the pregrasp opens [m].
        open_steps: number of steps in the search for the pregrasp.
        open_joint_rate: step size of revolute joints in this search [rad]. Prismatic joints move 0.05 m per radian.
        open_base_rate: step size of the hand's base in this search [m].
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
    """Settings for rounds of optimisation and trials. If too few grasps held, the next round starts from other poses.

    An effort of 1 leaves the method's settings unchanged. An effort below 1 multiplies the number of steps. An effort
    above 1 multiplies the number of starts.

    Attributes:
        most: maximum number of rounds.
        first_budget: effort of the first round for an object of known shape that stands alone. Others get 1.
        growth: factor on the effort from one round to the next.
    """

    most: int = 3
    first_budget: float = 0.5
    growth: float = 2.0


@dataclass(frozen=True)
class RobustConfig:
    """Settings for further trials of verified grasps, with the hand misplaced by up to 5 mm and 5°.

    Attributes:
        rank: whether to run these trials. Grasps that hold in more trials rank higher.
        trials: number of these hold trials for each verified grasp.
        hold_time: duration of each of a trial's six pulls [s].
        friction: whether to measure the least friction at which each verified grasp holds.
    """

    rank: bool = False
    trials: int = 8
    hold_time: float = 0.5
    friction: bool = False


@dataclass(frozen=True)
class HeldShares:
    """Fractions of single-view grasps that hold on the true object with its true mass, by trials (docs/clouds.md).

    Attributes:
        likeliest: among grasps that hold on the likeliest shape in trials.
        places: among those that also hold with the hand misplaced.
        shapes: among those that also hold on two other shapes of the hidden side.
        fails_places: among grasps that hold on the likeliest shape but not with the hand misplaced.
        fails_shapes: among grasps that hold with the hand misplaced but not on two other shapes.
    """

    likeliest: float
    places: float
    shapes: float
    fails_places: float
    fails_shapes: float


# Measured on 385 grasps planned without a mass and 544 with the true mass, on 76 single views (docs/clouds.md).
# An assumed mass is the heavy end of what the volume allows, so trials lift more than most objects weigh.
MASS_ASSUMED = HeldShares(0.85, 0.88, 0.95, 0.77, 0.85)
MASS_KNOWN = HeldShares(0.80, 0.89, 0.95, 0.61, 0.83)
# Masses as fractions of the heavy end of the volume, and the fraction of 325 drawn household objects and ten scans that
# weigh at most this.
_MASSES, _LIGHTER = (0.0, 0.25, 0.5, 0.7, 1.0), (0.0, 0.26, 0.64, 0.85, 1.0)
# With a payload below the heavy end, a grasp is verified only if at least this fraction of objects is lighter than it.
LEAST_LIGHT = 0.8
# Fraction of grasps that hold on a doubtful scene, e.g. with a doubtful camera position. Each doubt multiplies by it.
DOUBTED_SHARE = 0.6


def share_as_light(mass: float, heavy: float) -> float:
    """Return the fraction of objects that weigh at most `mass` [kg], if their volume allows up to `heavy` [kg]."""
    return float(np.interp(mass / heavy, _MASSES, _LIGHTER))


def light_end(heavy: float) -> float:
    """Return the least mass [kg] that a verified grasp must lift, if the object's volume allows up to `heavy` [kg]."""
    return float(np.interp(LEAST_LIGHT, _LIGHTER, _MASSES)) * heavy


@dataclass(frozen=True)
class CertaintyConfig:
    """How certain a grasp of an object seen by cameras must be to count as verified.

    Attributes:
        probability: least probability of holding on the true object, if that weighs no more than in the trials. With 0,
            only the likeliest shape is tried. Higher values require further trials (docs/clouds.md).

    Raises:
        ConfigError: the probability is higher than any trials can ensure.
    """

    probability: float = 0.95

    def __post_init__(self) -> None:
        most = min(MASS_ASSUMED.shapes, MASS_KNOWN.shapes)
        if not 0 <= self.probability <= most:
            raise ConfigError(f"certainty.probability: {self.probability}; valid: 0 to {most}")
