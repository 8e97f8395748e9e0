"""Settings of planning that every method shares, and the certainty that a verified grasp of a seen object needs."""

from __future__ import annotations

from dataclasses import dataclass

from graspd_core.errors import ConfigError


@dataclass(frozen=True)
class ProblemConfig:
    """How scene and hand are laid out as tensors. Every method's poses become grasps and are ranked in these terms.

    Attributes:
        candidates: contact candidates looked at by most steps.
        fine_candidates: contact candidates looked at while polishing.
        patch_size: how many of them make a patch that is drawn to the surface by itself, so that all of the hand comes
            to touch. Zero: of each rigid group of links the nearest candidate is drawn.
        softness: how deep the hand gives, as flesh does [m]: the object is planned with as so much thinner, without its
            sharp points. Trials know nothing of it.
        features: sharp points of the object looked at while polishing, more on large thin walls.
        directions: disturbance wrenches.
        friction: coefficient planned with, below the object's own, so that contacts keep a margin.
        confidence_floor: weight of a contact on surface that was only guessed, against one on seen surface.
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
    """Pregrasp and squeeze.

    Attributes:
        touch_reach: links this near to the object count as touching [m].
        grip_force: sum of the normal forces of the squeeze [N].
        stiffness: position gain of the hand's joint controllers, of turning joints [N·m/rad].
        slide_stiffness: the same of sliding joints [N/m].
        effort_share: share of a joint's effort limit that the squeeze may use.
        clearance: distance from the object that the pregrasp opens to [m].
        open_steps: steps of the search for the pregrasp.
        open_joint_rate: its step size of the joints [rad]. Sliding ones take 0.05 m for a radian.
        open_base_rate: its step size of the base [m].
    """

    touch_reach: float = 0.002
    grip_force: float = 40.0
    stiffness: float = 5.0
    slide_stiffness: float = 2000.0
    effort_share: float = 1.0
    clearance: float = 0.012
    open_steps: int = 40
    open_joint_rate: float = 0.04
    open_base_rate: float = 0.002


@dataclass(frozen=True)
class RoundsConfig:
    """Rounds of optimiser and trial: if too few grasps held, the next round starts from other poses.

    An effort of one is the method's settings as they are. Less is that share of its steps, more is as many times its
    starts.

    Attributes:
        most: rounds at most.
        first_budget: effort of the first round on an object of known shape that stands alone, one for all others.
        growth: times as much effort with every further round.
    """

    most: int = 3
    first_budget: float = 0.5
    growth: float = 2.0


@dataclass(frozen=True)
class RobustConfig:
    """Verified grasps tried again with the hand out of place by up to 5 mm and 5°: those that still hold come first.

    Attributes:
        rank: whether that is done, by `trials` further hold trials for every verified grasp.
        trials: hold trials of each.
        hold_time: how long each of their six pulls lasts [s].
        friction: whether the least friction at which each verified grasp holds is measured.
    """

    rank: bool = False
    trials: int = 8
    hold_time: float = 0.5
    friction: bool = False


@dataclass(frozen=True)
class HeldShares:
    """Shares of the grasps of a single view that hold on the true object at its own mass (docs/clouds.md).

    Attributes:
        likeliest: of those that hold on the likeliest shape.
        places: of these, that hold out of place as well.
        shapes: of these, that hold on two other shapes of the hidden side as well.
        fails_places: of those that hold on the likeliest shape but not out of place.
        fails_shapes: of those that hold out of place but not on two other shapes.
    """

    likeliest: float
    places: float
    shapes: float
    fails_places: float
    fails_shapes: float


# Over 1,323 grasps of 186 single views (docs/clouds.md says of what). Where the mass is the heavy end of what the
# volume allows, trials ask for more than most things weigh. Where it is known, places and friction leave less room.
MASS_ASSUMED = HeldShares(0.92, 0.94, 0.98, 0.87, 0.83)
MASS_KNOWN = HeldShares(0.70, 0.89, 0.95, 0.60, 0.59)
# Of 325 drawn household things and ten scans, about this much times x weigh at most x of the heavy end of their volume:
# 0.26 at 0.25, 0.64 at 0.5, 0.85 at 0.7. A hand whose payload is less than the heavy end holds no more of them.
_LIGHT_GROWTH = 1.3
# A grasp is verified at less than the heavy end only if at least this share of the things weighs less than the payload.
LEAST_LIGHT = 0.5
# The share that holds of grasps on a scene that something speaks against, as a cloud whose camera stood elsewhere.
DOUBTED_SHARE = 0.6


def share_as_light(mass: float, heavy: float) -> float:
    """Return the share of things whose volume allows `heavy` that weigh at most `mass` [kg]."""
    return min(1.0, _LIGHT_GROWTH * mass / heavy)


@dataclass(frozen=True)
class CertaintyConfig:
    """What a grasp of an object that cameras saw must survive to be called verified.

    Attributes:
        probability: of holding on the true object, at least. 0 asks for trials of the likeliest shape alone, more for
            further ones (docs/clouds.md).

    Raises:
        ConfigError: no trials make a grasp so sure.
    """

    probability: float = 0.95

    def __post_init__(self) -> None:
        if not 0 <= self.probability <= MASS_KNOWN.shapes:
            raise ConfigError(f"certainty.probability: {self.probability}; valid: 0 to {MASS_KNOWN.shapes}")
