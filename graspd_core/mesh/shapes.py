"""Built-in objects of graspable size, e.g. a sphere, a mug and a hammer.

The vertices of curved surfaces lie on the true surface, so meshes lose up to 1 % of the volume. The mug (cup, handle)
and the hammer (shaft and head) are overlapping closed bodies. The winding number inside these bodies is never zero.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from functools import lru_cache
from math import pi
from pathlib import Path

import numpy as np
from jaxtyping import Float

from graspd_core.errors import MeshError, choices
from graspd_core.mesh.mesh_files import MESH_ENDINGS, content_hash
from graspd_core.types import TriangleMesh, joined

SEGMENTS = 64  # straight segments that replace a circle
# Dimensions of the shapes [m].
SPHERE_RADIUS = 0.035
BOX_HALF = (0.03, 0.03, 0.045)
CYLINDER_RADIUS, CYLINDER_HALF = 0.033, 0.055
CAPSULE_RADIUS, CAPSULE_HALF = 0.028, 0.04
PLATE_HALF = (0.06, 0.04, 0.0075)
TORUS_MAJOR, TORUS_MINOR = 0.035, 0.013
MUG_RADIUS, MUG_HALF, MUG_WALL = 0.04, 0.0475, 0.004
HANDLE_ROOT, HANDLE_ARM, HANDLE_OUTER, HANDLE_INNER, HANDLE_HALF_WIDTH = 0.038, 0.044, 0.032, 0.024, 0.006
BOWL_RADIUS, BOWL_WALL = 0.065, 0.005
BOTTLE_PROFILE = ((0.032, -0.085), (0.032, 0.025), (0.014, 0.055), (0.014, 0.085))
L_LONG, L_SHORT, L_THICK, L_HALF_WIDTH = 0.09, 0.08, 0.035, 0.02
SHAFT_RADIUS, SHAFT_LOW, HEAD_LOW = 0.013, -0.09, 0.05
HEAD_HALF = (0.045, 0.015, 0.015)


def make_shape(name: str) -> TriangleMesh:
    """Build the built-in shape called `name` [m]. Raises MeshError for an unknown name."""
    if name not in SHAPES:
        raise MeshError(f"unknown shape {name!r}; {choices(name, sorted(SHAPES))}")
    return SHAPES[name]()


def _sphere() -> TriangleMesh:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=4, radius=SPHERE_RADIUS)
    return TriangleMesh(np.array(ball.vertices), np.array(ball.faces))


def _cylinder() -> TriangleMesh:
    r, h = CYLINDER_RADIUS, CYLINDER_HALF
    return _revolve([(0, -h), (r, -h), (r, h), (0, h)])


def _capsule() -> TriangleMesh:
    turn = np.linspace(-pi / 2, pi / 2, 34)
    lift = np.where(turn < 0, -CAPSULE_HALF, CAPSULE_HALF)
    return _revolve(np.column_stack([CAPSULE_RADIUS * np.cos(turn), CAPSULE_RADIUS * np.sin(turn) + lift]))


def _torus() -> TriangleMesh:
    turn = 2 * pi * np.arange(48) / 48
    ring = np.column_stack([TORUS_MAJOR + TORUS_MINOR * np.cos(turn), TORUS_MINOR * np.sin(turn)])
    return _revolve(ring, closed=True)


def _mug() -> TriangleMesh:
    r, h, wall = MUG_RADIUS, MUG_HALF, MUG_WALL
    cup = _revolve([(0, -h), (r, -h), (r, h), (r - wall, h), (r - wall, wall - h), (0, wall - h)])
    turn = np.linspace(-pi / 2, pi / 2, 25)
    bend = np.column_stack([np.cos(turn), np.sin(turn)])
    curves = []
    for radius in (HANDLE_OUTER, HANDLE_INNER):
        arc = radius * bend + [HANDLE_ARM, 0]
        curves.append(np.vstack([[HANDLE_ROOT, -radius], arc, [HANDLE_ROOT, radius]]))
    return joined(cup, _ribbon(curves[0], curves[1], HANDLE_HALF_WIDTH))


def _bowl() -> TriangleMesh:
    turn = np.linspace(-pi / 2, 0, 20)
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    inner = (BOWL_RADIUS - BOWL_WALL) * circle[::-1]
    profile = np.vstack([BOWL_RADIUS * circle, inner])
    return _revolve(profile + np.array([0, BOWL_RADIUS / 2]))


def _l_block() -> TriangleMesh:
    a, b, t = L_LONG, L_SHORT, L_THICK
    outer = np.array([(0, a), (0, 0), (b, 0)]) - [b / 2, a / 2]
    inner = np.array([(t, a), (t, t), (b, t)]) - [b / 2, a / 2]
    return _subdivide(_ribbon(outer, inner, L_HALF_WIDTH), 3)


def _hammer() -> TriangleMesh:
    inside_head = HEAD_LOW + HEAD_HALF[2]
    r = SHAFT_RADIUS
    shaft = _revolve([(0, SHAFT_LOW), (r, SHAFT_LOW), (r, inside_head), (0, inside_head)])
    return joined(shaft, _box(HEAD_HALF, (0.0, 0.0, inside_head)))


def _box(half: tuple[float, float, float], centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> TriangleMesh:
    x, y, z = half
    ring = _ribbon(np.array([(x, -z), (x, z)]), np.array([(-x, -z), (-x, z)]), y)
    fine = _subdivide(ring, 3)
    return TriangleMesh(fine.vertices + np.array(centre), fine.faces)


def _revolve(profile, closed: bool = False) -> TriangleMesh:
    """Revolve an (r, z) profile about z: a rising line with both ends on the axis, or a `closed` anticlockwise loop."""
    profile = np.asarray(profile, dtype=float)
    if not closed:
        profile[[0, -1], 0] = 0.0
    turn = 2 * pi * np.arange(SEGMENTS) / SEGMENTS
    r, z = profile[:, :1], profile[:, 1:]
    rings = np.stack([r * np.cos(turn), r * np.sin(turn), np.broadcast_to(z, (len(profile), SEGMENTS))], -1)
    return _stitch(rings, wrap_rows=closed)


def _ribbon(outer: Float[np.ndarray, "n 2"], inner: Float[np.ndarray, "n 2"], half_width: float) -> TriangleMesh:
    corners = [(outer, -half_width), (outer, half_width), (inner, half_width), (inner, -half_width)]
    rings = np.stack([np.column_stack([c[:, 0], np.full(len(c), y), c[:, 1]]) for c, y in corners], 1)
    # A ring that is shrunk to a point closes each end.
    ends = [np.broadcast_to(ring.mean(0), ring.shape)[None] for ring in (rings[0], rings[-1])]
    return _stitch(np.concatenate([ends[0], rings, ends[1]]), wrap_rows=False)


def _stitch(rings: Float[np.ndarray, "rows columns 3"], wrap_rows: bool) -> TriangleMesh:
    """Join each closed ring to the next by triangles. A ring may be a point. `wrap_rows` joins last to first ring."""
    rows, columns = rings.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    low = index if wrap_rows else index[:-1]
    high = np.roll(index, -1, 0) if wrap_rows else index[1:]
    a, b, c, d = low, np.roll(low, -1, 1), np.roll(high, -1, 1), high
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    vertices, inverse = np.unique(np.round(rings.reshape(-1, 3), 9), axis=0, return_inverse=True)
    faces = inverse.reshape(-1)[faces]
    solid = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return TriangleMesh(vertices, faces[solid])


def _subdivide(mesh: TriangleMesh, times: int) -> TriangleMesh:
    import trimesh

    vertices, faces = mesh.vertices, mesh.faces
    for _ in range(times):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)[:2]
    return TriangleMesh(np.asarray(vertices), np.asarray(faces))


SHAPES: dict[str, Callable[[], TriangleMesh]] = {
    "sphere": _sphere,
    "box": lambda: _box(BOX_HALF),
    "cylinder": _cylinder,
    "capsule": _capsule,
    "plate": lambda: _box(PLATE_HALF),
    "torus": _torus,
    "mug": _mug,
    "bowl": _bowl,
    "bottle": lambda: _revolve([(0, BOTTLE_PROFILE[0][1]), *BOTTLE_PROFILE, (0, BOTTLE_PROFILE[-1][1])]),
    "l_block": _l_block,
    "hammer": _hammer,
}


def object_sources(sources: Sequence[str]) -> tuple[str, ...]:
    """Return the sources, with each folder replaced by its mesh files. Raises MeshError if a source does not exist."""
    found: list[str] = []
    for source in sources:
        path = Path(source)
        if not source.startswith("shape:") and path.is_dir():
            files = sorted(p for p in path.iterdir() if p.suffix.lower().lstrip(".") in MESH_ENDINGS)
            if not files:
                raise MeshError(f"{source}: no mesh in this folder; valid endings: {', '.join(MESH_ENDINGS)}")
            found += map(str, files)
        else:
            object_hash(source)
            found.append(source)
    return tuple(found)


def object_hash(source: str) -> str:
    """Return the SHA-256 of the content of a shape or a mesh file. Raises MeshError if shape or file does not exist."""
    path = Path(source)
    if not source.startswith("shape:") and not path.is_file():
        raise MeshError(f"{path}: no such mesh file; valid: a file, or shape:NAME with {', '.join(sorted(SHAPES))}")
    if not source.startswith("shape:") and path.suffix.lower().lstrip(".") not in MESH_ENDINGS:
        raise MeshError(f"{path}: unknown mesh ending {path.suffix!r}; valid endings: {', '.join(MESH_ENDINGS)}")
    return source_hash(source)


def source_hash(source: str) -> str:
    """Return the SHA-256 of a file's content, or of a shape's mesh. Raises MeshError: the file cannot be read."""
    try:
        return _content_hash(source, file_state(source))
    except OSError as error:
        raise MeshError(f"{source}: {error.strerror or error}") from None


def file_state(path: str) -> tuple[int, ...]:
    """Return numbers that differ if a file was changed or replaced. Return no numbers if there is no such file."""
    try:
        found = os.stat(path)
    except OSError:
        return ()
    # A program can set back the time of writing, but not the time of the last change.
    return found.st_ctime_ns, found.st_ino, found.st_size


@lru_cache(maxsize=4096)
def _content_hash(source: str, state: tuple[int, ...]) -> str:
    del state
    if source.startswith("shape:"):
        return content_hash(make_shape(source.removeprefix("shape:")))
    with open(source, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
