"""The displacement trial (SD): how far gravity moves an object off a hand that is frozen in its grasp, in 0.15 s.

ObMan's protocol (Hasson et al., CVPR 2019), the figure that the papers report, re-implemented from its parameters in
PyBullet. Where this deviates: docs/metrics.md.
"""

# pybullet is a compiled module without stubs.
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from graspd_core.bench.bullet.bullet_world import BulletWorld, add_frozen_hand, add_object, simulation
from graspd_core.trials.displacement_trial import FRICTION, GRAVITY, MASS, STEPS, TIMESTEP
from graspd_core.trials.hold_trial import DIRECTIONS
from graspd_core.types import Posture

SOLVER_ITERATIONS = 150
HAND_RESTITUTION, OBJECT_RESTITUTION = 0.0, 0.5

# Gravity's one direction in the papers, object frame: any direction for a mesh that lies anyhow.
OBMAN = np.array([[0.0, 1.0, 0.0]])


def bullet_displacement(
    world: BulletWorld, posture: Posture, *, directions: Float[np.ndarray, "directions 3"] = DIRECTIONS
) -> float:
    """Displacement of the object's centre of mass [m] after 35 steps of 1/240 s, mean over gravity's directions.

    An object in free fall moves 10.7 cm, so that a figure near it says only that the hand does not hold.
    """
    return float(displacements(world, posture, directions).mean())


def displacements(
    world: BulletWorld, posture: Posture, directions: Float[np.ndarray, "directions 3"]
) -> Float[np.ndarray, "directions"]:
    """Displacement [m] under gravity along each of some unit directions of the object's frame."""
    import pybullet

    moved = np.empty(len(directions))
    with simulation(timestep=TIMESTEP, solver_iterations=SOLVER_ITERATIONS) as client:
        body = add_object(client, world, MASS)
        pybullet.changeDynamics(
            body, -1, lateralFriction=FRICTION, restitution=OBJECT_RESTITUTION, physicsClientId=client
        )
        for fixed in add_frozen_hand(client, world.hand, posture):
            pybullet.changeDynamics(
                fixed, -1, lateralFriction=FRICTION, restitution=HAND_RESTITUTION, physicsClientId=client
            )
        start = pybullet.saveState(physicsClientId=client)
        for index, direction in enumerate(directions):
            pybullet.restoreState(start, physicsClientId=client)
            pybullet.setGravity(*(GRAVITY * direction).tolist(), physicsClientId=client)
            for _ in range(STEPS):
                pybullet.stepSimulation(physicsClientId=client)
            position, _ = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
            moved[index] = np.linalg.norm(np.array(position) - world.center_of_mass)
    return moved
