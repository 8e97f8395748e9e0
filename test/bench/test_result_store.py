"""What a record is kept under, that it appears whole or not at all, and how a failure is written down."""

import importlib
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

import graspd_core
from graspd_bench import result_store as store
from graspd_bench.measurement import Cell, run_cell
from graspd_bench.run_studies import ENVIRONMENT, Job, run_cases, run_job
from graspd_bench.study import Case, find_objects, held_of
from graspd_core import TriangleMesh, make_shape, save_mesh
from graspd_core.errors import GraspdError, MeshError
from graspd_core.optimize.plan_config import METHODS, PlanConfig, load_preset, override, to_mapping
from graspd_dataset import run_records
from graspd_viewer.bench_page import page_data

CELL = Cell("raw", "balanced", PlanConfig(), "shape:box", "allegro_right", 0, 4, ("standard", "hard"))


# A module of its own, which processes import by its name.
ERRANDS = """
import os, time
from dataclasses import dataclass
from graspd_bench.run_studies import ENVIRONMENT
from graspd_bench.study import Case

@dataclass(frozen=True)
class Errand(Case):
    what: str

def do(errand):
    if errand.what == "end":
        os._exit(7)
    if errand.what == "sleep":
        time.sleep(600)
    if errand.what == "raise":
        raise ZeroDivisionError("of\\n nothing")
    return {"environment": {name: os.environ.get(name) for name in ENVIRONMENT}, "odd": float("inf")}
"""


@pytest.fixture
def job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Job]:
    """Makes a job of what a process is to do: "end", "sleep", "raise", or tell its environment."""
    (tmp_path / "errands.py").write_text(ERRANDS)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "errands", raising=False)
    errands = importlib.import_module("errands")
    return lambda what, **settings: Job("errands", errands.Errand(what), errands.do, "1+a", **settings)


@pytest.mark.parametrize(
    "changes",
    [
        {"kind": "verified"},
        {"name": "other"},
        {"object": "shape:mug"},
        {"hand": "leap_right"},
        {"seed": 1},
        {"count": 5},
        {"trials": ("standard",)},
        {"settings": PlanConfig(resolution=32)},
        {"settings": override(PlanConfig(), {"closed_form.weights.wrench_resistance": 2.0})},
    ],
    ids=lambda changes: ", ".join(changes),
)
def test_the_key_tells_cases_apart_that_ask_for_different_things(changes: dict[str, Any]):
    other = replace(CELL, **changes)
    assert store.case_key("main", other) != store.case_key("main", CELL) != store.case_key("hands", CELL)
    assert store.case_file("main", other) != store.case_file("main", CELL)


def test_the_key_does_not_depend_on_what_is_not_looked_at(tmp_path: Path):
    key = store.case_key("main", CELL)
    assert store.case_key("main", replace(CELL, trials=("hard", "standard"))) == key
    assert set(to_mapping(override(PlanConfig(), {"method": "graspd2022"}))) & set(METHODS) == {"graspd2022"}
    for folder in ("here", "there"):
        (tmp_path / folder).mkdir()
        save_mesh(tmp_path / folder / "thing.obj", make_shape("box"))
    here, there = (replace(CELL, object=str(tmp_path / folder / "thing.obj")) for folder in ("here", "there"))
    assert store.case_key("main", here) == store.case_key("main", there) != key


def test_objects_hands_and_presets_count_by_their_content(tmp_path: Path):
    @dataclass(frozen=True)
    class Plain(Case):
        object: str
        preset: str

    def keys(name: str, mesh: TriangleMesh, resolution: int) -> str:
        folder = tmp_path / name
        folder.mkdir()
        save_mesh(folder / "thing.obj", mesh)
        (folder / "mine.yaml").write_text(f"resolution: {resolution}\n")
        asked = Plain(str(folder / "thing.obj"), str(folder / "mine.yaml")).inputs()
        return json.dumps({**asked, "preset": ""})

    first = keys("a", make_shape("box"), 32)
    assert keys("b", make_shape("box"), 32) == first
    assert keys("c", make_shape("mug"), 32) != first
    assert keys("d", make_shape("box"), 48) != first


def test_a_file_name_is_for_the_eye_and_safe():
    name = store.case_file("main", replace(CELL, name="steps=180", object="shape:mug"))
    assert name.startswith("main-raw_steps=180_mug_seed_0-")
    assert name.endswith(".json")


def test_the_code_is_of_the_package_the_kernel_and_what_a_study_names(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    released, digest = run_records.code_version().split("+")
    assert released
    assert len(digest) == 12
    assert store.bench_version(("stress/*.py",)) != store.bench_version(()) != run_records.code_version()
    root = tmp_path / "graspd_core"
    for file in ("runtime/disk_cache.py", "optimize/kernel/src/step.cpp", "cli/run.py"):
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).write_text("1")
    monkeypatch.setattr(graspd_core, "__file__", str(root / "__init__.py"))
    fresh = run_records.code_version.__wrapped__
    before = fresh()
    (root / "cli" / "run.py").write_text("2")
    assert fresh() == before
    (root / "optimize" / "kernel" / "src" / "step.cpp").write_text("2")
    assert fresh() != before
    plugin = tmp_path / "mine.py"
    monkeypatch.setenv("GRASPD_PLUGINS", str(plugin))
    versions = [fresh() for text in ("1", "2", "1") if plugin.write_text(text)]
    assert versions[0] == versions[2] != versions[1]


def test_a_finished_case_is_found_again_only_under_its_code(tmp_path: Path):
    written = {**store.head("main", CELL, "1+a"), "held": 3}
    store.write_record(tmp_path, "main", CELL, written)
    assert store.read_record(tmp_path, "main", CELL, "1+a") == written
    assert store.read_record(tmp_path, "main", CELL, None) == written
    assert store.read_record(tmp_path, "main", CELL, "1+b") is None
    assert store.read_record(tmp_path, "main", replace(CELL, seed=1), None) is None


@pytest.mark.parametrize("text", ["", '{"key": ', "[1, 2]", '{"key": "other"}'])
def test_half_a_file_is_no_finished_case(tmp_path: Path, text: str):
    (tmp_path / store.case_file("main", CELL)).write_text(text)
    assert store.read_record(tmp_path, "main", CELL, None) is None


def test_a_write_that_fails_leaves_the_old_file_and_no_other(tmp_path: Path):
    old = store.head("main", CELL, "1+a")
    store.write_record(tmp_path, "main", CELL, old)
    with pytest.raises(UnicodeEncodeError):
        store.save_text(tmp_path / store.case_file("main", CELL), "half\ud800")
    assert store.read_record(tmp_path, "main", CELL, "1+a") == old
    assert len(list(tmp_path.iterdir())) == 1


def test_what_raises_is_a_record_with_its_error_and_runs_again(tmp_path: Path, job):
    record = run_job(failing := job("raise"))
    assert (record["failed"], record["error"]) == ("raised", "ZeroDivisionError: of nothing")
    assert "in do" in record["traceback"]
    store.write_record(tmp_path, "errands", failing.case, record)
    assert store.read_record(tmp_path, "errands", failing.case, None) is None
    assert store.read_record(tmp_path, "errands", failing.case, None, failed=True) == record


@pytest.mark.timeout(120)
def test_a_death_and_a_hang_cost_their_case_only(tmp_path: Path, job):
    jobs = [job(what, alone=True, patience=2.0 if what == "sleep" else 600.0) for what in ("end", "sleep", "tell")]
    records = {done.case: record for done, record in run_cases(jobs, tmp_path / "out", 3)}
    died, hung, told = (records[wanted.case] for wanted in jobs)
    assert (died["failed"], died["error"]) == ("died", "RuntimeError: its process died with exit code 7")
    assert (hung["failed"], hung["error"]) == ("hung", "TimeoutError: did not end within 2 s")
    assert told["environment"] == ENVIRONMENT
    assert told["odd"] is None, "JSON knows no infinity"
    kept = [store.read_record(tmp_path / "out", "errands", wanted.case, "1+a", failed=True) for wanted in jobs]
    assert kept == [died, hung, told]


def test_a_run_without_the_standard_trial_does_not_say_that_nothing_held():
    cell = replace(CELL, settings=load_preset("fast"), object="shape:sphere", count=1, trials=("gravity",))
    record = run_job(Job("main", cell, run_cell, "1+a"))
    assert record["grasps"][0]["gravity"]["displacement_cm"] >= 0.0
    assert "held" not in record
    assert held_of(record) == "measured"
    (run,) = page_data([record])["runs"]
    assert run["held"] is None
    assert [grasp["held"] for grasp in run["grasps"]] == [None]


def test_nothing_is_begun_once_stopped(tmp_path: Path, job):
    assert list(run_cases([job("tell")], tmp_path / "out", 1, stop=lambda: True)) == []
    assert not (tmp_path / "out").exists()


def test_an_object_that_cannot_be_grasped_is_a_cell_with_nothing_held(tmp_path: Path):
    box = make_shape("box")
    save_mesh(tmp_path / "crate.ply", TriangleMesh(box.vertices * 10, box.faces))
    cell = replace(CELL, settings=load_preset("random_closure"), object=str(tmp_path / "crate.ply"), count=1)
    record = run_job(Job("main", replace(cell, trials=("standard",)), run_cell, "1+a"))
    assert (record["error"], record["held"], record["first_verified"]) == ("", 0, None)
    assert len(record["grasps"]) == record["given"] <= record["count"]
    assert record["peak_mb"] > 10.0
    json.dumps(record, allow_nan=False)


def test_results_are_read_back_and_other_files_refused(tmp_path: Path):
    records = [{**store.head("main", CELL, "1+a"), "held": 3}]
    path = tmp_path / "results.json"
    store.write_results(path, records)
    assert store.read_results(path) == records
    for text, culprit in (
        ("{}", "not a graspd/bench file"),
        ("x", "not JSON"),
        (json.dumps({"format": store.FORMAT}), "version None"),
        (json.dumps({"format": store.FORMAT, "version": store.VERSION}), "its records are incomplete"),
        (json.dumps({"format": store.FORMAT, "version": store.VERSION, "records": [1]}), "its records are incomplete"),
    ):
        path.write_text(text)
        with pytest.raises(GraspdError, match=culprit):
            store.read_results(path)
    with pytest.raises(GraspdError, match="No such file"):
        store.read_results(tmp_path / "nowhere.json")


def test_objects_are_shapes_files_and_folders(tmp_path: Path):
    for name in ("b", "a"):
        save_mesh(tmp_path / f"{name}.obj", make_shape("box"))
    (tmp_path / "notes.txt").write_text("no mesh")
    found = find_objects(("shape:mug", str(tmp_path)))
    assert [Path(source).name for source in found] == ["shape:mug", "a.obj", "b.obj"]
    with pytest.raises(MeshError, match="share the name 'a'; rename one of them"):
        find_objects((str(tmp_path), str(tmp_path / "a.obj")))
