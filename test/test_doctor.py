"""`graspd doctor`: a healthy machine is called so, and what is missing or dies is named; the launch file compiles."""

from __future__ import annotations

import compileall
from pathlib import Path

import pytest

from graspd_core import doctor

ROOT = Path(__file__).parents[1]


def test_the_doctor_finds_this_machine_healthy(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(doctor, "PROBE_TIMEOUT", 600.0)  # of a busy machine
    failed = [check for check in doctor.run_checks() if not check.ok]
    assert not failed, doctor.format_checks(failed)


def test_the_doctor_reports_what_is_missing_and_what_dies():
    missing = doctor.try_code("gadget", "import no_such_library", "make setup", needed=True)
    dead = doctor.try_code("gizmo", "import os; os.abort()", "make setup", needed=False)
    assert (missing.ok, dead.ok) == (False, False)
    assert "No module named 'no_such_library'" in missing.detail
    assert dead.detail
    report = doctor.format_checks([missing, dead])
    assert "FAIL gadget" in report
    assert "-    gizmo" in report
    assert report.count("-> make setup") == 2


def test_the_launch_file_compiles():
    assert compileall.compile_dir(ROOT / "graspd_ros" / "launch", quiet=1, force=True)
