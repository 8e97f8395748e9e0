"""`graspd hands`: the built-in hands; `graspd hands inspect`: what is in a hand, and a picture of it."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

from graspd_core.cli.running import EXIT_OK
from graspd_core.errors import ConfigError


def add_command(commands: Any) -> None:
    """Add this command to the parser's."""
    hands = commands.add_parser("hands", help="list the built-in hands, or inspect one")
    hands.set_defaults(run=run)
    actions = hands.add_subparsers(metavar="inspect", dest="action")
    inspect = actions.add_parser("inspect", help="the tree, joints, palm and postures of a hand")
    inspect.set_defaults(run=run_inspect)
    inspect.add_argument(
        "hand", metavar="FILE|NAME", help="URDF, MJCF, hand description, or the name of a built-in hand"
    )
    inspect.add_argument(
        "--picture", type=Path, metavar="out.png", help="draw it: open and closed, palm and candidates"
    )
    inspect.add_argument("--yaml", type=Path, metavar="out.yaml", help="write a hand description with what was found")
    inspect.add_argument("--candidates", type=int, default=600, help="contact candidates (default 600)")


def run(options: argparse.Namespace) -> int:
    """List the built-in hands."""
    import torch

    from graspd_core.hands.library import hand_names, load_hand

    torch.set_num_threads(1)
    for name in hand_names():
        hand = load_hand(name)
        print(f"{name}: {hand.num_joints} joints, {len(hand.candidate_points)} contact candidates, {hand.urdf}")
    return EXIT_OK


def run_inspect(options: argparse.Namespace) -> int:
    """Print what is known of one hand."""
    import torch

    from graspd_core.formats.grasps_json import check_writable, save_text
    from graspd_core.hands.hand_report import as_text, as_yaml, report
    from graspd_core.hands.library import load_hand
    from graspd_core.rendering.hand_picture import hand_picture
    from graspd_core.rendering.render import save_png

    torch.set_num_threads(1)
    for path in (options.picture, options.yaml):
        if path is not None:
            check_writable(path)
    if options.picture is not None and options.picture.suffix.lower() != ".png":
        raise ConfigError(f"--picture {options.picture}: a .png file is written")
    if options.yaml is not None and Path(options.hand).suffix == ".pkl":
        raise ConfigError(f"--yaml {options.yaml}: a description names a URDF or MJCF file, not a MANO file")
    hand = load_hand(options.hand, candidates=options.candidates)
    found = report(hand)
    print(as_text(found))
    if options.picture is not None:
        save_png(hand_picture(hand), options.picture)
        print(f"{options.picture}: open (left) and closed (right), from the side and onto the palm")
    if options.yaml is not None:
        urdf = os.path.relpath(hand.urdf, options.yaml.parent)
        save_text(options.yaml, as_yaml(found, urdf))
        print(f"{options.yaml}: a hand description to edit; graspd synthesize --hand {options.yaml}")
    return EXIT_OK
