"""The picture of the README: three hands, each with the best grasp that held. `make pictures` writes it anew."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graspd_core import Verdict, load_hand, load_scene, plan_grasps
from graspd_core.formats.grasp_page import placed_hand
from graspd_core.rendering.render import camera_of_view, look_at, render_scene, render_shaded, save_png

OUT = Path(__file__).parents[1] / "docs" / "figures" / "grasps.png"
SIZE, OVERSAMPLING = 420, 2


# What is grasped, and by which hand.
PAIRS = (("shape:mug", "allegro_right"), ("shape:torus", "barrett_like"), ("shape:hammer", "leap_right"))
OBJECT, HAND = (0.90, 0.58, 0.28), (0.62, 0.70, 0.82)
# Directions to look from, 20 and 50 degrees above the horizon.
TURNS = np.arange(0.0, 2 * np.pi, np.pi / 8)
EYES = [(np.cos(up) * np.cos(a), np.cos(up) * np.sin(a), np.sin(up)) for up in np.radians((20.0, 50.0)) for a in TURNS]


def picture_of(source: str, hand_name: str) -> np.ndarray:
    """A square picture of the best grasp, from where most of the object is seen. Raises RuntimeError: none held."""
    scene, hand = load_scene(source), load_hand(hand_name)
    result = plan_grasps(scene, hand, count=4, seed=0)
    held = [grasp for grasp in result.grasps if grasp.verdict is Verdict.VERIFIED]
    if not held:
        raise RuntimeError(f"{source} by {hand_name}: {result.outcome.value}")
    meshes = (scene.object.mesh, placed_hand(hand, held[0].grasp))
    corners = np.vstack([mesh.vertices for mesh in meshes])
    middle, radius = 0.5 * (corners.min(0) + corners.max(0)), 0.5 * np.linalg.norm(np.ptp(corners, axis=0))
    poses = [look_at(middle + 2.3 * radius * np.array(eye), middle) for eye in EYES]
    small = camera_of_view(60, 60)
    pose = max(poses, key=lambda pose: int((render_scene(meshes, small, pose)[1] == 0).sum()))
    sides = {"width": SIZE * OVERSAMPLING, "height": SIZE * OVERSAMPLING}
    image = render_shaded(list(zip(meshes, (OBJECT, HAND), strict=True)), T_world_camera=pose, **sides)
    # Averaging pixels smooths the edges.
    return image.reshape(SIZE, OVERSAMPLING, SIZE, OVERSAMPLING, 3).mean(axis=(1, 3)).astype(np.uint8)


if __name__ == "__main__":
    save_png(np.hstack([picture_of(*pair) for pair in PAIRS]), OUT)
    print(OUT)
