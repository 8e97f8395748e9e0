"""Success over friction and mass: grasps are planned at a friction and then tried at every mass."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graspd_core.bench.failure_maps.map_case import Done, MapCase, plan, settings, try_grasps
from graspd_core.hands.model import HandModel
from graspd_core.scene.load_scene import load_scene
from graspd_core.scene.scene import ObjectModel
from graspd_core.trials.world import PROTOCOLS, at_friction
from graspd_core.types import Grasp

FRICTIONS = (0.1, 0.2, 0.3, 0.6, 1.5)
MASSES = (0.005, 0.03, 0.1, 0.3, 1.0, 2.0)
THINGS = ("cylinder", "mug")


def run(case: MapCase) -> Done:
    """Plan at the friction of the case, for the 0.1 kg that planning supposes; try at every mass."""
    config = settings(case.preset)
    scene = load_scene(f"shape:{case.thing}", friction=float(case.across), resolution=config.resolution)
    hand, grasps = plan(case, scene)
    protocol = at_friction(PROTOCOLS["standard"], float(case.across))
    cells = tuple(try_grasps(case, mass, hand, at_mass(scene.object, mass), grasps, protocol) for mass in case.up)
    stiffness = np.where(hand.slides, protocol.slide_stiffness, protocol.stiffness)
    shares = [effort_used(hand, grasp, stiffness) for grasp in grasps]
    return Done(cells, {"effort_used": float(np.median(shares)) if shares else None})


def at_mass(target: ObjectModel, mass: float | str) -> ObjectModel:
    """The same object of another mass [kg], evenly spread as before."""
    share = float(mass) / target.mass
    return replace(target, mass=float(mass), inertia=target.inertia * share)


def effort_used(hand: HandModel, grasp: Grasp, stiffness: np.ndarray) -> float:
    """The greatest share of its effort limit that a joint's motor is asked for in the squeeze; one is all of it."""
    offset = grasp.squeeze.joint_positions - grasp.grasp.joint_positions
    return float((np.abs(offset) * stiffness / hand.effort).max())
