"""Any tree of links and joints moves as in MuJoCo, and is given a palm and postures."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.library import load_hand, read_hand_file
from graspd_core.hands.model import HandModel, all_joint_names, all_joint_positions

# Trees are small as drawn, and shrinking one takes minutes.
DRAWS = {
    "phases": [Phase.reuse, Phase.generate],
    "suppress_health_check": [HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
}


def _check_against_mujoco(
    hand: HandModel, model: Any, base: str | None, values: dict[str, float], q: np.ndarray
) -> None:
    mujoco: Any = importlib.import_module("mujoco")  # it ships no type information

    data = mujoco.MjData(model)
    for name, value in values.items():
        data.joint(name).qpos[0] = value
    mujoco.mj_kinematics(model, data)
    rotations, translations = link_poses(hand, q)
    turn = data.body(base).xmat.reshape(3, 3) if base else np.eye(3)
    origin = data.body(base).xpos if base else np.zeros(3)
    names = {model.body(i).name for i in range(model.nbody)} & set(hand.link_names)
    assert names >= {name for name in hand.link_names[1:] if ":" not in name}
    for name in names:
        link, body = hand.link_index[name], data.body(name)
        # Both count in float64; the bound that is promised is 1e-5.
        np.testing.assert_allclose(translations[link], turn.T @ (body.xpos - origin), atol=1e-9)
        np.testing.assert_allclose(rotations[link], turn.T @ body.xmat.reshape(3, 3), atol=1e-9)


@settings(max_examples=12, **DRAWS)
@given(data=st.data(), seed=st.integers(0, 2**31))
def test_any_tree_moves_as_in_mujoco(folder: Path, trees: st.SearchStrategy, data: st.DataObject, seed: int) -> None:
    mujoco: Any = importlib.import_module("mujoco")
    text, couplings = data.draw(trees)
    path = folder / "zoo.urdf"
    path.write_text(text)
    hand = read_hand_file(path)
    q = np.random.default_rng(seed).uniform(hand.lower, hand.upper)
    values = dict(zip(hand.joint_names, q.tolist(), strict=True))

    def value(name: str) -> float:
        if name not in couplings:
            return values[name]
        leader, multiplier, offset = couplings[name]
        return multiplier * value(leader) + offset

    every = {name: value(name) for name in all_joint_names(hand)}
    np.testing.assert_allclose(all_joint_positions(hand, q), list(every.values()), atol=1e-12)
    # MuJoCo wants masses, knows no capsule in a URDF and ignores couplings: it is shown the bare tree.
    bare = re.sub(r"<(collision|visual)>.*?</\1>|<mimic.*?/>", "", text)
    bare = re.sub(r"(<link name=\"\w+\">)", r'\1<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" '
                  r'ixy="0" ixz="0" iyz="0"/></inertial>', bare)  # fmt: skip
    bare = bare.replace('<robot name="zoo">', '<robot name="zoo"><mujoco><compiler fusestatic="false"/></mujoco>')
    _check_against_mujoco(hand, mujoco.MjModel.from_xml_string(bare), None, every, q)


@pytest.mark.parametrize("seed", range(3))
def test_an_mjcf_file_moves_as_in_mujoco(folder: Path, mjcf: str, seed: int) -> None:
    mujoco: Any = importlib.import_module("mujoco")
    path = folder / "tri.xml"
    path.write_text(mjcf)
    hand = read_hand_file(path)
    assert (hand.name, hand.base_link, hand.joint_names) == ("tri", "palm", ("j1", "j2", "j3", "s1"))
    np.testing.assert_allclose(hand.effort, [2, np.inf, np.inf, 15])
    q = np.random.default_rng(seed).uniform(hand.lower, hand.upper)
    values = dict(zip(all_joint_names(hand), all_joint_positions(hand, q).tolist(), strict=True))
    model = mujoco.MjModel.from_xml_path(str(path))
    _check_against_mujoco(hand, model, "palm", values, q)
    # What MuJoCo's equality constraint wants of the coupled joint, as its documentation states it.
    reference = {name: float(model.joint(name).qpos0[0]) for name in ("k", "j3")}
    wanted = reference["k"] + 0.1 + 0.5 * (values["j3"] - reference["j3"])
    assert values["k"] == pytest.approx(wanted)


@pytest.mark.slow
@settings(max_examples=6, deadline=None, **DRAWS)
@given(data=st.data())
def test_any_tree_is_given_a_palm_postures_and_candidates(
    folder: Path, trees: st.SearchStrategy, data: st.DataObject
) -> None:
    path = folder / "whole.urdf"
    path.write_text(data.draw(trees)[0])
    hand = load_hand(path, candidates=60)
    for posture in (hand.open_posture, hand.closed_posture):
        assert ((hand.lower <= posture) & (posture <= hand.upper)).all()
    for direction in (hand.palm_normal, hand.approach):
        assert np.linalg.norm(direction) == pytest.approx(1.0)
    assert np.isfinite(hand.palm_center).all()
    assert len(hand.candidate_points) > 0
