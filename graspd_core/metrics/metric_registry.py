"""The metrics of a grasp, one row each: `measure`, files, messages and tables follow; a test checks docs/metrics.md."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from graspd_core.metrics.hand_contacts import contact_area, contact_links
from graspd_core.metrics.intersection import penetration, self_penetration
from graspd_core.metrics.prepared_grasp import PreparedGrasp


@dataclass(frozen=True)
class Metric:
    """How one metric is measured and shown.

    Attributes:
        name: key of `GraspMetrics`.
        unit: that files and tables show; empty without one.
        scale: value in that unit over value in SI units.
        measure: gives the value in SI units; None where another step of planning fills it in.
        description: definition, for docs/metrics.md.
        digits: decimals in tables.
    """

    name: str
    unit: str
    scale: float
    measure: Callable[[PreparedGrasp], float | None] | None
    description: str
    digits: int = 2

    @property
    def key(self) -> str:
        """Key in files: the name, and the unit in ASCII."""
        unit = self.unit.replace("1/", "per_").translate(str.maketrans("²³", "23"))
        return f"{self.name}_{unit}" if unit else self.name

    @property
    def title(self) -> str:
        """Heading in tables."""
        return f"{self.name.replace('_', ' ')} {self.unit}".rstrip()

    def text(self, value: float) -> str:
        """A value in SI units for people."""
        return f"{self.name.replace('_', ' ')} {value * self.scale:.{self.digits}f} {self.unit}".rstrip()


def _contact_per_volume(grasp: PreparedGrasp) -> float | None:
    volume = grasp.intersection_volume
    return contact_area(grasp.placed) / volume if volume > 0 else None


_ROWS = (
    Metric(
        "penetration", "mm", 1e3, lambda g: penetration(g.placed),
        "greatest depth of a sample inside the object",
    ),
    Metric(
        "self_penetration", "mm", 1e3, lambda g: self_penetration(g.context, g.placed),
        "greatest depth of a sample inside a link that is not adjacent to its own; links are adjacent when a joint "
        "joins them, or when they overlap by design",
    ),
    Metric(
        "contact_area", "cm²", 1e4, lambda g: contact_area(g.placed),
        "CA: sum of the areas of samples within 2 mm of the object's surface, on either side", 1,
    ),
    Metric(
        "contact_area_5mm", "cm²", 1e4, lambda g: contact_area(g.placed, 0.005),
        "contact area within 5 mm", 1,
    ),
    Metric(
        "contact_area_10mm", "cm²", 1e4, lambda g: contact_area(g.placed, 0.01),
        "contact area within 10 mm", 1,
    ),
    Metric(
        "intersection_volume", "cm³", 1e6, lambda g: g.intersection_volume,
        "IV: volume shared by hand and object, in 1 mm voxels of a lattice fixed in the hand's base frame; an octree "
        "finds them, so that no overlap is too small to be visited",
    ),
    Metric(
        "contact_per_volume", "1/cm", 1e-2, _contact_per_volume,
        "CA/IV: contact area within 2 mm over intersection volume; none where nothing is shared", 0,
    ),
    Metric(
        "contact_links", "", 1.0, lambda g: contact_links(g.placed),
        "links with a sample outside by at most 2 mm, or inside", 0,
    ),
    Metric(
        "epsilon", "", 1.0, lambda g: g.wrench_hull[0],
        "ε: radius of the largest ball about the origin in the convex hull of contact wrenches (Ferrari and Canny, "
        "ICRA 1992); 0 when the origin is outside", 3,
    ),
    Metric("volume", "", 1.0, lambda g: g.wrench_hull[1], "volume of that hull", 3),
    Metric(
        "robustness", "", 1.0, None,
        "share of noisy trials (below) that a verified grasp held; measured with `robust.rank` only",
    ),
)  # fmt: skip
METRICS: dict[str, Metric] = {row.name: row for row in _ROWS}
"""The metrics by name; a row that is added is measured too."""
