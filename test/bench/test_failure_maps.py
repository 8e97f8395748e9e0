"""Failure maps and charts: cells, records, what is counted from them, and pictures that are the same every time."""

import re
from collections import Counter
from dataclasses import asdict, replace
from itertools import combinations, product
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from graspd_bench import charts, failure_maps
from graspd_bench.failure_maps import COUNT, MAPS, METHODS, MapAxis, MapCase, cases_of, draw_map, map_cases, shares
from graspd_bench.figures import by_name, rows
from graspd_bench.rendering.depth_noise import DEFAULT, NONE
from graspd_bench.studies.robust_ranking import draw_robust
from graspd_bench.study import Request
from graspd_core import Method, load_hand
from graspd_core.optimize.closed_form.closed_form_config import ClosedFormConfig
from graspd_core.optimize.plan_config import METHODS as ALL_METHODS

TINY = MapCase("size", "random_closure", "sphere", 0.2, ("sphere",), 1, 0)


def records_of(name: str, method: str, held: int) -> list[dict[str, Any]]:
    """Records of all cases of a map, `held` grasps of each cell holding."""
    return [
        {
            "error": "",
            **asdict(case),
            "cells": [{"up": up, "held": held, "reasons": {"the object moved": case.count - held}} for up in case.up],
        }
        for case in cases_of(name, method)
    ]


@pytest.mark.parametrize("name", MAPS)
@pytest.mark.parametrize("method", METHODS)
def test_jobs_cover_every_cell_once(name: str, method: str):
    drawn, asked = MAPS[name], Counter()
    for case in cases_of(name, method):
        for up in case.up:
            asked[case.across, up] += case.count
    assert asked == dict.fromkeys(product(drawn.across.places, drawn.up.places), COUNT)
    assert len(asked) <= 36


def test_every_seed_has_every_case():
    asked = map_cases(Request(cases=("wall",)))
    once = [case for method in METHODS for case in cases_of("wall", method)]
    assert Counter(asked) == Counter(replace(case, seed=seed) for case in once for seed in failure_maps.SEEDS)
    assert len({case.label for case in asked}) == len(asked)
    assert {case.seed for case in map_cases(Request(cases=("wall",), seeds=(5,)))} == {5}


def test_a_real_case_leaves_a_record():
    record = failure_maps.run_map(TINY)
    (cell,) = record["cells"]
    assert cell["up"] == "sphere"
    assert cell["held"] + sum(cell["reasons"].values()) == TINY.count


def test_a_refused_scene_loses_all_grasps_and_says_why():
    done = failure_maps.run_on(failure_maps.run_size, replace(TINY, thing="teapot", up=("a", "b")))
    assert [(cell["up"], cell["held"]) for cell in done] == [("a", 0), ("b", 0)]
    for cell in done:
        ((reason, count),) = cell["reasons"].items()
        assert reason.startswith("no scene: unknown shape 'teapot'")
        assert count == TINY.count


def test_shares_and_reasons_are_of_all_objects_together():
    records = [
        {"across": 1.0, "count": 4, "cells": [{"up": 2.0, "held": 4, "reasons": {}}]},
        {"across": 1.0, "count": 4, "cells": [{"up": 2.0, "held": 1, "reasons": {"fell": 2, "turned": 1}}]},
    ]
    assert shares(records) == {(1.0, 2.0): 5 / 8}
    assert failure_maps.reasons(records) == Counter(fell=2, turned=1)


def test_the_report_names_every_failure_and_draws_what_there_is(tmp_path: Path):
    sections = failure_maps.map_sections(records_of("wall", "closed_form", COUNT - 1), tmp_path / "bench")
    assert list(sections) == ["map-wall", "map-failures"]
    assert (tmp_path / "map_wall.png").is_file()
    (table,) = sections["map-failures"]
    failed = len(cases_of("wall", "closed_form"))
    assert f"| wall and grid | closed_form (preset balanced) | {failed} the object moved |" in str(table)
    assert "| wall and grid | graspd2022 (preset graspd2022_short) | no failure |" in str(table)


def test_pictures_show_what_is_recorded_and_are_the_same_every_time(tmp_path: Path):
    from matplotlib.image import imread

    panels = {m: shares(records_of("wall", m, held)) for m, held in (("closed_form", COUNT), ("graspd2022", 0))}
    draw_map(MAPS["wall"], panels, tmp_path / "one")
    draw_map(MAPS["wall"], panels, tmp_path / "two")
    for ending in ("png", "svg"):
        assert (tmp_path / f"one.{ending}").read_bytes() == (tmp_path / f"two.{ending}").read_bytes()
    picture = imread(tmp_path / "one.png")[..., :3]
    # Cividis ends in yellow and begins in dark blue: one panel is of each.
    yellow = (picture[..., 0] > 0.9) & (picture[..., 1] > 0.8) & (picture[..., 2] < 0.4)
    blue = (picture[..., 0] < 0.1) & (picture[..., 2] > 0.25) & (picture[..., 2] < 0.45)
    half = picture.shape[1] // 2
    for panel, colour in ((np.s_[:, :half], yellow), (np.s_[:, half : int(0.85 * 2 * half)], blue)):
        assert colour[panel].mean() > 0.3
    assert "<!-- 100 -->" in (tmp_path / "one.svg").read_text()


def test_rows_of_which_nothing_is_known_are_left_out_and_a_map_without_any_is_drawn_empty(tmp_path: Path):
    panels: dict[str, failure_maps.Shares] = {"some": {(x, "box"): 0.5 for x in MAPS["size"].across.places}}
    draw_map(MAPS["size"], panels, tmp_path / "part")
    said = (tmp_path / "part.svg").read_text()
    assert "<!-- box -->" in said
    assert "<!-- sphere -->" not in said
    drawn = replace(MAPS["size"], across=MapAxis("x", (1.0,)), up=MapAxis("y", ("box",)))
    assert draw_map(drawn, {"none": {}}, tmp_path / "empty").is_file()


def test_the_span_of_a_gripper_is_its_opening():
    # Jaws of 12 mm that open to 140 mm: from the middle of the one to that of the other.
    hand = load_hand("parallel_gripper")
    assert failure_maps.hand_span(hand) == pytest.approx(0.152, abs=0.003)
    assert 0.25 < failure_maps.hand_span(failure_maps.hand_for("allegro_right", 600)) < 0.45


def test_noise_grows_from_none_over_a_camera_s_to_more():
    assert failure_maps.noise_at(0.0) == NONE
    assert failure_maps.noise_at(1.0) == DEFAULT
    loud = failure_maps.noise_at(4.0)
    assert loud.quadratic == 4 * DEFAULT.quadratic
    assert loud.flying == 1.0
    assert loud.grazing == DEFAULT.grazing


def test_another_grid_leaves_the_shape_alone():
    cup = failure_maps.cup(0.3)
    coarse, fine = (failure_maps.on_grid(cup, nodes) for nodes in (8, 32))
    assert float(coarse.sdf.spacing) > 3.9 * float(fine.sdf.spacing)
    assert coarse.object is cup.object


ENDS = ("_short", "_planned", "_ladder")


@pytest.fixture
def records(record):
    names = [
        "fast",
        "balanced",
        "accurate",
        "closed_form_hard_contact",
        "random_closure",
        "candidates=64",
        "candidates=128",
    ]
    return [
        record(name, thing, cpu={"scene": 1.0, "optimise": 1.0 + i, "standard": 3.0}, held=(i + j) % 4)
        for i, name in enumerate(names)
        for j, thing in enumerate(("box", "mug", "bowl"))
    ]


def test_charts_are_written_and_not_blank(tmp_path: Path, records, planned):
    from matplotlib.image import imread

    drawn = charts.draw_charts([*records, planned(), planned("fast")], tmp_path / "deep" / "chart")
    assert {png.name for png in drawn.values()} == {f"chart{end}.png" for end in ("", *ENDS)}
    for name in ("chart", *(f"chart{end}" for end in ENDS)):
        picture = imread(tmp_path / "deep" / f"{name}.png")[..., :3]
        assert picture.shape[1] > 400
        inked = (np.abs(picture - 1.0) > 0.1).any(-1)
        assert 0.005 < inked.mean() < 0.5, name
        assert ElementTree.parse(tmp_path / "deep" / f"{name}.svg").getroot().tag.endswith("svg")


def test_a_comparison_says_what_it_is_of_and_names_nothing_that_is_absent(tmp_path: Path, record):
    # All that were asked for held: the axis ends at 100 %.
    all_held = {"given": 4, "held": 4, "grasps": 4 * record()["grasps"][:1]}
    own = [record("balanced", **all_held), record("mine", **all_held, cpu={"optimise": 2.02, "standard": 3.0})]
    drawn = charts.draw_charts([*own, record("robust")], tmp_path / "chart")
    chart, short = (drawn[name].with_suffix(".svg").read_text() for name in ("speed", "short"))
    for text in ("allegro_right; box", "n = 4 grasps a preset; bars: quartiles over grasps", "closed form"):
        assert text in chart
    assert "<!-- ablation -->" not in chart
    percents = [float(text) for text in re.findall(r"<!-- ([\d.]+) -->", chart)]
    assert max(percents) == 100.0
    # The preset that held less, of which the axis goes farther down, is not among the few.
    assert ("<!-- 40 -->" in chart, "<!-- 40 -->" in short) == (True, False)
    one = charts.draw_charts([record("balanced")], tmp_path / "one")["speed"].with_suffix(".svg").read_text()
    assert "<!-- Pareto front -->" not in one
    ablation = charts.draw_charts([record("balanced"), record("closed_form_no_patches")], tmp_path / "two")["speed"]
    assert "<!-- ablation -->" in ablation.with_suffix(".svg").read_text()


def test_ticks_of_a_narrow_axis_stand_apart(tmp_path: Path):
    with charts.figure(4.5, 4.5) as (made, axis):
        axis.plot([0.0266, 0.0284], [1.0, 2.0], "o")
        axis.set_xscale("log")
        axis.margins(0.18)
        charts._few_ticks(axis.xaxis)
        made.canvas.draw()
        boxes = [t.get_window_extent() for t in axis.get_xticklabels(which="both") if t.get_text() and t.get_visible()]
    assert 2 <= len(boxes) <= 6
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))


def test_the_same_figures_draw_the_same_chart(tmp_path: Path, records):
    presets = by_name(rows(records[:9]))
    for name in ("one", "two"):
        charts.draw_speed(presets, tmp_path / name)
    for ending in ("png", "svg"):
        assert (tmp_path / f"one.{ending}").read_bytes() == (tmp_path / f"two.{ending}").read_bytes()


def test_nothing_to_draw_is_no_chart(tmp_path: Path, record):
    assert charts.draw_charts([record(kind="pace")], tmp_path / "chart") == {}
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("shapes", [["mug"], ["mug", "box", "mug"]])
def test_the_chart_of_the_ranking_has_a_bar_for_each_shape_and_a_curve_for_each_order(tmp_path: Path, shapes):
    costs = {"plan_cpu_s": 2.0, "ranked_plan_cpu_s": 3.0}
    found = [{"shape": shape, "shares": [0.5, 1.0], "ranked_by": [0.25, 0.75], **costs} for shape in shapes]
    assert draw_robust(found, tmp_path / "robust") == tmp_path / "robust.png"
    drawing = (tmp_path / "robust.svg").read_text()
    for text in ("ranked by score", "ranked by noisy trials", "CPU seconds for 2 verified grasps"):
        assert f"<!-- {text} -->" in drawing
    assert [shape for shape in ("mug", "box", "bowl") if f"<!-- {shape} -->" in drawing] == list(dict.fromkeys(shapes))


def test_labels_keep_clear_of_each_other():
    points = [(1.0 + 0.01 * i, 1.0 + 0.02 * (i % 3)) for i in range(8)]
    with charts.figure(4.5, 4.5) as (made, axis):
        axis.plot(*zip(*points, strict=True), "o")
        charts.place_labels(axis, points, [f"a preset {i}" for i in range(8)], ["black"] * 8)
        made.canvas.draw()
        boxes = [text.get_window_extent() for text in axis.texts]
    assert len(boxes) == 8
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))


def test_a_new_method_is_drawn(tmp_path: Path, record, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(ALL_METHODS, "dummy", Method("dummy", ClosedFormConfig, "a dummy", "#123456", "*", 2))
    drawn = charts.draw_charts([record("mine", method="dummy"), record("fast")], tmp_path / "chart")
    text = drawn["speed"].with_suffix(".svg").read_text()
    assert "a dummy" in text
    assert "#123456" in text
