"""What every built-in hand must show, whoever added it: a new `config/hands/*.yaml` is picked up by itself."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.library import hand_names, load_hand
from graspd_core.hands.model import HandModel, all_joint_names, all_joint_positions
from graspd_core.hands.self_collision import link_overlaps
from graspd_core.hands.surface_points import dense_samples
from graspd_core.perception.load_scene import load_scene
from graspd_core.planning.plan_grasps import plan_grasps
from graspd_core.types import Verdict


@pytest.fixture(scope="module", params=hand_names())
def hand(request: pytest.FixtureRequest) -> HandModel:
    return load_hand(request.param)


# Fingertip origins in the base frame at mid-range [m], of the published descriptions through pytorch-kinematics and,
# for the Allegro, MuJoCo. The left hand's are the right's, mirrored: its abduction joints are at zero.
ALLEGRO_TIPS = [
    [0.09535, 0.04752, 0.04437],
    [0.09535, 0, 0.04679],
    [0.09535, -0.04752, 0.04437],
    [0.08403, 0.05714, -0.0102],
]
LEAP_TIPS = [
    [0.02002, 0.02266, -0.09861],
    [0.02002, -0.02279, -0.09861],
    [0.02002, -0.06824, -0.09861],
    [-0.06132, 0.04303, -0.08248],
]
ALLEGRO_ENDS = tuple(f"link_{number}.0_tip" for number in (3, 7, 11, 15))
GOLDEN = {
    "allegro_right": (ALLEGRO_ENDS, np.array(ALLEGRO_TIPS)),
    "allegro_left": (ALLEGRO_ENDS, np.array(ALLEGRO_TIPS) * [1.0, -1.0, 1.0]),
    "leap_right": (("fingertip", "fingertip_2", "fingertip_3", "thumb_fingertip"), np.array(LEAP_TIPS)),
}


def tips(hand: HandModel, q: np.ndarray) -> np.ndarray:
    """Places of the links that carry no other."""
    ends = np.setdiff1d(np.arange(1, hand.num_links), hand.link_parent)
    return link_poses(hand, q)[1][ends]


def test_forward_kinematics_agree_with_mujocos(hand: HandModel) -> None:
    mujoco: Any = importlib.import_module("mujoco")  # it ships no type information
    keep = '<mujoco><compiler fusestatic="false" discardvisual="true"/></mujoco>'
    text = re.sub(r"<robot\b[^>]*>", lambda match: match.group() + keep, Path(hand.urdf).read_text(), count=1)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    for q in (hand.open_posture, hand.closed_posture, *rng.uniform(hand.lower, hand.upper, (3, hand.num_joints))):
        # Coupled joints at their own values: MuJoCo only couples them while it steps.
        for name, value in zip(all_joint_names(hand), all_joint_positions(hand, q), strict=True):
            data.joint(name).qpos[0] = value
        mujoco.mj_kinematics(model, data)
        rotations, translations = link_poses(hand, q)
        # MuJoCo makes the root link one with the world.
        for link in range(1, hand.num_links):
            body = data.body(hand.link_names[link])
            np.testing.assert_allclose(translations[link], body.xpos, atol=1e-9)
            np.testing.assert_allclose(rotations[link], body.xmat.reshape(3, 3), atol=1e-9)


@pytest.mark.parametrize("name", GOLDEN)
def test_golden_fingertips(name: str) -> None:
    hand, (ends, golden) = load_hand(name, candidates=8), GOLDEN[name]
    found = link_poses(hand, 0.5 * (hand.lower + hand.upper))[1][[hand.link_index[end] for end in ends]]
    np.testing.assert_allclose(found, golden, atol=1e-5)  # the golden values have five decimals


def test_joints_have_room_force_and_postures_within_their_limits(hand: HandModel) -> None:
    assert (hand.lower < hand.upper).all()
    assert np.isfinite([*hand.lower, *hand.upper, *hand.effort, *hand.velocity]).all()
    assert (hand.effort > 0).all()
    for q in (hand.open_posture, hand.closed_posture):
        assert ((hand.lower <= q) & (q <= hand.upper)).all()
    assert not hand.warnings


@pytest.mark.parametrize("posture", ["open_posture", "closed_posture"])
def test_no_link_is_inside_another(hand: HandModel, posture: str) -> None:
    points, links, _ = dense_samples(hand, count=4000, seed=11)
    overlap = link_overlaps(hand, getattr(hand, posture)[None], points, links)[0]
    assert np.where(hand.adjacent, 0.0, overlap).max() == 0.0


def test_fingertips_close_in_front_of_the_palm(hand: HandModel) -> None:
    assert np.linalg.norm(hand.palm_normal) == pytest.approx(1.0)
    opened, closed = tips(hand, hand.open_posture), tips(hand, hand.closed_posture)
    spread_open, spread_closed = (np.linalg.norm(ends - ends.mean(0), axis=1).mean() for ends in (opened, closed))
    assert spread_closed < spread_open
    for ends in (opened, closed):
        assert ((ends.mean(0) - hand.palm_center) @ hand.palm_normal) > -0.01


def test_candidates_lie_on_every_link_that_moves(hand: HandModel) -> None:
    with_solids = {p.link for p in hand.primitives if hand.link_group[p.link] != hand.link_group[0]}
    groups = {int(hand.link_group[link]) for link in with_solids}
    assert groups <= {int(hand.link_group[link]) for link in hand.candidate_link}


def test_masses_are_given(hand: HandModel) -> None:
    # The lightest gripper and the heaviest hand in use.
    assert 0.1 < hand.link_mass.sum() < 5.0


def test_inertias_are_those_of_solid_bodies(hand: HandModel) -> None:
    for inertia in hand.link_inertia:
        a, b, c = np.linalg.eigvalsh(inertia)
        assert a > 0
        assert a + b >= c


@pytest.mark.slow
def test_a_box_is_grasped(hand: HandModel) -> None:
    result = plan_grasps(load_scene("shape:box"), hand, count=1, seed=0, preset="balanced")
    best = result.grasps[0]
    assert best.verdict is Verdict.VERIFIED, best.reason
    for posture in (best.pregrasp, best.grasp, best.squeeze):
        assert ((hand.lower <= posture.joint_positions) & (posture.joint_positions <= hand.upper)).all()
