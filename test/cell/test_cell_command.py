"""`graspd cell` as a user runs it, and the pictures that it makes."""

from __future__ import annotations

import argparse
import re
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from graspd_cell import cell_command, picker
from graspd_cell.cell_view import FRAMES, Film, LiveCell
from graspd_cell.simulated_robot import SimulatedRobot

ONE_BOX = ("--hand", "parallel_gripper", "--things", "shape:box", "--count", "1")


def _options(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    cell_command.add_command(parser.add_subparsers())
    return parser.parse_args(["cell", *words])


@pytest.mark.timeout(300)
def test_a_bin_is_emptied_in_a_line_a_pick_and_a_film(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    film = tmp_path / "film.png"
    status = cell_command.run(_options(*ONE_BOX, "--preset", "fast", "--film", str(film)))
    *lines, last = capsys.readouterr().out.splitlines()
    # A busy machine may end before the first grasp is found. What came of it is not this test's business.
    assert all(line.startswith(f"{number}: ") for number, line in enumerate(lines, 1))
    # That it is told truly is.
    out = bool(lines) and lines[-1].endswith("1 of 1 out")
    assert (status == 0, "left: nothing" in last) == (out, out)
    assert film.exists() == any(": picked" in line for line in lines)


@pytest.mark.timeout(300)
def test_an_empty_bin_is_filled_again_until_there_were_enough_picks(capsys: pytest.CaptureFixture[str]):
    assert cell_command.run(_options(*ONE_BOX, "--attempts", "1", "--picks", "2", "--preset", "fast")) == 0
    *failures, endings, last = capsys.readouterr().out.splitlines()
    assert all(line.startswith(("bin 1, attempt 1: ", "bin 2, attempt 1: ")) for line in failures)
    assert sum(int(part.rpartition(": ")[2]) for part in endings.split("; ")) == 2
    assert re.search(r"things in 2 attempts; .*; 2 bins; \d+ MB after the first bin, \d+ MB after the last", last)


def test_ctrl_c_is_no_failure_of_the_arm(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    def cancelled(*_: object):
        raise picker.Cancelled("cancelled")

    monkeypatch.setattr(picker.Picker, "empty_the_bin", cancelled)
    cell_command.run(_options(*ONE_BOX, "--picks", "1"))
    said = capsys.readouterr().out
    assert "bin 1: cancelled" in said
    assert "the arm stayed where it was" not in said


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--count", "0"), "--count: 0; valid: 1 to 24"),
        (("--seed", "-1"), "--seed: -1; valid: 0 to"),
        (("--speed", "0"), "--speed: 0.0; valid: a positive number"),
        (("--speed", "inf"), "--speed: inf; valid: a positive number"),
        (("--attempts", "0"), "--attempts: 0; valid: 1 or more"),
        (("--picks", "0"), "--picks: 0; valid: 1 or more"),
        (("--picks", "9", "--view"), "--picks cannot be combined with --view or --film; remove one of them"),
        (("--things", "nothing"), "unknown thing 'nothing'"),
        (("--hand", "none"), "unknown hand 'none'"),
    ],
)
def test_a_wrong_option_is_refused_by_name(refusal_of, words: tuple[str, ...], reason: str):
    assert reason in refusal_of("cell", *words)


def test_a_film_has_eight_frames_that_differ(robot_of: Callable[..., SimulatedRobot], tmp_path: Path):
    robot = robot_of("ur5e_like", "parallel_gripper", "shape:box")
    film = Film(robot)
    robot.wait(1.0)
    film.save(tmp_path / "film.png")
    assert robot.watchers == []
    picture = np.asarray(Image.open(tmp_path / "film.png"))
    rows, columns = picture.shape[0] // 2, picture.shape[1] // (FRAMES // 2)
    assert (rows, columns) == (240, 320)
    # The box falls between the first frame and the last.
    assert (picture[:rows, :columns] != picture[rows:, -columns:]).any()


def test_a_page_shows_the_cell_as_it_moves(robot_of: Callable[..., SimulatedRobot]):
    pytest.importorskip("viser")
    robot = robot_of("ur5e_like", "parallel_gripper", "shape:box")
    live = LiveCell(robot, host="127.0.0.1", port=0, speed=1000.0)
    try:
        with urllib.request.urlopen(live.page.url) as answer:
            assert answer.status == 200
        robot.wait(1.0)
        live.page.draw_points(np.zeros((5, 3)))
        live.page.write("1 of 1 things out", "<script>")
        box = robot.solids().index(next(solid for solid in robot.solids() if solid[0] == "box"))
        nodes = live.page._nodes._groups
        end = time.monotonic() + 60.0
        while "cloud" not in nodes or nodes["moving"][box].position[2] > 100 * robot.solid_poses()[box][2, 3] + 0.1:
            assert time.monotonic() < end
            time.sleep(0.02)
        assert len(nodes["moving"]) == len(robot.solids())
        while "&lt;script&gt;" not in live.page._text.content:
            assert time.monotonic() < end
            time.sleep(0.02)
    finally:
        live.page.close()
