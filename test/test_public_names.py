"""The package: what it offers, what a fresh interpreter imports of it, where its configuration lies, and its doctor."""

import ast
import compileall
import doctest
import inspect
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import graspd_core
from graspd_core import doctor, paths
from graspd_core.errors import ConfigError

PACKAGE = Path(graspd_core.__file__).parent


@pytest.mark.parametrize("name", graspd_core.__all__)
def test_a_public_name_is_there_and_documented(name: str):
    value = getattr(graspd_core, name)
    # Registries are dictionaries: their module describes them.
    assert name.isupper() or inspect.getdoc(value)


EXAMPLES = PACKAGE.parent / "examples" / "library.pycon"


def test_the_examples_of_the_reference_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    ran = doctest.testfile(str(EXAMPLES), module_relative=False)
    assert (ran.failed, ran.attempted > 60) == (0, True)


def test_every_public_name_has_an_example():
    code = "".join(example.source for example in doctest.DocTestParser().get_examples(EXAMPLES.read_text()))
    used = {node.id for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Name)}
    assert set(graspd_core.__all__) - used == set()
    page = (PACKAGE.parent / "docs" / "api.md").read_text()
    assert all(f"library.pycon:{part}" in page for part in re.findall(r"\[start:(\w+)\]", EXAMPLES.read_text()))


def test_type_checkers_see_the_same_names_as_users():
    tree = ast.parse((PACKAGE / "__init__.py").read_text())
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    seen = {f"{n.module}.{alias.asname}" for n in block.body if isinstance(n, ast.ImportFrom) for alias in n.names}
    assert seen == {f"graspd_core.{module}.{name}" for name, module in graspd_core._MODULE_OF.items()}
    assert (PACKAGE / "py.typed").exists()


def test_importing_the_package_imports_nothing_heavy():
    program = "import sys, graspd_core; print([n for n in ('torch', 'numpy', 'mujoco', 'yaml') if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", graspd_core._MOVED_TO)
def test_a_name_that_moved_is_found_with_a_warning(name: str):
    with pytest.warns(DeprecationWarning, match=f"graspd_core.{name} is removed in version"):
        assert callable(getattr(graspd_core, name))


def test_other_names_are_missing_as_in_any_module():
    with pytest.raises(AttributeError, match="no attribute 'plan_grapes'"):
        graspd_core.plan_grapes  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]


# Each takes 0.1 s or more to import, or pulls in what does.
UNUSED = ["open3d", "trimesh", "matplotlib", "scipy.stats", "scipy.optimize", "fast_simplification", "pybullet"]
UNUSED += ["rclpy", "networkx", "pandas", "dash", "sympy", "torch._dynamo"]
UNUSED += ["graspd_core.perception.reconstruct.reconstruct", "graspd_core.perception.segment.segment"]
# Who gives no arm, no library and no MANO hand loads nothing of them, nor a package beside the pipeline.
UNUSED += ["pytorch_kinematics", "graspd_core.arms", "graspd_core.library", "sqlite3", "graspd_core.hands.mano"]
UNUSED += ["graspd_bench", "graspd_dataset", "graspd_viewer"]
# What the library imports for a plan, the command imports too.
COMMAND = """
from graspd_core.cli import main
assert main(["synthesize", "shape:mug", "-n", "1", "--preset", "fast"]) == 0
"""


def test_a_plan_on_a_mesh_imports_what_it_uses(tmp_path):
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "GRASPD_CACHE": ""}
    ask = f"{COMMAND}\nimport sys\nprint([name for name in {UNUSED!r} if name in sys.modules])"
    # With nothing on disk, and with all of it there.
    for _ in range(2):
        run = subprocess.run([sys.executable, "-c", ask], env=environment, capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stderr
        assert run.stdout.splitlines()[-1] == "[]"


NO_OPEN3D = "graspd: open3d is not installed; run: pip install 'graspd[clouds]'\n"
WITHOUT_OPEN3D = """
import sys
sys.modules["open3d"] = None
from graspd_core.cli import main
sys.exit(main(["synthesize", sys.argv[1], "-n", "1", "--preset", "fast", "--out", "grasps.json"]))
"""


@pytest.mark.parametrize(
    ("source", "status", "error"), [("ball.stl", 0, ""), ("ball.npy", 2, NO_OPEN3D), ("ball.xyz", 2, NO_OPEN3D)]
)
def test_a_mesh_needs_no_open3d_and_a_cloud_names_its_extra(source: str, status: int, error: str, tmp_path: Path):
    ball = graspd_core.make_shape("sphere")
    graspd_core.save_mesh(tmp_path / "ball.stl", ball)
    # What a camera at the origin sees.
    seen = np.add(ball.vertices[ball.vertices[:, 2] < -0.01], (0, 0, 0.5))
    np.save(tmp_path / "ball.npy", seen)
    np.savetxt(tmp_path / "ball.xyz", seen)
    command = [sys.executable, "-c", WITHOUT_OPEN3D, source]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, error in done.stderr) == (status, True), done.stderr
    assert status == 0 or done.stderr == error


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
