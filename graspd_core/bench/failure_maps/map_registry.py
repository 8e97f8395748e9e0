"""All maps: their axes, their objects, and the cases that they are made of. `MAPS` is the registry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

from graspd_core.bench.failure_maps import map_runs
from graspd_core.bench.failure_maps.map_case import MapCase, Place, Run, run_on
from graspd_core.bench.study import Record, Request
from graspd_core.errors import ConfigError

# Methods side by side, each by the preset that stands for it. The published settings hold nothing anywhere, and the
# repaired ones take seven times as long as their short form.
METHODS: Mapping[str, str] = {"closed_form": "balanced", "graspd2022": "graspd2022_short"}
# Raw grasps of a cell and a seed, shared evenly among its objects.
COUNT, SEEDS = 16, (0, 1, 2)
# Objects that the map of sizes has a row each for.
_SIZED = ("sphere", "box", "cylinder")


@dataclass(frozen=True)
class MapAxis:
    """What an axis shows, and where its cells lie, from left to right or from the bottom up."""

    label: str
    places: tuple[Place, ...]


@dataclass(frozen=True)
class Map:
    """One picture.

    Attributes:
        title: what it shows.
        across, up: its axes.
        things: objects; a cell is of all of them, unless they are what an axis shows.
        run: what is done for a case.
        together: whether one planning serves all cells of a column.
    """

    title: str
    across: MapAxis
    up: MapAxis
    things: tuple[str, ...]
    run: Run
    together: bool = False

    @property
    def rows(self) -> bool:
        """Whether every row has an object of its own."""
        return self.up.places == self.things


MAPS: Mapping[str, Map] = {
    "friction_mass": Map(
        "friction and mass",
        MapAxis("friction coefficient", (0.1, 0.2, 0.3, 0.6, 1.5)),
        MapAxis("mass [kg]", (0.005, 0.03, 0.1, 0.3, 1.0, 2.0)),
        ("cylinder", "mug"),
        map_runs.run_friction_mass,
        together=True,
    ),
    "size": Map(
        "size",
        MapAxis("least width of the object / span of the hand", (0.025, 0.05, 0.1, 0.25, 0.4, 0.5)),
        MapAxis("object", _SIZED),
        _SIZED,
        map_runs.run_size,
    ),
    "view": Map(
        "view",
        MapAxis("elevation of the only camera [deg]", (15.0, 30.0, 50.0, 80.0)),
        MapAxis("noise [times a D415's]", (0.0, 1.0, 2.0, 4.0)),
        ("mug",),
        map_runs.run_view,
    ),
    "wall": Map(
        "wall and grid",
        MapAxis("resolution of the distance grid", (8.0, 16.0, 48.0, 96.0)),
        MapAxis("wall of the cup [mm]", (0.3, 1.0, 3.0, 6.0)),
        ("cup",),
        map_runs.run_wall,
    ),
}


def map_cases(request: Request) -> tuple[MapCase, ...]:
    """The cases of the maps that are asked for. Raises ConfigError: there is no such map."""
    if unknown := [name for name in request.cases if name not in MAPS]:
        raise ConfigError(f"unknown map {unknown[0]!r}; valid: {', '.join(MAPS)}")
    names = request.cases or (tuple(MAPS)[1:2] if request.quick else tuple(MAPS))
    seeds = request.seeds or (SEEDS[:1] if request.quick else SEEDS)
    # Both methods on one object after the other: what is built of it is remembered.
    pairs = (zip(*(cases_of(name, method) for method in METHODS), strict=True) for name in names)
    return tuple(replace(case, seed=seed) for pair in pairs for cases in pair for seed in seeds for case in cases)


def cases_of(name: str, method: str) -> tuple[MapCase, ...]:
    """All cases of a map with one method and the first seed; those on the same object lie next to each other."""
    drawn = MAPS[name]
    count = COUNT if drawn.rows else COUNT // len(drawn.things)
    cases = []
    for thing in drawn.things:
        rows = (thing,) if drawn.rows else drawn.up.places
        for up in (rows,) if drawn.together else ((row,) for row in rows):
            cases += [MapCase(name, METHODS[method], thing, x, up, count, SEEDS[0]) for x in drawn.across.places]
    return tuple(cases)


def run_map(case: MapCase) -> Record:
    """The figures of one case."""
    cells = [asdict(cell) for cell in run_on(MAPS[case.map].run, case)]
    return {"cells": cells, "held": max(cell["held"] for cell in cells)}


def map_seconds(case: MapCase) -> float:
    """CPU seconds of a case, roughly."""
    each = {"balanced": 0.1, "graspd2022_short": 0.45}.get(case.preset, 1.0)
    return 0.5 + case.count * (each + 0.05 * len(case.up))
