"""Meshes broken on purpose: what scanners, CAD exports and hands at a keyboard make of a mug or a box."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from graspd_core.bench.stress.stress_case import GRASP, Case
from graspd_core.mesh.mesh_files import check_mesh
from graspd_core.mesh.shapes import make_shape
from graspd_core.scene.load_scene import load_scene
from graspd_core.scene.scene import Scene
from graspd_core.types import TriangleMesh

_SEED = 7
_FEW = ("TOO_FEW", "NO_CANDIDATES")

# What must be said of some of them: what was done, or what to do.
_TOLD = {
    "debris": "40 ",
    "millions-of-faces": "simplified from ",
    "one-triangle": "not closed",
    "nan-vertices": "NaN",
    "millimetres": "--units mm",
    "centimetres": "--units cm",
    "crate-1200-mm": "fingertips of allegro_right open to ",
}

Maker = Callable[[], TriangleMesh]


def mesh_cases() -> tuple[Case, ...]:
    """Every broken mesh, through a file and `load_scene`."""
    whole = (
        ("open-box", "a box without its lid", lambda: _without_faces(make_shape("box"), above=0.044)),
        ("open-cylinder", "a cylinder without its ends: a tube of no thickness", _tube),
        ("half-scanned-mug", "a mug with every fifth face missing", lambda: _thinned(make_shape("mug"), 0.2)),
        ("doubled-faces", "every face twice, the second one inside out", _doubled),
        ("inverted", "all faces wound inwards", lambda: _flipped(make_shape("bottle"), 1.0)),
        ("mixed-winding", "half of the faces wound inwards at random", lambda: _flipped(make_shape("mug"), 0.5)),
        ("soup", "a box of loose triangles that share no corner", lambda: _soup(make_shape("box"), 0.0)),
        (
            "jittered-soup",
            "loose triangles with gaps of half a millimetre",
            lambda: _soup(make_shape("cylinder"), 5e-4),
        ),
        ("overlapping-bodies", "a cross of three boxes that run through each other", _cross),
        ("self-intersecting", "a bottle with noise that folds its surface through itself", _folded),
        ("inner-void", "a ball with a smaller ball inside, wound alike", _nested),
        ("slivers", "a box cut into triangles a thousand times longer than wide", _slivers),
        ("stray-vertices", "vertices far away that no face uses", _stray),
        ("debris", "a box with tiny pieces floating about it", _debris),
        ("millions-of-faces", "a ball of 1.3 million faces", lambda: _fine("sphere", 4)),
        ("far-from-origin", "a mug 40 m from its origin", lambda: _shifted(make_shape("mug"), 40.0)),
        ("thin-wall-cup", "a cup with walls of 0.9 mm", lambda: thin_cup(9e-4)),
        ("high-genus", "a plate with 24 holes", _sieve),
        ("long-rod", "a rod of 1.2 m", lambda: _box((0.012, 0.012, 0.6))),
    )
    broken = (
        ("nan-vertices", "three vertices are NaN", _with_nan, ("MeshError",)),
        ("one-triangle", "a single triangle", _triangle, (GRASP, *_FEW)),
        ("zero-faces", "vertices and no face", lambda: TriangleMesh(np.eye(3), np.zeros((0, 3), int)), ("MeshError",)),
        ("flat-sheet", "a sheet of paper: no thickness at all", _sheet, (GRASP, *_FEW)),
        ("all-degenerate", "faces that are lines", _lines, ("MeshError",)),
        ("millimetres", "a mug in millimetres", lambda: _scaled(make_shape("mug"), 1e3), ("MeshError",)),
        ("centimetres", "a mug in centimetres", lambda: _scaled(make_shape("mug"), 1e2), ("MeshError",)),
        ("tiny-5-mm", "a cube of 5 mm", lambda: _box((0.0025,) * 3), (GRASP, *_FEW)),
        ("crate-1200-mm", "a crate of 1.2 m", lambda: _box((0.6,) * 3), _FEW),
        ("micrometre", "a cube of 1 µm", lambda: _box((5e-7,) * 3), ("MeshError",)),
    )
    return (
        *(_case(name, about, make) for name, about, make in whole),
        *(_case(name, about, make, expect, whole=False) for name, about, make, expect in broken),
        _text("no-mesh-at-all", "a file of prose with the ending obj", "shopping: milk, bread\n"),
        _text("bad-indices", "faces that name vertices which do not exist", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
        _text("cut-off", "a file that ends in the middle of a line", "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2"),
    )


def _case(name: str, about: str, make: Maker, expect: tuple[str, ...] = (GRASP,), *, whole: bool = True) -> Case:
    def scene(folder: Path) -> Scene:
        path = folder / f"{name}.obj"
        write_obj(make(), path)
        return load_scene(path)

    return Case(name, "mesh", about, scene, expect, whole, told=_TOLD.get(name, ""))


def _text(name: str, about: str, text: str) -> Case:
    def scene(folder: Path) -> Scene:
        path = folder / f"{name}.obj"
        path.write_text(text)
        return load_scene(path)

    return Case(name, "mesh", about, scene, ("MeshError",), whole=False)


def write_obj(mesh: TriangleMesh, path: Path) -> None:
    """As it is, NaN and all; `save_mesh` would refuse or repair some of these."""
    # One format for all rows: `np.savetxt` takes four seconds for a million.
    vertices = "v %.9g %.9g %.9g\n" * len(mesh.vertices) % tuple(mesh.vertices.ravel().tolist())
    faces = "f %d %d %d\n" * len(mesh.faces) % tuple((mesh.faces + 1).ravel().tolist())
    path.write_text(vertices + faces)


def _box(half: tuple[float, ...]) -> TriangleMesh:
    box = make_shape("box")
    return TriangleMesh(box.vertices / np.abs(box.vertices).max(0) * half, box.faces)


def _centres(mesh: TriangleMesh) -> np.ndarray:
    return mesh.vertices[mesh.faces].mean(1)


def _scaled(mesh: TriangleMesh, factor: float) -> TriangleMesh:
    return replace(mesh, vertices=mesh.vertices * factor)


def _shifted(mesh: TriangleMesh, metres: float) -> TriangleMesh:
    return replace(mesh, vertices=mesh.vertices + metres / np.sqrt(3.0))


def _joined(*meshes: TriangleMesh) -> TriangleMesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)]
    return TriangleMesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def _without_faces(mesh: TriangleMesh, above: float) -> TriangleMesh:
    return replace(mesh, faces=mesh.faces[_centres(mesh)[:, 2] < above])


def _tube() -> TriangleMesh:
    mesh = make_shape("cylinder")
    corners = mesh.vertices[mesh.faces]
    return replace(mesh, faces=mesh.faces[np.ptp(corners[..., 2], axis=1) > 1e-6])


def _thinned(mesh: TriangleMesh, share: float) -> TriangleMesh:
    kept = np.random.default_rng(_SEED).random(len(mesh.faces)) >= share
    return replace(mesh, faces=mesh.faces[kept])


def _doubled() -> TriangleMesh:
    mesh = make_shape("l_block")
    copy = TriangleMesh(mesh.vertices, mesh.faces[:, ::-1])
    return _joined(mesh, copy)


def _flipped(mesh: TriangleMesh, share: float) -> TriangleMesh:
    flip = np.random.default_rng(_SEED).random(len(mesh.faces)) < share
    return replace(mesh, faces=np.where(flip[:, None], mesh.faces[:, ::-1], mesh.faces))


def _soup(mesh: TriangleMesh, jitter: float) -> TriangleMesh:
    corners = mesh.vertices[mesh.faces]
    corners = corners + np.random.default_rng(_SEED).normal(0.0, jitter, (len(corners), 1, 3))
    return TriangleMesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def _cross() -> TriangleMesh:
    half = np.array([0.015, 0.015, 0.05])
    return _joined(*(_box(tuple(np.roll(half, turn))) for turn in range(3)))


def _folded() -> TriangleMesh:
    mesh = _fine_mesh(make_shape("bottle"), 1)
    noise = np.random.default_rng(_SEED).normal(0.0, 1.2e-3, mesh.vertices.shape)
    return replace(mesh, vertices=mesh.vertices + noise)


def _nested() -> TriangleMesh:
    ball = make_shape("sphere")
    return _joined(ball, _scaled(ball, 0.6))


def _slivers() -> TriangleMesh:
    """Each face of a box becomes a fan of a hundred triangles along its longest side."""
    mesh = make_shape("box")
    pieces = []
    for a, b, c in mesh.vertices[mesh.faces]:
        along = np.linspace(0.0, 1.0, 101)[:, None]
        edge = b + along * (c - b)
        pieces += [(a, p, q) for p, q in pairwise(edge)]
    corners = np.array(pieces)
    return TriangleMesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def _stray() -> TriangleMesh:
    mesh = make_shape("capsule")
    return replace(mesh, vertices=np.concatenate([mesh.vertices, np.full((5, 3), 1e4)]))


def _debris() -> TriangleMesh:
    rng = np.random.default_rng(_SEED)
    tiny = [_shifted_by(_box((0.0007,) * 3), rng.choice([-1, 1], 3) * rng.uniform(0.05, 0.09, 3)) for _ in range(40)]
    return _joined(make_shape("box"), *tiny)


def _shifted_by(mesh: TriangleMesh, offset: np.ndarray) -> TriangleMesh:
    return replace(mesh, vertices=mesh.vertices + offset)


def _fine(shape: str, times: int) -> TriangleMesh:
    return _fine_mesh(make_shape(shape), times)


def _fine_mesh(mesh: TriangleMesh, times: int) -> TriangleMesh:
    import trimesh

    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    for _ in range(times):
        body = body.subdivide()
    return TriangleMesh(np.array(body.vertices), np.array(body.faces))


def thin_cup(wall: float) -> TriangleMesh:
    """A cup 80 mm high and 66 mm wide, open at the top, with a wall and a bottom of `wall` [m]."""
    radius, half = 0.033, 0.04
    turn = np.linspace(0.0, 2 * np.pi, 65)[:-1]
    profile = [(0, -half), (radius, -half), (radius, half), (radius - wall, half), (radius - wall, wall - half)]
    profile.append((0, wall - half))
    rings = np.array([[(r * np.cos(a), r * np.sin(a), z) for a in turn] for r, z in profile])
    count, around = len(profile), len(turn)
    faces = []
    for ring in range(count - 1):
        for i in range(around):
            j = (i + 1) % around
            a, b, c, d = (ring * around + i, ring * around + j, (ring + 1) * around + j, (ring + 1) * around + i)
            faces += [(a, b, c), (a, c, d)]
    # The rings about the axis are points.
    return check_mesh(TriangleMesh(rings.reshape(-1, 3), np.array(faces)), "cup")[0]


def _sieve() -> TriangleMesh:
    """A plate of 6 x 4 cells, each a square frame about a square hole, joined along their sides."""
    cell, rim, half = 0.02, 0.004, 0.01
    frames = []
    for i in range(6):
        for j in range(4):
            centre = np.array([(i - 2.5) * cell, (j - 1.5) * cell, 0.0])
            reach = cell / 2 - rim / 2
            for x, y, size in (
                (reach, 0, (rim / 2, cell / 2, half)),
                (-reach, 0, (rim / 2, cell / 2, half)),
                (0, reach, (cell / 2 - rim, rim / 2, half)),
                (0, -reach, (cell / 2 - rim, rim / 2, half)),
            ):
                frames.append(_shifted_by(_box(size), centre + np.array([x, y, 0])))
    return _joined(*frames)


def _with_nan() -> TriangleMesh:
    mesh = make_shape("box")
    vertices = mesh.vertices.copy()
    vertices[:3] = np.nan
    return replace(mesh, vertices=vertices)


def _sheet() -> TriangleMesh:
    corners = np.array([[-0.05, -0.07, 0], [0.05, -0.07, 0], [0.05, 0.07, 0], [-0.05, 0.07, 0]])
    return TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def _triangle() -> TriangleMesh:
    """A sheet too: where two triangles may be grasped, one may."""
    return TriangleMesh(np.eye(3) * 0.05, np.array([[0, 1, 2]]))


def _lines() -> TriangleMesh:
    along = np.linspace(0.0, 0.1, 12)
    return TriangleMesh(np.outer(along, [1.0, 1.0, 0.0]), np.arange(12).reshape(-1, 3))
