"""Failure maps: heat maps that show under which conditions methods fail. `MAPS` has all maps.

Axes: friction × mass, size × object, view × noise, or cup wall × grid size. A case plans once and tries its grasps in
one or more cells of a map. A cell shows the share of grasps that held. A line marks where the share falls below half.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from graspd_bench.charts import figure, save
from graspd_bench.rendering.depth_noise import DEFAULT, NONE, DepthNoise
from graspd_bench.rendering.tabletop import CAMERA, ring_poses, tabletop, views_of
from graspd_bench.stress.broken_meshes import thin_cup
from graspd_bench.study import PROTOCOL_MASS, Case, Picture, Record, Request, Sections, raw_grasps
from graspd_core.errors import ConfigError, GraspdError, choices
from graspd_core.hands.fingers import find_fingers
from graspd_core.hands.kinematics import forward, make_kinematics, place_points, placement
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import HandModel
from graspd_core.mesh.sdf import build_sdf
from graspd_core.mesh.shapes import make_shape
from graspd_core.optimize.plan_config import PlanConfig, load_preset
from graspd_core.perception.load_scene import load_scene
from graspd_core.perception.scene import ObjectModel, Scene, build_scene, object_parts
from graspd_core.perception.scene_from_views import scene_from_views
from graspd_core.planning.feasibility import kind_of
from graspd_core.types import Grasp
from graspd_core.verify.hold_trial import hold_trial
from graspd_core.verify.world import PROTOCOLS, Protocol, at_friction, build_world
from graspd_dataset.run_records import markdown_table

# The value of a cell on an axis: a number, or the name of an object.
Place = float | str

# Reasons of failure of requested grasps that were not found, or were not planned because no scene could be built.
NOT_FOUND, NO_SCENE = "no grasp found", "no scene"


@dataclass(frozen=True)
class MapCase(Case):
    """One planning run, and the cells in which its grasps are tried.

    Attributes:
        map: name of the map.
        preset: preset of the method.
        thing: name of the object.
        across: value of all cells of the case on the horizontal axis, such as a friction coefficient.
        up: values of the case's cells on the vertical axis, such as masses [kg].
        count: number of requested raw grasps. Each grasp is tried in every cell of the case.
        seed: random seed of the planner and the sensor noise.
        hand: name of the hand.
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


# Runs a case of a map. It raises GraspdError if no scene can be built. Returns a record for each cell of the case: its
# vertical value `up`, the number of grasps that passed the hold trial as `held`, and the number of failed grasps by
# reason as `reasons`. Grasps that were not found count as failed.
Run = Callable[[MapCase], list[Record]]


def run_on(run: Run, case: MapCase) -> list[Record]:
    """Run a case. If the scene cannot be built, all grasps of the case fail for that reason."""
    try:
        return run(case)
    except GraspdError as error:
        reason = f"{NO_SCENE}: {kind_of(str(error))}"
        return [{"up": up, "held": 0, "reasons": {reason: case.count}} for up in case.up]


@lru_cache(maxsize=4)
def settings(preset: str) -> PlanConfig:
    return load_preset(preset)


@lru_cache(maxsize=4)
def hand_for(name: str, candidates: int) -> HandModel:
    return load_hand(name, candidates=candidates)


def plan(case: MapCase, scene: Scene) -> tuple[HandModel, tuple[Grasp, ...]]:
    """Return the hand, and the first `case.count` grasps in the method's own ranking. No trial has filtered them."""
    config = settings(case.preset)
    hand = hand_for(case.hand, config.problem.fine_candidates)
    return hand, raw_grasps(scene, hand, config, case.count, case.seed)


def try_grasps(
    case: MapCase, up: Place, hand: HandModel, target: ObjectModel, grasps: Sequence[Grasp], protocol: Protocol
) -> Record:
    """Run the hold trial of every grasp on `target`. Return the results as the map cell with vertical value `up`."""
    if not grasps:
        return {"up": up, "held": 0, "reasons": {NOT_FOUND: case.count}}
    world = build_world(hand, target, object_parts(target), protocol)
    holds = [hold_trial(world, grasp, protocol) for grasp in grasps]
    reasons = Counter(kind_of(hold.reason) for hold in holds if not hold.passed)
    if len(grasps) < case.count:
        reasons[NOT_FOUND] = case.count - len(grasps)
    return {"up": up, "held": sum(hold.passed for hold in holds), "reasons": dict(reasons)}


_POSTURES = 4096
_YAW, _AZIMUTH = 0.3, np.deg2rad(20.0)


def run_friction_mass(case: MapCase) -> list[Record]:
    """Plan with friction `case.across` and a mass of 0.1 kg. Try the grasps at every mass of `case.up` [kg]."""
    config = settings(case.preset)
    scene = load_scene(
        f"shape:{case.thing}", mass=PROTOCOL_MASS, friction=float(case.across), resolution=config.resolution
    )
    hand, grasps = plan(case, scene)
    protocol = at_friction(PROTOCOLS["standard"], float(case.across))
    return [try_grasps(case, mass, hand, scene.object.at_mass(float(mass)), grasps, protocol) for mass in case.up]


def run_size(case: MapCase) -> list[Record]:
    """Plan grasps of a shape of 0.1 kg and try them. Its least width is `case.across` times the hand's span."""
    config = settings(case.preset)
    width = float(case.across) * _span(case.hand, config.problem.fine_candidates)
    # The least width is along x, y or z. The hand must open at least this wide.
    scale = width / float(np.ptp(make_shape(case.thing).vertices, axis=0).min())
    scene = load_scene(f"shape:{case.thing}", mass=PROTOCOL_MASS, scale=scale, resolution=config.resolution)
    hand, grasps = plan(case, scene)
    return [try_grasps(case, up, hand, scene.object, grasps, PROTOCOLS["standard"]) for up in case.up]


def hand_span(hand: HandModel) -> float:
    """Return the greatest distance between two fingertips within the joint limits [m].

    The result is the maximum over 4096 seeded random postures, about 1 mm below the true value.
    """
    fingers = find_fingers(hand)
    draw = torch.Generator().manual_seed(0)
    lower, upper = torch.as_tensor(hand.lower), torch.as_tensor(hand.upper)
    shares = torch.rand(_POSTURES, hand.num_joints, generator=draw, dtype=torch.float64)
    # The greatest distances occur at joint limits, so half of the postures have every joint at a limit.
    shares[::2] = shares[::2].round()
    links = forward(make_kinematics(hand, dtype=torch.float64), lower + shares * (upper - lower))
    matrix = placement(hand.num_links, torch.as_tensor(fingers.points), torch.as_tensor(fingers.links))
    tips = place_points(matrix, links)
    return float(torch.cdist(tips, tips).max())


@lru_cache(maxsize=4)
def _span(hand: str, candidates: int) -> float:
    return hand_span(hand_for(hand, candidates))


def run_view(case: MapCase) -> list[Record]:
    """Plan on the reconstruction of one view, at elevation `case.across` [deg]. Try the grasps on the true object."""
    (noise,) = case.up
    truth, scene = _seen(case.thing, float(case.across), float(noise), case.seed, settings(case.preset).resolution)
    hand, grasps = plan(case, scene)
    return [try_grasps(case, noise, hand, truth, grasps, PROTOCOLS["standard"])]


def noise_at(times: float) -> DepthNoise:
    """Return the default depth noise with errors and losses multiplied by `times`, or no noise if `times` is 0.

    Rounding, depth range, lens distance and grazing angle stay the same, because they are not noise.
    """
    if not times:
        return NONE
    grown = {name: getattr(DEFAULT, name) * times for name in ("floor", "quadratic", "jitter")}
    shares = {name: min(getattr(DEFAULT, name) * times, 1.0) for name in ("flying", "edge_loss", "loss")}
    return replace(DEFAULT, **grown, **shares)


@lru_cache(maxsize=1)
def _seen(thing: str, elevation: float, noise: float, seed: int, resolution: int) -> tuple[ObjectModel, Scene]:
    """Return the true object, and the scene reconstructed from one view. Raises CloudError: no object is found."""
    stage = tabletop(thing, yaw=_YAW)
    poses = ring_poses(1, elevation=float(np.deg2rad(elevation)), azimuth=float(_AZIMUTH))
    views = views_of(stage, CAMERA, poses, noise_at(noise), seed)
    scene = scene_from_views(views, mass=PROTOCOL_MASS, resolution=resolution)
    return build_scene(stage.truth, source=thing, mass=PROTOCOL_MASS, resolution=resolution).object, scene


def run_wall(case: MapCase) -> list[Record]:
    """Plan and try on a cup. `case.up` is the wall thickness [mm]. `case.across` is the resolution of the SDF grid."""
    (wall,) = case.up
    scene = on_grid(cup(float(wall)), int(case.across))
    hand, grasps = plan(case, scene)
    return [try_grasps(case, wall, hand, scene.object, grasps, PROTOCOLS["standard"])]


@lru_cache(maxsize=1)
def cup(wall: float) -> Scene:
    """Return a scene with a cup whose wall is `wall` [mm] thick."""
    return build_scene(thin_cup(wall * 1e-3), mass=PROTOCOL_MASS, source=f"cup of {wall:g} mm")


def on_grid(scene: Scene, resolution: int) -> Scene:
    """Return the scene with an SDF of at most `resolution`³ nodes, even if such a grid is far too coarse."""
    return replace(scene, sdf=build_sdf(scene.object.mesh, resolution=resolution))


# The compared methods and their presets. `graspd2022_short` is used for two reasons: with the published settings no
# grasp holds in any cell, and the repaired settings take seven times as long.
METHODS: Mapping[str, str] = {"closed_form": "balanced", "graspd2022": "graspd2022_short"}
# Raw grasps per cell and seed. The objects of a cell share them evenly.
COUNT, SEEDS = 16, (0, 1, 2)
# Objects of the size map, one row each.
_SIZED = ("sphere", "box", "cylinder")


@dataclass(frozen=True)
class MapAxis:
    """One axis of a map: its label, and the values of its cells, from left to right or from bottom to top."""

    label: str
    places: tuple[Place, ...]


@dataclass(frozen=True)
class Map:
    """One heat map.

    Attributes:
        title: title of the map.
        across, up: horizontal and vertical axis.
        things: names of the objects. A cell sums over all objects. If `rows` is true, each row is one object.
        run: function that runs a case.
        together: whether the grasps of one planning run are tried in all cells of a column.
    """

    title: str
    across: MapAxis
    up: MapAxis
    things: tuple[str, ...]
    run: Run
    together: bool = False

    @property
    def rows(self) -> bool:
        """Return whether each row of the map shows one object."""
        return self.up.places == self.things


MAPS: Mapping[str, Map] = {
    "friction_mass": Map(
        "friction and mass", MapAxis("friction coefficient", (0.1, 0.2, 0.3, 0.6, 1.5)),
        MapAxis("mass [kg]", (0.005, 0.03, 0.1, 0.3, 1.0, 2.0)), ("cylinder", "mug"), run_friction_mass, together=True,
    ),
    "size": Map(
        "size", MapAxis("least width of the object / span of the hand", (0.025, 0.05, 0.1, 0.25, 0.4, 0.5)),
        MapAxis("object", _SIZED), _SIZED, run_size,
    ),
    "view": Map(
        "view", MapAxis("elevation of the only camera [deg]", (15.0, 30.0, 50.0, 80.0)),
        MapAxis("noise [times a D415's]", (0.0, 1.0, 2.0, 4.0)), ("mug",), run_view,
    ),
    "wall": Map(
        "wall and grid", MapAxis("resolution of the distance grid", (8.0, 16.0, 48.0, 96.0)),
        MapAxis("wall of the cup [mm]", (0.3, 1.0, 3.0, 6.0)), ("cup",), run_wall,
    ),
}  # fmt: skip


def map_cases(request: Request) -> tuple[MapCase, ...]:
    """Return the cases of the requested maps. Raises ConfigError: there is no such map."""
    if unknown := [name for name in request.cases if name not in MAPS]:
        raise ConfigError(f"unknown map {unknown[0]!r}; {choices(unknown[0], MAPS)}")
    names = request.cases or (tuple(MAPS)[1:2] if request.quick else tuple(MAPS))
    seeds = request.seeds or (SEEDS[:1] if request.quick else SEEDS)
    # The methods run one after another on each object, so that the second method reuses the cached object.
    pairs = (zip(*(cases_of(name, method) for method in METHODS), strict=True) for name in names)
    return tuple(replace(case, seed=seed) for pair in pairs for cases in pair for seed in seeds for case in cases)


def cases_of(name: str, method: str) -> tuple[MapCase, ...]:
    """Return all cases of a map with one method and the first seed, grouped by object."""
    drawn = MAPS[name]
    count = COUNT if drawn.rows else COUNT // len(drawn.things)
    cases = []
    for thing in drawn.things:
        rows = (thing,) if drawn.rows else drawn.up.places
        for up in (rows,) if drawn.together else ((row,) for row in rows):
            cases += [MapCase(name, METHODS[method], thing, x, up, count, SEEDS[0]) for x in drawn.across.places]
    return tuple(cases)


def run_map(case: MapCase) -> Record:
    cells = run_on(MAPS[case.map].run, case)
    return {"cells": cells, "held": max(cell["held"] for cell in cells)}


def map_seconds(case: MapCase) -> float:
    """Return the estimated CPU time of a case [s]."""
    each = {"balanced": 0.1, "graspd2022_short": 0.45}.get(case.preset, 1.0)
    return 0.5 + case.count * (each + 0.05 * len(case.up))


Shares = Mapping[tuple[Place, Place], float]

# Colour map of Nuñez, Anderton and Renslow (2018): lightness rises evenly, and colour-blind viewers can read the map.
_COLOURS = "cividis"
_CELL, _EDGE = 0.52, "#D55E00"


def draw_map(drawn: Map, methods: Mapping[str, Shares], path: Path) -> Path:
    """Draw a map with one panel per method. `methods` maps captions to `shares`. Return the PNG's path.

    Cells without a record are white. Rows and columns without any record are left out.
    """
    drawn = _known(drawn, methods)
    columns, rows = len(drawn.across.places), len(drawn.up.places)
    width = len(methods) * max(columns * _CELL, 2.6) + 1.5
    with figure(width, rows * _CELL + 1.3, ncols=len(methods), squeeze=False, sharey=True) as (made, axes):
        made.get_layout_engine().set(wspace=0.06)
        image = None
        for axis, (caption, shares) in zip(axes[0], methods.items(), strict=True):
            image = _panel(axis, drawn, shares)
            axis.set_title(caption, fontsize=9)
            axis.set_xlabel(drawn.across.label)
        axes[0][0].set_ylabel(drawn.up.label)
        bar = made.colorbar(image, ax=list(axes[0]), fraction=0.04, pad=0.015)
        bar.set_label("grasps that held [%]")
        bar.outline.set_visible(False)
        return save(made, path)


def _known(drawn: Map, methods: Mapping[str, Shares]) -> Map:
    places = [place for shares in methods.values() for place in shares]
    across = tuple(x for x in drawn.across.places if any(x == place[0] for place in places))
    up = tuple(y for y in drawn.up.places if any(y == place[1] for place in places))
    if not places:
        return drawn
    return replace(drawn, across=replace(drawn.across, places=across), up=replace(drawn.up, places=up))


def _panel(axis: Any, drawn: Map, shares: Shares) -> Any:
    across, up = drawn.across.places, drawn.up.places
    grid = np.array([[100 * shares.get((x, y), np.nan) for x in across] for y in up])
    image = axis.imshow(grid, cmap=_COLOURS, vmin=0, vmax=100, origin="lower", aspect="auto")
    for row, column in np.argwhere(np.isfinite(grid)):
        value = grid[row, column]
        colour = "white" if value < 50 else "black"
        axis.text(column, row, f"{value:.0f}", ha="center", va="center", color=colour, fontsize=8)
    _border(axis, grid)
    axis.set_xticks(range(len(across)), [_written(place) for place in across])
    axis.set_yticks(range(len(up)), [_written(place) for place in up])
    for ticks, places in ((axis.set_xticks, across), (axis.set_yticks, up)):
        ticks(np.arange(1, len(places)) - 0.5, minor=True)
    axis.tick_params(which="both", length=0)
    axis.grid(False)
    axis.grid(which="minor", color="white", lw=1.0)
    for spine in axis.spines.values():
        spine.set_visible(False)
    return image


def _border(axis: Any, grid: Any) -> None:
    """Draw a line between two neighbouring cells if at least half of the grasps held in one, but not in the other."""
    works, known = grid >= 50, np.isfinite(grid)
    beside = (works[:, 1:] != works[:, :-1]) & known[:, 1:] & known[:, :-1]
    above = (works[1:] != works[:-1]) & known[1:] & known[:-1]
    line: dict[str, Any] = {"color": _EDGE, "lw": 2.2, "solid_capstyle": "round"}
    for row, column in np.argwhere(beside):
        axis.plot([column + 0.5] * 2, [row - 0.5, row + 0.5], **line)
    for row, column in np.argwhere(above):
        axis.plot([column - 0.5, column + 0.5], [row + 0.5] * 2, **line)


def _written(place: Place) -> str:
    return place if isinstance(place, str) else f"{place:g}"


def map_sections(records: Sequence[Record], chart: Path | None) -> Sections:
    """Return a section with a picture for each map, if `chart` is given, and one that counts failures by reason."""
    sections: dict[str, list[str | Picture | None]] = {}
    body = []
    for name, drawn in MAPS.items():
        panels = {
            f"{method} (preset {preset})": [r for r in records if (r["map"], r["preset"]) == (name, preset)]
            for method, preset in METHODS.items()
        }
        if not any(panels.values()):
            continue
        if chart is not None:
            png = draw_map(drawn, {title: shares(own) for title, own in panels.items()}, chart.with_name(f"map_{name}"))
            sections[f"map-{name.replace('_', '-')}"] = [Picture(f"Success over {drawn.title}", png)]
        body += [[drawn.title, title, _counts(reasons(own))] for title, own in panels.items()]
    return {**sections, "map-failures": [markdown_table(["map", "method", "failures by reason"], body)] if body else []}


def shares(records: Sequence[Record]) -> dict[tuple[Place, Place], float]:
    """Return the share of requested grasps that held, over all objects, by the cell's values (across, up)."""
    held, asked = Counter[tuple[Place, Place]](), Counter[tuple[Place, Place]]()
    for record in records:
        for cell in record["cells"]:
            held[record["across"], cell["up"]] += cell["held"]
            asked[record["across"], cell["up"]] += record["count"]
    return {place: held[place] / asked[place] for place in asked}


def reasons(records: Sequence[Record]) -> Counter[str]:
    """Return the number of failed grasps by reason."""
    return sum((Counter(cell["reasons"]) for record in records for cell in record["cells"]), Counter[str]())


def _counts(why: Counter[str]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in why.most_common()) or "no failure"
