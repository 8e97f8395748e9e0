"""Who watches a run sees starts that move and drop out, then candidates whose trials end one by one."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from graspd_core import load_hand, load_scene, plan_grasps
from graspd_core.types import Snapshot, Verdict


@pytest.fixture
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("_one_thread")
@pytest.mark.parametrize("preset", ["fast", "random_closure"])
def test_a_watched_run_ends_as_one_that_nobody_watches(preset: str):
    scene, hand, seen = load_scene("shape:box"), load_hand("parallel_gripper"), list[Snapshot]()
    watched = plan_grasps(scene, hand, count=3, preset=preset, measure=False, watch=seen.append)
    alone = plan_grasps(scene, hand, count=3, preset=preset, measure=False)
    assert [g.grasp.position.tolist() for g in watched.grasps] == [g.grasp.position.tolist() for g in alone.grasps]
    starts = [s for s in seen if not s.verdicts]
    # The last of each round: the next has other candidates.
    tried = [s for s, after in pairwise([*seen, starts[0]]) if s.verdicts and not after.verdicts]
    assert starts
    assert all(np.isfinite(s.positions).all() and s.joint_positions.shape[1] == hand.num_joints for s in starts)
    told = [verdict for s in tried for verdict in s.verdicts if verdict is not Verdict.UNVERIFIED]
    assert sorted(told) == sorted(g.verdict for g in watched.grasps)


def test_hands_are_seen_where_the_object_is_though_it_is_planned_on_about_its_own_centre():
    from graspd_core.mesh.shapes import make_shape
    from graspd_core.types import TriangleMesh

    shape, far = make_shape("box"), np.array([40.0, 0.0, 0.0])
    scene, seen = load_scene(TriangleMesh(shape.vertices + far, shape.faces)), list[Snapshot]()
    plan_grasps(scene, load_hand("parallel_gripper"), count=1, preset="fast", measure=False, watch=seen.append)
    assert {bool(s.verdicts) for s in seen} == {True, False}
    assert all(np.abs(s.positions - far).max() < 1.0 for s in seen)
