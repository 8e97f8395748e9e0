"""`graspd library`: build and list libraries, which are files of verified grasps of known objects."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graspd_core.cli.options import add_planning_options, planning_options
from graspd_core.cli.output import Reporter, answer, busy, print_error, print_note
from graspd_core.cli.running import EXIT_INTERRUPTED, EXIT_OK, EXIT_TOO_FEW, Interrupt
from graspd_core.errors import ConfigError, MeshError

if TYPE_CHECKING:
    from graspd_core.hands.model import HandModel
    from graspd_core.library.grasp_library import GraspLibrary, LibraryEntry


def add_command(commands: Any) -> None:
    """Add the command `library` to the parsers in `commands`."""
    parser = commands.add_parser("library")
    actions = parser.add_subparsers(required=True, metavar="ACTION", dest="action")
    build = actions.add_parser("build", help="plan for meshes and add the verified grasps; stored grasps stay")
    build.set_defaults(run=_build)
    build.add_argument("meshes", nargs="*", metavar="MESH", help="mesh files, folders of them, or shape:NAME")
    build.add_argument("--out", type=Path, required=True, metavar="FILE", help="the library, created if missing")
    build.add_argument("--scales", type=float, nargs="+", default=(1.0,), metavar="S", help="metres per unit of a file")
    add_planning_options(build)
    listing = actions.add_parser("list", help="list the objects of a library")
    listing.set_defaults(run=_list)
    listing.add_argument("library", type=Path, metavar="FILE")


def _build(options: argparse.Namespace) -> int:
    """Add grasps of all objects. Return 0, or 3 if an object has too few grasps, or 130 if interrupted."""
    from graspd_core.hands.library import load_hand
    from graspd_core.library.grasp_library import GraspLibrary
    from graspd_core.mesh.shapes import object_sources

    config, request = planning_options(options)
    if options.verify == "none":
        raise ConfigError("--verify: 'none'; valid for a library: standard, full, hard, hard_full")
    sources, hand = object_sources(options.meshes), load_hand(options.hand)
    library = GraspLibrary(options.out)
    library.create()
    library.checked()
    short, objects = 0, []
    with Interrupt() as interrupt:
        request |= {"preset": config, "stop": interrupt.is_interrupted}
        for source, scale in [(source, scale) for source in sources for scale in options.scales]:
            if interrupt.is_interrupted():
                break
            try:
                has = _add_object(options, library, source, scale, hand, request)
            except MeshError as error:
                print_error(error)
                has = 0
            objects.append({"source": source, "scale": scale, "grasps": has})
            short += has < options.count
    answer({"library": options.out, "objects": objects})
    return EXIT_INTERRUPTED if interrupt.is_interrupted() else EXIT_TOO_FEW if short else EXIT_OK


def _add_object(
    options: argparse.Namespace, library: GraspLibrary, source: str, scale: float, hand: HandModel, request: dict
) -> int:
    """Plan the grasps that the library lacks for an object, and add them. Return the object's new number of grasps."""
    from graspd_core.library.grasp_library import entry_of
    from graspd_core.library.known_grasps import add_planned
    from graspd_core.perception.load_scene import load_scene
    from graspd_core.planning.plan_grasps import plan_grasps

    with busy("load"):
        scene = load_scene(source, mass=options.mass, friction=options.friction, scale=scale)
    for warning in (*scene.object.warnings, *hand.named_warnings):
        print_note(warning)
    entry = entry_of(scene.object, hand, options.verify)
    _refuse_name(library, entry)

    def stored() -> int:
        # An object without a given mass may be stored at less than its assumed mass, if the hand cannot lift that.
        same = library.of_mesh(entry)
        return sum(len(library.grasps(one, hand)) for one in same if one.verify == entry.verify)

    has = stored()
    if has >= options.count:
        print(f"{entry.name}: the library has {has} grasps already")
        return has
    missing = {**request, "count": options.count - has, "seed": options.seed + has}
    with Reporter() as reporter:
        result = plan_grasps(scene, hand, deadline=options.deadline, progress=reporter, **missing)
    for warning in result.warnings[len(scene.object.warnings) + len(hand.named_warnings) :]:
        print_note(warning)
    add_planned(library, scene, hand, request["preset"], result, options.verify)
    has = stored()
    print(f"{entry.name}: {has} of {options.count} grasps, {result.timing.total:.1f} s", flush=True)
    return has


def _refuse_name(library: GraspLibrary, entry: LibraryEntry) -> None:
    for other, _ in library.entries(name=entry.name):
        if other.source != entry.source and other.mesh_sha256 != entry.mesh_sha256:
            fault = f"{entry.source}: the library {library.path} has another {entry.name!r}, from {other.source}"
            raise ConfigError(f"{fault}; give one of the files another name")


def _list(options: argparse.Namespace) -> int:
    from graspd_core.library.grasp_library import GraspLibrary

    rows = GraspLibrary(options.library).checked().entries()
    for entry, grasps in rows:
        physics = f"{entry.mass:g} kg, friction {entry.friction:g}, {entry.verify}"
        print(f"{entry.name:24} {entry.hand:20} {grasps:4} grasps  {physics:32} {entry.source}")
    print(f"{options.library}: {len(rows)} records, {sum(grasps for _, grasps in rows)} grasps")
    answer([{**vars(entry), "grasps": grasps} for entry, grasps in rows])
    return EXIT_OK
