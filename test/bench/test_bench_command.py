"""`graspd bench`: it resumes after a kill, keeps finished cells after Ctrl-C, and names what is wrong in one line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from graspd_bench import run_studies
from graspd_bench.result_store import read_results
from graspd_bench.run_studies import Job
from graspd_core.cli import main
from graspd_core.cli.running import EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_OK

GRASPD = [sys.executable, "-m", "graspd_core.cli", "bench"]
# Two cells of a few seconds, whose method does next to nothing.
SMALL = ["--presets", "random_closure", "--objects", "shape:sphere", "--count", "2", "--trials", "standard"]

BAD: list[tuple[list[str], str]] = [
    (["--presets", "best"], "unknown preset 'best'; valid presets: accurate, "),
    (["--objects", "shape:teapot"], "unknown shape 'teapot'; valid shapes: bottle, "),
    (["--objects", "cup.obj"], "cup.obj: no such mesh file; shape:NAME is an authored shape: bottle, "),
    (["--suite", "tall"], "unknown suite 'tall'; valid suites: main, "),
    (["--trials", "standard,gentle"], "unknown trial 'gentle'; valid trials: standard, hard, "),
    (["--hand", "claw"], "unknown hand 'claw'; known: "),
    (["--count", "0"], "count: 0 grasps; valid: 1 to 1024"),
    (["--seeds", "-1"], "seed: -1; valid: 0 to"),
    (["--processes", "0"], "processes: 0; at least 1"),
    (["--compare", "nowhere.json"], "nowhere.json: No such file"),
    (["--frobnicate"], "unrecognized arguments: --frobnicate"),
]


@pytest.mark.parametrize(("options", "culprit"), BAD, ids=lambda value: str(value)[:40])
def test_a_bad_option_is_named_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], culprit: str
):
    assert main(["bench", "--out", str(tmp_path / "out"), *options]) == EXIT_BAD_INPUT
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert culprit in err
    assert not (tmp_path / "out").exists()


def test_an_empty_folder_of_objects_and_a_file_for_a_folder_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "none").mkdir()
    assert main(["bench", "--objects", str(tmp_path / "none")]) == EXIT_BAD_INPUT
    assert "none: no mesh in this folder; valid endings: dae" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert main(["bench", *SMALL, "--out", str(tmp_path / "file" / "out")]) == EXIT_BAD_INPUT
    assert "cannot be written" in capsys.readouterr().err


def test_cells_that_raise_are_named_at_the_end_and_the_others_kept(
    tmp_path: Path, record, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def run(jobs: Sequence[Job], folder: Path, processes: int, stop: Any):
        for job in jobs:
            case: Any = job.case
            error = "ValueError: odd" if case.seed else ""
            yield job, record(case.name, "sphere", seed=case.seed, kind=case.kind, error=error)

    monkeypatch.setattr(run_studies, "run_cases", run)
    assert main(["bench", *SMALL, "--seeds", "0", "1", "--out", str(tmp_path)]) == 1
    out, err = capsys.readouterr()
    assert "graspd: failed: main raw random_closure sphere seed 1: ValueError: odd" in err
    assert "graspd: 2 cases, about 0 minutes on 1 quiet cores" in err
    assert "| `random_closure` | 50% |" in out
    assert len(read_results(tmp_path / "results.json")) == 2


def finished(folder: Path) -> dict[str, float]:
    """Cells on disk and when they were written."""
    return {path.name: path.stat().st_mtime for path in folder.glob("main-raw*.json")}


def lives(process: str) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_for_a_cell(process: subprocess.Popen[str], folder: Path) -> None:
    while not finished(folder):
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_killed_run_goes_on_where_it_was(tmp_path: Path):
    """SIGKILL in the middle; the second run does only what is missing, the third one nothing."""
    command = [*GRASPD, *SMALL, "--seeds", "0", "1", "2", "--out", str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    wait_for_a_cell(process, tmp_path)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    process.kill()
    process.communicate()
    # Its worker ends by itself, a moment later; until then it may finish a cell.
    while any(map(lives, children)):
        time.sleep(0.05)
    before = finished(tmp_path)
    assert 1 <= len(before) < 3
    assert not (tmp_path / "results.json").exists()
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert done.returncode == EXIT_OK, done.stderr
    assert f"{len(before)} of 3 cases had finished before" in done.stderr
    assert {name: finished(tmp_path)[name] for name in before} == before
    cells = read_results(tmp_path / "results.json")
    assert sorted(cell["seed"] for cell in cells) == [0, 1, 2]
    again = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert "3 of 3 cases had finished before" in again.stderr
    assert again.stdout == done.stdout


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_ctrl_c_keeps_finished_cells(tmp_path: Path):
    command = [*GRASPD, *SMALL, "--seeds", *map(str, range(40)), "--out", str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    wait_for_a_cell(process, tmp_path)
    os.kill(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == EXIT_INTERRUPTED, errors
    assert "Traceback" not in errors
    kept = len(finished(tmp_path))
    assert f"interrupted; {kept} of 40 cases are kept" in errors
