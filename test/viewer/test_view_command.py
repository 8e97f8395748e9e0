"""The commands as a user starts them: a run that is watched, and a file that is looked at, until Ctrl-C."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

Start = Callable[..., tuple[Any, str]]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts `graspd` and gives its process and the address that it prints."""
    started: list[Any] = []

    def run(*arguments: str) -> tuple[Any, str]:
        command = [sys.executable, "-m", "graspd_core.cli", *arguments, "--port", "0"]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
        )
        started.append(process)
        assert process.stdout is not None
        line = next(line for line in process.stdout if "http://" in line)
        return process, next(word for word in line.split() if word.startswith("http://"))

    yield run
    for process in started:
        process.kill()
        process.communicate()


def test_a_run_is_watched_and_its_grasps_looked_at(start, visit, tmp_path: Path):
    out = tmp_path / "grasps.json"
    arguments = ("shape:box", "--hand", "parallel_gripper", "--preset", "fast", "-n", "2", "--out", str(out), "--view")
    process, url = start("synthesize", *arguments)
    page = visit(url)
    page.text("#0 verified")
    process.send_signal(signal.SIGINT)
    rest, _ = process.communicate(timeout=60)
    assert process.returncode == 0, rest
    assert "2 of 2 grasps" in rest
    assert f"written: {out}; to look at it: graspd view {out}" in rest
    assert "Traceback" not in rest
    assert out.is_file()
    page.errors.clear()  # of the connection that is gone


def test_a_file_is_looked_at_until_ctrl_c(start, visit, grasps_file):
    process, url = start("view", str(grasps_file))
    page = visit(url)
    page.text("#0 verified")
    process.send_signal(signal.SIGINT)
    rest, _ = process.communicate(timeout=60)
    assert process.returncode == 0, rest
    assert "Traceback" not in rest
    page.errors.clear()
