"""Failure maps: their cells, their records on disk, what is counted from them, and the pictures."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspd_bench import failure_maps as map_runs
from graspd_bench.failure_maps import (
    COUNT,
    MAPS,
    METHODS,
    SEEDS,
    MapAxis,
    MapCase,
    Shares,
    cases_of,
    draw_map,
    hand_for,
    map_cases,
    map_sections,
    reasons,
    run_map,
    run_on,
    shares,
)
from graspd_bench.rendering.depth_noise import DEFAULT, NONE
from graspd_bench.study import Request
from graspd_core.hands.library import load_hand
from graspd_core.mesh.shapes import BOX_HALF, make_shape
from graspd_core.perception.load_scene import load_scene
from graspd_core.planning.feasibility import kind_of

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
    assert Counter(asked) == Counter(replace(case, seed=seed) for case in once for seed in SEEDS)
    assert len({case.label for case in asked}) == len(asked)
    assert {case.seed for case in map_cases(Request(cases=("wall",), seeds=(5,)))} == {5}


def test_a_real_case_leaves_a_record():
    record = run_map(TINY)
    (cell,) = record["cells"]
    assert cell["up"] == "sphere"
    assert cell["held"] + sum(cell["reasons"].values()) == TINY.count


def test_a_refused_scene_loses_all_grasps_and_says_why():
    done = run_on(map_runs.run_size, replace(TINY, thing="teapot", up=("a", "b")))
    assert [(cell.up, cell.held) for cell in done] == [("a", 0), ("b", 0)]
    for cell in done:
        ((reason, count),) = cell.reasons.items()
        assert reason.startswith("no scene: unknown shape 'teapot'")
        assert count == TINY.count


@pytest.mark.parametrize(
    ("said", "kind"),
    [
        ("the object moved 5.1 cm under a pull along +x", "the object moved under a pull"),
        ("the object turned 16° while closing", "the object turned while closing"),
        ("the pregrasp penetrates the object by 12.3 mm", "the pregrasp penetrates the object"),
        ("the simulation diverged under a pull along -z", "the simulation diverged under a pull"),
        ("cloud: 9 points (35 % do); take more", "cloud: points; take more"),
    ],
)
def test_reasons_are_counted_without_their_figures(said: str, kind: str):
    assert kind_of(said) == kind


def test_shares_and_reasons_are_of_all_objects_together():
    records = [
        {"across": 1.0, "count": 4, "cells": [{"up": 2.0, "held": 4, "reasons": {}}]},
        {"across": 1.0, "count": 4, "cells": [{"up": 2.0, "held": 1, "reasons": {"fell": 2, "turned": 1}}]},
    ]
    assert shares(records) == {(1.0, 2.0): 5 / 8}
    assert reasons(records) == Counter(fell=2, turned=1)


def test_the_report_names_every_failure_and_draws_what_there_is(tmp_path: Path):
    sections = map_sections(records_of("wall", "closed_form", COUNT - 1), tmp_path / "bench")
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


def test_rows_of_which_nothing_is_known_are_left_out(tmp_path: Path):
    panels: dict[str, Shares] = {"some": {(x, "box"): 0.5 for x in MAPS["size"].across.places}}
    draw_map(MAPS["size"], panels, tmp_path / "part")
    said = (tmp_path / "part.svg").read_text()
    assert "<!-- box -->" in said
    assert "<!-- sphere -->" not in said


def test_a_map_with_nothing_in_it_is_drawn_empty(tmp_path: Path):
    drawn = replace(MAPS["size"], across=MapAxis("x", (1.0,)), up=MapAxis("y", ("box",)))
    assert draw_map(drawn, {"none": {}}, tmp_path / "empty").is_file()


def test_the_span_of_a_gripper_is_its_opening():
    # Jaws of 12 mm that open to 140 mm: from the middle of the one to that of the other.
    hand = load_hand("parallel_gripper")
    assert map_runs.hand_span(hand) == pytest.approx(0.152, abs=0.003)
    assert 0.25 < map_runs.hand_span(hand_for("allegro_right", 600)) < 0.45


def test_the_least_width_of_the_box_is_its_shortest_side():
    assert map_runs.least_width(make_shape("box")) == pytest.approx(2 * min(BOX_HALF))


def test_noise_grows_from_none_over_a_camera_s_to_more():
    assert map_runs.noise_at(0.0) == NONE
    assert map_runs.noise_at(1.0) == DEFAULT
    loud = map_runs.noise_at(4.0)
    assert loud.quadratic == 4 * DEFAULT.quadratic
    assert loud.flying == 1.0
    assert loud.grazing == DEFAULT.grazing


def test_another_mass_leaves_the_shape_alone():
    thing = load_scene("shape:box", resolution=8).object
    heavy = map_runs.at_mass(thing, 2.0)
    assert heavy.mass == 2.0
    np.testing.assert_allclose(heavy.inertia, 20 * thing.inertia)
    assert heavy.sha256 == thing.sha256


def test_the_grid_is_as_coarse_as_asked_and_the_cup_stays():
    cup = map_runs.cup(0.3)
    coarse, fine = (map_runs.on_grid(cup, nodes) for nodes in (8, 32))
    assert float(coarse.sdf.spacing) > 3.9 * float(fine.sdf.spacing)
    assert coarse.object is cup.object
