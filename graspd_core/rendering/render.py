"""Rays against meshes: depth images as a camera sees them, and shaded pictures, without any display.

Camera frames follow the optical convention: z forward, x right, y down.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from graspd_core.mesh.shapes import joined
from graspd_core.mesh.surface_queries import first_hits
from graspd_core.pointcloud.camera import PinholeCamera, camera_rays
from graspd_core.se3 import perpendicular
from graspd_core.types import TriangleMesh

Vector = Sequence[float | int] | Float[np.ndarray, "3"]

BACKGROUND = 255
AMBIENT = 0.25


def camera_of_view(width: int, height: int, field_of_view: float = 0.7) -> PinholeCamera:
    """A centred camera of that vertical field of view [rad]."""
    focal = 0.5 * height / float(np.tan(0.5 * field_of_view))
    return PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def look_at(eye: Vector, target: Vector, up: Vector = (0.0, 0.0, 1.0)) -> Float[np.ndarray, "4 4"]:
    """`T_world_camera` of a camera at `eye` that looks at `target` with `up` upwards in its image [m].

    Looking along `up`, any roll will do and one is chosen.
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
    """Distance along the optical axis [m], 0 where the ray meets nothing."""
    distance, _, _ = _cast(mesh, camera, T_world_camera)
    return np.where(np.isfinite(distance), distance, 0.0)


def render_scene(
    meshes: Sequence[TriangleMesh], camera: PinholeCamera, T_world_camera: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, "height width"], Int[np.ndarray, "height width"]]:
    """Distance along the optical axis [m], 0 where the ray meets nothing, and which mesh it meets, -1 for none."""
    distance, face, _ = _cast(joined(*meshes), camera, T_world_camera)
    hit = np.isfinite(distance)
    label = np.full(distance.shape, -1)
    label[hit] = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])[face[hit]]
    return np.where(hit, distance, 0.0), label


def render_shaded(
    meshes: Sequence[tuple[TriangleMesh, tuple[float, float, float]]],
    *,
    T_world_camera: Float[np.ndarray, "4 4"],
    width: int = 640,
    height: int = 480,
) -> UInt8[np.ndarray, "height width 3"]:
    """A picture of meshes in their colours (RGB, 0 to 1), lit from the camera and from above, on white."""
    together = joined(*(mesh for mesh, _ in meshes))
    colours = np.repeat(np.array([rgb for _, rgb in meshes], dtype=float), [len(m.faces) for m, _ in meshes], axis=0)
    distance, face, normal = _cast(together, camera_of_view(width, height), T_world_camera)
    hit = np.isfinite(distance)
    view, above = -T_world_camera[:3, 2], np.array([0.0, 0.0, 1.0])
    # A face is lit whichever way it is wound: towards the viewer.
    normal = normal * np.where(normal @ view < 0, -1.0, 1.0)[..., None]
    light = AMBIENT + 0.55 * (normal @ view).clip(0) + 0.2 * (normal @ above).clip(0)
    image = np.full((height, width, 3), BACKGROUND, dtype=np.uint8)
    image[hit] = (255 * (colours[face[hit]] * light[hit][:, None]).clip(0, 1)).astype(np.uint8)
    return image


def save_png(image: UInt8[np.ndarray, "height width 3"], path: str | Path) -> None:
    """Write an RGB picture (PNG specification: one IHDR, one IDAT of unfiltered rows, IEND)."""
    height, width, _ = image.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), image.reshape(height, width * 3)], axis=1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes())) + chunk(b"IEND", b"")
    Path(path).write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def _cast(mesh: TriangleMesh, camera: PinholeCamera, T_world_camera: Float[np.ndarray, "4 4"]):
    """Depth (infinite where nothing is hit), face index and unit face normal of each pixel."""
    rotation, position = T_world_camera[:3, :3], T_world_camera[:3, 3]
    rays = camera_rays(camera)
    # Pixels beyond the lens's range look nowhere.
    blind = np.isnan(rays[..., 0])
    distance, face, normal = first_hits(
        TriangleMesh(mesh.vertices - position, mesh.faces), np.nan_to_num(rays) @ rotation.T
    )
    return np.where(blind, np.inf, distance), face, normal
