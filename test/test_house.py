"""The house's own machinery: where config is found, and what the doctor says."""

from __future__ import annotations

import compileall
import shutil
from pathlib import Path

import pytest

from graspd_core import doctor, paths
from graspd_core.errors import ConfigError

ROOT = Path(__file__).parents[1]


def test_config_is_found_in_a_checkout():
    assert (paths.config_dir() / "hands").is_dir()


def test_the_environment_names_another_config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("GRASPD_CONFIG", str(tmp_path))
    assert paths.config_dir() == tmp_path
    monkeypatch.setenv("GRASPD_CONFIG", str(tmp_path / "nowhere"))
    with pytest.raises(ConfigError, match=r"GRASPD_CONFIG=.*nowhere"):
        paths.config_dir()


def test_config_is_found_beside_an_installed_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    package = tmp_path / "lib" / "python3.12" / "site-packages" / "graspd_core"
    package.mkdir(parents=True)
    shutil.copy(ROOT / "graspd_core" / "paths.py", package / "paths.py")
    monkeypatch.setattr(paths, "__file__", str(package / "paths.py"))
    monkeypatch.setattr(paths.sys, "prefix", str(tmp_path / "elsewhere"))
    with pytest.raises(ConfigError, match="GRASPD_CONFIG"):
        paths.config_dir()
    (tmp_path / "share" / "graspd" / "config" / "hands").mkdir(parents=True)
    assert paths.config_dir() == tmp_path / "share" / "graspd" / "config"


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
