"""What `import graspd_core` offers: documented, lazy, typed; names that moved are found with a warning."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import graspd_core

PACKAGE = Path(graspd_core.__file__).parent


@pytest.mark.parametrize("name", graspd_core.__all__)
def test_a_public_name_is_there_and_documented(name: str):
    value = getattr(graspd_core, name)
    # Registries are dictionaries: their module describes them.
    assert name.isupper() or inspect.getdoc(value)


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
    with pytest.warns(DeprecationWarning, match=f"graspd_core.{name} goes with version"):
        assert callable(getattr(graspd_core, name))


def test_other_names_are_missing_as_in_any_module():
    with pytest.raises(AttributeError, match="no attribute 'plan_grapes'"):
        graspd_core.plan_grapes  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]
