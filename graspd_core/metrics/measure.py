"""Static quality of one grasp. Definitions are those of docs/metrics.md; every figure is independent of the frame."""

from __future__ import annotations

from graspd_core.metrics.metric_registry import METRICS
from graspd_core.metrics.metrics_context import MetricsContext
from graspd_core.metrics.prepared_grasp import MAX_CONTACTS, prepare_grasp
from graspd_core.types import GraspMetrics, Posture


def measure(context: MetricsContext, posture: Posture, *, max_contacts: int = MAX_CONTACTS) -> GraspMetrics:
    """Every metric of the registry, of the context's hand at `posture` on the context's object.

    ε and volume are those of at most `max_contacts` contacts. None where another step measures the metric.
    """
    grasp = prepare_grasp(context, posture, max_contacts)
    values = {name: row.measure(grasp) if row.measure else None for name, row in METRICS.items()}
    return GraspMetrics({name: None if value is None else float(value) for name, value in values.items()})
