"""Every study: its cases differ, its smallest run ends in a record, and its report fills its sections."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

from graspd_bench.result_store import case_file, case_key
from graspd_bench.run_studies import Job, make_plan, run_job, studies_of
from graspd_bench.studies.human_hand import SOFTNESS
from graspd_bench.study import Request
from graspd_bench.study_registry import STUDIES
from graspd_bench.tables import sourced, written
from graspd_core.errors import ConfigError
from graspd_core.runtime.records import code_version

ROOT = Path(__file__).parents[2]
# Of each the marker of a section that its report fills, and the page that has it; their smallest runs take seconds.
PAGES = {
    "main": ("bench", "README.md"),
    "rgbd": ("rgbd", "docs/clouds.md"),
    "piles": ("piles", "docs/clouds.md"),
    "robust": ("robust", "docs/stress.md"),
    "steered": ("steered", "docs/usage.md"),
    "early": ("early-ends", "docs/bench.md"),
    "throughput": ("throughput", "docs/bench.md"),
    "reach": ("inverse-kinematics", "docs/arms.md"),
    "simulators": ("simulators", "docs/metrics.md"),
    "stress": ("stress", "docs/stress.md"),
    "decades": ("decades", "docs/stress.md"),
    "hands": ("bench-hands", "docs/hands.md"),
}


@pytest.mark.parametrize("name", [name for name, study in STUDIES.items() if study.usual])
def test_cases_differ_and_a_small_run_has_fewer(name: str):
    study = STUDIES[name]
    small, whole = (study.cases(Request(quick=quick)) for quick in (True, False))
    assert 0 < len(small) < len(whole)
    for cases in (small, whole):
        assert len({case_key(name, case) for case in cases}) == len(cases)
        assert len({case_file(name, case) for case in cases}) == len(cases)
        assert all(study.seconds(case) > 0 for case in cases)


def test_all_of_them_fit_into_eighty_minutes_on_two_cores():
    seconds = sum(study.seconds(case) for study in STUDIES.values() if study.usual for case in study.cases(Request()))
    assert seconds / 2 < 80 * 60


def test_every_source_that_a_study_names_is_there():
    folder = ROOT / "graspd_core" / "bench"
    assert all(list(folder.glob(source)) for study in STUDIES.values() for source in study.sources)
    assert len({code_version(study.sources) for study in STUDIES.values()}) == len(
        {s.sources for s in STUDIES.values()}
    )


def test_every_page_that_a_study_fills_is_filled_by_make_bench():
    (row,) = re.findall(r"^PAGES := (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    named = {Path(word.strip("$()")).name for word in re.split(r"[\s,]+", row)}
    assert {Path(page).name for _, page in PAGES.values()} <= named
    for marker, page in PAGES.values():
        assert f"<!-- {marker}:begin -->" in (ROOT / page).read_text(), page


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


def test_an_option_that_no_study_looks_at_is_named(tmp_path: Path):
    with pytest.raises(ConfigError, match="trials: maps does not look at it; valid: cases, quick"):
        make_plan(studies_of(["maps"]), Request(trials=("hard",)), tmp_path)
    both = make_plan(studies_of(["maps", "main", "maps"]), Request(trials=("hard",), quick=True), tmp_path)
    assert {job.study for job in both.jobs} == {"maps", "main"}


def test_what_needs_the_user_s_files_says_so():
    assert "frames" not in studies_of(["all"])
    with pytest.raises(ConfigError, match="objects: no"):
        STUDIES["frames"].cases(Request())
    with pytest.raises(ConfigError, match="hand: none given; valid: MANO_RIGHT"):
        STUDIES["mano"].cases(Request())
