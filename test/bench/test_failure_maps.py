"""Failure maps: their cells, their records on disk, what is counted from them, and the pictures."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspd_core.bench.charts.failure_map_chart import Shares, draw_map
from graspd_core.bench.failure_maps import camera_view as view
from graspd_core.bench.failure_maps import friction_mass
from graspd_core.bench.failure_maps import object_size as size
from graspd_core.bench.failure_maps import wall_thickness as wall
from graspd_core.bench.failure_maps.map_job import Job, hand_for, job_key, kind_of, run_job
from graspd_core.bench.failure_maps.map_registry import COUNT, MAPS, METHODS, MapAxis, jobs_of
from graspd_core.bench.failure_maps.run_map_jobs import (
    finished,
    job_file,
    read_job,
    reasons,
    report,
    run_missing,
    shares,
)
from graspd_core.hands.library import load_hand
from graspd_core.mesh.shapes import BOX_HALF, make_shape
from graspd_core.rendering.depth_noise import DEFAULT, NONE
from graspd_core.scene.load_scene import load_scene
from graspd_core.types import Grasp, Posture

TINY = Job("size", "random_closure", "sphere", 0.2, ("sphere",), 1, 0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where one real job was run."""
    folder = tmp_path_factory.mktemp("maps")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GRASPD_CACHE", "off")
        assert len(list(run_missing([TINY], folder, "code-1"))) == 1
    return folder


def stored(folder: Path, name: str, method: str, held: int) -> None:
    """Records of all jobs of a map, `held` grasps of each cell holding."""
    for job in jobs_of(name, method):
        cells = [{"up": up, "held": held, "reasons": {"the object moved": job.count - held}} for up in job.up]
        record = {"key": job_key(job), "code": "c", "across": job.across, "count": job.count, "cells": cells}
        (folder / job_file(job)).write_text(json.dumps(record))


@pytest.mark.parametrize("name", MAPS)
@pytest.mark.parametrize("method", METHODS)
def test_jobs_cover_every_cell_once(name: str, method: str):
    drawn, asked = MAPS[name], Counter()
    jobs = jobs_of(name, method)
    for job in jobs:
        for up in job.up:
            asked[job.across, up] += job.count
    assert asked == dict.fromkeys(product(drawn.across.places, drawn.up.places), COUNT)
    assert len(asked) <= 36
    assert len({job_key(job) for job in jobs}) == len({job_file(job) for job in jobs}) == len(jobs)


def test_the_key_is_of_everything_that_is_asked():
    changes: list[dict[str, Any]] = [
        {"map": "wall"}, {"preset": "fast"}, {"thing": "mug"}, {"across": 0.3}, {"up": ("mug",)}, {"count": 3},
        {"seed": 1},
    ]  # fmt: skip
    keys = {job_key(TINY), *(job_key(replace(TINY, **change)) for change in changes)}
    assert len(keys) == 1 + len(changes)


def test_a_real_job_leaves_a_record(folder: Path):
    record = read_job(folder, TINY, "code-1")
    assert record is not None
    (cell,) = record["cells"]
    assert cell["up"] == "sphere"
    assert cell["held"] + sum(cell["reasons"].values()) == TINY.count
    span = size.hand_span(hand_for(600))
    assert record["evidence"]["width_mm"] == pytest.approx(200 * span)
    assert record["cpu"] > 0


def test_what_is_finished_is_not_run_again(folder: Path):
    assert list(run_missing([TINY], folder, "code-1")) == []
    assert list(run_missing([TINY], folder, "code-2", any_code=True)) == []
    assert read_job(folder, TINY, "code-2") is None
    assert read_job(folder, TINY, None) is not None


def test_what_raises_is_written_down_and_run_again(tmp_path: Path):
    wrong = Job("view", "fast", "box", 45.0, ("loud",), 2, 0)
    for _ in range(2):
        (record,) = run_missing([wrong], tmp_path, "code")
        assert "loud" in record["error"]
        assert read_job(tmp_path, wrong, None) is None


def test_a_refused_scene_loses_all_grasps_and_says_why():
    done = run_job(size.run, replace(TINY, thing="teapot", up=("a", "b")))
    assert [(cell.up, cell.held) for cell in done.cells] == [("a", 0), ("b", 0)]
    for cell in done.cells:
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
    assert reasons(records) == {(1.0, 2.0): Counter(fell=2, turned=1)}


def test_the_report_names_every_failure(tmp_path: Path):
    stored(tmp_path, "wall", "closed_form", 7)
    said = report(tmp_path)
    assert f"**wall and grid, closed_form**: {len(jobs_of('wall', 'closed_form'))} the object moved" in said
    assert "**size, graspd2022**: no failure" in said


def test_pictures_show_what_is_stored_and_are_the_same_every_time(tmp_path: Path):
    from matplotlib.image import imread

    stored(tmp_path, "wall", "closed_form", 8)
    stored(tmp_path, "wall", "graspd2022", 0)
    panels = {method: shares(finished(tmp_path, "wall", method)) for method in METHODS}
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
    assert size.hand_span(hand) == pytest.approx(0.152, abs=0.003)
    assert 0.25 < size.hand_span(hand_for(600)) < 0.45


def test_the_least_width_of_the_box_is_its_shortest_side():
    assert size.least_width(make_shape("box")) == pytest.approx(2 * min(BOX_HALF))


def test_noise_grows_from_none_over_a_camera_s_to_more():
    assert view.noise_at(0.0) == NONE
    assert view.noise_at(1.0) == DEFAULT
    loud = view.noise_at(4.0)
    assert loud.quadratic == 4 * DEFAULT.quadratic
    assert loud.flying == 1.0
    assert loud.grazing == DEFAULT.grazing


def test_another_mass_leaves_the_shape_alone():
    thing = load_scene("shape:box", resolution=8).object
    heavy = friction_mass.at_mass(thing, 2.0)
    assert heavy.mass == 2.0
    np.testing.assert_allclose(heavy.inertia, 20 * thing.inertia)
    assert heavy.sha256 == thing.sha256


def test_effort_is_the_offset_of_the_squeeze_times_stiffness():
    hand = load_hand("parallel_gripper")
    rest = Posture(np.zeros(3), np.array([1.0, 0, 0, 0]), hand.open_posture)
    pressed = replace(rest, joint_positions=hand.open_posture + 0.25 * hand.effort / 2000.0)
    grasp = Grasp(rest, rest, pressed, (), 0.0)
    assert friction_mass.effort_used(hand, grasp, np.full(hand.num_joints, 2000.0)) == pytest.approx(0.25)


def test_a_coarse_grid_loses_a_thin_wall():
    cup = wall.cup(0.3)
    coarse, fine = (wall.grid_errors(wall.on_grid(cup, nodes)) for nodes in (8, 32))
    assert coarse["surface_off_mm"] > fine["surface_off_mm"] > 0.3
    assert coarse["cell_mm"] > 4 * fine["cell_mm"]
