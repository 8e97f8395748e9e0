"""All maps: their axes, their objects, and the jobs that they are made of. `MAPS` is the registry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from graspd_core.bench.failure_maps import camera_view as view
from graspd_core.bench.failure_maps import friction_mass
from graspd_core.bench.failure_maps import object_size as size
from graspd_core.bench.failure_maps import wall_thickness as wall
from graspd_core.bench.failure_maps.map_job import Job, Place, Run

# Methods side by side, each by the preset that stands for it. The published settings hold nothing anywhere, and the
# repaired ones take seven times as long as their short form.
METHODS: Mapping[str, str] = {"closed_form": "balanced", "graspd2022": "graspd2022_short"}
# Raw grasps of a cell, shared evenly among its objects.
COUNT = 8


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
        run: what is done for a job.
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
        MapAxis("friction coefficient", friction_mass.FRICTIONS),
        MapAxis("mass [kg]", friction_mass.MASSES),
        friction_mass.THINGS,
        friction_mass.run,
        together=True,
    ),
    "size": Map(
        "size",
        MapAxis("least width of the object / span of the hand", size.RATIOS),
        MapAxis("object", size.THINGS),
        size.THINGS,
        size.run,
    ),
    "view": Map(
        "view",
        MapAxis("elevation of the only camera [deg]", view.ELEVATIONS),
        MapAxis("noise [times a D415's]", view.NOISES),
        view.THINGS,
        view.run,
    ),
    "wall": Map(
        "wall and grid",
        MapAxis("resolution of the distance grid", wall.RESOLUTIONS),
        MapAxis("wall of the cup [mm]", wall.WALLS),
        wall.THINGS,
        wall.run,
    ),
}


def jobs_of(name: str, method: str, *, seed: int = 0) -> tuple[Job, ...]:
    """All jobs of a map with one method; those on the same object lie next to each other."""
    drawn = MAPS[name]
    count = COUNT if drawn.rows else COUNT // len(drawn.things)
    jobs = []
    for thing in drawn.things:
        rows = (thing,) if drawn.rows else drawn.up.places
        for up in (rows,) if drawn.together else ((row,) for row in rows):
            jobs += [Job(name, METHODS[method], thing, across, up, count, seed) for across in drawn.across.places]
    return tuple(jobs)
