"""The noisy hold trial: does a grasp survive not knowing exactly where the object is?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.se3 import quaternion_from_rotation, rotation_from_axis_angle, rotation_from_quaternion
from graspd_core.trials.hold_trial import hold_trial
from graspd_core.trials.world import Protocol, World
from graspd_core.types import Grasp, Posture, TrialResult

TRIALS = 8
# A turn and an offset [m] of the hand.
PoseError = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]
# Errors are uniform up to these: along each axis [m], and about a random axis through the centre of mass [rad].
OFFSET, TURN = 0.005, float(np.deg2rad(5.0))


def noisy_trial(
    world: World, grasp: Grasp, protocol: Protocol, *, seed: int = 0, stop: Callable[[], bool] = lambda: False
) -> float:
    """Share of 8 hold trials that the grasp passes, each with the hand out of place by up to 5 mm and 5°."""
    return sum(hold.passed for hold in noisy_holds(world, grasp, protocol, seed=seed, stop=stop)) / TRIALS


def noisy_holds(
    world: World, grasp: Grasp, protocol: Protocol, *, seed: int = 0, stop: Callable[[], bool] = lambda: False
) -> tuple[TrialResult, ...]:
    """The 8 hold trials of a noisy trial.

    The error moves pregrasp, grasp and squeeze alike, as a wrong estimate of the object's pose would. Same seed, same
    errors. A start that the error pushes too deep into the object counts as not held.
    """
    moved = [displaced(grasp, *error, world.center_of_mass + world.origin) for error in pose_errors(seed, TRIALS)]
    return tuple(hold_trial(world, g, protocol, stop=stop) for g in moved)


def noisy_share(
    world: World,
    grasp: Grasp,
    protocol: Protocol,
    errors: Sequence[PoseError],
    *,
    stop: Callable[[], bool] = lambda: False,
) -> float | None:
    """Share of hold trials under the given errors that the grasp passes.

    None where `stop` ended one of them, or there is none.
    """
    held, center = 0, world.center_of_mass + world.origin
    for error in errors:
        held += hold_trial(world, displaced(grasp, *error, center), protocol, stop=stop).passed
        if stop():
            return None
    return held / len(errors) if errors else None


def pose_errors(seed: int | Sequence[int], count: int) -> list[PoseError]:
    """Seeded errors, one for each trial."""
    rng = np.random.default_rng(seed)
    return [pose_error(rng) for _ in range(count)]


def pose_error(rng: np.random.Generator) -> PoseError:
    """A random turn and a random offset [m]."""
    axis = rng.normal(size=3)
    angle = torch.tensor(rng.uniform(-TURN, TURN), dtype=torch.float64)
    rotation = rotation_from_axis_angle(torch.as_tensor(axis / np.linalg.norm(axis)), angle).numpy()
    return rotation, rng.uniform(-OFFSET, OFFSET, 3)


def displaced(
    grasp: Grasp,
    rotation: Float[np.ndarray, "3 3"],
    offset: Float[np.ndarray, "3"],
    center: Float[np.ndarray, "3"],
) -> Grasp:
    """The grasp with all its hand postures turned about `center` and shifted by `offset` [m], object frame."""

    def move(posture: Posture) -> Posture:
        base = rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz, dtype=torch.float64)).numpy()
        return replace(
            posture,
            position=rotation @ (posture.position - center) + center + offset,
            quaternion_wxyz=quaternion_from_rotation(torch.as_tensor(rotation @ base)).numpy(),
        )

    return replace(grasp, pregrasp=move(grasp.pregrasp), grasp=move(grasp.grasp), squeeze=move(grasp.squeeze))
