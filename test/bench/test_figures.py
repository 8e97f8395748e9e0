"""From records to figures, tables, comparisons and the front."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from graspd_bench import tables
from graspd_bench.figures import (
    by_name,
    comparison,
    is_few,
    moves,
    parent_of,
    pareto_front,
    per_verified,
    rows,
    share_interval,
    short_name,
    spread,
)
from graspd_bench.suites import DECADES
from graspd_core.errors import ConfigError
from graspd_core.verify.metrics import METRICS, Metric

# Small whole numbers, so that points are often equal on an axis.
POINTS = arrays(np.float64, st.tuples(st.integers(1, 12), st.integers(1, 3)), elements=st.integers(0, 5).map(float))

SUMMARY = """\
| preset | held | held, hard | SD cm | penetration mm | contact area cm² | CPU s per grasp | CPU s per verified |
|---|---|---|---|---|---|---|---|
| `fast` | 50% | 25% | 0.30 | 2.00 | 20.0 | 0.5 | 2.5 |
| `balanced` | 62% | 38% | 0.25 | 1.75 | 20.0 | 0.5 | 2 |"""

PLANNED = """\
| preset | verified | first verified CPU s, median (worst) | first verified s | CPU s per verified | rounds | peak MB |
|---|---|---|---|---|---|---|
| `balanced` | 8/8 | 4.00 (4.00) | 8 | 2 | 2 | 600 |"""


def test_a_grasp_that_was_not_found_counts_as_failed(record):
    (row,) = rows([record()])
    assert (row.count, row.held) == (4, 2)
    assert row.values["standard"] == 0.5
    assert row.values["hard"] == 0.25
    assert row.values["noisy"] is None
    assert row.values["sd_cm"] == 0.3
    assert row.values["penetration_mm"] == pytest.approx(2.0)
    assert row.values["cpu_per_grasp"] == 0.5
    assert row.values["cpu_with_scene"] == 0.75
    assert row.values["cpu_per_verified"] == 2.5
    assert row.values["first_wall"] == 8.0


def test_the_first_page_has_presets_that_people_plan_with_and_the_users_own():
    names = ("balanced", "mine", "robust", "closed_form_no_patches", "steps=90", "hand:leap_right")
    assert [is_few(name) for name in names] == [True, True, False, False, False, False]


def test_a_share_has_wilsons_interval_and_one_object_the_quartiles_of_its_grasps(record):
    assert share_interval(10, 10) == pytest.approx((10 / (10 + 1.96**2), 1.0))
    assert share_interval(0, 10) == pytest.approx((0.0, 1.96**2 / (10 + 1.96**2)))
    low, high = share_interval(8, 16)
    assert low + high == pytest.approx(1.0)
    one = spread(rows([record()]), "sd_cm")
    assert one is not None
    # Of 0.1, 0.3 and 9 cm.
    assert (one.low, one.median, one.high) == pytest.approx((0.2, 0.3, 4.65))


def test_a_method_that_found_nothing_failed_the_trials_that_were_run(record):
    _, row = rows([record(), record(thing="mug", given=0, held=0, grasps=[], first_verified=None)])
    assert row.values["standard"] == row.values["hard"] == 0.0
    assert row.values["noisy"] is row.values["sd_cm"] is row.values["cpu_per_verified"] is None


def test_without_the_standard_trial_nothing_is_said_of_it(record):
    hard = [{"hard": {"passed": True}}, {"hard": {"passed": False}}]
    objects = tables.object_tables([record(count=2, given=2, held=0, grasps=hard)])
    assert "| object | held, hard | CPU s per grasp |" in objects
    assert "| box | 50% | 1 |" in objects
    untried = record("hand:leap_right", count=2, given=2, grasps=hard)
    del untried["held"]
    assert (
        tables.hands_table([untried])
        == "| hand | held, hard | CPU s per grasp |\n|---|---|---|\n| `leap_right` | 50% | 1 |"
    )
    setting, values = DECADES[0][2:]
    table = tables.decades_sections([{**untried, "name": f"{setting}={values[0]:g}"}], None)["decades"][0]
    assert f"| `{setting}` |{' – |' * len(values)}" in str(table)


def test_what_the_means_leave_out_is_said(record):
    full = [record(), record(thing="mug"), record("fast"), record("fast", thing="mug")]
    assert tables.missing(full) == ""
    assert tables.missing(full[:3]) == "Means are over 2 objects, but `fast` of 1 only."
    raised = tables.provenance("graspd bench main", [*full[:3], record("fast", thing="mug", error="died")])
    assert raised.endswith("1 cases failed and are in no figure.")


def test_seeds_are_pooled_and_cells_that_raised_left_out(record):
    found = rows([record(seed=0), record(seed=1, held=4), record("fast"), record("worse", error="died")])
    assert [(row.name, row.count, row.held) for row in found] == [("balanced", 8, 6), ("fast", 4, 2)]
    assert set(by_name(found)) == {"balanced", "fast"}


def test_the_spread_is_over_objects(record):
    found = rows([record(thing=f"{held}", held=held, cpu={"optimise": float(held)}) for held in (0, 1, 2, 3, 4)])
    over = spread(found, "cpu_per_grasp")
    assert over is not None
    assert (over.low, over.median, over.high, over.mean, over.objects) == (0.25, 0.5, 0.75, 0.5, 5)
    assert spread(found, "noisy") is None


def test_an_object_on_which_nothing_held_makes_verified_grasps_dearer(record):
    found = rows([record(thing="easy"), record(thing="hard", held=0)])
    assert per_verified(found) == 5.0
    assert per_verified(found[1:]) is None


def test_the_tables_are_these(record, planned):
    four = [record()["grasps"][i] for i in (0, 1, 0, 2)]
    records = [record("fast"), record(), record(thing="mug", held=3, grasps=four), planned(), record("steps=90")]
    assert tables.summary_table(records) == SUMMARY
    assert tables.planned_table(records) == PLANNED
    silent = tables.planned_table([planned(rounds=0)])
    assert silent == PLANNED.replace("| 2 | 600 |", "| – | 600 |"), "a method that sends no progress has unknown rounds"
    objects = tables.object_tables(records)
    assert "| mug | 3/4 | 50% | 0.20 | 1.50 | 20.0 | – |" not in objects, "columns without figures are left out"
    assert "| mug | 3/4 | 50% | 0.20 | 1.50 | 20.0 | 8 | 0.5 | 1.67 |" in objects
    assert objects.count("| **mean** |") == 2


def test_area_over_volume_is_none_where_nothing_is_shared(record):
    def shared(ratio: float | None) -> list[dict]:
        return [{"metrics": {"contact_area": 2e-3, "contact_area_5mm": 4e-3, "contact_per_volume": ratio}}]

    some, none = rows([record(grasps=shared(5000.0)), record(thing="mug", grasps=shared(None))])
    assert some.values["contact_per_volume_per_cm"] == pytest.approx(50.0)
    assert some.values["contact_area_5mm_cm2"] == pytest.approx(40.0)
    assert none.values["contact_per_volume_per_cm"] is None


def test_a_metric_of_the_registry_has_a_column(record, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(METRICS, "height", Metric("height", "mm", 1e3, None, "z of the base link", 1))
    grasps = [{"standard": {"passed": True}, "metrics": {"height": 0.25}}]
    table = tables.object_tables([record(count=1, given=1, held=1, grasps=grasps)])
    assert "| object | held | height mm | CPU s per grasp |" in table
    assert "| box | 1/1 | 250.0 |" in table


def test_documents_get_their_sections_and_keep_the_rest(tmp_path: Path, record):
    document = tmp_path / "page.md"
    spoken_of = "fills `<!-- bench:begin -->` and others"
    document.write_text(
        f"{spoken_of}\n<!-- bench:begin -->\nold\n<!-- bench:end -->\nafter <!-- bench-ladder:begin --> none\n"
    )
    sections = tables.sourced(
        "graspd bench main", [record()], tables.main_sections([record()], tmp_path / "figures" / "bench")
    )
    assert list(sections) == ["bench", "bench-all", "bench-objects"], "what has no figures has no section"
    assert tables.fill(document, sections) == ["bench"]
    text = document.read_text()
    picture = "![Speed against accuracy](figures/bench_short.png)"
    assert text.startswith(f"{spoken_of}\n<!-- bench:begin -->\n{picture}\n\n| preset |")
    source = (
        "Made 2026-11-22 by `graspd bench main` at commit 1234567 (code 0.1.0+abc): 1 cases, 0 CPU minutes on 2 cores."
    )
    assert f"\n\n{source}\n<!-- bench:end -->" in text
    assert text.endswith("\n<!-- bench:end -->\nafter <!-- bench-ladder:begin --> none\n")
    assert "old" not in text
    document.write_text("no sections")
    with pytest.raises(ConfigError, match="none of the sections bench, bench-all"):
        tables.fill(document, sections)
    with pytest.raises(ConfigError, match="No such file"):
        tables.fill(tmp_path / "nowhere.md", {})


def test_a_comparison_shows_what_moved_and_only_that(record, planned):
    old = [record(), record(thing="mug"), record("fast"), planned()]
    assert comparison(old, old) == "nothing moved"
    slower = {"scene": 1.0, "optimise": 4.0, "standard": 3.0}
    new = [record(), record(thing="mug", cpu=slower), record("accurate"), planned(first_verified=None)]
    moved = {(m.kind, m.name, m.object, m.figure): (m.old, m.new) for m in moves(old, new)}
    assert moved[("raw", "balanced", "mug", "cpu_per_grasp")] == (0.5, 1.0)
    assert moved[("raw", "balanced", "all", "cpu_per_grasp")] == (0.5, 0.75)
    assert moved[("verified", "balanced", "box", "first_cpu")] == (4.0, None)
    assert not any(thing == "box" and kind == "raw" for kind, _, thing, _ in moved)
    table = comparison(old, new)
    assert "+100%" in table
    assert "only in the old run: 1 (raw fast box)" in table
    assert "only in this run: 1 (raw accurate box)" in table


@given(POINTS)
def test_the_front_is_what_nothing_beats(points: np.ndarray):
    front = pareto_front(points)

    def beaten(point: np.ndarray) -> bool:
        return any((other <= point).all() and (other < point).any() for other in points)

    assert front.any()
    assert [not beaten(point) for point in points] == front.tolist()


def test_ablations_know_what_they_are_ablations_of():
    assert parent_of("closed_form_hard_contact") == "balanced"
    assert parent_of("graspd2022_no_leak") == "graspd2022_repaired"
    assert parent_of("graspd2022_short") is parent_of("fast") is None
    assert short_name("graspd2022_no_leak") == "no leak"
    assert short_name("random_closure") == "random_closure"
