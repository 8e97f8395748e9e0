"""The examples do what they say; the client of the node is tried in test/ros/test_client_example.py."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from pathlib import Path

import pytest

import graspd_core

EXAMPLES = Path(__file__).parents[1] / "examples"

# Runs `main` of an example with arguments, in a directory of its own.
Run = Callable[..., int]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return lambda name, *arguments, **named: importlib.import_module(name).main(arguments, **named)


def test_a_mesh(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    graspd_core.save_mesh(graspd_core.make_shape("box"), tmp_path / "box.obj")
    assert run("grasp_a_mesh", "box.obj", "box.json") == 0
    assert "links touch" in capsys.readouterr().out
    assert graspd_core.load_grasps(tmp_path / "box.json")[0].verdict == "verified"


def test_a_cloud(run: Run, capsys: pytest.CaptureFixture[str]):
    assert run("grasp_a_cloud") == 0
    assert "held ['hold', 'lift', 'hypotheses']" in capsys.readouterr().out


def test_your_own_hand(run: Run, capsys: pytest.CaptureFixture[str]):
    assert run("your_own_hand") == 0
    assert "claw: 6 joints" in capsys.readouterr().out


def test_loss_weights(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "mine.yaml").write_text("closed_form: {weights: {distance: 2.0}}\n")
    assert run("loss_weights", "shape:box", "mine.yaml") == 0
    out = capsys.readouterr().out
    assert "unknown key 'speed'" in out
    assert [line.split()[0] for line in out.splitlines()[-3:]] == ["fast", "gentle", "yours"]


def test_your_own_metric(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    # The row that the example adds is for this test only.
    monkeypatch.setitem(graspd_core.METRICS, "contact_offset", None)
    assert run("your_own_metric", "shape:box") == 0
    best = json.loads((tmp_path / "grasps.json").read_text())["grasps"][0]
    assert 0 < best["metrics"]["contact_offset_mm"] < 100


def test_many_objects(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "meshes").mkdir()
    graspd_core.save_mesh(graspd_core.make_shape("sphere"), tmp_path / "meshes" / "ball.stl")
    for ending in ("succeeded", "done before"):
        assert run("many_objects", "out", "meshes", "nothing.obj", processes=1) == 1
        lines = capsys.readouterr().out.splitlines()
        assert lines[0].endswith(f"verified  meshes/ball.stl: {ending}")
        assert lines[1].endswith("nothing.obj: no such mesh file")
    assert (tmp_path / "out" / "objects.csv").read_text().startswith("object,verified,ending\nmeshes/ball.stl,4,")


def test_somebody_elses_grasp(run: Run, capsys: pytest.CaptureFixture[str]):
    assert run("try_your_grasp") == 1
    verdicts = [line.split(": ")[1].split(";")[0] for line in capsys.readouterr().out.splitlines()]
    assert verdicts == ["verified", "verified", "verified", "failed"]


def test_examples_are_short():
    lengths = {path.name: len(path.read_text().splitlines()) for path in EXAMPLES.glob("*.py") if path.stem != "demo"}
    assert len(lengths) == 10
    assert {name: n for name, n in lengths.items() if not 40 <= n <= 80} == {}
