"""Add your own metric, measured like the built-in metrics: python examples/your_own_metric.py [OBJECT].

As a plugin: graspd synthesize OBJECT --plugin examples/your_own_metric.py --out grasps.json.

A metric is one row of `METRICS`. Every verified grasp then has the metric, for example in the file of `--out`.
`graspd bench --readme PAGE.md` writes the metric's column to the section `bench-objects` of the page.
`grasp.placed` has surface samples of the hand in the object's frame, `grasp.context` has object and hand.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from graspd_core import METRICS, Metric, Verdict, load_hand, load_preset, load_scene, plan_grasps, save_result
from graspd_core.verify.prepared_grasp import PreparedGrasp

TOUCHING = 0.002  # distance to the object that counts as contact [m]


def contact_offset(grasp: PreparedGrasp) -> float | None:
    """Return the distance of the contacts' centroid, weighted by area, from the centre of mass [m], or None."""
    touching = np.abs(grasp.placed.distance) <= TOUCHING
    if not touching.any():
        return None
    centroid = np.average(grasp.placed.points[touching], axis=0, weights=grasp.placed.areas[touching])
    return float(np.linalg.norm(centroid - grasp.context.target.center_of_mass))


METRICS["contact_offset"] = Metric(
    name="contact_offset",
    unit="mm",
    scale=1e3,
    measure=contact_offset,
    description="distance of the contacts' centroid to the centre of mass",
    digits=1,
)


def main(arguments: Sequence[str]) -> int:
    """Return 0 if there is a verified grasp, else 1."""
    scene, hand, preset = load_scene(*(arguments or ["shape:hammer"])), load_hand("allegro_right"), load_preset("fast")
    result = plan_grasps(scene, hand, count=4, seed=0, preset=preset)
    held = [grasp for grasp in result.grasps if grasp.verdict is Verdict.VERIFIED and grasp.metrics]
    # Grasps near the centre of mass come first, because they are the steadiest.
    values_of = lambda grasp: grasp.metrics or {}  # noqa: E731
    held.sort(key=lambda grasp: np.inf if (offset := values_of(grasp)["contact_offset"]) is None else offset)
    for grasp in held:
        values = [(METRICS[name], values_of(grasp)[name]) for name in ("contact_offset", "penetration", "epsilon")]
        print(", ".join(row.text(value) for row, value in values if value is not None))
    save_result("grasps.json", result, scene.object, hand, preset)
    print('grasps.json: each grasp has "contact_offset_mm" among its metrics')
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
