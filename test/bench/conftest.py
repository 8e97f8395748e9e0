"""Records as cells leave them, with figures that can be worked out by hand."""

from collections.abc import Callable
from typing import Any

import pytest

Make = Callable[..., dict[str, Any]]


def _record(name: str = "balanced", thing: str = "box", **changes: Any) -> dict[str, Any]:
    """A raw record of four grasps asked for, of which three were found and two held."""
    grasps = [
        {
            "standard": {"passed": passed},
            "hard": {"passed": passed and depth < 1.5},
            "sd": {"displacement_cm": sd},
            "metrics": {"penetration": depth * 1e-3, "contact_area": 2e-3, "contact_links": 8},
        }
        for passed, depth, sd in ((True, 1.0, 0.1), (True, 2.0, 0.3), (False, 3.0, 9.0))
    ]
    made = {
        "kind": "raw", "name": name, "method": "closed_form", "object": thing, "hand": "allegro_right", "seed": 0,
        "count": 4, "given": 3, "held": 2, "error": "", "study": "main",
        "label": f"raw {name} {thing} seed {changes.get('seed', 0)}", "made": "2026-11-22", "commit": "1234567",
        "code": "0.1.0+abc", "machine": "2 cores", "case_cpu": 12.0, "peak_mb": 600.0, "grasps": grasps,
        "cpu": {"scene": 1.0, "optimise": 2.0, "standard": 3.0, "hard": 4.0},
        "wall": {"scene": 2.0, "optimise": 4.0, "standard": 6.0, "hard": 8.0},
        "first_verified": {"cpu": 4.0, "wall": 8.0},
    }  # fmt: skip
    return {**made, **changes}


def _planned(name: str = "balanced", thing: str = "box", **changes: Any) -> dict[str, Any]:
    """A planned record: eight verified grasps in two rounds."""
    own = {"kind": "verified", "count": 8, "given": 10, "held": 8, "rounds": 2, "cpu": {"total": 16.0}, "grasps": []}
    return _record(name, thing, **{**own, **changes})


@pytest.fixture
def record() -> Make:
    return _record


@pytest.fixture
def planned() -> Make:
    return _planned
