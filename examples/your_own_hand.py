"""Use your own hand from its URDF: python examples/your_own_hand.py [my_hand.urdf].

If a URDF has no description, palm and postures are guessed. A YAML description beside the URDF corrects the guesses.
`graspd hands inspect my_hand.urdf --picture hand.png` shows the hand. Without a file, the program uses an example claw.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from graspd_core import HandModel, Verdict, load_hand, load_scene, plan_grasps

LINK = '<link name="{name}"><inertial><mass value="{mass}"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial><collision><origin xyz="{at}"/><geometry><box size="{size}"/></geometry></collision></link>'  # noqa: E501
JOINT = '<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/><axis xyz="{axis}"/><limit lower="-0.8" upper="1.0" effort="2" velocity="2"/></joint>'  # noqa: E501
# Fingers point out of the palm (z). Each finger bends towards the middle, about the axis given here.
FINGERS = {"left": ("0 0.05 0.03", "1 0 0"), "right": ("0 -0.05 0.03", "-1 0 0"), "thumb": ("0.05 0 0.03", "0 -1 0")}


def claw() -> str:
    """Return a URDF of a palm with three fingers of two links each."""
    parts = [LINK.format(name="palm", mass=0.4, at="0 0 0", size="0.12 0.12 0.06")]
    for finger, (root, axis) in FINGERS.items():
        for place, parent, at in (("lower", "palm", root), ("upper", f"{finger}_lower", "0 0 0.06")):
            link = f"{finger}_{place}"
            parts.append(LINK.format(name=link, mass=0.05, at="0 0 0.03", size="0.02 0.02 0.056"))
            parts.append(JOINT.format(name=f"{link}_joint", parent=parent, child=link, at=at, axis=axis))
    return f'<robot name="claw">{"".join(parts)}</robot>'


def described(urdf: Path, joints: Sequence[str]) -> HandModel:
    """Return the hand with a description of its palm and its open and closed postures."""
    postures = {
        name: ", ".join(f"{joint}: {angle}" for joint in joints) for name, angle in (("open", -0.3), ("closed", 0.5))
    }
    description = urdf.with_suffix(".yaml")
    description.write_text(
        f"urdf: {urdf.name}\n"
        "palm: {link: palm, center: [0.0, 0.0, 0.03], normal: [0.0, 0.0, 1.0]}\n"
        "approach: [0.0, 0.0, 1.0]\n"
        f"open: {{{postures['open']}}}\nclosed: {{{postures['closed']}}}\n"
    )
    return load_hand(description)


def main(arguments: Sequence[str]) -> int:
    """Return 0 if the hand holds a sphere in a trial, else 1."""
    with tempfile.TemporaryDirectory() as folder:
        urdf = Path(arguments[0]) if arguments else Path(folder) / "claw.urdf"
        if not arguments:
            urdf.write_text(claw())
        guessed = load_hand(urdf)
        for warning in guessed.warnings:
            print(f"guessed: {warning}")
        hand = guessed if arguments else described(urdf, guessed.joint_names)
    print(f"{hand.name}: {len(hand.joint_names)} joints; palm at {hand.palm_center}, normal {hand.palm_normal}")
    result = plan_grasps(load_scene("shape:sphere"), hand, count=1, preset="fast")
    print(result.outcome.value)
    return 0 if any(grasp.verdict is Verdict.VERIFIED for grasp in result.grasps) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
