"""Where the configuration is found: in a checkout, beside an installed package, or where the environment says."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from graspd_core import paths
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
