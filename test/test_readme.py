"""What the documents show is true: the README's Python runs, its commands parse, its links lead somewhere."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from graspd_core.cli import build_parser
from graspd_core.io.grasps_json import FORMAT, VERSION
from graspd_core.optimize.plan_config import load_preset

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
USAGE = (ROOT / "docs" / "usage.md").read_text()
DOCUMENTS = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", *sorted(f"docs/{p.name}" for p in ROOT.glob("docs/*.md"))]


@pytest.mark.parametrize("page", [README, USAGE], ids=["README", "usage"])
def test_the_python_runs(page: str, capsys: pytest.CaptureFixture[str]):
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert blocks
    for block in blocks:
        exec(compile(block, "page", "exec"), {})
    assert capsys.readouterr().out.count("verified") == 2


def test_the_commands_of_the_usage_page_parse():
    lines = [line.split("#")[0].strip() for line in USAGE.splitlines() if line.startswith("    graspd ")]
    assert len(lines) >= 12
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


def test_presets_named_in_the_documents_exist(tmp_path: Path):
    named = re.search(r"preset \(([a-z, ]+), or", USAGE).group(1).split(", ")  # pyright: ignore[reportOptionalMemberAccess]
    table = README.split("<!-- bench:begin -->")[1].split("<!-- bench:end -->")[0]
    for name in [*named, *re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)]:
        load_preset(name)
    (own,) = re.findall(r"```yaml\n(.*?)```", USAGE, re.DOTALL)
    (tmp_path / "own.yaml").write_text(own)
    assert load_preset(str(tmp_path / "own.yaml")) != load_preset("balanced")
