"""A depth image in, grasps out: python examples/grasp_a_cloud.py [view.npz].

The file holds `depth` (height x width, [m]), the camera's matrix `K` (3 x 3) and `T_world_camera` (4 x 4, z forward).
Without one, a cylinder on a table is rendered. The object is cut out and made whole; the table stays in the way.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from graspd_bench.rendering.tabletop import depth_views, ring_poses, tabletop
from graspd_core import (
    GraspdError,
    PinholeCamera,
    SceneConfig,
    Target,
    Verdict,
    cloud_from_depth,
    load_hand,
    plan_grasps,
    scene_from_views,
)


def rendered_view() -> tuple[np.ndarray, PinholeCamera, np.ndarray]:
    """What a camera sees of a cylinder on a table: depth [m], the camera, where it stood."""
    camera = PinholeCamera(320, 240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
    (pose,) = ring_poses(1, elevation=0.6)
    ((depth, _),) = depth_views(tabletop("cylinder"), camera, [pose])
    return depth, camera, pose


def view_of(path: Path) -> tuple[np.ndarray, PinholeCamera, np.ndarray]:
    """The same from a file."""
    with np.load(path) as arrays:
        depth, matrix, pose = arrays["depth"], arrays["K"], arrays["T_world_camera"]
    height, width = depth.shape
    fx, fy, cx, cy = (float(matrix[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return depth, PinholeCamera(width, height, fx, fy, cx, cy), pose


def main(arguments: Sequence[str]) -> int:
    """0 when there is a verified grasp, 1 when not, 2 when the view shows no object."""
    depth, camera, T_world_camera = view_of(Path(arguments[0])) if arguments else rendered_view()
    view = cloud_from_depth(depth, camera, T_world_camera)
    try:
        # Several views of one scene go into the list; Target also takes a box or a mask.
        scene = scene_from_views([view], target=Target(point=np.array([0.0, 0.0, 0.05])), settings=SceneConfig())
    except GraspdError as error:
        print(f"no object: {error}")
        return 2
    for warning in scene.object.warnings:
        print(f"guessed: {warning}")

    result = plan_grasps(scene, load_hand("allegro_right"), count=2, preset="fast", deadline=60.0)
    print(result.outcome.value)
    for grasp in result.grasps:
        if grasp.verdict is Verdict.VERIFIED:
            print(
                f"hand at {grasp.grasp.position.round(3)} m in the world; held {[trial.name for trial in grasp.trials]}"
            )
    return 0 if any(grasp.verdict is Verdict.VERIFIED for grasp in result.grasps) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
