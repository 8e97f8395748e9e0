"""Success over the resolution of the distance grid and the thickness of an open cup's wall."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

from graspd_core.bench.failure_maps.map_case import MapCase, MapCell, plan, try_grasps
from graspd_core.bench.stress.broken_meshes import thin_cup
from graspd_core.mesh.sdf import build_sdf
from graspd_core.scene.scene import Scene, build_scene
from graspd_core.trials.world import PROTOCOLS

RESOLUTIONS = (8.0, 16.0, 48.0, 96.0)
WALLS = (0.3, 1.0, 3.0, 6.0)
THINGS = ("cup",)


def run(case: MapCase) -> tuple[MapCell, ...]:
    """Plan on a grid of that resolution, and no finer, of a cup with walls of so many millimetres."""
    (wall,) = case.up
    scene = on_grid(cup(float(wall)), int(case.across))
    hand, grasps = plan(case, scene)
    return (try_grasps(case, wall, hand, scene.object, grasps, PROTOCOLS["standard"]),)


@lru_cache(maxsize=1)
def cup(wall: float) -> Scene:
    """A cup with walls of so many millimetres."""
    return build_scene(thin_cup(wall * 1e-3), source=f"cup of {wall:g} mm")


def on_grid(scene: Scene, resolution: int) -> Scene:
    """The same scene with the distances of another grid, however much too coarse."""
    return replace(scene, sdf=build_sdf(scene.object.mesh, resolution=resolution))
