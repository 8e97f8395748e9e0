"""The coverage-guided fuzzer itself: it runs, learns, and finds what is planted; not where atheris is missing."""

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("atheris")

FUZZ = Path(__file__).parents[2] / "benchmarks" / "fuzz.py"
PLANTED = """
import sys
sys.path.insert(0, {folder!r})
import fuzz_targets
from graspd_core.optimize import plan_config

def eager(values, where):
    if "method" in values:
        raise KeyError("planted")
    return values

plan_config.plan_config = eager
import runpy
sys.argv = ["fuzz.py", "--child", "preset", "--seconds", "1", "--out", {out!r}]
runpy.run_path({file!r}, run_name="__main__")
"""


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, errors="replace", timeout=100)


# The second is compiled code, which can end a process: here a process of its own.
@pytest.mark.parametrize("target", ["layout", "mjcf"])
def test_one_second_finds_nothing(target: str, tmp_path: Path) -> None:
    ended = run(str(FUZZ), "--targets", target, "--minutes", "0.02", "--out", str(tmp_path))
    assert ended.returncode == 0, ended.stdout + ended.stderr
    (row,) = (line.split("|")[1:-1] for line in ended.stdout.splitlines() if line.startswith(f"| {target}"))
    inputs, edges, _, findings = map(int, row[1:])
    assert inputs > 20, ended.stdout
    assert edges > 5, ended.stdout
    assert findings == 0, ended.stdout
    assert len(list((tmp_path / "corpus" / target).iterdir())) > 2


def test_what_is_planted_is_found_and_kept(tmp_path: Path) -> None:
    ended = run("-c", PLANTED.format(folder=str(FUZZ.parent), out=str(tmp_path), file=str(FUZZ)))
    notes = [path.read_text() for path in (tmp_path / "findings").glob("preset-*.txt")]
    assert any("KeyError: 'planted'" in note for note in notes), ended.stderr
