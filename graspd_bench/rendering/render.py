"""Rendering without a display: depth images by ray casting, shaded pictures of meshes, and pictures of a hand.

Camera frames follow the optical convention: z forward, x right, y down. Pictures need no Open3D: they are drawn point
by point, with outlines that are up to half a pixel too wide.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image

from graspd_core.hands.kinematics import hand_mesh, in_base, link_poses
from graspd_core.hands.model import HandModel
from graspd_core.mesh.surface_queries import first_hits
from graspd_core.mesh.topology import scaled_normals
from graspd_core.perception.cloud.camera import PinholeCamera, camera_rays
from graspd_core.se3 import perpendicular
from graspd_core.types import TriangleMesh, joined

Vector = Sequence[float | int] | Float[np.ndarray, "3"]

BACKGROUND = 255
AMBIENT = 0.25


def camera_of_view(width: int, height: int, field_of_view: float = 0.7) -> PinholeCamera:
    """Return a pinhole camera with a centred principal point. `field_of_view` is vertical [rad]."""
    focal = 0.5 * height / float(np.tan(0.5 * field_of_view))
    return PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def look_at(eye: Vector, target: Vector, up: Vector = (0.0, 0.0, 1.0)) -> Float[np.ndarray, "4 4"]:
    """Return `T_world_camera` of a camera at `eye` [m] that looks at `target` [m].

    `up` points upwards in the image. If the camera looks along `up`, its roll is arbitrary.
    """
    forward = np.asarray(target, dtype=float) - np.asarray(eye, dtype=float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.asarray(up, dtype=float))
    if np.linalg.norm(right) < 1e-9:
        right = perpendicular(forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = eye
    return pose


def render_depth(
    mesh: TriangleMesh, camera: PinholeCamera, T_world_camera: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "height width"]:
    """Return the depth image of a mesh: distances along the optical axis [m], or 0 where a ray hits nothing."""
    distance, _, _ = _cast(mesh, camera, T_world_camera)
    return np.where(np.isfinite(distance), distance, 0.0)


def render_scene(
    meshes: Sequence[TriangleMesh], camera: PinholeCamera, T_world_camera: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, "height width"], Int[np.ndarray, "height width"]]:
    """Return the depth image of all meshes together [m] (0: no hit), and the mesh index of each pixel (-1: no hit)."""
    distance, face, _ = _cast(joined(*meshes), camera, T_world_camera)
    hit = np.isfinite(distance)
    return np.where(hit, distance, 0.0), np.where(hit, _owner(meshes)[np.where(hit, face, 0)], -1)


def draw_labels(
    meshes: Sequence[TriangleMesh], camera: PinholeCamera, T_world_camera: Float[np.ndarray, "4 4"]
) -> Int[np.ndarray, "height width"]:
    """Return the mesh index of each pixel of a picture, -1 where no mesh is."""
    distance, face, _ = draw_points(joined(*meshes), camera, T_world_camera)
    return np.where(np.isfinite(distance), _owner(meshes)[face], -1)


def _owner(meshes: Sequence[TriangleMesh]) -> Int[np.ndarray, "faces"]:
    return np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])


def render_shaded(
    meshes: Sequence[tuple[TriangleMesh, tuple[float, float, float]]],
    *,
    T_world_camera: Float[np.ndarray, "4 4"],
    width: int = 640,
    height: int = 480,
) -> UInt8[np.ndarray, "height width 3"]:
    """Return a picture of meshes with their RGB colours (0 to 1), on white. Light comes from the camera and from +z."""
    together = joined(*(mesh for mesh, _ in meshes))
    colours = np.repeat(np.array([rgb for _, rgb in meshes], dtype=float), [len(m.faces) for m, _ in meshes], axis=0)
    distance, face, normal = draw_points(together, camera_of_view(width, height), T_world_camera)
    hit = np.isfinite(distance)
    view, above = -T_world_camera[:3, 2], np.array([0.0, 0.0, 1.0])
    # Normals are flipped towards the viewer, so that the winding of a face does not matter.
    normal = normal * np.where(normal @ view < 0, -1.0, 1.0)[..., None]
    light = AMBIENT + 0.55 * (normal @ view).clip(0) + 0.2 * (normal @ above).clip(0)
    image = np.full((height, width, 3), BACKGROUND, dtype=np.uint8)
    image[hit] = (255 * (colours[face[hit]] * light[hit][:, None]).clip(0, 1)).astype(np.uint8)
    return image


def save_png(path: str | Path, image: UInt8[np.ndarray, "height width 3"]) -> None:
    """Write an RGB picture as a PNG file."""
    Image.fromarray(image).save(path, "PNG")


def _cast(mesh: TriangleMesh, camera: PinholeCamera, T_world_camera: Float[np.ndarray, "4 4"]):
    """Return depth [m], face index and unit face normal of each pixel. The depth is infinite without a hit."""
    rotation, position = T_world_camera[:3, :3], T_world_camera[:3, 3]
    rays = camera_rays(camera)
    # Pixels outside the range of the lens model have no ray.
    blind = np.isnan(rays[..., 0])
    distance, face, normal = first_hits(
        TriangleMesh(mesh.vertices - position, mesh.faces), np.nan_to_num(rays) @ rotation.T
    )
    return np.where(blind, np.inf, distance), face, normal


# Nearest depth that is drawn [m], and greatest distance between drawn points of a face [pixels].
_NEAREST, _DOT_GAP = 1e-3, 0.7


def draw_points(mesh: TriangleMesh, camera: PinholeCamera, T_world_camera: Float[np.ndarray, "4 4"]):
    """Return the same as `_cast`, from points on the faces and a depth buffer, for a camera that sees the whole mesh.

    Faces that reach behind the camera are left out. Faces far larger than the picture need much memory. There is no
    lens distortion.
    """
    corners = ((mesh.vertices - T_world_camera[:3, 3]) @ T_world_camera[:3, :3])[mesh.faces]
    scaled = scaled_normals(mesh.vertices, mesh.faces)
    normals = scaled / np.maximum(np.linalg.norm(scaled, axis=1, keepdims=True), 1e-300)
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    pixels = corners[..., :2] / np.maximum(corners[..., 2:], _NEAREST) * focal + middle
    size = np.array([camera.width, camera.height])
    shown = (corners[..., 2] > _NEAREST).all(1) & (pixels.max(1) > -1).all(1) & (pixels.min(1) < size).all(1)
    # Rows of points are parallel to the longest side. Faces with equally many points are drawn together, and powers of
    # two make these groups few.
    sides = np.roll(pixels, -1, axis=1) - pixels
    lengths = np.linalg.norm(sides, axis=-1)
    first, longest = lengths.argmax(1)[:, None], lengths.max(1)
    corners = np.take_along_axis(corners, (first + np.arange(3))[..., None] % 3, 1)
    heights = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]) / np.maximum(longest, 1e-12)
    levels = np.ceil(np.log2(np.maximum(np.column_stack([longest, heights]), _DOT_GAP) / _DOT_GAP)).astype(int)
    depth, face = np.full(camera.height * camera.width, np.inf), np.zeros(camera.height * camera.width, dtype=int)
    for level in np.unique(levels[shown], axis=0):
        along, across = (grid.ravel() for grid in np.meshgrid(*(np.arange(2**n + 1) / 2**n for n in level)))
        weights = np.column_stack([(1.0 - across) * (1.0 - along), (1.0 - across) * along, across])
        rows = np.flatnonzero(shown & (levels == level).all(1))
        for some in np.array_split(rows, -(-len(rows) * len(weights) // _AT_ONCE)):
            points = (weights @ corners[some]).reshape(-1, 3)
            at = np.rint(points[:, :2] / points[:, 2:] * focal + middle).astype(int)
            seen = ((at >= 0) & (at < size)).all(1)
            of, z = np.repeat(some, len(weights))[seen], points[seen, 2]
            pixel = at[seen, 1] * camera.width + at[seen, 0]
            # The nearest point is written last, and so stays.
            order = np.argsort(-z, kind="stable")
            order = order[z[order] < depth[pixel[order]]]
            depth[pixel[order]], face[pixel[order]] = z[order], of[order]
    shape = (camera.height, camera.width)
    return depth.reshape(shape), face.reshape(shape), normals[face].reshape(*shape, 3)


# Greatest number of points that are drawn at once.
_AT_ONCE = 500_000
_HAND, _CANDIDATE, _PALM = (0.45, 0.55, 0.75), (0.85, 0.25, 0.15), (0.15, 0.6, 0.2)
_WIDTH, _HEIGHT = 560, 480
# Radius of the dots at candidates, and length and radius of the palm's arrow, as fractions of the hand's size.
_DOT, _ARROW, _SHAFT = 0.006, 0.35, 0.012


def hand_picture(hand: HandModel) -> UInt8[np.ndarray, "height width 3"]:
    """Return a picture with four views of a hand. The left column shows it open, the right column closed.

    The upper row looks from the side, the lower row at the palm. Red dots are contact candidates. A green arrow marks
    the palm's centre and normal.
    """
    reach = hand_mesh(hand, hand.open_posture).vertices
    middle, size = 0.5 * (reach.min(0) + reach.max(0)), float(np.ptp(reach, axis=0).max())
    up = _up(hand, middle)
    side = np.cross(up, hand.palm_normal)
    eyes = (side + 0.5 * hand.palm_normal + 0.25 * up, hand.palm_normal + 0.15 * side + 0.1 * up)
    rows = []
    for eye in eyes:
        # The fingers are turned to +z, because the light comes from there.
        frame = np.column_stack([np.cross(hand.palm_normal, up), hand.palm_normal, up]).T
        pose = look_at(frame @ (2.1 * size * eye / np.linalg.norm(eye)), np.zeros(3), np.array([0.0, 0.0, 1.0]))
        row = []
        for posture in (hand.open_posture, hand.closed_posture):
            meshes = [
                (TriangleMesh((mesh.vertices - middle) @ frame.T, mesh.faces), colour)
                for mesh, colour in _scene(hand, posture, size)
            ]
            row.append(render_shaded(meshes, T_world_camera=pose, width=_WIDTH, height=_HEIGHT))
        rows.append(np.concatenate(row, axis=1))
    return np.concatenate(rows, axis=0)


def _up(hand: HandModel, middle: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    along = middle - hand.palm_center
    along = along - (along @ hand.palm_normal) * hand.palm_normal
    length = float(np.linalg.norm(along))
    return along / length if length > 1e-3 else perpendicular(hand.palm_normal)


def _scene(
    hand: HandModel, posture: Float[np.ndarray, "joints"], size: float
) -> list[tuple[TriangleMesh, tuple[float, float, float]]]:
    import trimesh

    placed = in_base(link_poses(hand, posture), hand.candidate_points, hand.candidate_link)
    dot = trimesh.creation.icosphere(subdivisions=0, radius=_DOT * size)
    count = len(dot.vertices)
    dots = TriangleMesh(
        (placed[:, None] + np.asarray(dot.vertices)).reshape(-1, 3),
        (np.asarray(dot.faces) + count * np.arange(len(placed))[:, None, None]).reshape(-1, 3),
    )
    ends = np.stack([hand.palm_center, hand.palm_center + _ARROW * size * hand.palm_normal])
    shaft = trimesh.creation.cylinder(radius=_SHAFT * size, segment=ends, sections=12)
    knob = trimesh.creation.icosphere(subdivisions=1, radius=2 * _SHAFT * size)
    knob.apply_translation(ends[1])
    arrow = joined(*(TriangleMesh(np.asarray(body.vertices), np.asarray(body.faces)) for body in (shaft, knob)))
    return [(hand_mesh(hand, posture), _HAND), (dots, _CANDIDATE), (arrow, _PALM)]
