"""Every stress case by its name."""

from __future__ import annotations

from graspd_core.bench.stress.broken_clouds import cloud_cases
from graspd_core.bench.stress.broken_meshes import mesh_cases
from graspd_core.bench.stress.extremes import extreme_cases
from graspd_core.bench.stress.stress_case import Case

CASES: dict[str, Case] = {case.name: case for case in (*mesh_cases(), *cloud_cases(), *extreme_cases())}
