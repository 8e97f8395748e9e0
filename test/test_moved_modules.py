"""Names of version 0.1: module paths are refused with the name that they have now, and the page lists every name."""

import importlib
import importlib.util
import json
import re
import sys
from importlib.machinery import PathFinder
from pathlib import Path

import pytest

import graspd_core

MOVED = {
    f"graspd_core.{old}": new
    for new, olds in json.loads(Path(graspd_core.__file__).with_name("moved.json").read_text()).items()
    for old in olds.split()
}


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("graspd_core.methods.losses", "graspd_core.optimize.losses"),
        ("graspd_core.methods.stages.squeeze", "graspd_core.optimize.grasp_postures"),
        ("graspd_core.bench.study_registry", "graspd_bench.study_registry"),
        ("graspd_core.dataset.ray_engine", "graspd_dataset.ray_engine"),
        ("graspd_core.viewer.server", "graspd_viewer.server"),
        ("graspd_core.cli.bench_command", "graspd_bench.bench_command"),
    ],
)
def test_an_old_path_is_refused_with_the_new_name(old: str, new: str):
    told = f"^{old} is {new} since version 0.2$"
    with pytest.raises(ImportError, match=told):
        importlib.import_module(old)
    folder, _, module = old.rpartition(".")
    with pytest.raises(ImportError, match=told):
        exec(f"from {folder} import {module}")


def test_every_new_name_exists_and_no_old_one():
    assert [new for new in sorted(set(MOVED.values())) if importlib.util.find_spec(new) is None] == []
    # Python itself refuses what would lie inside a module: `planning.steering` was a folder.
    inside = "graspd_core.planning.steering."
    for old in MOVED:
        if not old.startswith(inside):
            with pytest.raises(ImportError, match=r"since version 0\.2"):
                importlib.import_module(old)


def test_a_name_of_a_folder_that_is_gone_is_no_name():
    with pytest.raises(ImportError, match=r"graspd_core\.methods"):
        exec("from graspd_core.methods import METHODS")


def test_what_never_was_is_told_by_python():
    with pytest.raises(ModuleNotFoundError, match=r"No module named 'graspd_core.nothing'"):
        importlib.import_module("graspd_core.nothing")
    # It is asked last but for finders that came later, so that it costs nothing where a module is there.
    names = [type(finder).__module__ for finder in sys.meta_path]
    assert names.index("graspd_core") > sys.meta_path.index(PathFinder)


def test_the_page_has_the_tables_of_the_code():
    page = (Path(__file__).parents[1] / "docs" / "reference" / "migration.md").read_text()
    rows = re.findall(r"^\| (`.*`) \| `graspd_core\.([\w.]+)` \|$", page, re.MULTILINE)
    assert {module: " ".join(re.findall(r"`(\w+)`", names)) for names, module in rows} == graspd_core._MOVED
    assert '\n--8<-- "graspd_core/moved.json"\n' in page
