"""Charts are drawn, show something, are the same every time, and their labels keep apart."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from graspd_bench import charts
from graspd_bench import charts as charts_style
from graspd_bench.figures import by_name, rows
from graspd_bench.studies.robust_ranking import draw_robust

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
    with charts_style.figure(4.5, 4.5) as (made, axis):
        axis.plot(*zip(*points, strict=True), "o")
        charts_style.place_labels(axis, points, [f"a preset {i}" for i in range(8)], ["black"] * 8)
        made.canvas.draw()
        boxes = [text.get_window_extent() for text in axis.texts]
    assert len(boxes) == 8
    assert not [pair for pair in combinations(range(8), 2) if boxes[pair[0]].overlaps(boxes[pair[1]])]
