"""The 3D scene of the page: the meshes of `drawing` as nodes of viser. Only the drawing thread changes it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from graspd_core.hands.model import HandModel
from graspd_core.mesh.topology import is_closed
from graspd_core.se3 import perpendicular, quaternion_from_rotation
from graspd_core.types import Posture, TriangleMesh
from graspd_viewer.drawing import SEEN, Part, hand_parts, placed_links, scene_parts, sdf_slice, slice_axes
from graspd_viewer.session import Session

_MOST_POINTS = 20_000
# The browser's scene is in centimetres. viser draws an empty background one unit from the camera, which costs a
# software renderer a fifth of the frame time. The near plane at `_NEAR` units removes this background.
PER_METRE, _NEAR = 100.0, 1.01


class SceneNodes:
    """Nodes of one server's 3D scene: hand, object, support, neighbours, arrows, SDF slice, lines and points."""

    def __init__(self, server: Any) -> None:
        self._server = server
        self._links: dict[int, Any] = {}
        self._groups: dict[str, list[Any]] = {}
        self._object: Any = None
        self._hidden: set[str] = set()
        self._opacity = 1.0
        # With viser's default lights, shadows and reflections a software renderer reaches only 1 frame a second.
        server.initial_camera.near = _NEAR
        server.scene.configure_default_lights(False)
        server.scene.configure_environment_map(None)
        server.scene.add_light_hemisphere(
            "/light/sky", sky_color=(255, 255, 255), ground_color=(90, 90, 110), intensity=3.0
        )
        server.scene.add_light_directional("/light/sun", intensity=1.5, cast_shadow=False, position=(1.0, 1.0, 2.0))

    def show(self, session: Session) -> None:
        """Clear the scene. Draw the object, support, neighbours, camera points and hand of a session."""
        with self._server.atomic():
            for name in list(self._groups):
                self.draw(name, ())
            if self._object is not None:
                self._object.remove()
            self._object = self._server.scene.add_frame("/object", show_axes=False)
            if session.scene is not None:
                for group in ("object", "around"):
                    self.draw(group, [p for p in scene_parts(session.scene) if p.name.startswith(group)])
            self.draw_points(session.seen)
            self._draw_hand(session.hand)
        self._aim(session)

    def draw(self, group: str, parts: Sequence[Part]) -> None:
        """Replace the drawn parts of a group."""
        self._clear(group)
        self._groups[group] = [self._mesh(f"/{part.name}", part) for part in parts]
        for node in self._groups[group]:
            node.visible = group not in self._hidden

    def _clear(self, group: str) -> None:
        for node in self._groups.pop(group, ()):
            node.remove()

    def draw_lines(self, lines: Float[np.ndarray, "n 2 3"], colours: Float[np.ndarray, "n 3"]) -> None:
        """Replace the drawn line segments [m]. `colours` are RGB, 0 to 1."""
        self._clear("lines")
        if len(lines):
            tints = np.repeat((255 * colours).astype(np.uint8)[:, None], 2, axis=1)
            node = self._server.scene.add_line_segments(
                "/lines", PER_METRE * lines, tints, thickness=PER_METRE * 0.0015
            )
            self._groups["lines"] = [node]

    def draw_slice(self, session: Session, axis: int | None, share: float) -> None:
        """Replace the drawn SDF slice. See `sdf_slice` for `axis` and `share`. If `axis` is None, remove the slice."""
        self._clear("slice")
        if axis is None or session.scene is None:
            return
        image, middle = sdf_slice(session.scene, axis, share)
        size = 2 * PER_METRE * session.scene.sdf.half.double().cpu().numpy()
        down, right = slice_axes(axis)
        turn = np.zeros((3, 3))
        turn[right, 0], turn[down, 1] = 1.0, 1.0
        turn[:, 2] = np.cross(turn[:, 0], turn[:, 1])
        node = self._server.scene.add_image(
            "/slice", image, float(size[right]), float(size[down]), wxyz=_quaternion(turn), position=PER_METRE * middle
        )
        self._groups["slice"] = [node]

    def set_visible(self, group: str, visible: bool) -> None:
        """Show or hide a group. This also applies to parts that are drawn later."""
        (self._hidden.discard if visible else self._hidden.add)(group)
        for node in self._groups.get(group, ()):
            node.visible = visible

    def pose_hand(self, hand: HandModel, posture: Posture) -> None:
        """Move the hand to a posture."""
        self.pose_links(*placed_links(hand, posture))

    def pose_links(self, positions: Float[np.ndarray, "_ 3"], quaternions: Float[np.ndarray, "_ 4"]) -> None:
        """Set the pose of each link: positions [m] and quaternions wxyz, by link index."""
        with self._server.atomic():
            for link, node in self._links.items():
                node.position, node.wxyz = PER_METRE * positions[link], quaternions[link]

    def pose_object(self, position: Float[np.ndarray, "3"], quaternion: Float[np.ndarray, "4"]) -> None:
        """Set the object's pose relative to its pose during planning: position [m] and quaternion wxyz."""
        if self._object is not None:
            self._object.position, self._object.wxyz = PER_METRE * position, quaternion

    def show_hand(self, visible: bool) -> None:
        for node in self._links.values():
            node.visible = visible

    def fade_hand(self, opacity: float) -> None:
        """Set the hand's opacity (0.05 to 1). This also applies to hands that are drawn later."""
        self._opacity = min(max(opacity, 0.05), 1.0)
        for node in self._links.values():
            node.opacity = None if self._opacity == 1.0 else self._opacity

    def _draw_hand(self, hand: HandModel) -> None:
        for node in self._links.values():
            node.remove()
        self._links = {link: self._mesh(f"/{part.name}", part) for link, part in hand_parts(hand).items()}
        self.fade_hand(self._opacity)

    def place(self, group: str, poses: Sequence[Float[np.ndarray, "4 4"]]) -> None:
        """Set the poses of a group's parts, in the order in which they were drawn [m]."""
        for node, pose in zip(self._groups.get(group, ()), poses, strict=True):
            node.position, node.wxyz = PER_METRE * pose[:3, 3], _quaternion(pose[:3, :3])

    def draw_points(self, points: Float[np.ndarray, "n 3"]) -> None:
        """Replace the drawn points [m]."""
        self._clear("cloud")
        if len(points):
            every = -(-len(points) // _MOST_POINTS)
            shown = (PER_METRE * points[::every]).astype(np.float32)
            node = self._server.scene.add_point_cloud("/cloud", shown, SEEN, point_size=PER_METRE * 0.0012)
            self._groups["cloud"] = [node]

    def _mesh(self, name: str, part: Part) -> Any:
        # The inside of a closed body is invisible. Drawing the inside costs a software renderer a fifth of a frame.
        mesh, hand = part.mesh, name.startswith("/hand")
        closed = hand or is_closed(mesh)
        # Toon shading looks similar on solids and saves a sixth of a frame. Toon shading is never flat, so each face
        # gets its own vertices.
        if hand:
            mesh = TriangleMesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(mesh.faces.size).reshape(-1, 3))
        return self._server.scene.add_mesh_simple(
            name, PER_METRE * mesh.vertices, mesh.faces,
            color=tuple(round(255 * channel) for channel in part.colour), flat_shading=True,
            material="toon5" if hand else "standard", side="front" if closed else "double",
            opacity=None if part.opacity == 1.0 else part.opacity, cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _aim(self, session: Session) -> None:
        """Turn every visitor's camera to the object. Up is the support's normal, or z without a support."""
        middle, size, up = np.zeros(3), 0.1, np.array([0.0, 0.0, 1.0])
        if session.scene is not None:
            corners = session.scene.object.mesh.vertices
            middle, size = 0.5 * (corners.min(0) + corners.max(0)), float(np.ptp(corners, axis=0).max())
            up = up if session.scene.support is None else session.scene.support.normal
        elif session.grasps:
            middle = session.grasps[0].grasp.position
        side = perpendicular(up)
        self.aim(middle + (0.14 + 1.5 * size) * (0.75 * side + 0.55 * np.cross(up, side) + 0.45 * up), middle, up)

    def aim(self, eye: Float[np.ndarray, "3"], middle: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]) -> None:
        """Move every visitor's camera to `eye`, looking at the point `middle` [m]."""
        self._server.scene.set_up_direction(up)
        for camera in (self._server.initial_camera, *(c.camera for c in self._server.get_clients().values())):
            camera.position, camera.look_at = PER_METRE * eye, PER_METRE * middle


def _quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    return quaternion_from_rotation(torch.as_tensor(rotation)).numpy()
