"""Stress cases: named once, refused inputs refused in one line, endings weighed, and a table that hides no fault."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from graspd_bench.result_store import head, write_record
from graspd_bench.run_studies import Job, run_cases
from graspd_bench.stress import stress_cases
from graspd_bench.stress.run_stress_case import GRASP, StressEnding, faults, run_case
from graspd_bench.stress.stress_cases import CASES, StressRun, ending_of, stress_runs
from graspd_bench.study import Request
from graspd_core.cli import main
from graspd_core.cli.running import EXIT_BAD_INPUT, EXIT_OK
from graspd_core.errors import ConfigError
from graspd_core.types import Outcome

BOX, NAN = CASES["open-box"], CASES["nan-vertices"]
GRASPED = StressEnding("open-box", GRASP, "open | closed", 0.5, 2.4, 400.0, 3, 2, 2)


def test_cases_are_named_once_and_expect_endings_that_there_are():
    import graspd_core.errors as errors

    known = {GRASP, *(outcome.name for outcome in Outcome), *vars(errors)}
    assert len(CASES) > 80
    assert all(case.name == name and set(case.expect) <= known for name, case in CASES.items())
    assert all(GRASP in case.expect for case in CASES.values() if case.whole)


@pytest.mark.parametrize("name", ["nan-vertices", "no-object", "half-out-of-view"])
def test_what_shows_nothing_or_a_part_is_refused_in_one_line(name: str):
    # What it took is the study's to say: this process holds what other tests left, and is not alone on the machine.
    ending = replace(run_case(CASES[name], "fast"), loading=0.0, planning=0.0, memory=0.0)
    assert faults(CASES[name], ending) == ()
    assert "\n" not in ending.message
    assert "; ;" not in ending.message


def test_faults_are_named():
    case = replace(CASES["open-box"], deadline=2.0, loading=1.0, memory=500.0)
    fine = StressEnding("open-box", GRASP, "", 0.5, 2.4, 400.0, 3, 2, 2)
    assert faults(case, fine) == ()
    for changed, word in (
        ({"ending": "crash", "message": "boom"}, "ended in crash"),
        ({"planning": 2.6}, "deadline"),
        ({"loading": 1.1}, "loaded"),
        ({"memory": 501.0}, "MB"),
        ({"again": 1}, "second trial"),
        ({"finite": False}, "not finite"),
    ):
        (fault,) = faults(case, replace(fine, **changed))
        assert word in fault


@pytest.mark.timeout(120)
def test_a_case_ends_in_a_process_of_its_own_and_leaves_nothing_on_disk(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    job = Job("stress", StressRun("too-wide", "fast"), stress_cases.run_stress, "here", alone=True)
    ((_, record),) = run_cases([job], tmp_path / "out", 1)
    assert ending_of(record).ending in CASES["too-wide"].expect
    assert 100 < ending_of(record).memory < CASES["too-wide"].memory
    assert not (tmp_path / "cache" / "graspd").exists()


@pytest.mark.parametrize(("failed", "ending"), [("died", "crash"), ("raised", "crash"), ("hung", "hang")])
def test_a_process_that_failed_is_an_ending_that_nobody_expects(failed: str, ending: str):
    record: dict[str, Any] = {"name": "open-box", "failed": failed, "error": "RuntimeError: gone"}
    assert ending_of(record) == StressEnding("open-box", ending, "RuntimeError: gone")
    assert stress_cases.stress_faults(record)[0].startswith(f"ended in {ending}, not in grasp: RuntimeError")


def test_cases_are_chosen_by_name_and_family():
    assert [run.name for run in stress_runs(Request())] == list(CASES)
    assert {run.name for run in stress_runs(Request(cases=("hand", "empty")))} >= {"empty", "too-wide"}
    many, none = (stress_cases.stress_patience(StressRun(name, "fast")) for name in ("ten-million-points", "empty"))
    assert many > none
    with pytest.raises(ConfigError, match="unknown case 'broken'; valid: cloud, hand, mesh, numbers, physics, all-at"):
        stress_runs(Request(cases=("broken",)))


def test_the_table_shows_what_came_of_each_case_and_the_summary_every_fault():
    wrong = StressEnding("nan-vertices", GRASP, "", 0.1, 30.0, 300.0, 2, 1, 0)
    told = stress_cases.summary({BOX: GRASPED, NAN: wrong})
    assert told.startswith("Cases: 2. Faults: 4. mesh: 1 of 1 (100%) with something to grasp end in a verified grasp.")
    assert "2 of 3 verified grasps hold in a second trial." in told
    for fault in ("ended in grasp, not in MeshError", "planned 30.0 s at", "1 of 1 verified", "the message lacks"):
        assert f"* `nan-vertices`: {fault}" in told
    table = stress_cases.stress_table({BOX: GRASPED, NAN: wrong})
    assert f"| `open-box` | {BOX.about} | grasp | 0.5 | 2.4 | 400 | 2/3 | 2 | – | open \\| closed |" in table
    assert "**grasp**" in table


def test_the_command_reports_kept_endings_and_fills_a_document(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run = StressRun("open-box", "balanced")
    write_record(tmp_path, "stress", run, {**head("stress", run, "here"), **asdict(GRASPED)})
    page = tmp_path / "page.md"
    sections = ("stress-summary", "stress")
    page.write_text("".join(f"<!-- {name}:begin -->\nbygone\n<!-- {name}:end -->\n" for name in sections))
    command = ["bench", "stress", "--no-run", "--out", str(tmp_path)]
    (tmp_path / "none.md").write_text("no section")
    assert main([*command, "--readme", str(tmp_path / "none.md"), "--readme", str(page)]) == EXIT_BAD_INPUT
    assert "none.md: has none of the sections stress-summary, stress" in capsys.readouterr().err
    assert "bygone" not in page.read_text(), "the other page is filled all the same"
    assert main([*command, "--readme", str(page)]) == EXIT_OK
    assert "Cases: 1. Faults: 0." in capsys.readouterr().out
    assert "Cases: 1. Faults: 0." in page.read_text()
    assert "by `graspd bench stress` at commit" in page.read_text()
    assert "open-box" in page.read_text()
    assert "bygone" not in page.read_text()
