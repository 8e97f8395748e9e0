"""The sources of graspd_msgs: documented, told alike to colcon and pip, built when stale."""

import ast
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import pytest
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "msg_defs"
DEFINITIONS = sorted(path for kind in ("msg", "srv", "action") for path in PACKAGE.glob(f"{kind}/*.*"))

# Types that carry a physical quantity, or a number whose unit a reader must ask for.
QUANTITIES = {"float32", "float64", "geometry_msgs/Pose", "geometry_msgs/Point", "geometry_msgs/Vector3"}


def declarations(path: Path) -> list[tuple[str, str, str]]:
    """Type, name (or NAME=value) and comment of every field and constant."""
    found = []
    for line in path.read_text().splitlines():
        declared, _, comment = line.partition("#")
        if declared.strip() and declared.strip() != "---":
            kind, name, *_ = declared.split()
            found.append((kind, name, comment.strip()))
    return found


def dependencies(manifest: Path, *tags: str) -> set[str]:
    root = ElementTree.parse(manifest).getroot()
    return {element.text or "" for tag in tags for element in root.iterfind(tag)}


def version(manifest: Path) -> str | None:
    return ElementTree.parse(manifest).findtext("version")


@pytest.mark.parametrize("path", DEFINITIONS, ids=lambda path: path.name)
def test_every_field_says_what_it_is(path: Path):
    fields = declarations(path)
    assert fields
    silent = [name for _, name, comment in fields if len(comment) < 8]
    assert not silent, f"{path.name}: no comment on {silent}"
    unitless = [
        name
        for kind, name, comment in fields
        if kind.removesuffix("[]") in QUANTITIES
        and not re.search(r"\[(m|m2|s|rad|kg|N)\]|without unit|from 0 to 1", comment)
    ]
    assert not unitless, f"{path.name}: no unit on {unitless}"
    assert path.read_text().startswith("# "), f"{path.name} does not say what it is for"


def test_colcon_and_pip_are_told_of_every_package_in_use():
    used = {kind.split("/")[0] for path in DEFINITIONS for kind, *_ in declarations(path) if "/" in kind}
    in_cmake = re.search(r"DEPENDENCIES ([\w\s]+)\)", (PACKAGE / "CMakeLists.txt").read_text())
    assert in_cmake
    told = set(in_cmake[1].split())
    declared = dependencies(PACKAGE / "package.xml", "depend")
    assert used <= told <= declared
    assert declared - used <= {"action_msgs", "builtin_interfaces", "service_msgs", "unique_identifier_msgs"}


def test_one_version_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert version(PACKAGE / "package.xml") == version(ROOT / "package.xml") == project
    assert f"\nversion: {project}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## [{project}] - 20" in (ROOT / "CHANGELOG.md").read_text()


PINS = re.compile(r"^([\w.-]+)==([\w.]+)$", re.MULTILINE)


def test_every_library_is_locked_listed_and_named_to_ros():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *project["optional-dependencies"]["clouds"]]
    names = {re.split(r"[<>=\[]", requirement)[0] for requirement in wanted}
    lock, pins = (
        {canonicalize_name(name): pinned for name, pinned in PINS.findall((ROOT / file).read_text())}
        for file in ("requirements.lock", "constraints.txt")
    )
    assert lock.keys() >= names
    assert not {name for name in lock.keys() & pins.keys() if lock[name] != pins[name]}
    page = (ROOT / "docs" / "reference" / "dependencies.md").read_text()
    table = dict(re.findall(r"^\| ([\w.-]+) \| [\d.]+ \| (\w*) ?\|", page, re.MULTILINE))
    locked = {name for name, extra in table.items() if extra in ("", "clouds")}
    # pip's list leaves setuptools out.
    assert locked - {"graspd", "setuptools"} == lock.keys() - {"setuptools"}
    users = project["optional-dependencies"].keys() - {"fuzz", "docs", "dev"}
    assert {*table.values()} - {""} == users
    keys = {"pyyaml": "python3-yaml", "pillow": "python3-pil", "tqdm": "python3-tqdm"}
    by_pip = re.findall(r"[\w-]+", re.findall(r"<!-- From pip.*?-->", (ROOT / "package.xml").read_text(), re.DOTALL)[0])
    assert {keys[name] for name in names & keys.keys()} <= dependencies(ROOT / "package.xml", "exec_depend")
    assert names - keys.keys() <= {*by_pip}


def test_the_interfaces_are_built_against_the_pinned_wheels():
    pins = dict(re.findall(r"^([\w-]+)==([\w.]+)", (ROOT / "constraints.txt").read_text(), re.MULTILINE))
    for file in ("pyproject.toml", "setup.py"):
        named = re.findall(r"\"(ros-[\w-]+)(?:\[\w+\])?==([\w.]+)\"", (PACKAGE / file).read_text())
        assert named
        assert {name: pins[name] for name, _ in named} == dict(named), file


def test_the_manifest_names_every_ros_package_that_the_node_imports():
    imported = set()
    for path in (ROOT / "graspd_ros").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                imported.add(node.module.split(".")[0])
            elif isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
    share = Path(sys.prefix) / "share" / "ament_index" / "resource_index" / "packages"
    packages = {name for name in imported if (share / name).is_file()}
    assert {"rclpy", "sensor_msgs", "graspd_msgs"} <= packages
    assert packages - {"graspd_ros"} <= dependencies(ROOT / "package.xml", "exec_depend", "depend")


def test_every_command_has_its_function():
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    for target in scripts.values():
        module, _, function = target.partition(":")
        base = ROOT / module.replace(".", "/")
        path = next(path for path in (base.with_suffix(".py"), base / "__init__.py") if path.is_file())
        assert re.search(rf"^def {function}\(|import .*\b{function}\b", path.read_text(), re.MULTILINE), target


def test_a_missing_compiler_is_named(tmp_path: Path):
    command = [sys.executable, str(PACKAGE / "setup.py"), "-q", "build"]
    environment = {**os.environ, "CXX": "no-such-compiler"}
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60)
    assert result.returncode == 1
    expected = "graspd_msgs: no compiler 'no-such-compiler'; install one with: sudo apt-get install build-essential"
    assert result.stderr.splitlines()[-1] == expected
    assert not list(tmp_path.iterdir())
