"""A grasp to look at: one HTML page that needs no network, to turn and zoom in any browser."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from graspd_core.hands.kinematics import hand_mesh
from graspd_core.hands.model import HandModel
from graspd_core.io.grasps_json import save_text
from graspd_core.mesh.topology import far_centre, moved_mesh
from graspd_core.perception.scene import moved_grasp
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import Grasp, Posture, TriangleMesh, Verdict

OBJECT_COLOUR, HAND_COLOUR = (217, 140, 64), (89, 115, 153)


def save_view(
    path: str | Path, object_mesh: TriangleMesh, hand: HandModel, grasps: Sequence[Grasp], *, name: str = "object"
) -> None:
    """Write a page with the object and the hand at the first grasp that did not fail its trial.

    Args:
        path: of the page. It appears whole or not at all.
        object_mesh: object frame [m].
        hand: that the grasps are for.
        grasps: in rank order. If all failed, the page shows the object alone.
        name: of the object, for the page's title.
    """
    from trimesh.viewer.notebook import scene_to_html

    best = next((grasp for grasp in grasps if grasp.verdict is not Verdict.FAILED), None)
    # The page keeps places as float32.
    far = far_centre(object_mesh.vertices)
    scene = view_scene(moved_mesh(object_mesh, -far), hand, best and moved_grasp(best, -far))
    said = f"{name}, {hand.name}: {f'{best.verdict} grasp' if best else 'no grasp'}"
    page = re.sub("<title>.*?</title>", lambda _: f"<title>{html.escape(said)}</title>", scene_to_html(scene), count=1)
    save_text(Path(path), page)


def view_scene(object_mesh: TriangleMesh, hand: HandModel, grasp: Grasp | None):
    """Return object and hand as a `trimesh.Scene` with the meshes `object` and `hand`, object frame [m]."""
    import trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    meshes = {"object": (object_mesh, OBJECT_COLOUR)}
    if grasp is not None:
        meshes["hand"] = (placed_hand(hand, grasp.grasp), HAND_COLOUR)
    scene = trimesh.Scene()
    for name, (mesh, colour) in meshes.items():
        material = PBRMaterial(baseColorFactor=[*colour, 255], doubleSided=True)
        # Faces that share no vertices are shaded flat, which is what shows the edges of a hand made of boxes.
        corners = mesh.vertices[mesh.faces].reshape(-1, 3)
        body = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
        body.visual = TextureVisuals(material=material)
        scene.add_geometry(body, geom_name=name, node_name=name)
    return scene


def placed_hand(hand: HandModel, posture: Posture) -> TriangleMesh:
    """Return the hand's collision surface at a posture, object frame [m]."""
    mesh = hand_mesh(hand, posture.joint_positions)
    rotation = rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz)).numpy()
    return TriangleMesh(mesh.vertices @ rotation.T + posture.position, mesh.faces)
