"""Every study ends in records and sections; `graspd bench` resumes after a kill and names what is wrong in one line."""

import os
import re
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from graspd_bench import run_studies
from graspd_bench.result_store import bench_version, case_file, case_key, read_results
from graspd_bench.run_studies import Job, make_plan, run_job, studies_of
from graspd_bench.studies.human_hand import SOFTNESS
from graspd_bench.study import Record, Request
from graspd_bench.study_registry import STUDIES
from graspd_bench.suites import main_suite
from graspd_bench.tables import sourced, written
from graspd_core.cli import main
from graspd_core.cli.running import EXIT_INTERRUPTED, EXIT_OK
from graspd_core.errors import ConfigError
from graspd_core.mesh.mesh_files import save_mesh
from graspd_core.mesh.shapes import make_shape

ROOT = Path(__file__).parents[2]

# Of each the marker of a section that its report fills, and the page that has it; their smallest runs take seconds.
PAGES = {
    "main": ("bench", "README.md"),
    "rgbd": ("rgbd", "docs/tables/clouds.md"),
    "cameras": ("cameras", "docs/tables/clouds.md"),
    "robust": ("robust", "docs/tables/stress.md"),
    "steered": ("steered", "docs/usage.md"),
    "early": ("early-ends", "docs/tables/bench.md"),
    "throughput": ("throughput", "docs/tables/bench.md"),
    "reach": ("inverse-kinematics", "docs/arms.md"),
    "simulators": ("simulators", "docs/metrics.md"),
    "stress": ("stress", "docs/tables/stress.md"),
    "decades": ("decades", "docs/tables/stress.md"),
    "hands": ("bench-hands", "docs/hands.md"),
}


@pytest.mark.parametrize("name", PAGES)
def test_the_page_of_a_study_has_its_section_and_is_filled(name: str):
    marker, page = PAGES[name]
    assert f"\n<!-- {marker}:begin -->\n" in (ROOT / page).read_text()
    if STUDIES[name].usual:
        makefile = (ROOT / "Makefile").read_text().partition("PAGES := ")[2].partition("\n")[0]
        assert page.removeprefix("docs/") in re.findall(r"[\w/]+\.md", makefile)


@pytest.mark.parametrize("name", [name for name, study in STUDIES.items() if study.usual])
def test_cases_differ_and_a_small_run_has_fewer(name: str):
    study = STUDIES[name]
    small, whole = (study.cases(Request(quick=quick)) for quick in (True, False))
    assert 0 < len(small) < len(whole)
    for cases in (small, whole):
        assert len({case_key(name, case) for case in cases}) == len(cases)
        assert len({case_file(name, case) for case in cases}) == len(cases)
        assert all(study.seconds(case) > 0 for case in cases)


@pytest.mark.parametrize("name", ["main", "hands", "robust", "early", "steered"])
def test_a_seed_that_is_given_twice_counts_once(tmp_path: Path, name: str):
    plans = [make_plan(studies_of([name]), Request(seeds=seeds, quick=True), tmp_path) for seeds in ((0,), (0, 0))]
    assert plans[0].jobs == plans[1].jobs


def test_all_of_them_fit_into_eighty_minutes_on_two_cores():
    seconds = sum(study.seconds(case) for study in STUDIES.values() if study.usual for case in study.cases(Request()))
    assert seconds / 2 < 80 * 60


def test_every_source_that_a_study_names_is_there():
    folder = ROOT / "graspd_bench"
    assert all(list(folder.glob(source)) for study in STUDIES.values() for source in study.sources)
    assert len({bench_version(study.sources) for study in STUDIES.values()}) == len(
        {s.sources for s in STUDIES.values()}
    )


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", [name for name in PAGES if name != "main"])
def test_the_smallest_run_ends_in_a_record_and_fills_its_section(name: str, tmp_path: Path):
    pytest.importorskip("pybullet") if name == "simulators" else None
    study = STUDIES[name]
    record = run_job(Job(name, study.cases(Request(quick=True))[0], study.run, "1+a"))
    assert record["error"] == ""
    assert study.faults(record) == ()
    sections = sourced(f"graspd bench {name}", [record], study.sections([record], tmp_path / "bench"))
    assert f"by `graspd bench {name}` at commit" in written(sections[PAGES[name][0]])


def test_a_human_hand_is_measured_rigid_and_with_flesh_that_gives(tmp_path: Path):
    file = tmp_path / "MANO_RIGHT.pkl"
    runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "mano_synthetic.py"))["write_synthetic"](file, 0)
    study = STUDIES["mano"]
    cases = study.cases(Request(hand=str(file), objects=("shape:sphere",), seeds=(0,), presets=("fast",), count=2))
    assert [vars(case)["softness"] for case in cases] == list(SOFTNESS)
    jobs = [Job("mano", case, study.run, "1+a") for case in cases]
    records = [run_job(job) for job in jobs]
    assert [record["error"] for record in records] == ["", ""]
    (table,) = study.sections(records, None)["mano"]
    names = [line.split(" | ")[0].strip("| ") for line in str(table).splitlines()[2:6]]
    assert names == ["sphere, rigid", "**mean**, rigid", "sphere, 1 mm", "**mean**, 1 mm"]


def test_a_plan_without_verified_grasps_costs_time_in_the_throughput():
    def plan(thing: str, verified: int, wall: float) -> Record:
        return {"object": thing, "threads": 1, "verified": verified, "tried": 20, "wall_s": wall, "cpu_s": wall}

    records = [plan("shape:mug", 10, 1.0), plan("shape:mug", 0, 4.0), plan("shape:box", 0, 1.0)]
    lines = str(STUDIES["throughput"].sections(records, None)["throughput"][0]).splitlines()[2:]
    assert lines == ["| mug | 4.00 | 2.0 | 500.0 | – | – |", "| box | – | 0.0 | – | – | – |", lines[2]]


def test_an_option_that_no_study_looks_at_is_named(tmp_path: Path):
    with pytest.raises(ConfigError, match="trials: not used by maps; valid: cases, quick"):
        make_plan(studies_of(["maps"]), Request(trials=("hard",)), tmp_path)
    both = make_plan(studies_of(["maps", "main", "maps"]), Request(trials=("hard",), quick=True), tmp_path)
    assert {job.study for job in both.jobs} == {"maps", "main"}


def test_scans_count_by_content_and_need_a_mass(tmp_path: Path):
    cameras, scan = STUDIES["cameras"], tmp_path / "thing.obj"

    def key() -> str:
        return case_key("cameras", cameras.cases(Request(objects=(str(scan),), seeds=(100,)))[-1])

    save_mesh(scan, make_shape("box"))
    (tmp_path / "stats.csv").write_text("name,mass_kg\nother,0.3\n")
    with pytest.raises(ConfigError, match=r"no mass of thing\.obj; its csv files name other; columns"):
        key()
    (tmp_path / "stats.csv").write_text("name,mass_kg\nthing,0.3\n")
    keys = [key()]
    (tmp_path / "stats.csv").write_text("name,mass_kg\nthing,0.4\n")
    keys.append(key())
    save_mesh(scan, make_shape("mug"))
    assert len({*keys, key()}) == 3
    with pytest.raises(ConfigError, match=r"objects: shape:mug; valid: mesh files in a folder with a csv of masses"):
        cameras.cases(Request(objects=("shape:mug",)))


def test_what_needs_the_user_s_files_says_so():
    assert "frames" not in studies_of(["all"])
    with pytest.raises(ConfigError, match="objects: no"):
        STUDIES["frames"].cases(Request())
    with pytest.raises(ConfigError, match="hand: none given; valid: the path of MANO_RIGHT"):
        STUDIES["mano"].cases(Request())


GRASPD = [sys.executable, "-m", "graspd_core.cli", "bench"]


def test_a_preset_of_ones_own_is_planned_with_and_nothing_else_that_was_not_asked_for(tmp_path: Path):
    (tmp_path / "own.yaml").write_text("rounds: {growth: 1.5}\n")
    presets = ("balanced", "random_closure", str(tmp_path / "own.yaml"))
    cells = main_suite(Request(presets=presets, objects=("shape:box",)))
    assert [cell.name for cell in cells if cell.kind == "verified"] == ["balanced", "own"]


def test_two_presets_of_one_name_are_refused_because_their_counts_would_be_summed(tmp_path: Path):
    (tmp_path / "balanced.yaml").write_text("rounds: {growth: 1.5}\n")
    with pytest.raises(ConfigError, match=r"presets: balanced, .*balanced.yaml; valid: presets of different names"):
        main_suite(Request(presets=("balanced", str(tmp_path / "balanced.yaml")), objects=("shape:box",)))


def test_the_standard_trial_runs_first_and_once_because_it_times_the_first_grasp():
    cells = main_suite(Request(presets=("fast",), objects=("shape:box",), trials=("hard", "standard", "standard")))
    assert cells[0].trials == ("standard", "hard")


# Two cells of a few seconds, whose method does next to nothing.
SMALL = ["--presets", "random_closure", "--objects", "shape:sphere", "--count", "2", "--trials", "standard"]
BAD: list[tuple[list[str], str]] = [
    (["--presets", "best"], "unknown preset 'best'; valid: accurate, "),
    (["--suite", "tall"], "unknown study 'tall'; did you mean 'all'?"),
    (["--trials", "standard,gentle"], "unknown trial 'gentle'; valid: standard, hard, "),
    (["--processes", "0"], "processes: 0; valid: 1 or more"),
    (["--compare", "nowhere.json"], "nowhere.json: No such file"),
    (["--cases", "empty"], "cases: not used by main; valid: "),
    (["stress", "--cases", "broken"], "unknown case 'broken'; valid: "),
    (["--suite", "stress", "--presets", "fast", "balanced"], "one at a time"),
    (["--frobnicate"], "unrecognized arguments: --frobnicate"),
]


@pytest.mark.parametrize(("options", "culprit"), BAD, ids=lambda value: str(value)[:40])
def test_a_bad_option_is_named_in_one_line(tmp_path, refusal_of, options, culprit):
    assert culprit in refusal_of("bench", "--out", tmp_path / "out", *options)
    assert not (tmp_path / "out").exists()


def test_an_empty_folder_of_objects_and_a_file_for_a_folder_are_named(tmp_path, refusal_of):
    (tmp_path / "none").mkdir()
    line = refusal_of("bench", "--objects", tmp_path / "none")
    assert "none: no mesh in this folder; valid endings: dae" in line
    (tmp_path / "file").write_text("")
    assert "cannot be written" in refusal_of("bench", *SMALL, "--out", tmp_path / "file" / "out")


def test_cells_that_raise_are_named_at_the_end_and_the_others_kept(tmp_path, record, monkeypatch, capsys):
    def run(jobs: Sequence[Job], folder: Path, processes: int, stop: Any):
        for job in jobs:
            case: Any = job.case
            error = "ValueError: odd" if case.seed else ""
            yield job, record(case.name, "sphere", seed=case.seed, kind=case.kind, error=error)

    monkeypatch.setattr(run_studies, "run_cases", run)
    assert main(["bench", *SMALL, "--seeds", "0", "1", "--out", str(tmp_path)]) == 1
    out, err = capsys.readouterr()
    assert "graspd: failed: main raw random_closure sphere seed 1: ValueError: odd" in err
    assert "graspd: 2 cases, about 0 minutes on 1 idle cores" in err
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
    assert f"{len(before)} of 3 cases had finished in earlier runs" in done.stderr
    assert {name: finished(tmp_path)[name] for name in before} == before
    cells = read_results(tmp_path / "results.json")
    assert sorted(cell["seed"] for cell in cells) == [0, 1, 2]
    again = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert "3 of 3 cases had finished in earlier runs" in again.stderr
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
    assert f"interrupted; {kept} of 40 cases are finished" in errors
