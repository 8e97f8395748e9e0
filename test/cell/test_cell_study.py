"""The study of bins: which cases there are, what is told of them, and that the referee's word counts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graspd_bench.result_store import case_file, case_key
from graspd_bench.run_studies import Job, run_job
from graspd_bench.study import Record, Request
from graspd_cell.cell_study import DEVELOPED_ON, PAIRS, SIZES, STUDY, AttemptWatch, CellCase, cell_cases, cell_sections
from graspd_cell.picker import Attempt, Ending
from graspd_cell.simulated_robot import SimulatedRobot
from graspd_core.errors import ConfigError
from graspd_core.mesh.mesh_files import save_mesh
from graspd_core.mesh.shapes import make_shape


def test_cases_differ_and_no_thing_of_theirs_was_developed_on():
    small, whole = (cell_cases(Request(quick=quick)) for quick in (True, False))
    assert 0 < len(small) < len(whole)
    assert {(case.pair, case.size) for case in whole} == {(pair, size) for pair in PAIRS for size in SIZES}
    for name_of in (case_key, case_file):
        assert len({name_of("cell", case) for case in whole}) == len(whole)
    for case in whole:
        sources = case.sources()
        assert len(sources) == case.size
        assert all(int(source.source.rsplit(":", 1)[1]) > DEVELOPED_ON for source in sources)
        assert sources == replace(case).sources()
    many = CellCase(PAIRS[0], 20, 100, "balanced").sources()
    assert len(set(many)) == 20


def test_a_case_that_there_is_not_is_named():
    assert [(c.pair, c.size) for c in cell_cases(Request(cases=("2", PAIRS[2]), seeds=(7,)))] == [(PAIRS[2], 2)]
    for wrong in ("0", "25", "gripper"):
        with pytest.raises(ConfigError, match=f"cases: '{wrong}'; valid: 1 to 24 things, or a pair such as ur5e_like"):
            cell_cases(Request(cases=(wrong,)))
    with pytest.raises(ConfigError, match="unknown thing"):
        cell_cases(Request(objects=("nowhere",)))


def test_a_changed_mesh_is_another_case(tmp_path: Path):
    (tmp_path / "masses.csv").write_text("name,mass_kg\nthing,0.2\n")
    keys = set()
    for shape in ("box", "mug"):
        save_mesh(tmp_path / "thing.obj", make_shape(shape))
        (case,) = cell_cases(Request(objects=(str(tmp_path),), cases=("1", PAIRS[2]), seeds=(7,)))
        keys.add(case_key("cell", case))
    assert len(keys) == 2


def _attempt(place: np.ndarray, ending: Ending) -> Attempt:
    return Attempt(
        number=1, ending=ending, reason="", place=place, verified=True, probability=0.9, tries=0,
        graspd_seconds=1.0, closing_seconds=3.0, seconds=8.0, things=2,
    )  # fmt: skip


def test_what_the_referee_saw_counts_and_not_what_the_picker_says(robot_of: Callable[..., SimulatedRobot]):
    robot = robot_of("ur5e_like", "parallel_gripper", "family:pear:0", "shape:box")
    robot.wait(1.0)
    watch = AttemptWatch(robot)
    pear, box = (pose[:3, 3].copy() for pose in robot.thing_poses())
    lied = watch.note(_attempt(pear, Ending.PICKED), 0.5)
    assert (lied["target"], lied["out"], lied["ending"]) == ("pear 0", [], "picked")
    watch.about_to_look()
    address = robot.world.thing_qpos[1]
    robot._data.qpos[address : address + 2] = robot.world.layout.place.center
    robot.wait(0.2)
    lost = watch.note(_attempt(box, Ending.LOST_CARRYING), 0.5)
    assert (lost["target"], lost["out"], lost["astray"]) == ("box", ["box"], [])
    robot._data.qpos[address] = 5.0
    robot.wait(1.0)
    watch.about_to_look()
    robot._data.qpos[robot.world.thing_qpos[0] + 1] = 9.0
    robot.wait(1.0)
    assert watch.note(_attempt(pear, Ending.NOT_GRIPPED), 0.5)["astray"] == ["pear 0"]


def test_an_object_over_the_wall_of_its_bin_is_the_target_of_its_grasp(robot_of: Callable[..., SimulatedRobot]):
    robot = robot_of("ur5e_like", "parallel_gripper", "shape:box")
    robot._data.qpos[robot.world.thing_qpos[0]] += robot.world.layout.pick.half + 0.1
    robot.step()
    watch = AttemptWatch(robot)
    assert robot.referee().places["box"] == "table"
    assert watch.note(_attempt(robot.thing_poses()[0][:3, 3], Ending.NOT_GRIPPED), 0.5)["target"] == "box"


def _record(pair: str, **changed: object) -> Record:
    base = {
        "ending": "picked", "target": "a", "out": ["a"], "astray": [], "hard": {}, "tries": 0,
        "verified": True, "probability": 0.9, "graspd_cpu": 1.0, "graspd_seconds": 1.5,
        "closing_seconds": 3.0, "seconds": 8.0,
    }  # fmt: skip
    failed = {**base, "ending": "lost while lifting", "target": "b", "out": [], "probability": 0.6}
    failed["hard"] = {"hand on table": 60.0}
    unreached = {**base, "ending": "no way for the arm", "target": "b", "out": [], "tries": 1, "closing_seconds": 0.0}
    return {
        "pair": pair,
        "size": 3,
        "dropped": {"a": "pick bin", "b": "pick bin", "c": "table"},
        "ended": {"a": "place bin", "b": "pick bin", "c": "table"},
        "fits": {"a": True, "b": False, "c": True},
        "attempts": [base, failed, unreached],
        **changed,
    }


def test_the_tables_count_what_they_say():
    table, curve, endings, times = map(str, cell_sections([_record(PAIRS[0])], None)["cell"])
    row = [cell.strip() for cell in table.splitlines()[2].strip("|").split("|")]
    assert row == [
        PAIRS[0], "3", "2", "1", "1 (100 %)", "1 (50 %)", "0", "3", "1 (50 %)", "1 (33 %)", "2", "1 (50 %)",
    ]  # fmt: skip
    assert "| 0.5 to 0.7 | 1 | 0.60 | 0 (0 %) |" in curve
    assert "| 0.85 to 0.95 | 1 | 0.90 | 1 (100 %) |" in curve
    assert "| no way for the arm | no | 1 |" in endings
    assert "from there to the closed hand 3.0 s" in times
    assert STUDY.summary(_record(PAIRS[0])) == "1 of 2 out in 3 attempts"
    # A thing that moved from the table to the floor is one thing.
    strayed = _record(PAIRS[0], ended={"a": "place bin", "b": "lost", "c": "table"})
    strayed["attempts"] = [{**attempt, "astray": ["b"]} for attempt in strayed["attempts"]]
    assert str(cell_sections([strayed], None)["cell"][0]).splitlines()[2].split("|")[7].strip() == "1"


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_small_bin_ends_in_a_record_and_a_section():
    case = cell_cases(Request(quick=True))[0]
    record = run_job(Job("cell", case, STUDY.run, "1+a"))
    assert (record["error"], STUDY.faults(record)) == ("", ())
    assert record["attempts"]
    assert "can be held" in str(STUDY.sections([record], None)["cell"][0])
