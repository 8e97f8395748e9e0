"""`graspd hands`: the built-in hands; `graspd hands inspect`: what is in a hand, as text, picture and description."""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from graspd_core.cli.running import EXIT_OK, sibling
from graspd_core.errors import ConfigError
from graspd_core.hands.kinematics import link_depths
from graspd_core.hands.model import HandModel, all_joint_names


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

    from graspd_core.hands.library import load_hand
    from graspd_core.io.grasps_json import check_writable, save_text

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
        render = sibling("graspd_bench.rendering.render")
        render.save_png(render.hand_picture(hand), options.picture)
        print(f"{options.picture}: open (left) and closed (right), from the side and onto the palm")
    if options.yaml is not None:
        urdf = os.path.relpath(hand.urdf, options.yaml.parent)
        save_text(options.yaml, as_yaml(found, urdf))
        print(f"{options.yaml}: a hand description to edit; graspd synthesize --hand {options.yaml}")
    return EXIT_OK


@dataclass(frozen=True)
class LinkReport:
    """One link: how deep it lies in the tree, what moves it, its mass [kg], its solids and contact candidates."""

    name: str
    depth: int
    joint: str
    mass: float
    solids: tuple[str, ...]
    candidates: int


@dataclass(frozen=True)
class JointReport:
    """One joint [rad, N·m] or [m, N]; a coupled one has the text of its coupling and no numbers of its own."""

    name: str
    kind: str
    lower: float = float("nan")
    upper: float = float("nan")
    effort: float = float("nan")
    open: float = float("nan")
    closed: float = float("nan")
    coupling: str = ""


@dataclass(frozen=True, eq=False)
class HandReport:
    """A hand in the order in which a person asks: what it is, its tree, its joints, its palm, what was mended."""

    name: str
    source: str
    links: tuple[LinkReport, ...]
    joints: tuple[JointReport, ...]
    palm_center: Float[np.ndarray, "3"]
    palm_normal: Float[np.ndarray, "3"]
    approach: Float[np.ndarray, "3"]
    pairs: tuple[int, int]
    warnings: tuple[str, ...]


def report(hand: HandModel) -> HandReport:
    """The report on a loaded hand; `pairs` counts the pairs of links checked against each other, and all pairs."""
    names = _joint_of_link(hand)
    depth = link_depths(hand.link_parent)
    links = tuple(
        LinkReport(
            name=name,
            depth=int(depth[i]),
            joint=names[i],
            mass=float(hand.link_mass[i]),
            solids=tuple(_solid(p.kind, len(p.vertices)) for p in hand.primitives_of[i]),
            candidates=int((hand.candidate_link == i).sum()),
        )
        for i, name in enumerate(hand.link_names)
    )
    pairs = hand.num_links * (hand.num_links - 1) // 2
    return HandReport(
        name=hand.name,
        source=hand.urdf,
        links=links,
        joints=_joints(hand),
        palm_center=hand.palm_center,
        palm_normal=hand.palm_normal,
        approach=hand.approach,
        pairs=(int((~hand.adjacent).sum() // 2), pairs),
        warnings=hand.warnings,
    )


def as_text(found: HandReport) -> str:
    """The report for a terminal: angles in radians, lengths in metres."""
    actuated = sum(not joint.coupling for joint in found.joints)
    coupled = len(found.joints) - actuated
    lines = [
        f"{found.name}: {len(found.links)} links, {actuated} actuated joints, {coupled} coupled",
        f"  read from {found.source}",
        "",
        "links (joint, mass, solids, contact candidates)",
    ]
    for link in found.links:
        solids = ", ".join(_counted(link.solids)) or "no solids"
        mass = f"{link.mass * 1e3:.0f} g" if link.mass else "no mass"
        joint = f" <- {link.joint}" if link.joint else ""
        lines.append(f"  {'  ' * link.depth}{link.name}{joint}: {mass}, {solids}, {link.candidates} candidates")
    width = max(len(joint.name) for joint in found.joints)
    lines += ["", f"joints {'':{max(0, width - 5)}} kind         lower   upper   effort    open  closed"]
    for joint in found.joints:
        if joint.coupling:
            lines.append(f"  {joint.name:{width}} {joint.kind:10} {joint.coupling}")
        else:
            numbers = f"{joint.lower:8.3f}{joint.upper:8.3f}{joint.effort:9.3g}{joint.open:8.3f}{joint.closed:8.3f}"
            lines.append(f"  {joint.name:{width}} {joint.kind:10}{numbers}")
    lines += [
        "",
        f"palm centre {_vector(found.palm_center)}, normal {_vector(found.palm_normal)}, "
        f"approach {_vector(found.approach)}, in {found.links[0].name}",
        f"self-collision: {found.pairs[0]} of {found.pairs[1]} pairs of links are checked",
    ]
    lines += [f"warning: {text}" for text in found.warnings]
    return "\n".join(lines)


def as_yaml(found: HandReport, urdf: str) -> str:
    """A hand description that says what the report says, to be edited; `urdf` is the path to write into it."""
    lines = [f"urdf: {_quoted(urdf)}", "", "palm:", f"  link: {_quoted(found.links[0].name)}"]
    lines += [f"  center: {_list(found.palm_center)}", f"  normal: {_list(found.palm_normal)}"]
    lines += ["", f"approach: {_list(found.approach)}"]
    for key in ("open", "closed"):
        lines += ["", f"{key}:"]
        for joint in found.joints:
            if not joint.coupling:
                # Rounded towards the inside, or a posture at a limit would be beyond it.
                value = float(np.clip(round(getattr(joint, key), 3), joint.lower, joint.upper))
                # Written out: YAML reads 1e-05 as text.
                lines.append(f"  {_quoted(joint.name)}: {np.format_float_positional(value, trim='0')}")
    return "\n".join(lines) + "\n"


def _joint_of_link(hand: HandModel) -> list[str]:
    coupled = {mimic.link: mimic.name for mimic in hand.mimics}
    return [
        coupled.get(link) or (hand.joint_names[joint] if joint >= 0 else "")
        for link, joint in enumerate(hand.link_joint.tolist())
    ]


def _joints(hand: HandModel) -> tuple[JointReport, ...]:
    of_link, coupled = _joint_of_link(hand), {mimic.name: mimic for mimic in hand.mimics}
    found = []
    for name in all_joint_names(hand):
        kind = hand.joint_kind[of_link.index(name)]
        if name in coupled:
            mimic = coupled[name]
            text = f"= {mimic.multiplier:g} · {hand.joint_names[mimic.joint]} {mimic.offset:+g}"
            found.append(JointReport(name, kind, coupling=text))
            continue
        i = hand.joint_names.index(name)
        columns = (hand.lower, hand.upper, hand.effort, hand.open_posture, hand.closed_posture)
        lower, upper, effort, opened, closed = (float(column[i]) for column in columns)
        found.append(JointReport(name, kind, lower, upper, effort, opened, closed))
    return tuple(found)


def _solid(kind: str, corners: int) -> str:
    return f"hull of {corners} corners" if kind == "hull" else kind


def _counted(words: tuple[str, ...]) -> list[str]:
    return [f"{words.count(word)} x {word}" if words.count(word) > 1 else word for word in dict.fromkeys(words)]


def _vector(values: Float[np.ndarray, "3"]) -> str:
    return f"({', '.join(f'{value + 0.0:.3f}' for value in values)})"


def _list(values: Float[np.ndarray, "3"]) -> str:
    return f"[{', '.join(f'{value + 0.0:.4f}' for value in values)}]"


def _quoted(name: str) -> str:
    return '"' + name.replace("\\", "\\\\").replace('"', '\\"') + '"'
