"""The score of candidates: it sees what it should, whatever the pose, and its file fits it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import ranking as benchmark
import torch

from graspd_core.optimize.candidates import find_candidates, staged
from graspd_core.optimize.initial_poses import draw_starts
from graspd_core.optimize.loop import Hooks, Poses
from graspd_core.optimize.plan_config import load_preset
from graspd_core.optimize.problem import Problem
from graspd_core.optimize.ranking import Staged, _fitted, log_odds, ranking_figures, score

CONFIG = load_preset("fast")


@pytest.fixture(scope="module")
def some(problem_of, hand, scenes) -> tuple[Problem, Staged]:
    """Eight good poses on a box, and a few that were only drawn."""
    problem = problem_of("box", torch.float32)
    found = find_candidates(scenes["box"], hand, count=8, seed=0, config=CONFIG, hooks=Hooks()).grasps[:8]
    rows = [(g.grasp.position, g.grasp.quaternion_wxyz, g.grasp.joint_positions) for g in found]
    good = [torch.as_tensor(np.stack(part)).float() for part in zip(*rows, strict=True)]
    drawn = vars(draw_starts(scenes["box"], hand, 4, 0, "cpu", torch.float32)).values()
    poses = Poses(*(torch.cat(parts) for parts in zip(good, drawn, strict=True)))
    return problem, staged(problem, hand, poses, CONFIG)


def test_the_file_fits_the_figures(some: tuple[Problem, Staged]):
    figures = ranking_figures(*some)
    assert torch.isfinite(figures).all()
    assert _fitted()["mean"].shape == _fitted()["deviation"].shape == figures.shape[1:]
    # A figure that never varied was not learned from, and would weigh by chance where it does.
    assert (_fitted()["deviation"] > 1e-3).all()


def test_hands_that_were_only_drawn_come_after_all_that_grasp(some: tuple[Problem, Staged]):
    scores = score(*some)
    assert scores[:8].min() > scores[8:].max()


def test_without_a_force_no_contact_shares_the_load(some: tuple[Problem, Staged]):
    problem, before = some
    loose = before._replace(pressed=replace(before.pressed, forces=torch.zeros_like(before.pressed.forces)))
    assert ranking_figures(problem, loose).abs().max() < 100.0


def test_the_commands_make_a_network(tmp_path: Path):
    tried, network = tmp_path / "tried", tmp_path / "network.npz"
    few = ["--objects", "shape:sphere", "--hands", "parallel_gripper", "--variants", "1", "--count", "1"]
    benchmark.main(["try", *few, "--out", str(tried)])
    (block,) = tried.glob("*.npz")
    benchmark.main(["fit", "--out", str(tried), "--to", str(network)])
    with np.load(network) as arrays, np.load(block) as rows:
        fitted = {name: torch.as_tensor(arrays[name]).double() for name in arrays.files}
        odds = log_odds(fitted, torch.as_tensor(rows["figures"]))
        assert len(odds) == len(rows["standard"]) == len(rows["hard"]) == 8
    assert torch.isfinite(odds).all()


def test_one_at_a_time_is_as_all_at_once(some: tuple[Problem, Staged]):
    problem, all_rows = some
    rows = torch.arange(3, 4)
    contact_set, pressed = all_rows.contact_set, all_rows.pressed
    one = Staged(
        all_rows.poses[rows],
        all_rows.opened[rows],
        all_rows.clearance[rows],
        replace(contact_set, **{k: v[rows] for k, v in vars(contact_set).items() if k != "link"}),
        replace(pressed, **{k: v[rows] for k, v in vars(pressed).items()}),
        all_rows.overlap[rows],
    )
    assert score(problem, one) == pytest.approx(score(*some)[rows], abs=1e-4)


@pytest.mark.parametrize("what", ["overlap", "depth"])
def test_what_a_trial_forgives_costs(some: tuple[Problem, Staged], what: str):
    problem, before = some
    if what == "overlap":
        after = before._replace(overlap=before.overlap + 0.005)
    else:
        distance = before.contact_set.distance.clone()
        distance[:, 0] = -0.012
        after = before._replace(contact_set=replace(before.contact_set, distance=distance))
    assert (score(problem, after) < score(problem, before) - 3.0).all()


def test_what_is_no_number_ranks_without_an_error(some: tuple[Problem, Staged]):
    problem, before = some
    spoilt = replace(before.pressed, imbalance=torch.full_like(before.pressed.imbalance, torch.nan))
    assert torch.isfinite(score(problem, before._replace(pressed=spoilt))).all()
