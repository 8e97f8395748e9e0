"""Success over the resolution of the distance grid and the thickness of an open cup's wall."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import torch

from graspd_core.bench.failure_maps.map_case import Done, MapCase, plan, try_grasps
from graspd_core.bench.stress.broken_meshes import thin_cup
from graspd_core.mesh.mesh_files import surface_samples
from graspd_core.mesh.sdf import build_sdf, sample_sdf
from graspd_core.scene.scene import Scene, build_scene
from graspd_core.trials.world import PROTOCOLS

RESOLUTIONS = (8.0, 16.0, 48.0, 96.0)
WALLS = (0.3, 1.0, 3.0, 6.0)
THINGS = ("cup",)
_SAMPLES = 4000


def run(case: MapCase) -> Done:
    """Plan on a grid of that resolution, and no finer, of a cup with walls of so many millimetres."""
    (wall,) = case.up
    scene = on_grid(cup(float(wall)), int(case.across))
    hand, grasps = plan(case, scene)
    cell = try_grasps(case, wall, hand, scene.object, grasps, PROTOCOLS["standard"])
    return Done((cell,), grid_errors(scene))


@lru_cache(maxsize=1)
def cup(wall: float) -> Scene:
    """A cup with walls of so many millimetres."""
    return build_scene(thin_cup(wall * 1e-3), source=f"cup of {wall:g} mm")


def on_grid(scene: Scene, resolution: int) -> Scene:
    """The same scene with the distances of another grid, however much too coarse."""
    return replace(scene, sdf=build_sdf(scene.object.mesh, resolution=resolution))


def grid_errors(scene: Scene) -> dict[str, float]:
    """What is left of the wall in the grid: nodes inside it, and how far from zero the distance is on the surface."""
    points = torch.as_tensor(surface_samples(scene.object.mesh, _SAMPLES, 0)[0]).to(scene.sdf.field)
    off = sample_sdf(scene.sdf, points)[0].abs()
    return {
        "cell_mm": 1e3 * float(scene.sdf.spacing),
        "nodes_inside": float((scene.sdf.field[0] < 0).sum()),
        "surface_off_mm": 1e3 * float(off.mean()),
    }
