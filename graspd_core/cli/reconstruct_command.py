"""`graspd reconstruct`: reconstruct a closed mesh from point clouds."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from graspd_core.cli.options import (
    add_bag_options,
    add_camera_option,
    add_object_options,
    check_bag_options,
    load_views,
    scene_config_of,
    target_of,
)
from graspd_core.cli.output import answer, busy, print_note
from graspd_core.cli.running import EXIT_OK


def add_command(commands: Any) -> None:
    """Add the command `reconstruct` to the parsers in `commands`."""
    parser = commands.add_parser("reconstruct")
    parser.set_defaults(run=run)
    parser.add_argument("cloud", metavar="CLOUD_OR_BAG", type=Path, help="cloud, depth image, or bag (its first cloud)")
    add_camera_option(parser)
    add_object_options(parser)
    add_bag_options(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="mesh.ply")


def run(options: argparse.Namespace) -> int:
    """Reconstruct a mesh and write it to `--out`. Return the exit status."""
    from graspd_core.io.grasps_json import check_writable
    from graspd_core.mesh.mesh_files import save_mesh
    from graspd_core.perception.scene_from_views import reconstruct_object

    check_bag_options(options)
    check_writable(options.out)
    settings = scene_config_of(options)
    views = load_views(options.cloud, options)
    with busy("reconstruct"):
        whole, _, _, warnings = reconstruct_object(views, target_of(options), options.alone, settings)
    mesh, notes = whole.mesh, [*warnings, *whole.warnings]
    save_mesh(options.out, mesh)
    for note in notes:
        print_note(note)
    extent = mesh.vertices.max(0) - mesh.vertices.min(0)
    print(f"{options.out}: {len(mesh.faces)} faces, {' x '.join(f'{e * 1e3:.0f}' for e in extent)} mm")
    answer({"file": options.out, "faces": len(mesh.faces), "extent": extent.tolist(), "warnings": notes})
    return EXIT_OK
