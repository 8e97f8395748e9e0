"""Answers from a library of grasps. If the library has too few valid grasps, more are planned."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from graspd_core import HandModel, Reach, Scene, Steering, load_scene
from graspd_core.library.grasp_library import GraspLibrary, LibraryEntry, hand_hash
from graspd_core.library.known_grasps import Physics, entry_by_file, entry_by_name, known_or_planned, library_result
from graspd_core.runtime.worker_process import run_isolated
from graspd_core.types import GraspResult
from graspd_ros.convert import Matrix
from graspd_ros.parameters import Settings
from graspd_ros.request import KnownObject, Request
from graspd_ros.request_planner import unlike


def find_entry(known: KnownObject, settings: Settings, hand: HandModel | None) -> LibraryEntry | None:
    """Return the library entry of an object for `hand`, or for any hand if None. Return None if there is no entry.

    Raises GraspdError if a required entry is missing or the library cannot be read.
    """
    library = GraspLibrary(Path(settings.grasp_library))
    physics = Physics(settings.mass or None, settings.friction, settings.verify)
    if known.name:
        return entry_by_name(library, hand, known.name, physics)
    return entry_by_file(library, hand, known.path, settings.mesh_scale, physics, required=known.required)


def warm_up_library(settings: Settings, hand: HandModel) -> None:
    """Read one entry of the library, so that the first request is fast. Raises FormatError: library not readable."""
    library = GraspLibrary(Path(settings.grasp_library))
    for entry, _ in library.entries(hand_content=hand_hash(hand))[:1]:
        library.grasps(entry, hand)


def named_loader(known: KnownObject, settings: Settings) -> Callable[[], Scene]:
    """Return a function that loads the library's object named `known.name` as a scene."""

    def load() -> Scene:
        entry = find_entry(known, settings, None)
        assert entry is not None
        # An assumed mass is assumed again, because the entry's may be lower: as much as the hand lifts.
        mass = None if entry.mass_assumed else entry.mass
        return run_isolated(load_scene, entry.source, mass=mass, friction=entry.friction, scale=entry.scale)

    return load


def answer_known(
    request: Request,
    known: KnownObject,
    hand: HandModel,
    excluded: Sequence[Matrix],
    restrictions: Sequence[Steering | Reach],
    **plan: Any,
) -> tuple[GraspResult, Scene | None, bool]:
    """Return grasps, the scene, and whether its mass is assumed. No grasp is similar to an `excluded` base-link pose.

    The scene is None if it was not loaded. If the library has too few grasps, plan more with arguments `plan`. Raises
    the errors of `find_entry` and planning.
    """
    began, settings = time.perf_counter(), request.settings
    count, library = settings.num_grasps, GraspLibrary(Path(settings.grasp_library))
    entry = find_entry(known, settings, hand)
    if entry is not None and not restrictions and request.surface is None and not request.collision_objects:
        grasps = unlike(library.grasps(entry, hand), excluded)[:count]
        if len(grasps) >= count:
            found = library_result(library, grasps, count, time.perf_counter() - began)
            assumed = entry.mass_assumed if known.name else not settings.mass
            found = replace(found, mass=entry.mass, tried_mass=entry.mass, warnings=_other_friction(entry, settings))
            return found, None, assumed
    scene = request.load()
    plan |= {"deadline": max(request.time_left(), 1e-3), "count": count, "restrictions": restrictions}
    result = known_or_planned(library, scene, hand, wanted=lambda grasps: unlike(grasps, excluded), **plan)
    warnings = (*result.warnings, *_other_friction(entry, settings))
    return replace(result, warnings=warnings), scene, scene.object.mass_assumed


def _other_friction(entry: LibraryEntry | None, settings: Settings) -> tuple[str, ...]:
    if entry is None or entry.friction <= settings.friction:
        return ()
    told = f"{entry.name}: grasps were tried at the library's friction of {entry.friction:g}"
    return (f"{told}; the parameter's is {settings.friction:g}",)
