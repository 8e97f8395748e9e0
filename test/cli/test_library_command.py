"""`graspd library`: built, gone on with, listed; what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from graspd_core import TriangleMesh, make_shape
from graspd_core.cli import main
from graspd_core.mesh.mesh_files import save_mesh

FEW = ["-n", "2", "--preset", "fast"]


def build(out: Path, *words: str) -> int:
    return main(["library", "build", *words, "--out", str(out), *FEW])


def test_a_library_is_built_gone_on_with_and_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "known.grasps"
    assert build(out, "shape:sphere") == 0
    assert "sphere: 2 of 2 grasps" in capsys.readouterr().out
    assert build(out, "shape:sphere", "--scales", "1", "0.9") == 0
    told = capsys.readouterr().out
    assert "sphere: 2 grasps are there" in told
    assert "sphere@0.9: 2 of 2 grasps" in told
    assert main(["library", "list", str(out)]) == 0
    rows = capsys.readouterr().out.splitlines()
    assert [row.split()[:4] for row in rows[:2]] == [
        ["sphere", "allegro_right", "2", "grasps"],
        ["sphere@0.9", "allegro_right", "2", "grasps"],
    ]
    assert rows[2] == f"{out}: 2 records, 4 grasps"
    # A mesh that cannot be used keeps no other from being added.
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "bad.obj").write_text("v 0 0 0\n")
    save_mesh(make_shape("capsule"), tmp_path / "meshes" / "capsule.obj")
    assert build(out, str(tmp_path / "meshes")) == 3
    told = capsys.readouterr()
    assert "capsule: 2 of 2 grasps" in told.out
    assert "bad.obj" in told.err


def test_an_object_that_would_go_by_the_name_of_another_is_refused(tmp_path: Path, capsys):
    out, mesh = tmp_path / "known.grasps", make_shape("sphere")
    for folder, size in (("a", 1.0), ("b", 0.9)):
        (tmp_path / folder).mkdir()
        save_mesh(TriangleMesh(mesh.vertices * size, mesh.faces), tmp_path / folder / "ball.obj")
    assert build(out, str(tmp_path / "a" / "ball.obj")) == 0
    assert build(out, str(tmp_path / "b" / "ball.obj")) == 2
    told = capsys.readouterr().err
    assert "has another 'ball', of" in told
    assert "give one of the files another name" in told


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["build", "shape:sphere"], "--out"),
        (["build", "shape:nothing", "--out", "new.grasps"], "shape"),
        (["build", "shape:sphere", "--out", "new.grasps", "--verify", "none"], "verify: none"),
        (["build", "shape:sphere", "--out", "other.grasps"], "other.grasps: torn or no library"),
        (["list", "none.grasps"], "none.grasps: no such file"),
        (["list", "other.grasps"], "other.grasps: torn or no library"),
    ],
)
def test_what_cannot_be_done_is_told_in_one_line(tmp_path: Path, monkeypatch, capsys, words: list[str], told: str):
    monkeypatch.chdir(tmp_path)
    Path("other.grasps").write_text("some other file\n" * 100)
    assert main(["library", *words]) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
    assert not Path("new.grasps").exists()
