"""`graspd hands`: list the built-in hands. `graspd hands inspect`: show one hand as text, picture or description."""

from __future__ import annotations

import argparse
import os
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from graspd_core.cli.output import answer, busy, waiting
from graspd_core.cli.running import EXIT_OK, sibling
from graspd_core.errors import ConfigError

if TYPE_CHECKING:
    from graspd_core.hands.model import HandModel


def add_command(commands: Any) -> None:
    """Add the command `hands` to the parsers in `commands`."""
    hands = commands.add_parser("hands")
    hands.set_defaults(run=run)
    actions = hands.add_subparsers(metavar="inspect", dest="action")
    inspect = actions.add_parser("inspect", help="show links, joints, palm and postures of a hand")
    inspect.set_defaults(run=run_inspect)
    inspect.add_argument(
        "hand", metavar="FILE|NAME", help="URDF, MJCF, hand description, or the name of a built-in hand"
    )
    inspect.add_argument(
        "--picture", type=Path, metavar="out.png", help="draw open and closed hand, palm and contact candidates"
    )
    inspect.add_argument("--yaml", type=Path, metavar="out.yaml", help="write a hand description to edit")
    inspect.add_argument("--candidates", type=int, default=600, help="number of contact candidates (default 600)")


def run(options: argparse.Namespace) -> int:
    """List the built-in hands."""
    import torch

    from graspd_core.hands.library import hand_names, load_hand

    torch.set_num_threads(1)
    names, listed = hand_names(), []
    for hand in waiting(map(load_hand, names), "hand", len(names)):
        numbers = {"joints": hand.num_joints, "candidates": len(hand.candidate_points)}
        listed.append({"name": hand.name, **numbers, "urdf": hand.urdf})
        print("{name}: {joints} joints, {candidates} contact candidates, {urdf}".format(**listed[-1]), flush=True)
    answer(listed)
    return EXIT_OK


def run_inspect(options: argparse.Namespace) -> int:
    """Print one hand. Draw it or write its description if requested."""
    import torch

    from graspd_core.hands.library import load_hand
    from graspd_core.io.grasps_json import check_writable, save_text

    torch.set_num_threads(1)
    for path in (options.picture, options.yaml):
        if path is not None:
            check_writable(path)
    if options.picture is not None and options.picture.suffix.lower() != ".png":
        raise ConfigError(f"--picture {options.picture}; valid: a file name that ends in .png")
    if options.yaml is not None and Path(options.hand).suffix == ".pkl":
        raise ConfigError(f"--yaml: {options.hand} is a MANO file; valid: a hand read from a URDF or MJCF file")
    hand = load_hand(options.hand, candidates=options.candidates)
    # Write the files first, because printing fails if the reader of the output has ended.
    if options.picture is not None:
        with busy("draw"):
            render = sibling("graspd_bench.rendering.render")
            render.save_png(options.picture, render.hand_picture(hand))
    if options.yaml is not None:
        urdf = os.path.relpath(hand.urdf, options.yaml.parent)
        save_text(options.yaml, as_yaml(hand, urdf))
    print(as_text(hand))
    answer(_document(hand))
    if options.picture is not None:
        print(f"{options.picture}: open (left) and closed (right), from the side and onto the palm")
    if options.yaml is not None:
        print(f"{options.yaml}: a hand description to edit; graspd synthesize --hand {options.yaml}")
    return EXIT_OK


def _document(hand: HandModel) -> dict[str, Any]:
    """Return a hand as JSON-ready values, in rad, m, N and N·m."""
    joints = [
        {"name": name, "lower": lower, "upper": upper, "effort": effort, "open": at_open, "closed": at_closed}
        for name, lower, upper, effort, at_open, at_closed in zip(
            hand.joint_names,
            *(v.tolist() for v in (hand.lower, hand.upper, hand.effort, hand.open_posture, hand.closed_posture)),
            strict=True,
        )
    ]
    vectors = {name: getattr(hand, name).tolist() for name in ("palm_center", "palm_normal", "approach")}
    names = {"name": hand.name, "urdf": hand.urdf, "base_link": hand.base_link, "links": hand.link_names}
    return {**names, "joints": joints, **vectors, "warnings": hand.warnings}


def as_text(hand: HandModel) -> str:
    """Return a hand as text in rad and m: link tree, joints, palm, number of self-collision pairs, and warnings."""
    from graspd_core.hands.kinematics import link_depths
    from graspd_core.hands.model import all_joint_names

    couplings = {mimic.name: mimic for mimic in hand.mimics}
    lines = [
        f"{hand.name}: {hand.num_links} links, {hand.num_joints} actuated joints, {len(couplings)} coupled",
        f"  read from {hand.urdf}",
        "",
        "links (joint, mass, solids, contact candidates)",
    ]
    moving, depth = hand.link_joint_names, link_depths(hand.link_parent)
    for link, name in enumerate(hand.link_names):
        kinds = (f"hull of {len(p.vertices)} corners" if p.kind == "hull" else p.kind for p in hand.primitives_of[link])
        solids = Counter(kinds)
        solid_names = ", ".join(f"{n} x {solid}" if n > 1 else solid for solid, n in solids.items()) or "no solids"
        mass = f"{hand.link_mass[link] * 1e3:.0f} g" if hand.link_mass[link] else "no mass"
        joint = f" <- {moving[link]}" if moving[link] else ""
        candidates = int((hand.candidate_link == link).sum())
        lines.append(f"  {'  ' * int(depth[link])}{name}{joint}: {mass}, {solid_names}, {candidates} candidates")
    names = all_joint_names(hand)
    width = max(map(len, names))
    lines += ["", f"joints {'':{max(0, width - 5)}} kind         lower   upper   effort    open  closed"]
    for name in names:
        start = f"  {name:{width}} {hand.joint_kind[moving.index(name)]:10}"
        if name in couplings:
            mimic = couplings[name]
            lines.append(f"{start} = {mimic.multiplier:g} · {hand.joint_names[mimic.joint]} {mimic.offset:+g}")
            continue
        i = hand.joint_names.index(name)
        postures = f"{hand.open_posture[i]:8.3f}{hand.closed_posture[i]:8.3f}"
        lines.append(f"{start}{hand.lower[i]:8.3f}{hand.upper[i]:8.3f}{hand.effort[i]:9.3g}{postures}")
    pairs = hand.num_links * (hand.num_links - 1) // 2
    lines += [
        "",
        f"palm centre {_vector(hand.palm_center)}, normal {_vector(hand.palm_normal)}, "
        f"approach {_vector(hand.approach)}, in {hand.base_link}",
        f"self-collision: {int((~hand.adjacent).sum() // 2)} of {pairs} pairs of links are checked",
    ]
    lines += [f"warning: {text}" for text in hand.warnings]
    return "\n".join(lines)


def as_yaml(hand: HandModel, urdf: str) -> str:
    """Return an editable hand description in YAML. `urdf` is the hand's file, relative to the description."""
    from graspd_core.hands.model import all_joint_names

    lines = [f"urdf: {_quoted(urdf)}", "", "palm:", f"  link: {_quoted(hand.base_link)}"]
    lines += [f"  center: {_list(hand.palm_center)}", f"  normal: {_list(hand.palm_normal)}"]
    lines += ["", f"approach: {_list(hand.approach)}"]
    for key, posture in (("open", hand.open_posture), ("closed", hand.closed_posture)):
        lines += ["", f"{key}:"]
        for name in (name for name in all_joint_names(hand) if name in hand.joint_names):
            i = hand.joint_names.index(name)
            # Clip the rounded value, because rounding may move a posture beyond a joint limit.
            value = float(np.clip(round(float(posture[i]), 3), hand.lower[i], hand.upper[i]))
            # Write without an exponent, because YAML reads 1e-05 as text.
            lines.append(f"  {_quoted(name)}: {np.format_float_positional(value, trim='0')}")
    return "\n".join(lines) + "\n"


def _vector(values: Float[np.ndarray, "3"]) -> str:
    return f"({', '.join(f'{value + 0.0:.3f}' for value in values)})"


def _list(values: Float[np.ndarray, "3"]) -> str:
    return f"[{', '.join(f'{value + 0.0:.4f}' for value in values)}]"


def _quoted(name: str) -> str:
    return '"' + name.replace("\\", "\\\\").replace('"', '\\"') + '"'
