"""The case of most studies: grasps of an object, and what is loaded for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from graspd_core.bench.study import Case, Request, find_objects
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import HandModel
from graspd_core.methods.candidates import find_candidates
from graspd_core.methods.loop import Hooks
from graspd_core.methods.plan_config import PlanConfig, load_preset
from graspd_core.scene.load_scene import load_scene
from graspd_core.scene.scene import Scene
from graspd_core.types import Grasp


@dataclass(frozen=True)
class ObjectCase(Case):
    """`count` grasps of an object (a mesh file or shape:NAME) with a hand, a preset and a seed."""

    object: str
    preset: str
    hand: str
    seed: int
    count: int

    @property
    def config(self) -> PlanConfig:
        return load_preset(self.preset)

    def load(self, friction: float = 0.6) -> tuple[HandModel, Scene]:
        """The hand and the scene."""
        hand = load_hand(self.hand, candidates=self.config.problem.fine_candidates)
        return hand, load_scene(self.object, resolution=self.config.resolution, friction=friction)


def object_cases(request: Request, objects: Sequence[str], count: int, quick_count: int = 2) -> tuple[ObjectCase, ...]:
    """One an object and seed; of a small run the first object, with fewer grasps."""
    things = find_objects(request.objects or objects[: 1 if request.quick else None])
    count, hand = request.count or (quick_count if request.quick else count), request.hand or "allegro_right"
    seeds = request.seeds or (0,)
    return tuple(ObjectCase(thing, request.preset(), hand, seed, count) for seed in seeds for thing in things)


def raw_grasps(scene: Scene, hand: HandModel, config: PlanConfig, count: int, seed: int) -> tuple[Grasp, ...]:
    """The first of a method's own ranking, none filtered by a trial."""
    return find_candidates(scene, hand, count=count, seed=seed, config=config, hooks=Hooks()).grasps[:count]
