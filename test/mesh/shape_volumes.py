"""Closed-form volumes of the authored shapes [m³]. Overlaps count once."""

from itertools import pairwise
from math import asin, pi, prod, sqrt

from graspd_core.mesh import shapes


def _mug() -> float:
    """Cup, half-ring handle, and the handle's two arms from the cup's outer wall to the bend.

    An arm of width 2w is a box less the cylinder x² + y² < R²: ∫ (x_end − √(R² − y²)) dy over |y| < w.
    """
    r, h, wall, w = shapes.MUG_RADIUS, shapes.MUG_HALF, shapes.MUG_WALL, shapes.HANDLE_HALF_WIDTH
    outer, inner = shapes.HANDLE_OUTER, shapes.HANDLE_INNER
    cup = pi * r**2 * 2 * h - pi * (r - wall) ** 2 * (2 * h - wall)
    arm = (2 * w * shapes.HANDLE_ARM - (w * sqrt(r**2 - w**2) + r**2 * asin(w / r))) * (outer - inner)
    return cup + pi / 2 * (outer**2 - inner**2) * 2 * w + 2 * arm


def shape_volume(name: str) -> float:
    """Return the volume of a shape."""
    return {
        "sphere": 4 / 3 * pi * shapes.SPHERE_RADIUS**3,
        "box": 8 * prod(shapes.BOX_HALF),
        "cylinder": pi * shapes.CYLINDER_RADIUS**2 * 2 * shapes.CYLINDER_HALF,
        "capsule": pi * shapes.CAPSULE_RADIUS**2 * (2 * shapes.CAPSULE_HALF + 4 / 3 * shapes.CAPSULE_RADIUS),
        "plate": 8 * prod(shapes.PLATE_HALF),
        "torus": 2 * pi**2 * shapes.TORUS_MAJOR * shapes.TORUS_MINOR**2,
        "mug": _mug(),
        "bowl": 2 / 3 * pi * (shapes.BOWL_RADIUS**3 - (shapes.BOWL_RADIUS - shapes.BOWL_WALL) ** 3),
        "bottle": sum(
            pi / 3 * (high - low) * (a * a + a * b + b * b) for (a, low), (b, high) in pairwise(shapes.BOTTLE_PROFILE)
        ),
        "l_block": (shapes.L_LONG + shapes.L_SHORT - shapes.L_THICK) * shapes.L_THICK * 2 * shapes.L_HALF_WIDTH,
        "hammer": 8 * prod(shapes.HEAD_HALF) + pi * shapes.SHAFT_RADIUS**2 * (shapes.HEAD_LOW - shapes.SHAFT_LOW),
    }[name]
