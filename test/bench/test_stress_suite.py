"""The stress suite: cases in processes of their own, endings that outlive a kill, and a table that hides no fault."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from graspd_core.bench.stress import stress_suite as suite
from graspd_core.bench.stress.run_stress_case import StressEnding
from graspd_core.bench.stress.stress_case import GRASP
from graspd_core.bench.stress.stress_cases import CASES
from graspd_core.bench.stress.stress_suite import EndingStore, cases_of, run_cases
from graspd_core.bench.stress.stress_table import stress_table, summary
from graspd_core.cli import main
from graspd_core.cli.running import EXIT_BAD_INPUT, EXIT_OK
from graspd_core.errors import ConfigError

BOX, NAN = CASES["open-box"], CASES["nan-vertices"]
GRASPED = StressEnding("open-box", GRASP, "open | closed", 0.5, 2.4, 400.0, 3, 2, 2)


def test_a_case_ends_in_a_process_of_its_own_and_a_death_is_an_ending(tmp_path: Path):
    store = EndingStore(tmp_path, "fast", "here")
    nobody = replace(NAN, name="not-a-case")
    endings = {case.name: ending for case, ending in run_cases([NAN, nobody], store, processes=2)}
    assert endings["nan-vertices"].ending == "MeshError"
    assert "nan-vertices.obj: 3 of " in endings["nan-vertices"].message
    assert endings["not-a-case"].ending == "crash"
    assert endings["not-a-case"].message.startswith("exit status 2; ")
    assert "not-a-case" in endings["not-a-case"].message
    assert store.read(NAN) == (endings["nan-vertices"], "here")


def test_nothing_of_a_case_is_remembered_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Else it would load faster the second time."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    ((_, ending),) = run_cases([CASES["too-wide"]], EndingStore(tmp_path, "fast", "here"), processes=1)
    assert ending.ending in CASES["too-wide"].expect
    assert not (tmp_path / "cache" / "graspd").exists()


def test_a_process_that_does_not_end_is_killed_and_called_hung(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(suite, "_PATIENCE", 0.0)
    hasty = replace(BOX, loading=0.1, deadline=0.1)
    ((_, ending),) = run_cases([hasty], EndingStore(tmp_path, "fast", "here"), processes=1)
    assert ending.ending == "hang"


def test_nothing_is_begun_once_stopped(tmp_path: Path):
    assert list(run_cases([NAN], EndingStore(tmp_path, "fast", "here"), 1, stop=lambda: True)) == []
    assert not list(tmp_path.iterdir())


def test_an_ending_counts_for_its_code_and_preset_alone(tmp_path: Path):
    EndingStore(tmp_path, "fast", "here").write(GRASPED, BOX)
    assert EndingStore(tmp_path, "fast", "here").read(BOX) == (GRASPED, "here")
    assert EndingStore(tmp_path, "fast", "there", any_code=True).read(BOX) == (GRASPED, "here")
    assert EndingStore(tmp_path, "fast", "there").read(BOX) is None
    assert EndingStore(tmp_path, "balanced", "here").read(BOX) is None
    path = EndingStore(tmp_path, "fast", "here").path(BOX)
    path.write_text(json.dumps({**json.loads(path.read_text()), "ending": {"odd": 1}}))
    assert EndingStore(tmp_path, "fast", "here").read(BOX) is None


def test_cases_are_chosen_by_name_and_family():
    assert cases_of(()) == tuple(CASES.values())
    assert {case.name for case in cases_of(["hand", "empty"])} >= {"empty", "too-wide"}
    with pytest.raises(ConfigError, match="unknown case 'broken'; valid: cloud, hand, mesh, numbers, physics, all-at"):
        cases_of(["broken"])


def test_the_table_shows_what_came_of_each_case_and_the_summary_every_fault():
    wrong = StressEnding("nan-vertices", GRASP, "", 0.1, 30.0, 300.0, 2, 1, 0)
    told = summary({BOX: GRASPED, NAN: wrong})
    assert told.startswith("2 cases, 4 faults. mesh: 1 of 1 (100%) with something to grasp end in a verified grasp.")
    assert "2 of 3 verified grasps hold in a second trial." in told
    for fault in ("ended in grasp, not in MeshError", "planned 30.0 s at", "1 of 1 verified", "the user does not read"):
        assert f"* `nan-vertices`: {fault}" in told
    table = stress_table({BOX: GRASPED, NAN: wrong})
    assert f"| `open-box` | {BOX.about} | grasp | 0.5 | 2.4 | 400 | 2/3 | 2 | – | open \\| closed |" in table
    assert "**grasp**" in table


def test_the_command_reports_kept_endings_and_fills_a_document(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    EndingStore(tmp_path, "balanced", "here").write(GRASPED, BOX)
    page = tmp_path / "page.md"
    sections = ("stress-summary", "stress")
    page.write_text("".join(f"<!-- {name}:begin -->\nbygone\n<!-- {name}:end -->\n" for name in sections))
    command = ["bench", "--suite", "stress", "--no-run", "--out", str(tmp_path), "--readme", str(page)]
    assert main(command) == EXIT_OK
    assert "1 cases, 0 faults." in capsys.readouterr().out
    assert "1 cases, 0 faults." in page.read_text()
    assert "Preset `balanced`; code here." in page.read_text()
    assert "open-box" in page.read_text()
    assert "bygone" not in page.read_text()


@pytest.mark.parametrize(
    ("options", "culprit"),
    [
        (["--suite", "stress", "--suite", "main"], "stress is run by itself"),
        (["--cases", "empty"], "stress is run by itself"),
        (["--suite", "stress", "--cases", "broken"], "unknown case 'broken'; valid: "),
        (["--suite", "stress", "--presets", "fast", "balanced"], "one at a time"),
        (["--suite", "stress", "--presets", "best"], "unknown preset 'best'"),
    ],
)
def test_bad_options_are_named_in_one_line(options: list[str], culprit: str, capsys: pytest.CaptureFixture[str]):
    assert main(["bench", *options]) == EXIT_BAD_INPUT
    err = capsys.readouterr().err
    assert culprit in err
    assert err.count("\n") == 1
