"""The pages build without a warning, the reference lists every public name, and the commands of contributors agree."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import yaml

import graspd_core

ROOT = Path(__file__).parents[1]
MAKEFILE = (ROOT / "Makefile").read_text()


def test_the_pages_build_without_a_warning(tmp_path: Path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "api.html").read_text()
    assert "Plan grasps and try them in rank order" in page
    # Nothing is loaded from elsewhere when a page is shown.
    assert not re.search(r"<(script|link|img)[^>]*(src|href)=\"https?:", page)


def test_the_reference_lists_every_public_name_once():
    listed = re.findall(r"^::: graspd_core\.(\w+)$", (ROOT / "docs" / "api.md").read_text(), re.MULTILINE)
    assert sorted({*listed} - {"errors"}) == graspd_core.__all__
    assert len(listed) == len({*listed})


def test_a_commit_is_checked_as_make_check_does():
    checks = re.search(r"^check: .*\n((?:\t.*\n)+)", MAKEFILE, re.MULTILINE)
    assert checks is not None
    commands = [line.replace("$(RUN)/", ".venv/bin/").removesuffix(" .") for line in checks[1].split("\n\t")]
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    entries = [hook["entry"].removesuffix(" --force-exclude") for hook in hooks]
    assert entries[: len(commands)] == [command.strip() for command in commands]
    assert {hook["language"] for hook in hooks} == {"system"}


def test_every_command_of_contributors_is_there():
    targets = set(re.findall(r"^([a-z-]+): .*##", MAKEFILE, re.MULTILINE))
    named = re.findall(r"^ +make ([a-z -]+?)(?: +#|$)", (ROOT / "CONTRIBUTING.md").read_text(), re.MULTILINE)
    assert {"help", "check", "test", "docs", "bench"} <= {name for line in named for name in line.split()} <= targets
