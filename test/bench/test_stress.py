"""Stress cases: named once, refused inputs refused in one line, and endings judged."""

from __future__ import annotations

from dataclasses import replace

import pytest

from graspd_core.bench.stress.run_stress_case import StressEnding, faults, run_case
from graspd_core.bench.stress.stress_case import GRASP
from graspd_core.bench.stress.stress_cases import CASES
from graspd_core.types import Outcome


def test_cases_are_named_once_and_expect_endings_that_there_are():
    import graspd_core.errors as errors

    known = {GRASP, *(outcome.name for outcome in Outcome), *vars(errors)}
    assert len(CASES) > 80
    assert all(case.name == name and set(case.expect) <= known for name, case in CASES.items())
    assert all(GRASP in case.expect for case in CASES.values() if case.whole)


@pytest.mark.parametrize(
    "name", ["nan-vertices", "zero-faces", "all-degenerate", "micrometre", "no-mesh-at-all", "bad-indices", "cut-off",
             "empty", "no-view", "all-nan", "ten-points", "zero-width", "lying-sizes"]
)  # fmt: skip
def test_what_shows_nothing_is_refused_in_one_line(name: str):
    # What it took is the suite's to judge: this process holds what other tests left, and is not alone on the machine.
    ending = replace(run_case(CASES[name], "fast"), loading=0.0, planning=0.0, memory=0.0)
    assert faults(CASES[name], ending) == ()
    assert "\n" not in ending.message


def test_faults_are_named():
    case = replace(CASES["open-box"], deadline=2.0, loading=1.0, memory=500.0)
    fine = StressEnding("open-box", GRASP, "", 0.5, 2.4, 400.0, 3, 2, 2)
    assert faults(case, fine) == ()
    for changed, word in (
        ({"ending": "crash", "message": "boom"}, "ended in crash"),
        ({"planning": 2.6}, "deadline"),
        ({"loading": 1.1}, "loaded"),
        ({"memory": 501.0}, "MB"),
        ({"again": 1}, "second trial"),
        ({"finite": False}, "not finite"),
    ):
        (fault,) = faults(case, replace(fine, **changed))
        assert word in fault
