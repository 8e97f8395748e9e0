"""Measure the grasp metrics, which a registry defines with the names and units for files, messages and tables.

The metrics are static and do not depend on the choice of frame. docs/metrics.md defines them, and a test compares that
page with the registry. `distinct` removes near-duplicate grasps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from graspd_core.errors import ConfigError, GraspdError, first_line
from graspd_core.hands.model import HandModel
from graspd_core.se3 import rotation_from_quaternion
from graspd_core.types import Grasp, GraspMetrics, Posture
from graspd_core.verify.prepared_grasp import (
    MAX_CONTACTS,
    MetricsContext,
    PreparedGrasp,
    contact_area,
    contact_depth,
    contact_links,
    penetration,
    self_penetration,
)


@dataclass(frozen=True)
class Metric:
    """Definition of one metric.

    Attributes:
        name: key of `GraspMetrics`.
        unit: unit in files and tables. Empty if the metric has no unit.
        scale: factor from SI units to `unit`.
        measure: function that returns the value in SI units. None if another step of planning measures the metric.
        description: definition for docs/metrics.md.
        digits: number of decimals in tables.
    """

    name: str
    unit: str
    scale: float
    measure: Callable[[PreparedGrasp], float | None] | None
    description: str
    digits: int = 2

    @property
    def key(self) -> str:
        """Key in files: the name followed by the unit in ASCII."""
        unit = self.unit.replace("1/", "per_").translate(str.maketrans("²³", "23"))
        return f"{self.name}_{unit}" if unit else self.name

    @property
    def title(self) -> str:
        """Column heading in tables."""
        return f"{self.name.replace('_', ' ')} {self.unit}".rstrip()

    def text(self, value: float) -> str:
        """Return a value, given in SI units, as text with name and unit."""
        return f"{self.name.replace('_', ' ')} {value * self.scale:.{self.digits}f} {self.unit}".rstrip()


def _contact_per_volume(grasp: PreparedGrasp) -> float | None:
    volume = grasp.shared_volume
    return contact_area(grasp.placed) / volume if volume > 0 else None


_ROWS = (
    Metric(
        "penetration", "mm", 1e3, lambda g: penetration(g.context, g.placed),
        "greatest depth of a sample of the hand's surface or edges inside the object, or of a point of the object's "
        "surface or edges inside the hand",
    ),
    Metric(
        "contact_depth", "mm", 1e3, lambda g: contact_depth(g.context, g.posture),
        "depth of the deepest contact of the hand with the object's convex parts in MuJoCo. Measured if a trial is run",
    ),
    Metric(
        "self_penetration", "mm", 1e3, lambda g: self_penetration(g.context, g.placed),
        "greatest depth of a sample inside a link not adjacent to the sample's link. Links are adjacent if a joint "
        "joins them, or if they overlap by design",
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
        "intersection_volume", "cm³", 1e6, lambda g: g.shared_volume,
        "IV: volume shared by hand and object, summed over 2 mm grid cells in the hand's base frame. Each cell counts "
        "by the thickness of the overlap. Overlaps of less than a cell at an edge count up to twice",
    ),
    Metric(
        "contact_per_volume", "1/cm", 1e-2, _contact_per_volume,
        "CA/IV: contact area within 2 mm divided by intersection volume. None if that volume is 0", 0,
    ),
    Metric(
        "contact_links", "", 1.0, lambda g: contact_links(g.placed),
        "number of links with a sample inside the object or within 2 mm", 0,
    ),
    Metric(
        "epsilon", "", 1.0, lambda g: g.wrench_hull.epsilon,
        "ε: radius of the largest ball about the origin in the convex hull of contact wrenches (Ferrari and Canny, "
        "ICRA 1992). 0 if the origin is outside", 3,
    ),
    Metric("volume", "", 1.0, lambda g: g.wrench_hull.volume, "volume of the convex hull of contact wrenches", 3),
    Metric(
        "payload", "kg", 1.0, None,
        "greatest mass at which the grasp resists the pulls of the hold trial, at the trial's friction. Found by "
        "bisection to 10 %. Measured only for verified grasps",
    ),
    Metric(
        "least_friction", "", 1.0, None,
        "least sliding friction at which the grasp passes the hold trial. Measured only with `robust.friction`",
    ),
    Metric(
        "robustness", "", 1.0, None,
        "fraction of noisy hold trials that a verified grasp passes. Measured only with `robust.rank`",
    ),
)  # fmt: skip
METRICS: dict[str, Metric] = {row.name: row for row in _ROWS}
"""The metrics by name. `measure` measures each metric that has a function `Metric.measure`."""


def measure(context: MetricsContext, posture: Posture, *, max_contacts: int = MAX_CONTACTS) -> GraspMetrics:
    """Measure all metrics of the context's hand at `posture` on the context's object.

    ε and volume use at most `max_contacts` contacts. A metric that another step measures is None.
    Raises ConfigError: the function of a plugin's metric raises, or returns no number.
    """
    grasp = PreparedGrasp(context, posture, max_contacts)
    return GraspMetrics({name: _value(row, grasp) for name, row in METRICS.items()})


def _value(row: Metric, grasp: PreparedGrasp) -> float | None:
    try:
        value = row.measure(grasp) if row.measure else None
        return None if value is None else float(value)
    except Exception as error:
        # A plugin's function may raise any exception. A fault of a built-in metric shows its traceback.
        if row in _ROWS or isinstance(error, GraspdError | MemoryError):
            raise
        raise ConfigError(f"metric {row.name!r}: {type(error).__name__}: {first_line(error)}") from error


# Two grasps are different if their palms are this far apart [m] or their base rotations differ by this angle [rad].
APART, TURNED = 0.02, float(np.deg2rad(20.0))


def distinct(grasps: Sequence[Grasp], hand: HandModel) -> tuple[Grasp, ...]:
    """Return the grasps in order, but leave out each near-duplicate of an earlier grasp.

    The palm centres of near-duplicates are less than 20 mm apart. Their base rotations differ by less than 20°.
    Grasping a ball from the left or the right gives two grasps, because a robot may reach only one side.
    """
    kept: list[Grasp] = []
    palms, turns = np.zeros((0, 3)), np.zeros((0, 3, 3))
    for grasp in grasps:
        posture = grasp.grasp
        turn = rotation_from_quaternion(torch.as_tensor(posture.quaternion_wxyz, dtype=torch.float64)).numpy()
        palm = posture.position + turn @ hand.palm_center
        # The trace of the relative rotation gives the cosine of its angle.
        cosine = (np.einsum("nij,ij->n", turns, turn) - 1.0) / 2.0
        near = np.linalg.norm(palms - palm, axis=1) < APART
        if not (near & (cosine > np.cos(TURNED))).any():
            kept.append(grasp)
            palms, turns = np.concatenate([palms, palm[None]]), np.concatenate([turns, turn[None]])
    return tuple(kept)
