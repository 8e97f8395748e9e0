"""Patches of the hand that are drawn to the surface, and a hand that gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from graspd_core.config import ProblemConfig
from graspd_core.hands.kinematics import in_base, link_poses
from graspd_core.hands.library import hand_names, load_hand
from graspd_core.optimize.problem import build_problem, make_hand_tensors, make_object_tensors

SETTINGS = ProblemConfig(candidates=200, features=24)


@pytest.mark.parametrize("name", hand_names())
def test_a_patch_is_part_of_one_rigid_group_and_all_have_a_coarse_candidate(name: str):
    hand = load_hand(name, candidates=400)
    tensors = make_hand_tensors(hand, 200, 4, "cpu", torch.float64)
    of_link = hand.link_group[hand.candidate_link]
    members = [np.unique(row) for row in tensors.fine.groups.numpy()]
    assert sorted(np.concatenate(members)) == sorted(np.flatnonzero(np.isin(of_link, of_link[:200])))
    assert all(len(set(of_link[some])) == 1 for some in members)
    coarse = [np.unique(row) for row in tensors.coarse.groups.numpy()]
    assert [set(some) for some in coarse] == [set(some[some < 200]) for some in members]
    assert 200 / 4 * 0.8 <= len(members) <= 200 / 4 * 1.2


def test_candidates_of_a_patch_lie_together():
    hand = load_hand("allegro_right", candidates=200)
    patches, links = (make_hand_tensors(hand, 200, size, "cpu", torch.float64) for size in (4, 0))

    def width(tensors) -> float:
        posture = link_poses(hand, (hand.lower + hand.upper) / 2)
        points = torch.as_tensor(in_base(posture, hand.candidate_points, hand.candidate_link))
        return float(torch.stack([points[row].std(0).norm() for row in tensors.coarse.groups]).mean())

    assert width(patches) < 0.7 * width(links)
    assert len(links.reach) == len(np.unique(hand.link_group[hand.candidate_link]))


def test_a_hand_that_gives_sees_a_thinner_object(scenes):
    firm, soft = (
        make_object_tensors(scenes["box"], replace(SETTINGS, softness=s), "cpu", torch.float64) for s in (0.0, 0.002)
    )
    assert torch.allclose(soft.sdf.field[0], firm.sdf.field[0] + 0.002)
    assert torch.equal(soft.sdf.field[1:], firm.sdf.field[1:])
    assert len(firm.features) > len(soft.features) == 0


def test_a_hand_that_gives_presses_deeper(scenes, hand):
    from graspd_bench.study import raw_grasps
    from graspd_core.optimize.plan_config import load_preset, override
    from graspd_core.verify.metrics import measure
    from graspd_core.verify.prepared_grasp import make_metrics_context

    context = make_metrics_context(scenes["cylinder"].object, hand)

    def depth(softness: float) -> float:
        config = override(load_preset("fast"), {"problem.softness": softness})
        grasps = raw_grasps(scenes["cylinder"], hand, config, 4, 0)
        return sum(measure(context, grasp.grasp)["intersection_volume"] or 0.0 for grasp in grasps)

    assert depth(0.003) > 2 * depth(0.0)


def test_patches_reach_the_problem(scenes, hand):
    few, many = (build_problem(scenes["box"], hand, replace(SETTINGS, patch_size=n), seed=0) for n in (0, 4))
    assert len(many.hand.reach) > 1.5 * len(few.hand.reach)
