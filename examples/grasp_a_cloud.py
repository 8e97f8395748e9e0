"""Plan grasps on a depth image: python examples/grasp_a_cloud.py [depth.png camera.json].

The camera's file has `width`, `height`, `K` and optionally `T_world_camera` (docs/clouds.md). The target is in the
world frame. Without files, a cylinder on a table is rendered. graspd guesses the hidden side. The table is an obstacle.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from graspd_bench.rendering.tabletop import depth_views, ring_poses, tabletop
from graspd_core import (
    GraspdError,
    PinholeCamera,
    PointCloud,
    SceneConfig,
    Target,
    Verdict,
    cloud_from_depth,
    load_depth_view,
    load_hand,
    plan_grasps,
    scene_from_views,
)


def rendered_view() -> PointCloud:
    """Render a cylinder on a table. Return the points that the camera sees, and the camera's position."""
    camera = PinholeCamera(320, 240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
    (pose,) = ring_poses(1, elevation=0.6)
    ((depth, _),) = depth_views(tabletop("cylinder"), camera, [pose])
    return cloud_from_depth(depth, camera, pose)


def main(arguments: Sequence[str]) -> int:
    """Return 0 if there is a verified grasp, 1 if not, 2 if the view shows no object."""
    view = load_depth_view(arguments[0], arguments[1]) if arguments else rendered_view()
    try:
        # The list may hold several views of one scene. The target may also be a box or a mask.
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
