"""What a cell is kept under, and that its record appears whole or not at all."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from graspd_core.bench import result_store as store
from graspd_core.bench.measurements import run_measurement as run
from graspd_core.bench.measurements.measurement import Cell, cell_file, cell_key, code_version
from graspd_core.bench.suites import SUITES, SuiteRequest, cells_of, find_objects
from graspd_core.errors import ConfigError, GraspdError, MeshError
from graspd_core.mesh.mesh_files import save_mesh
from graspd_core.mesh.shapes import make_shape
from graspd_core.methods.method_registry import METHODS
from graspd_core.methods.plan_config import PlanConfig, load_preset, override, to_mapping
from graspd_core.types import TriangleMesh

CELL = Cell("raw", "balanced", PlanConfig(), "shape:box", "f00", "allegro_right", "f11", 0, 4, ("standard", "hard"))


@pytest.mark.parametrize(
    "changes",
    [
        {"kind": "verified"},
        {"name": "other"},
        {"object_hash": "f01"},
        {"hand_hash": "f12"},
        {"seed": 1},
        {"count": 5},
        {"trials": ("standard",)},
        {"settings": PlanConfig(resolution=32)},
        {"settings": override(PlanConfig(), {"closed_form.weights.wrench_resistance": 2.0})},
    ],
    ids=lambda changes: ", ".join(changes),
)
def test_the_key_tells_cells_apart_that_ask_for_different_things(changes: dict[str, Any]):
    other = replace(CELL, **changes)
    assert cell_key(other) != cell_key(CELL)
    assert cell_file(other) != cell_file(CELL)


def test_the_key_does_not_depend_on_what_is_not_looked_at():
    assert cell_key(replace(CELL, trials=("hard", "standard"))) == cell_key(CELL)
    assert cell_key(replace(CELL, source="elsewhere/box.obj")) == cell_key(CELL)
    assert set(to_mapping(override(PlanConfig(), {"method": "graspd2022"}))) & set(METHODS) == {"graspd2022"}


def test_a_file_name_is_for_the_eye_and_safe():
    name = cell_file(replace(CELL, name="steps=180", source="scans/odd name?.obj"))
    assert name.startswith("raw-steps=180-odd_name_-seed0-")
    assert name.endswith(".json")


def test_the_code_has_a_version_and_a_hash_of_its_sources():
    released, digest = code_version().split("+")
    assert released
    assert len(digest) == 12


def test_a_finished_cell_is_found_again_only_under_its_code(tmp_path: Path):
    written = {**run.asked(CELL, "1+a"), "held": 3}
    store.write_cell(tmp_path, CELL, written)
    assert store.read_cell(tmp_path, CELL, "1+a") == written
    assert store.read_cell(tmp_path, CELL, None) == written
    assert store.read_cell(tmp_path, CELL, "1+b") is None
    assert store.read_cells(tmp_path, [CELL, replace(CELL, seed=1)], "1+a") == {CELL: written}


@pytest.mark.parametrize("text", ["", '{"key": ', "[1, 2]", '{"key": "other"}'])
def test_half_a_file_is_no_finished_cell(tmp_path: Path, text: str):
    (tmp_path / cell_file(CELL)).write_text(text)
    assert store.read_cell(tmp_path, CELL, None) is None


def test_a_write_that_fails_leaves_the_old_file_and_no_other(tmp_path: Path):
    old = run.asked(CELL, "1+a")
    store.write_cell(tmp_path, CELL, old)
    with pytest.raises(ValueError, match="JSON"):
        store.write_cell(tmp_path, CELL, {**old, "figure": float("nan")})
    with pytest.raises(UnicodeEncodeError):
        store.save_text(tmp_path / cell_file(CELL), "half\ud800")
    assert store.read_cell(tmp_path, CELL, "1+a") == old
    assert len(list(tmp_path.iterdir())) == 1


def test_a_cell_that_raises_is_a_record_with_its_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    def fail(cell: Cell) -> dict[str, Any]:
        raise ZeroDivisionError(f"of {cell.object}")

    monkeypatch.setattr(run, "KINDS", {"raw": fail})
    record = run.run_cell(CELL, "1+a")
    assert record["error"] == "ZeroDivisionError: of box"
    assert "in fail" in record["traceback"]
    store.write_cell(tmp_path, CELL, record)
    assert store.read_cell(tmp_path, CELL, "1+a") is None, "it is run again next time"


def test_an_object_that_cannot_be_grasped_is_a_cell_with_nothing_held(tmp_path: Path):
    box = make_shape("box")
    save_mesh(TriangleMesh(box.vertices * 10, box.faces), tmp_path / "crate.ply")
    config, source = load_preset("random_closure"), str(tmp_path / "crate.ply")
    record = run.run_cell(replace(CELL, settings=config, source=source, count=1, trials=("standard",)), "1+a")
    assert (record["error"], record["held"], record["first_verified"]) == ("", 0, None)
    assert len(record["grasps"]) == record["given"] <= record["asked"]
    assert record["peak_mb"] > 10.0
    json.dumps(record, allow_nan=False)


def test_records_hold_nothing_that_json_does_not_know():
    assert run.finite({"a": [float("inf"), 1.0, (float("nan"), "x")], 2: None}) == {
        "a": [None, 1.0, [None, "x"]],
        "2": None,
    }


def test_results_are_read_back_and_other_files_refused(tmp_path: Path):
    cells = [{**run.asked(CELL, "1+a"), "held": 3}]
    path = tmp_path / "results.json"
    store.write_results(path, cells)
    assert store.read_results(path) == cells
    for text, culprit in (
        ("{}", "not a graspd/bench file"),
        ("x", "not JSON"),
        (json.dumps({"format": store.FORMAT}), "version None"),
    ):
        path.write_text(text)
        with pytest.raises(GraspdError, match=culprit):
            store.read_results(path)
    with pytest.raises(GraspdError, match="No such file"):
        store.read_results(tmp_path / "nowhere.json")


def test_every_suite_makes_cells_of_its_own(tmp_path: Path):
    for name in SUITES:
        cells = cells_of([name], SuiteRequest(quick=True))
        assert len({cell_key(cell) for cell in cells}) == len(cells) > 0
    both = cells_of(["main", "ladder", "main"], SuiteRequest(seeds=(0, 1)))
    assert len({cell_key(cell) for cell in both}) == len(both)


def test_objects_are_shapes_files_and_folders(tmp_path: Path):
    for name in ("b", "a"):
        save_mesh(make_shape("box"), tmp_path / f"{name}.obj")
    (tmp_path / "notes.txt").write_text("no mesh")
    found = find_objects(("shape:mug", str(tmp_path)))
    assert [Path(thing.source).name for thing in found] == ["shape:mug", "a.obj", "b.obj"]
    assert found[1].sha256 == found[2].sha256 != found[0].sha256
    with pytest.raises(MeshError, match="two objects are called 'a'"):
        find_objects((str(tmp_path), str(tmp_path / "a.obj")))


def test_an_override_names_what_it_does_not_know():
    assert override(PlanConfig(), {"problem.candidates": 7, "resolution": 9}).problem.candidates == 7
    with pytest.raises(ConfigError, match="unknown key 'speed'; valid keys: closed_form"):
        override(PlanConfig(), {"speed": 1})
