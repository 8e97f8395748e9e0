"""Stress cases: meshes with faults of scanners, CAD exports and manual edits, and extreme inputs with valid meshes.

The extreme inputs have large or small friction and mass, unusual SDF values and grids, or objects unfit for the hand.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from graspd_bench.stress.run_stress_case import GRASP, Case
from graspd_core.mesh.shapes import make_shape
from graspd_core.optimize.plan_config import PlanConfig
from graspd_core.perception.load_scene import load_scene
from graspd_core.perception.scene import Scene
from graspd_core.types import TriangleMesh, joined

_SEED = 7
_FEW = ("TOO_FEW", "NO_CANDIDATES")

# Words that the message to the user must contain: what was repaired, or what the user can do.
_MESSAGES = {
    "debris": "40 ",
    "millions-of-faces": "simplified from ",
    "one-triangle": "not closed",
    "nan-vertices": "NaN",
    "millimetres": "from mm",
    "centimetres": "from cm",
    "crate-1200-mm": "fingertips of allegro_right open to ",
}

Maker = Callable[[], TriangleMesh]


def mesh_cases() -> tuple[Case, ...]:
    """Return all cases of faulty meshes. Each mesh is written to a file and loaded by `load_scene`."""
    return (*_whole(), *_broken())


def _whole() -> Iterator[Case]:
    """Yield cases of faulty meshes that still describe a solid. A verified grasp is expected."""
    whole = (
        ("open-box", "a box without its lid", lambda: _kept("box", lambda corners: corners[..., 2].mean(1) < 0.044)),
        ("open-cylinder", "a cylinder without its ends: a tube of no thickness",
         lambda: _kept("cylinder", lambda corners: np.ptp(corners[..., 2], axis=1) > 1e-6)),
        ("half-scanned-mug", "a mug with every fifth face missing",
         lambda: _kept("mug", lambda corners: _share(corners) >= 0.2)),
        ("doubled-faces", "every face twice, the second one inside out",
         lambda: joined(make_shape("l_block"), _flipped("l_block", 1.0))),
        ("inverted", "all faces wound inwards", lambda: _flipped("bottle", 1.0)),
        ("mixed-winding", "half of the faces wound inwards at random", lambda: _flipped("mug", 0.5)),
        ("soup", "a box of loose triangles that share no corner", lambda: _soup("box", 0.0)),
        ("jittered-soup", "loose triangles with gaps of half a millimetre", lambda: _soup("cylinder", 5e-4)),
        ("overlapping-bodies", "a cross of three boxes that run through each other",
         lambda: joined(*(box(np.roll((0.03, 0.03, 0.1), turn)) for turn in range(3)))),
        ("self-intersecting", "a bottle with noise that folds its surface through itself", _folded),
        ("inner-void", "a ball with a smaller ball inside, wound alike",
         lambda: joined(make_shape("sphere"), _scaled("sphere", 0.6))),
        ("slivers", "a box cut into triangles a thousand times longer than wide", _slivers),
        ("stray-vertices", "vertices far away that no face uses",
         lambda: _edited("capsule", lambda points: np.vstack([points, np.full((5, 3), 1e4)]))),
        ("debris", "a box with tiny pieces floating about it", _debris),
        ("millions-of-faces", "a ball of 1.3 million faces", lambda: _fine_mesh(make_shape("sphere"), 4)),
        ("far-from-origin", "a mug 40 m from its origin",
         lambda: _edited("mug", lambda points: points + 40.0 / np.sqrt(3.0))),
        ("thin-wall-cup", "a cup with walls of 0.9 mm", lambda: thin_cup(9e-4)),
        ("high-genus", "a plate with 24 holes", _sieve),
        ("long-rod", "a rod of 1.2 m", lambda: box((0.024, 0.024, 1.2))),
    )  # fmt: skip
    return (_case(name, about, make) for name, about, make in whole)


def _broken() -> Iterator[Case]:
    """Yield cases of meshes that describe no solid, or have an absurd size."""
    broken = (
        ("nan-vertices", "three vertices are NaN",
         lambda: _edited("box", lambda points: np.vstack([points[3:], np.full((3, 3), np.nan)])), ("MeshError",)),
        ("one-triangle", "a single triangle",
         lambda: TriangleMesh(np.eye(3) * 0.05, np.array([[0, 1, 2]])), (GRASP, *_FEW)),
        ("zero-faces", "vertices and no face", lambda: TriangleMesh(np.eye(3), np.zeros((0, 3), int)), ("MeshError",)),
        ("flat-sheet", "a sheet of paper: no thickness at all", _sheet, (GRASP, *_FEW)),
        ("millimetres", "a mug in millimetres", lambda: _scaled("mug", 1e3), ("MeshError",)),
        ("centimetres", "a mug in centimetres", lambda: _scaled("mug", 1e2), ("MeshError",)),
        ("tiny-5-mm", "a cube of 5 mm", lambda: box((0.005,) * 3), (GRASP, *_FEW)),
        ("crate-1200-mm", "a crate of 1.2 m", lambda: box((1.2,) * 3), _FEW),
        ("micrometre", "a cube of 1 µm", lambda: box((1e-6,) * 3), ("MeshError",)),
    )  # fmt: skip
    return (_case(name, about, make, expect, whole=False) for name, about, make, expect in broken)


def _case(name: str, about: str, make: Maker, expect: tuple[str, ...] = (GRASP,), *, whole: bool = True) -> Case:
    def scene(folder: Path) -> Scene:
        path = folder / f"{name}.obj"
        write_obj(make(), path)
        return load_scene(path)

    return Case(name, "mesh", about, scene, expect, whole, message=_MESSAGES.get(name, ""))


def write_obj(mesh: TriangleMesh, path: Path) -> None:
    """Write a mesh unchanged as an OBJ file, even with NaN. `save_mesh` would refuse or repair the mesh."""
    # One format string for all rows is fast. `np.savetxt` takes four seconds for a million rows.
    vertices = "v %.9g %.9g %.9g\n" * len(mesh.vertices) % tuple(mesh.vertices.ravel().tolist())
    faces = "f %d %d %d\n" * len(mesh.faces) % tuple((mesh.faces + 1).ravel().tolist())
    path.write_text(vertices + faces)


def box(size: Sequence[float] | np.ndarray, middle: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)) -> TriangleMesh:
    """Return a box with edge lengths `size` [m] centred at `middle` [m], with as many faces as the built-in box."""
    unit = make_shape("box").vertices
    return _edited("box", lambda points: points / np.abs(unit).max(0) / 2 * np.asarray(size) + np.asarray(middle))


def _edited(shape: str, change: Callable[[np.ndarray], np.ndarray]) -> TriangleMesh:
    mesh = make_shape(shape)
    return replace(mesh, vertices=change(mesh.vertices))


def _kept(shape: str, which: Callable[[np.ndarray], np.ndarray]) -> TriangleMesh:
    mesh = make_shape(shape)
    return replace(mesh, faces=mesh.faces[which(mesh.vertices[mesh.faces])])


def _scaled(shape: str, factor: float) -> TriangleMesh:
    return _edited(shape, lambda points: points * factor)


def _share(faces: np.ndarray) -> np.ndarray:
    return np.random.default_rng(_SEED).random(len(faces))


def _flipped(shape: str, share: float) -> TriangleMesh:
    mesh = make_shape(shape)
    flip = _share(mesh.faces) < share
    return replace(mesh, faces=np.where(flip[:, None], mesh.faces[:, ::-1], mesh.faces))


def _soup(shape: str, jitter: float) -> TriangleMesh:
    mesh = make_shape(shape)
    corners = mesh.vertices[mesh.faces]
    corners = corners + np.random.default_rng(_SEED).normal(0.0, jitter, (len(corners), 1, 3))
    return TriangleMesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def _folded() -> TriangleMesh:
    mesh = _fine_mesh(make_shape("bottle"), 1)
    noise = np.random.default_rng(_SEED).normal(0.0, 1.2e-3, mesh.vertices.shape)
    return replace(mesh, vertices=mesh.vertices + noise)


def _slivers() -> TriangleMesh:
    """Return a box in which each triangle is split into a fan of a hundred thin triangles."""
    mesh = make_shape("box")
    pieces = []
    for a, b, c in mesh.vertices[mesh.faces]:
        along = np.linspace(0.0, 1.0, 101)[:, None]
        edge = b + along * (c - b)
        pieces += [(a, p, q) for p, q in pairwise(edge)]
    corners = np.array(pieces)
    return TriangleMesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def _debris() -> TriangleMesh:
    rng = np.random.default_rng(_SEED)
    places = [rng.choice([-1, 1], 3) * rng.uniform(0.05, 0.09, 3) for _ in range(40)]
    return joined(make_shape("box"), *(box((0.0014,) * 3, place) for place in places))


def _fine_mesh(mesh: TriangleMesh, times: int) -> TriangleMesh:
    import trimesh

    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    for _ in range(times):
        body = body.subdivide()
    return TriangleMesh(np.array(body.vertices), np.array(body.faces))


def thin_cup(wall: float) -> TriangleMesh:
    """Return a cup, 80 mm high and 66 mm wide, open at the top. Wall and bottom are `wall` [m] thick."""
    import trimesh

    radius, half = 0.033, 0.04
    profile = [(0, -half), (radius, -half), (radius, half), (radius - wall, half), (radius - wall, wall - half)]
    turned = trimesh.creation.revolve(np.array([*profile, (0, wall - half)]), sections=64)
    return TriangleMesh(np.array(turned.vertices), np.array(turned.faces))


def _sieve() -> TriangleMesh:
    bars = [box((0.004, 0.084, 0.02), ((i - 3) * 0.02, 0.0, 0.0)) for i in range(7)]
    return joined(*bars, *(box((0.124, 0.004, 0.02), (0.0, (j - 2) * 0.02, 0.0)) for j in range(5)))


def _sheet() -> TriangleMesh:
    corners = np.array([[-0.05, -0.07, 0], [0.05, -0.07, 0], [0.05, 0.07, 0], [-0.05, 0.07, 0]])
    return TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


_MAYBE = (GRASP, *_FEW)


def extreme_cases() -> tuple[Case, ...]:
    """Return all cases of the families `physics`, `numbers` and `hand`."""
    return (*physics_cases(), *number_cases(), *hand_cases())


def physics_cases() -> Iterator[Case]:
    """Yield cases with small to large friction, cases with small to large mass, and cases with symmetric objects."""
    for mu in (0.1, 0.2, 0.3, 0.6, 1.0, 1.5):
        about, expect = f"a box at a friction of {mu:g}", (GRASP,) if mu >= 0.3 else _MAYBE
        yield Case(f"friction-{mu:g}", "physics", about, _shape("box", friction=mu), expect)
    for mass in (0.005, 0.02, 0.1, 0.5, 1.0, 2.0):
        about, expect = f"a cylinder of {1000 * mass:g} g", (GRASP,) if mass <= 1.0 else _MAYBE
        yield Case(f"mass-{1000 * mass:g}-g", "physics", about, _shape("cylinder", mass=mass), expect)
    for name in ("sphere", "cylinder", "torus"):
        yield Case(f"symmetric-{name}", "physics", f"a {name}: many minima of equal depth", _shape(name))


def number_cases() -> tuple[Case, ...]:
    """Return cases with bad SDF values, coarse and fine grids, a deadline of 0.2 s, and a request for many grasps."""
    family, box = "numbers", _shape("box")
    coarse, fine = ({"preset": PlanConfig(resolution=nodes)} for nodes in (8, 128))
    return (
        Case("nan-in-distance", family, "one node of the distance is NaN", _poisoned(0, float("nan"))),
        Case("inf-in-distance", family, "one node of the distance is infinite", _poisoned(0, float("inf"))),
        Case("nan-in-gradient", family, "one node of the gradient is NaN", _poisoned(1, float("nan"))),
        Case("zero-gradient", family, "the gradient is zero all over one slab", _flattened),
        Case("coarse-grid", family, "a grid of 8 nodes a side", box, _MAYBE, options=coarse),
        Case("fine-grid", family, "a grid of 128 nodes a side", box, options=fine),
        Case("no-time", family, "a deadline of 0.2 s", box, (GRASP, "DEADLINE"), whole=False, deadline=0.2),
        Case("one-grasp-of-many", family, "256 starts for one box", box, options={"count": 64}, deadline=60.0),
    )


def hand_cases() -> tuple[Case, ...]:
    """Return cases of objects that are too wide, too small or too heavy for the hand."""
    wide, small, heavy = _shape("sphere", scale=10.0), _shape("sphere", scale=0.1), _shape("box", mass=30.0)
    return (
        Case("too-wide", "hand", "a ball of 70 cm across", wide, _FEW, whole=False),
        Case("too-small", "hand", "a bead of 7 mm across", small, _MAYBE, whole=False),
        Case("too-heavy", "hand", "a box of 30 kg", heavy, _FEW, whole=False),
    )


def _shape(name: str, **settings: Any) -> Callable[[Path], Scene]:
    return lambda folder: load_scene(f"shape:{name}", **settings)


def _poisoned(channel: int, value: float) -> Callable[[Path], Scene]:
    """Return a function that loads a scene and sets one SDF channel (0: distance) to `value` at a surface node."""

    def scene(folder: Path) -> Scene:
        clean = load_scene("shape:cylinder")
        field = clean.sdf.field.clone()
        flat = int(field[0].abs().argmin())
        field[channel].view(-1)[flat] = value
        return replace(clean, sdf=replace(clean.sdf, field=field))

    return scene


def _flattened(folder: Path) -> Scene:
    clean = load_scene("shape:cylinder")
    field = clean.sdf.field.clone()
    field[1:, :, :, field.shape[3] // 2] = torch.zeros(())
    return replace(clean, sdf=replace(clean.sdf, field=field))
