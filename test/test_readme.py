"""What the documents show is true: the README's Python runs, its commands parse, its links lead somewhere."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from graspd_core.cli import build_parser
from graspd_core.formats.grasps_json import FORMAT, VERSION
from graspd_core.methods.plan_config import load_preset

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
DOCUMENTS = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", *sorted(f"docs/{p.name}" for p in ROOT.glob("docs/*.md"))]


def test_the_python_of_the_readme_runs(capsys: pytest.CaptureFixture[str]):
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert blocks
    for block in blocks:
        exec(compile(block, "README.md", "exec"), {})
    assert capsys.readouterr().out.count("verified") == 2


def test_the_commands_of_the_readme_parse():
    lines = [line.split("#")[0].strip() for line in README.splitlines() if line.startswith("    graspd ")]
    assert len(lines) >= 6
    for line in lines:
        build_parser().parse_args(shlex.split(line)[1:])


@pytest.mark.parametrize("name", DOCUMENTS)
def test_links_lead_to_files(name: str):
    document = ROOT / name
    targets = re.findall(r"\]\(((?!https?:)[^)#]+)", document.read_text())
    missing = [target for target in targets if not (document.parent / target).exists()]
    assert not missing


def test_the_format_page_is_of_the_version_written():
    page = (ROOT / "docs" / "format.md").read_text()
    assert f"`{FORMAT}`, version {VERSION}" in page


def test_presets_named_in_the_readme_exist():
    for name in re.search(r"preset \(([a-z, ]+), or", README).group(1).split(", "):  # pyright: ignore[reportOptionalMemberAccess]
        load_preset(name)


def test_results_have_a_place():
    assert README.index("<!-- bench:begin -->") < README.index("<!-- bench:end -->") < README.index("## Quick start")
