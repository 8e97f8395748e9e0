"""Plan verified grasps of a mesh: python examples/grasp_a_mesh.py [mug.obj] [grasps.json].

Coordinates in the file are metres. Pass `scale=0.001` for millimetres. Without a file, the object is a built-in mug.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from graspd_core import (
    Progress,
    Verdict,
    hand_names,
    load_grasps,
    load_hand,
    load_preset,
    load_scene,
    plan_grasps,
    save_result,
)


def report(progress: Progress) -> None:
    """Print progress at the end of each stage. `plan_grasps` calls this function."""
    if progress.step == progress.of:
        print(f"  {progress.elapsed:5.2f} s  {progress.stage}: {progress.verified} verified so far")


def main(arguments: Sequence[str]) -> int:
    """Return 0 if there is a verified grasp, else 1."""
    source = arguments[0] if arguments else "shape:mug"
    out = arguments[1] if len(arguments) > 1 else "grasps.json"
    scene = load_scene(source, mass=0.3, friction=0.6)
    size = np.ptp(scene.object.mesh.vertices, axis=0) * 100
    print(f"{source}: {size[0]:.1f} x {size[1]:.1f} x {size[2]:.1f} cm; hands: {', '.join(hand_names())}")

    hand, preset = load_hand("allegro_right"), load_preset("fast")
    result = plan_grasps(scene, hand, count=4, seed=0, preset=preset, deadline=60.0, progress=report)
    print(f"{result.outcome.value}; {result.timing.total:.1f} s")

    verified = [grasp for grasp in result.grasps if grasp.verdict is Verdict.VERIFIED]
    for rank, grasp in enumerate(verified):
        metrics = grasp.metrics or {}
        posture = grasp.grasp
        print(f"#{rank}: base at {posture.position.round(3)} m, turned by {posture.quaternion_wxyz.round(2)} (wxyz)")
        print(f"    fingers at {posture.joint_positions.round(2)} rad")
        print(f"    {len(grasp.contacts)} links touch, epsilon {metrics.get('epsilon')}")

    # A robot opens the hand at `pregrasp`, closes the hand to `grasp`, and presses towards `squeeze`.
    save_result(out, result, scene.object, hand, preset)
    print(f"{out}: {len(load_grasps(out))} grasps, failed grasps last")
    return 0 if verified else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
