"""Write grasps as an HTML page or a PNG picture. Both use the view in which object and hand are least hidden."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from graspd_bench.rendering.render import BACKGROUND, camera_of_view, draw_labels, look_at, render_shaded, save_png
from graspd_core.hands.kinematics import hand_mesh
from graspd_core.hands.model import HandModel
from graspd_core.io.grasps_json import save_text
from graspd_core.mesh.topology import far_centre, moved_mesh
from graspd_core.perception.scene import moved_grasp
from graspd_core.se3 import perpendicular, rotation_from_quaternion
from graspd_core.types import Grasp, Posture, TriangleMesh, Verdict
from graspd_viewer.drawing import HAND, NORMAL, OBJECT, Colour, contact_parts, css, hand_parts, placed_links
from graspd_viewer.grasp_list import label

PREGRASP: Colour = (0.62, 0.66, 0.72)
# Greatest number of grasps on a page, vertical field of view [rad], and size of a picture [pixels].
_MOST, _FIELD, _SIZE = 16, 0.7, (960, 720)
# Views that `best_view` compares: number of azimuths, elevations [rad], and size of their images [pixels].
_AZIMUTHS, _ELEVATIONS, _SMALL = 12, (0.2, 0.6, 1.0), (48, 36)
# What a page shows: key, name in the legend, colour, and whether it is visible at first.
_LEGEND = (
    ("object", "object", OBJECT, True),
    ("hand", "hand at the grasp", HAND, True),
    ("pregrasp", "hand at the pregrasp", PREGRASP, False),
    ("contacts", "contacts, with the object's normals", NORMAL, True),
)


def save_view(
    path: str | Path,
    object_mesh: TriangleMesh,
    hand: HandModel,
    grasps: Sequence[Grasp],
    *,
    name: str = "object",
    up: Float[np.ndarray, "3"] | None = None,
) -> None:
    """Write an HTML page with object and hand. Visitors select one of the first 16 grasps that did not fail.

    Args:
        path: path of the page. The file is written completely or not at all.
        object_mesh: mesh in the object's frame [m].
        hand: the hand of the grasps.
        grasps: grasps in rank order. If all failed, the page shows only the object.
        name: name of the object for the page's title.
        up: up direction in the object's frame. None: the z axis.
    """
    from trimesh.viewer.notebook import scene_to_html

    # The page stores positions as float32, which is too coarse far from the origin.
    far = far_centre(object_mesh.vertices)
    mesh = moved_mesh(object_mesh, -far)
    shown = [(rank, moved_grasp(g, -far)) for rank, g in enumerate(grasps) if g.verdict is not Verdict.FAILED][:_MOST]
    hands = [placed_hand(hand, grasp.grasp) for _, grasp in shown] or [None]
    data = {
        "grasps": [{"label": label(grasp, rank)} for rank, grasp in shown],
        "views": [dict(zip(("eye", "target", "up"), _lists(best_view(mesh, one, up)), strict=True)) for one in hands],
        "legend": [
            (kind, said, css(colour), seen) for kind, said, colour, seen in _LEGEND if shown or kind == "object"
        ],
    }
    title = html.escape(f"{name}, {hand.name}: {f'{shown[0][1].verdict} grasp' if shown else 'no grasp'}")
    added = _PAGE.replace("@TITLE@", title).replace("@FOV@", f"{np.degrees(_FIELD):.1f}")
    # The sequence `</` could end the script element early.
    added = added.replace("@DATA@", json.dumps(data).replace("</", "<\\/"))
    page = scene_to_html(view_scene(mesh, hand, [grasp for _, grasp in shown]))
    page = re.sub("<title>.*?</title>", lambda _: f"<title>{title}</title>", page, count=1)
    save_text(Path(path), page.replace("</body>", added, 1))


def save_picture(
    path: str | Path,
    object_mesh: TriangleMesh,
    hand: HandModel,
    grasps: Sequence[Grasp],
    *,
    up: Float[np.ndarray, "3"] | None = None,
) -> None:
    """Write a PNG picture of the object, the first grasp that did not fail, and its contacts. See `save_view`."""
    grasp = next((grasp for grasp in grasps if grasp.verdict is not Verdict.FAILED), None)
    held = grasp and placed_hand(hand, grasp.grasp)
    eye, target, up = best_view(object_mesh, held, up)
    look: Any = {"T_world_camera": look_at(eye, target, up), "width": _SIZE[0], "height": _SIZE[1]}
    image = render_shaded([(object_mesh, OBJECT), *([(held, HAND)] if held else [])], **look)
    # Contacts are hidden between hand and object, so their arrows are drawn on top.
    for part in contact_parts(grasp.contacts) if grasp else ():
        arrows = render_shaded([(part.mesh, part.colour)], **look)
        image = np.where((arrows == BACKGROUND).all(-1, keepdims=True), image, arrows)
    save_png(path, image)


def best_view(
    object_mesh: TriangleMesh, hand: TriangleMesh | None, up: Float[np.ndarray, "3"] | None = None
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return the camera's position, the point that it looks at [m], and the up direction of the best view.

    Each view has two fractions: visible pixels of the object, and of the hand, divided by the most in any view. The
    smaller fraction rates the view.
    """
    meshes = [object_mesh] if hand is None else [object_mesh, hand]
    corners = np.concatenate([mesh.vertices for mesh in meshes])
    middle = 0.5 * (corners.min(0) + corners.max(0))
    distance = 1.1 * float(np.linalg.norm(corners - middle, axis=1).max()) / np.sin(0.5 * _FIELD)
    up = np.array([0.0, 0.0, 1.0]) if up is None else up
    side = perpendicular(up)
    azimuth, elevation = (
        angles.ravel() for angles in np.meshgrid(np.linspace(0, 2 * np.pi, _AZIMUTHS, endpoint=False), _ELEVATIONS)
    )
    level = np.cos(azimuth)[:, None] * side + np.sin(azimuth)[:, None] * np.cross(up, side)
    eyes = middle + distance * (np.cos(elevation)[:, None] * level + np.sin(elevation)[:, None] * up)
    camera = camera_of_view(*_SMALL, _FIELD)
    labels = [draw_labels(meshes, camera, look_at(eye, middle, up)) for eye in eyes]
    seen = np.array([[(image == number).sum() for number in range(len(meshes))] for image in labels])
    best = int((seen / seen.max(0).clip(1)).min(1).argmax())
    return eyes[best], middle, up


def view_scene(object_mesh: TriangleMesh, hand: HandModel, grasps: Sequence[Grasp]):
    """Return a `trimesh.Scene` of the object, contacts, and hand links at grasps and pregrasps, object frame [m]."""
    import trimesh

    scene = trimesh.Scene()
    scene.add_geometry(_body(object_mesh, OBJECT), geom_name="object", node_name="object")
    for kind, colour in (("hand", HAND), ("pregrasp", PREGRASP)):
        links = {link: _body(part.mesh, colour) for link, part in hand_parts(hand).items()}
        for rank, grasp in enumerate(grasps):
            positions, quaternions = placed_links(hand, grasp.grasp if kind == "hand" else grasp.pregrasp)
            for link, body in links.items():
                pose = np.eye(4)
                pose[:3, :3] = rotation_from_quaternion(torch.as_tensor(quaternions[link])).numpy()
                pose[:3, 3] = positions[link]
                named: dict[str, Any] = {"node_name": f"{kind}{rank}_{link}", "geom_name": f"{kind}_{link}"}
                if rank == 0:
                    scene.add_geometry(body, **named, transform=pose)
                else:
                    scene.graph.update(frame_to=named["node_name"], matrix=pose, geometry=named["geom_name"])
    for rank, grasp in enumerate(grasps):
        for part in contact_parts(grasp.contacts):
            scene.add_geometry(_body(part.mesh, part.colour), geom_name=f"contacts{rank}", node_name=f"contacts{rank}")
    return scene


def _body(mesh: TriangleMesh, colour: Colour) -> Any:
    import trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    # The default material is metallic, and metal without an environment map is rendered black.
    material = PBRMaterial(
        baseColorFactor=[*(round(255 * c) for c in colour), 255],
        metallicFactor=0.0,
        roughnessFactor=0.9,
        doubleSided=True,
    )
    # Faces without shared vertices are shaded flat, which shows the edges of the hand's boxes.
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    body = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    body.visual = TextureVisuals(material=material)
    return body


def placed_hand(hand: HandModel, posture: Posture) -> TriangleMesh:
    """Return the mesh of the hand's collision shapes at a posture, object frame [m]."""
    mesh = hand_mesh(hand, posture.joint_positions)
    rotation = rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz)).numpy()
    return TriangleMesh(mesh.vertices @ rotation.T + posture.position, mesh.faces)


def _lists(vectors: Sequence[Float[np.ndarray, "3"]]) -> list[list[float]]:
    return [vector.tolist() for vector in vectors]


_PAGE = (Path(__file__).parent / "grasp_page.html").read_text(encoding="utf-8")
