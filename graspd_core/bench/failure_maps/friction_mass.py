"""Success over friction and mass: grasps are planned at a friction and then tried at every mass."""

from __future__ import annotations

from dataclasses import replace

from graspd_core.bench.failure_maps.map_case import MapCase, MapCell, plan, settings, try_grasps
from graspd_core.scene.load_scene import load_scene
from graspd_core.scene.scene import ObjectModel
from graspd_core.trials.world import PROTOCOLS, at_friction

FRICTIONS = (0.1, 0.2, 0.3, 0.6, 1.5)
MASSES = (0.005, 0.03, 0.1, 0.3, 1.0, 2.0)
THINGS = ("cylinder", "mug")


def run(case: MapCase) -> tuple[MapCell, ...]:
    """Plan at the friction of the case, for the 0.1 kg that planning supposes; try at every mass."""
    config = settings(case.preset)
    scene = load_scene(f"shape:{case.thing}", friction=float(case.across), resolution=config.resolution)
    hand, grasps = plan(case, scene)
    protocol = at_friction(PROTOCOLS["standard"], float(case.across))
    return tuple(try_grasps(case, mass, hand, at_mass(scene.object, mass), grasps, protocol) for mass in case.up)


def at_mass(target: ObjectModel, mass: float | str) -> ObjectModel:
    """The same object of another mass [kg], evenly spread as before."""
    share = float(mass) / target.mass
    return replace(target, mass=float(mass), inertia=target.inertia * share)
