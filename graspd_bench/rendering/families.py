"""Random household objects of irregular shape. The reconstruction's rules for hidden sides do not fit them.

The mesh of an object is the zero level set of a signed distance grid, so it is one watertight body. The body consists
of round cones, boxes and bodies of revolution, with smooth blends. The density is drawn from a typical range for such
objects, full or hollow. A family is a kind of object. The same family and seed give the same object.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from graspd_core.errors import MeshError, choices
from graspd_core.mesh.mesh_files import mass_properties, simplify
from graspd_core.types import TriangleMesh

Points = Float[np.ndarray, "n 3"]
Distance = Float[np.ndarray, "n"]
Field = Callable[[Points], Distance]
# Prefix of random objects in a request: family:pear:3 is the pear of seed 3.
PREFIX = "family:"
# Number of grid cells along the longest side, and number of mesh faces.
_CELLS, _FACES = 96, 8000


@dataclass(frozen=True)
class RandomObject:
    """A random object.

    Attributes:
        mesh: watertight mesh [m]. z is up in its usual orientation.
        mass: mass [kg].
    """

    mesh: TriangleMesh
    mass: float


@lru_cache(maxsize=64)
def draw_object(family: str, seed: int) -> RandomObject:
    """Return the random object of a family and seed. Raises MeshError: unknown family."""
    families = FAMILIES | OTHERS
    if family not in families:
        raise MeshError(f"unknown family {family!r}; {choices(family, families)}")
    rng = np.random.default_rng([sum(map(ord, family)), seed])
    field, size, (light, heavy) = families[family](rng)
    mesh = simplify(_surface(field, np.asarray(size, dtype=float)), _FACES)
    return RandomObject(mesh, float(rng.uniform(light, heavy) * mass_properties(mesh)[0]))


def _surface(field: Field, half: Float[np.ndarray, "3"]) -> TriangleMesh:
    """Return the zero level set of a field as a mesh, within a box around the origin. `half`: half edge lengths [m]."""
    import igl

    half = half + 0.004
    cell = 2 * half.max() / _CELLS
    axes = [np.arange(-h, h + cell, cell) for h in half]
    # `igl.marching_cubes` expects x to vary fastest.
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], 1)
    marching: Any = igl.marching_cubes
    vertices, faces = marching(field(points), points, *(len(axis) for axis in axes), 0.0)[:2]
    # igl returns an integer type other than numpy's int64.
    faces = faces.astype(np.int32).astype(np.int64)
    a, b, c = vertices[faces].transpose(1, 0, 2)
    # A positive signed volume means that the faces point outwards.
    outwards = np.einsum("ij,ij->", a, np.cross(b, c)) > 0
    return TriangleMesh(np.array(vertices), faces if outwards else faces[:, ::-1])


def _cone(*stations: tuple[float, float, float, float]) -> Field:
    """Return the distance field of round cones along a polyline of (x, y, z, radius) [m]."""
    nodes = np.array(stations)

    def field(points: Points) -> Distance:
        nearest = np.full(len(points), np.inf)
        for a, b in pairwise(nodes):
            along = b[:3] - a[:3]
            share = ((points - a[:3]) @ along / max(along @ along, 1e-12)).clip(0, 1)
            gap = np.linalg.norm(points - a[:3] - share[:, None] * along, axis=1)
            nearest = np.minimum(nearest, gap - a[3] - share * (b[3] - a[3]))
        return nearest

    return field


def _box(centre: tuple[float, float, float], half: tuple[float, float, float], rounding: float = 0.004) -> Field:
    def field(points: Points) -> Distance:
        beyond = np.abs(points - centre) - np.array(half) + rounding
        return np.linalg.norm(beyond.clip(0), axis=1) + beyond.max(1).clip(max=0) - rounding

    return field


def _revolved(profile: list[tuple[float, float]], flat: float = 1.0) -> Field:
    """Return the distance field of a body revolved about z. `profile` has (height, radius) [m], `flat` multiplies y."""
    heights, radii = np.array(profile).T

    def field(points: Points) -> Distance:
        radius = np.interp(points[:, 2], heights, radii)
        side = (np.hypot(points[:, 0], points[:, 1] / flat) - radius) * min(flat, 1.0)
        ends = np.maximum(heights[0] - points[:, 2], points[:, 2] - heights[-1])
        both = np.stack([side, ends], 1) + 0.004
        return np.linalg.norm(both.clip(0), axis=1) + both.max(1).clip(max=0) - 0.004

    return field


def _blend(*fields: Field, width: float = 0.004) -> Field:
    """Return the distance field of a smooth union of bodies. Fillets between them are about `width` [m] wide."""

    def field(points: Points) -> Distance:
        joined = fields[0](points)
        for other in fields[1:]:
            more = other(points)
            share = (0.5 + 0.5 * (joined - more) / width).clip(0, 1)
            joined = joined + share * (more - joined) - width * share * (1 - share)
        return joined

    return field


def _less(field: Field, hole: Field) -> Field:
    return lambda points: np.maximum(field(points), -hole(points))


# Signed distance field of an object, half edges of its bounding box [m], and range of its density [kg/m³].
Drawn = tuple[Field, tuple[float, float, float], tuple[float, float]]


def _pear(rng: np.random.Generator) -> Drawn:
    low, top, height = rng.uniform(0.028, 0.042), rng.uniform(0.012, 0.02), rng.uniform(0.03, 0.05)
    lean = rng.uniform(-0.008, 0.008)
    body = _cone((0, 0, -0.02, low), (lean, 0, height, top))
    return body, (low + 0.01, low + 0.002, 0.02 + max(low, height + top)), (850, 1050)


def _banana(rng: np.random.Generator) -> Drawn:
    bend, thick, turn = rng.uniform(0.06, 0.11), rng.uniform(0.014, 0.021), rng.uniform(1.3, 2.1)
    angles = np.linspace(-turn / 2, turn / 2, 13)
    thin = thick * (1 - 0.75 * np.abs(np.linspace(-1, 1, 13)) ** 4)
    middle = bend * (1 + np.cos(turn / 2)) / 2
    body = _cone(*((bend * np.sin(a), bend * np.cos(a) - middle, 0.0, r) for a, r in zip(angles, thin, strict=True)))
    return body, (bend * np.sin(turn / 2) + thick, bend * (1 - np.cos(turn / 2)) / 2 + thick, thick), (350, 1000)


def _pitcher(rng: np.random.Generator) -> Drawn:
    half, foot, rim = rng.uniform(0.07, 0.11), rng.uniform(0.04, 0.05), rng.uniform(0.048, 0.06)
    body = _revolved([(-half, foot), (half, rim)])
    inside = _revolved([(-half + 0.005, foot - 0.004), (half + 0.02, rim - 0.004)])
    out = rng.uniform(0.03, 0.045)
    handle = _cone(
        (-foot, 0, -0.5 * half, 0.008), (-rim - out, 0, -0.3 * half, 0.009), (-rim - out, 0, 0.5 * half, 0.009),
        (-rim + 0.002, 0, 0.7 * half, 0.008),
    )  # fmt: skip
    whole = _blend(body, handle)
    hollow = rng.random() < 0.5
    field = _less(whole, inside) if hollow else whole
    return field, (rim + out + 0.01, rim, half), (900, 1500) if hollow else (150, 1000)


def _spray(rng: np.random.Generator) -> Drawn:
    half, wide, flat = rng.uniform(0.06, 0.09), rng.uniform(0.032, 0.045), rng.uniform(0.6, 1.0)
    neck, reach = rng.uniform(0.03, 0.05), rng.uniform(0.035, 0.055)
    bottom = -half - neck / 2
    profile = [(bottom, wide), (bottom + 1.3 * half, wide), (bottom + 1.9 * half, 0.016), (half, 0.014)]
    head = _box((0.012, 0, half + 0.01), (reach, 0.011, 0.014))
    trigger = _cone((0.02, 0, half, 0.006), (0.03, 0, half - 0.035, 0.005))
    return _blend(_revolved(profile, flat), head, trigger), (0.07, wide, half + neck / 2 + 0.005), (400, 1000)


def _pump(rng: np.random.Generator) -> Drawn:
    half, wide, flat = rng.uniform(0.045, 0.075), rng.uniform(0.028, 0.042), rng.uniform(0.6, 1.0)
    body = _revolved([(-half - 0.02, wide), (half - 0.035, wide), (half - 0.02, 0.015), (half - 0.005, 0.014)], flat)
    stem = _cone((0, 0, half - 0.01, 0.005), (0, 0, half + 0.015, 0.005))
    spout = _cone((0, 0, half + 0.018, 0.011), (rng.uniform(0.03, 0.05), 0, half + 0.014, 0.005))
    return _blend(body, stem, spout), (max(wide, 0.058), wide, half + 0.035), (700, 1050)


def _detergent(rng: np.random.Generator) -> Drawn:
    half, wide, flat = rng.uniform(0.08, 0.11), rng.uniform(0.045, 0.06), rng.uniform(0.5, 0.7)
    bottom = -half - 0.012
    profile = [(bottom, wide), (0.2 * half, wide), (0.75 * half, 0.6 * wide), (half - 0.01, 0.02), (half + 0.012, 0.02)]
    x, z = rng.uniform(0.5, 0.6) * wide, 0.3 * half
    hole = _cone((x, -0.1, z, 0.014), (x, 0.1, z, 0.014))
    body = _revolved(profile, flat)
    return (_less(body, hole) if rng.random() < 0.5 else body), (wide, flat * wide, half + 0.014), (600, 1060)


def _tool(rng: np.random.Generator) -> Drawn:
    grip, shaft, thick = rng.uniform(0.04, 0.06), rng.uniform(0.07, 0.14), rng.uniform(0.011, 0.018)
    middle = 0.5 * (shaft - grip)
    handle = _cone((-grip - middle, 0, 0, thick), (grip - middle, 0, 0, 0.8 * thick))
    rod = _cone((grip - middle, 0, 0, 0.005), (grip + shaft - middle, 0, 0, 0.0045))
    parts = [handle, rod]
    if rng.random() < 0.5:
        parts.append(_box((grip + shaft - middle, 0, 0), (0.012, rng.uniform(0.012, 0.03), 0.008)))
    return _blend(*parts), (grip + 0.5 * (grip + shaft) + 0.02, 0.035, thick), (1200, 3500)


def _drill(rng: np.random.Generator) -> Drawn:
    long, thick, grip = rng.uniform(0.06, 0.085), rng.uniform(0.024, 0.032), rng.uniform(0.08, 0.11)
    top = 0.5 * grip
    body = _cone((-long, 0, top, thick), (0.3 * long, 0, top, thick), (long, 0, top, 0.016))
    handle = _cone((-0.4 * long, 0, top, 0.019), (-0.55 * long, 0, top - grip, 0.018))
    foot = _box((-0.45 * long, 0, top - grip - 0.012), (rng.uniform(0.03, 0.045), 0.028, 0.014))
    return _blend(body, handle, foot), (long + thick, thick + 0.005, 0.5 * grip + 0.036), (1000, 1700)


def _plane(rng: np.random.Generator) -> Drawn:
    long, thick, span = rng.uniform(0.06, 0.1), rng.uniform(0.016, 0.025), rng.uniform(0.05, 0.09)
    hull = _cone((-long, 0, 0, 0.5 * thick), (0.2 * long, 0, 0, thick), (long, 0, 0, 0.7 * thick))
    wings = _box((rng.uniform(-0.02, 0.02), 0, 0), (rng.uniform(0.016, 0.026), span, 0.006), 0.003)
    tail = _box((-0.9 * long, 0, 0), (0.012, 0.4 * span, 0.005), 0.003)
    fin = _box((-0.9 * long, 0, 0.5 * thick + 0.012), (0.012, 0.004, 0.02), 0.003)
    return _blend(hull, wings, tail, fin), (long + thick, span, thick + 0.03), (300, 800)


def _animal(rng: np.random.Generator) -> Drawn:
    long, thick, leg = rng.uniform(0.03, 0.05), rng.uniform(0.018, 0.028), rng.uniform(0.03, 0.05)
    body = _cone((-long, 0, 0, thick), (long, 0, 0, 0.9 * thick))
    reach = 0.7 * thick
    legs = [_cone((x, y, 0, 0.009), (x, y, -leg, 0.0085)) for x in (-0.8 * long, 0.8 * long) for y in (-reach, reach)]
    neck = _cone((long, 0, 0.3 * thick, 0.012), (1.4 * long, 0, thick + rng.uniform(0.0, 0.03), 0.014))
    return _blend(body, neck, *legs), (1.4 * long + thick, thick + 0.003, max(leg + 0.01, thick + 0.045)), (250, 1000)


def _pan(rng: np.random.Generator) -> Drawn:
    radius, deep, long = rng.uniform(0.06, 0.09), rng.uniform(0.025, 0.04), rng.uniform(0.1, 0.15)
    shift = 0.5 * long
    dish = _less(
        _revolved([(-deep / 2, 0.85 * radius), (deep / 2, radius)]),
        _revolved([(-deep / 2 + 0.004, 0.85 * radius - 0.004), (deep / 2 + 0.01, radius - 0.004)]),
    )
    handle = _cone((radius - 0.002, 0, 0.3 * deep, 0.008), (radius + long, 0, 0.3 * deep + 0.015, 0.01))
    whole = _blend(dish, handle, width=0.002)
    moved = lambda points: whole(points + np.array([shift, 0, 0]))  # noqa: E731
    return moved, (radius + shift + 0.012, radius, deep + 0.02), (2500, 6000)


def _sponge(rng: np.random.Generator) -> Drawn:
    half = (rng.uniform(0.04, 0.065), rng.uniform(0.025, 0.04), rng.uniform(0.012, 0.025))
    block = _box((0, 0, 0), half, rng.uniform(0.004, 0.01))
    bite = _cone((0, half[1] + 0.012, -0.1, 0.02), (0, half[1] + 0.012, 0.1, 0.02))
    return (_less(block, bite) if rng.random() < 0.5 else block), half, (25, 250)


def _jar(rng: np.random.Generator) -> Drawn:
    half, wide = rng.uniform(0.035, 0.065), rng.uniform(0.026, 0.042)
    lid, rim = rng.uniform(0.012, 0.02), rng.uniform(0.75, 1.08) * wide
    below = half - lid
    profile = [(-half, wide), (below - 0.008, wide), (below, 0.95 * rim), (below + 0.001, rim), (half, rim)]
    return _revolved(profile), (max(wide, rim), max(wide, rim), half), (600, 1400)


def _compound(rng: np.random.Generator) -> Drawn:
    fields: list[Field] = []
    centre, reach = np.zeros(3), np.zeros(3)
    for _ in range(rng.integers(2, 5)):
        size = rng.uniform(0.014, 0.045, 3) * (0.8 if fields else 1.0)
        kind, long = rng.integers(3), rng.uniform(0.02, 0.07)
        if kind == 0:
            solid, radius = _box((0, 0, 0), tuple(size), 0.005), np.linalg.norm(size)
        elif kind == 1:
            ends = 0.7 * size[:2]
            solid, radius = _cone((0, 0, -long, ends[0]), (0, 0, long, ends[1])), long + ends.max()
        else:
            profile = [
                (-long, 0.5 * size[0]),
                (-0.4 * long, 0.9 * size[0]),
                (0.2 * long, size[0]),
                (long, 0.6 * size[0]),
            ]
            solid, radius = _revolved(profile, rng.uniform(0.5, 1.0)), np.hypot(long, size[0])
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0] if rng.random() < 0.5 else np.eye(3)
        fields.append(lambda points, f=solid, c=centre, r=turn: f((points - c) @ r))
        reach = np.maximum(reach, np.abs(centre) + radius)
        step = rng.normal(size=3)
        centre = np.clip(centre + rng.uniform(0.5, 0.9) * radius * step / np.linalg.norm(step), -0.07, 0.07)
    return _blend(*fields, width=rng.uniform(0.002, 0.01)), (reach[0], reach[1], reach[2]), (150, 1800)


FAMILIES: dict[str, Callable[[np.random.Generator], Drawn]] = {
    "pear": _pear, "banana": _banana, "pitcher": _pitcher, "spray": _spray, "pump": _pump, "detergent": _detergent,
    "tool": _tool, "drill": _drill, "plane": _plane, "animal": _animal, "pan": _pan, "sponge": _sponge, "jar": _jar,
}  # fmt: skip
"""Functions that draw an object, by family."""

OTHERS = {"compound": _compound}
"""Functions that draw objects of no household kind: two to four solids, joined at random."""
