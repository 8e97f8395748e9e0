"""A case of study `piles`: so many things, how they are dropped, and what the camera sees of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.bench.study import Case, Record, Request, find_objects, object_hash, thing_name
from graspd_core.errors import ConfigError
from graspd_core.mesh.shapes import SHAPES
from graspd_core.methods.plan_config import PlanConfig, load_preset
from graspd_core.pointcloud.depth_image import cloud_from_depth
from graspd_core.pointcloud.point_cloud import PointCloud
from graspd_core.rendering.depth_noise import DEFAULT
from graspd_core.rendering.tabletop import CAMERA, TabletopScene, depth_views, moved, ring_poses, tabletop
from graspd_core.scene.load_scene import load_scene
from graspd_core.scene.scene import object_parts
from graspd_core.se3 import random_rotations
from graspd_core.trials.bodies import FreeBody
from graspd_core.trials.free_bodies import settle

# Things in a scene.
SIZES, MOST_THINGS = (3, 5, 8, 12), 24
MASS = 0.1
# The fence that things fall into has this side for one thing, and the root of their number times it for many [m].
_FENCE = 0.12
# Where the camera stands: far enough to see what rolls away [rad], [m].
_ELEVATION, _DISTANCE = np.deg2rad(55.0), 0.7


@dataclass(frozen=True)
class PileCase(Case):
    """`size` things drawn from `objects`, dropped, and taken out as cameras see them from `views` places."""

    objects: tuple[str, ...]
    size: int
    preset: str
    hand: str
    seed: int
    views: int = 1

    @property
    def label(self) -> str:
        return f"{self.size} things {self.preset} {self.hand} {self.seed} {self.views}"

    @property
    def config(self) -> PlanConfig:
        return load_preset(self.preset)

    def asked(self) -> Record:
        return {**super().asked(), "objects": [[thing_name(thing), object_hash(thing)] for thing in self.objects]}


def pile_cases(request: Request) -> tuple[PileCase, ...]:
    """A scene a size and seed. Raises GraspdError: an object or a size that there is not."""
    sizes = tuple(map(_size, request.cases)) or (SIZES[:1] if request.quick else SIZES)
    objects = find_objects(request.objects or [f"shape:{name}" for name in SHAPES])
    preset, hand = request.preset(), request.hand or "allegro_right"
    return tuple(PileCase(objects, size, preset, hand, seed) for seed in request.seeds or (0,) for size in sizes)


def _size(text: str) -> int:
    if not text.isdigit() or not 1 <= int(text) <= MOST_THINGS:
        raise ConfigError(f"cases: {text!r}; valid: how many things there are, 1 to {MOST_THINGS}")
    return int(text)


def pile_seconds(case: PileCase) -> float:
    """CPU seconds of a case, roughly: among more neighbours every plan takes longer."""
    return 4.0 * case.size + 0.3 * case.size**2


def drawn_things(case: PileCase) -> list[str]:
    """The things of a scene: all in a drawn order, then all again where there are too few."""
    rng = np.random.default_rng((case.seed, case.size))
    order: list[str] = []
    while len(order) < case.size:
        order += [case.objects[k] for k in rng.permutation(len(case.objects))]
    return order[: case.size]


def dropped_pile(case: PileCase) -> tuple[FreeBody, ...]:
    """Things at rest: they fall one above the other into a fence, which is taken away then."""
    things = drawn_things(case)
    models = {thing: load_scene(thing, mass=MASS).object for thing in set(things)}
    generator = torch.Generator().manual_seed(1000 * case.seed + case.size)
    turns = random_rotations(case.size, generator, torch.float64).numpy()
    wall = 0.5 * _FENCE * float(np.sqrt(case.size)) + 0.05
    places = 0.3 * wall * (2 * torch.rand(case.size, 2, generator=generator, dtype=torch.float64).numpy() - 1)
    bodies, height = [], 0.0
    for thing, turn, place in zip(things, turns, places, strict=True):
        model, pose = models[thing], np.eye(4)
        reach = model.radius + 0.01
        pose[:3, :3] = turn
        pose[:3, 3] = np.array([*place, height + reach]) - turn @ model.center_of_mass
        height += 2 * reach
        bodies.append(FreeBody(model, object_parts(model), pose))
    fallen = posed(bodies, settle(bodies, wall=wall, seconds=4.0 + height))
    return posed(fallen, settle(fallen))


def posed(bodies: Sequence[FreeBody], poses: Sequence[Float[np.ndarray, "4 4"]]) -> tuple[FreeBody, ...]:
    """The things elsewhere."""
    return tuple(replace(body, pose=pose) for body, pose in zip(bodies, poses, strict=True))


def seen_pile(case: PileCase, bodies: Sequence[FreeBody], look: int) -> tuple[list[PointCloud], Any]:
    """What the cameras see, and of each point, view after view, which thing it truly is of (beyond them: the table)."""
    meshes = [moved(body.model.mesh, body.pose) for body in bodies]
    table = tabletop("sphere")
    stage = TabletopScene(meshes[0], np.eye(4), tuple(meshes[1:]), table.table, table.support)
    poses = ring_poses(case.views, elevation=_ELEVATION, distance=_DISTANCE, azimuth=np.deg2rad(20.0 + 120 * case.seed))
    images = depth_views(stage, CAMERA, poses, DEFAULT, 100_000 * case.seed + 10 * look)
    views = [cloud_from_depth(depth, CAMERA, pose) for (depth, _), pose in zip(images, poses, strict=True)]
    return views, np.concatenate([label[depth > 0] for depth, label in images])
