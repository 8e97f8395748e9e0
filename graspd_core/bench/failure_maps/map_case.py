"""One case of a map: a planning, the cells that its grasps are tried in, and what came of it in each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from graspd_core.bench.object_case import raw_grasps
from graspd_core.bench.study import Case
from graspd_core.errors import GraspdError
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import HandModel
from graspd_core.methods.plan_config import PlanConfig, load_preset
from graspd_core.planning.feasibility import kind_of
from graspd_core.scene.scene import ObjectModel, Scene, object_parts
from graspd_core.trials.hold_trial import hold_trial
from graspd_core.trials.world import Protocol, build_world
from graspd_core.types import Grasp

# Where a cell lies on an axis of its map: a number, or the name of an object.
Place = float | str

# What an empty place among the grasps asked for is called.
NOT_FOUND, NO_SCENE = "no grasp found", "no scene"


@dataclass(frozen=True)
class MapCase(Case):
    """A planning, and the cells that its grasps are tried in.

    Attributes:
        map: name of the map.
        preset: settings of the method.
        thing: name of the object.
        across: place of all its cells on the horizontal axis.
        up: places of its cells on the vertical axis.
        count: raw grasps asked for, each of which is tried in every cell.
        seed: of everything that is drawn.
        hand: by name.
    """

    map: str
    preset: str
    thing: str
    across: Place
    up: tuple[Place, ...]
    count: int
    seed: int
    hand: str = "allegro_right"

    @property
    def label(self) -> str:
        place = (self.thing, self.across, *self.up[:1])
        return " ".join(str(word) for word in (self.map, self.preset, *place, f"seed {self.seed}"))


@dataclass(frozen=True)
class MapCell:
    """What came of one case's grasps in one cell.

    Attributes:
        up: its place on the vertical axis.
        held: grasps that passed the hold trial.
        reasons: why the others did not, and how many each; a grasp that was not found has a reason, too.
    """

    up: Place
    held: int
    reasons: Mapping[str, int]


# What a map does for each of its cases. A scene that is refused raises a GraspdError.
Run = Callable[[MapCase], tuple[MapCell, ...]]


def run_on(run: Run, case: MapCase) -> tuple[MapCell, ...]:
    """The cells of a case; where its scene is refused, all of its grasps are lost for that reason."""
    try:
        return run(case)
    except GraspdError as error:
        reason = f"{NO_SCENE}: {kind_of(str(error))}"
        return tuple(MapCell(up, 0, {reason: case.count}) for up in case.up)


@lru_cache(maxsize=4)
def settings(preset: str) -> PlanConfig:
    """Settings by name."""
    return load_preset(preset)


@lru_cache(maxsize=4)
def hand_for(name: str, candidates: int) -> HandModel:
    """A hand with so many contact candidates."""
    return load_hand(name, candidates=candidates)


def plan(case: MapCase, scene: Scene) -> tuple[HandModel, tuple[Grasp, ...]]:
    """The hand, and the first of the method's own ranking, none filtered by a trial."""
    config = settings(case.preset)
    hand = hand_for(case.hand, config.problem.fine_candidates)
    return hand, raw_grasps(scene, hand, config, case.count, case.seed)


def try_grasps(
    case: MapCase, up: Place, hand: HandModel, target: ObjectModel, grasps: Sequence[Grasp], protocol: Protocol
) -> MapCell:
    """Every grasp in the hold trial on `target`."""
    if not grasps:
        return MapCell(up, 0, {NOT_FOUND: case.count})
    world = build_world(hand, target, object_parts(target), protocol)
    holds = [hold_trial(world, grasp, protocol) for grasp in grasps]
    reasons = Counter(kind_of(hold.reason) for hold in holds if not hold.passed)
    if len(grasps) < case.count:
        reasons[NOT_FOUND] = case.count - len(grasps)
    return MapCell(up, sum(hold.passed for hold in holds), dict(reasons))
