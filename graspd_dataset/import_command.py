"""The command `graspd import`: convert grasps of other projects to grasps.json (docs/dataset.md)."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graspd_core.cli.output import answer, busy, print_note
from graspd_core.cli.running import EXIT_OK, EXIT_TOO_FEW
from graspd_core.config import VERIFICATIONS
from graspd_core.errors import ConfigError
from graspd_core.types import GraspResult, Timing, Verdict

if TYPE_CHECKING:
    from graspd_core.hands.model import HandModel
    from graspd_core.perception.scene import Scene
    from graspd_dataset.foreign_grasps import ImportedGrasp


# A warning counts squeezes whose base is farther than this from the grasp's base [m].
_MOVED = 1e-4


def add_command(commands: Any) -> None:
    """Add this command to the parser."""
    parser = commands.add_parser("import")
    parser.set_defaults(run=run)
    parser.add_argument(
        "place", metavar="PATH", type=Path, help="DexGraspBench .npy, isaac_grasp .yaml, GraspGen .json"
    )
    parser.add_argument("--hand", required=True, metavar="NAME|PATH", help="hand of the grasps")
    parser.add_argument("--object", default=None, metavar="MESH", help="replaces the mesh that the files name")
    parser.add_argument("--joint-order", default="", metavar="A,B,…", help="joint names of npy files, in their order")
    parser.add_argument("--preset", default="balanced", help="settings for pregrasps and squeezes that files lack")
    parser.add_argument("--mass", type=float, default=None, metavar="KG", help="default: a heavy object's mass")
    parser.add_argument("--friction", type=float, default=0.6, metavar="MU", help="default 0.6")
    parser.add_argument("--verify", choices=VERIFICATIONS, default="none", help="trials of the grasps (default none)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder, or .json file for one object")


def run(options: argparse.Namespace) -> int:
    """Import the grasps. Return the exit status: 0, or 3 if an object has no accepted grasp."""
    from graspd_core.hands.library import load_hand
    from graspd_core.io.grasps_json import check_writable, save_result
    from graspd_core.optimize.plan_config import load_preset
    from graspd_core.perception.load_scene import load_scene
    from graspd_dataset.complete_grasps import by_object
    from graspd_dataset.foreign_grasps import read_foreign

    config = load_preset(options.preset)
    hand = load_hand(options.hand, candidates=config.problem.fine_candidates)
    order = tuple(name for name in options.joint_order.split(",") if name)
    targets = by_object(read_foreign(options.place, hand, mesh=options.object, order=order))
    single = options.out.suffix == ".json"
    if single and len(targets) > 1:
        raise ConfigError(f"{options.out}: one file for {len(targets)} objects; give a directory")
    check_writable(options.out if single else options.out / "probe")
    status, files = EXIT_OK, []
    for (mesh, scale), imported in targets.items():
        factors = {"mass": options.mass, "friction": options.friction, "scale": scale}
        scene = load_scene(mesh, resolution=config.resolution, **factors)
        with busy("complete"):
            result = _result(scene, hand, imported, config, options.verify)
        path = options.out if single else options.out / f"{scene.object.sha256[:16]}.json"
        if any(done["file"] == path for done in files):  # another mesh file has the same content
            path = path.with_stem(f"{path.stem}-{len(files)}")
        save_result(path, result, scene.object, hand, config)
        status = status if result.tried else EXIT_TOO_FEW
        held = sum(grasp.verdict is Verdict.VERIFIED for grasp in result.tried)
        tried = f", {held} verified" if options.verify != "none" else ""
        print(f"{path}: {len(result.tried)} of {len(imported)} grasps of {mesh}{tried}")
        counts = {"given": len(imported), "grasps": len(result.tried), "verified": held}
        files.append({"file": path, "object": mesh, **counts, "refused": result.refused, "warnings": result.warnings})
        for line in (*(f"{count} refused: {why}" for why, count in result.refused.items()), *result.warnings):
            print_note(line)
    answer(files)
    return status


def _result(scene: Scene, hand: HandModel, imported: Sequence[ImportedGrasp], config: Any, verify: str) -> GraspResult:
    """Complete the grasps of one object, and try them unless `verify` is "none". Verified grasps come first."""
    from graspd_core.planning.plan_grasps import on_surface
    from graspd_core.verify.run_clock import outcome_of
    from graspd_core.verify.verification import verify_grasps
    from graspd_dataset.complete_grasps import complete_grasps

    completed = complete_grasps(scene, hand, imported, config)
    grasps = on_surface(scene, completed.grasps)
    if verify != "none":
        tried = verify_grasps(scene, hand, grasps, verify=verify)
        grasps = tuple(sorted(tried, key=lambda grasp: grasp.verdict is not Verdict.VERIFIED))
    good = sum(grasp.usable for grasp in grasps)
    moved = [grasp.squeeze_moved for grasp in imported if grasp.squeeze_moved > _MOVED]
    warnings = [*hand.named_warnings, *filter(None, [completed.frame_doubt])]
    if moved:
        note = f"{len(moved)} squeezes move the base, by up to {max(moved) * 1000:.1f} mm"
        warnings.append(f"{note}; graspd keeps the base at the grasp's pose")
    count = len(imported)
    message = f"{len(grasps)} of {count} imported grasps accepted; {good} verified, or untried with contacts"
    about = {"warnings": tuple(warnings), "refused": completed.refused, "count": count}
    return GraspResult(outcome_of(grasps, count), grasps, Timing(), 0, "imported", message, **about)
