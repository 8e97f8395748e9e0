"""Coupled joints: read, resolved, moved as MuJoCo moves them, and seen by everything that differentiates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graspd_core.errors import HandError
from graspd_core.hands.library import DEFAULT_EFFORT, DEFAULT_FORCE, load_hand
from graspd_core.hands.model import HandModel, Mimic, all_joint_names, all_joint_positions
from graspd_core.hands.readers.urdf import read_urdf

BOX = '<collision><geometry><box size="0.01 0.01 0.01"/></geometry></collision>'
LIMIT = '<limit lower="{}" upper="{}" effort="{}" velocity="{}"/>'


def joint(name: str, parent: str, child: str, *, kind: str = "revolute", limit: str = "", mimic: str = "") -> str:
    limit = limit or LIMIT.format(-1, 1, 0, 2)
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0.02 0.01 0.03" rpy="0.3 -0.2 0.5"/><axis xyz="0 1 1"/>{limit}{mimic}</joint>'
    )


def robot(*joints: str) -> str:
    links = "".join(f'<link name="{name}">{BOX}</link>' for name in ("base", "a", "b", "c", "d"))
    return f'<robot name="linkage">{links}{"".join(joints)}</robot>'


def follows(leader: str, **numbers: float) -> str:
    return f'<mimic joint="{leader}" {" ".join(f"{key}={str(value)!r}" for key, value in numbers.items())}/>'


# b follows a; c follows b, and is named before it; d follows nothing, and slides.
LINKAGE = robot(
    joint("third", "b", "c", mimic=follows("second", multiplier=-2, offset=0.1), limit=LIMIT.format(-3, 3, 1, 9)),
    joint("first", "base", "a"),
    joint("second", "a", "b", mimic=follows("first", multiplier=0.5, offset=-0.2), limit=LIMIT.format(-0.5, 0.2, 1, 9)),
    joint("rail", "base", "d", kind="prismatic", limit=LIMIT.format(0, 0.1, 0, 1)),
)


def write(folder: Path, text: str) -> Path:
    path = folder / "linkage.urdf"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def hand(tmp_path_factory: pytest.TempPathFactory) -> HandModel:
    return read_urdf(write(tmp_path_factory.mktemp("linkage"), LINKAGE))


def test_only_joints_that_lead_are_variables(hand: HandModel) -> None:
    assert hand.joint_names == ("first", "rail")
    assert all_joint_names(hand) == ("first", "second", "third", "rail")
    index = hand.link_index
    # c follows b: -2 (0.5 q - 0.2) + 0.1.
    assert hand.mimics == (Mimic("second", index["b"], 0, 0.5, -0.2), Mimic("third", index["c"], 0, -1.0, 0.5))
    assert hand.link_joint.tolist() == [-1, 0, 0, 0, 1]
    assert all_joint_positions(hand, np.array([0.6, 0.05])).tolist() == pytest.approx([0.6, 0.1, -0.1, 0.05])


def test_a_leader_keeps_its_followers_within_their_limits(hand: HandModel) -> None:
    # second: [-0.5, 0.2] allows first [-0.6, 0.8]; third allows more than [-1, 1].
    np.testing.assert_allclose(hand.lower, [-0.6, 0.0])
    np.testing.assert_allclose(hand.upper, [0.8, 0.1])
    assert not hand.warnings
    for q in (hand.lower, hand.upper):
        assert -0.5 - 1e-12 <= all_joint_positions(hand, q)[1] <= 0.2 + 1e-12


def test_a_leader_is_no_faster_than_its_followers_can_be(tmp_path: Path) -> None:
    fast = robot(joint("first", "base", "a"), joint("second", "a", "b", mimic=follows("first", multiplier=-4)),
                 joint("w", "a", "c", kind="fixed"), joint("v", "a", "d", kind="fixed"))  # fmt: skip
    assert read_urdf(write(tmp_path, fast)).velocity.tolist() == [0.5]


def test_limits_of_the_wrong_sign_are_given_up_with_a_warning(tmp_path: Path) -> None:
    wrong = robot(
        joint("first", "base", "a", limit=LIMIT.format(0, 0.8, 1, 1)),
        joint("second", "a", "b", mimic=follows("first", multiplier=-1), limit=LIMIT.format(0, 0.8, 1, 1)),
        joint("third", "a", "c", kind="continuous", mimic=follows("first", multiplier=9)),
        joint("still", "base", "d", kind="fixed"),
    )
    hand = read_urdf(write(tmp_path, wrong))
    assert (hand.lower.tolist(), hand.upper.tolist()) == ([0.0], [0.8])
    assert len(hand.warnings) == 1
    assert "'second'" in hand.warnings[0]


def test_a_follower_whose_limits_are_given_up_is_driven_no_faster(tmp_path: Path) -> None:
    wrong = robot(
        joint("first", "base", "a", limit=LIMIT.format(0, 0.8, 1, 1)),
        joint("second", "a", "b", mimic=follows("first", multiplier=-1), limit=LIMIT.format(0, 0.8, 1, 0.25)),
        joint("third", "a", "c", kind="fixed"),
        joint("still", "base", "d", kind="fixed"),
    )
    assert read_urdf(write(tmp_path, wrong)).velocity.tolist() == [0.25]


def test_a_follower_in_another_unit_is_refused(tmp_path: Path) -> None:
    slide = joint(
        "rail", "base", "d", kind="prismatic", mimic=follows("first", multiplier=50), limit=LIMIT.format(-50, 50, 1, 9)
    )
    millimetres = robot(joint("first", "base", "a"), slide, joint("b", "a", "b"), joint("c", "a", "c"))
    with pytest.raises(HandError, match=r"linkage.urdf: joint 'rail' slides by 100 m; .* to 2 m at most"):
        read_urdf(write(tmp_path, millimetres))


@pytest.mark.parametrize(
    ("mimic", "message"),
    [
        (follows("first"), "circle: first -> first"),
        (follows("second"), "circle: first -> second -> first"),
        (follows("lost"), r"joint 'first' mimics 'lost', which is no movable joint; choose from first, second"),
        (follows("weld"), "joint 'first' mimics 'weld', which is no movable joint"),
        ("<mimic/>", "joint 'first' mimics None"),
        ('<mimic joint="second" multiplier="two"/>', r"multiplier='two'.*expected 1 finite number"),
    ],
)
def test_a_bad_coupling_is_refused_by_name(tmp_path: Path, mimic: str, message: str) -> None:
    text = robot(
        joint("first", "base", "a", mimic=mimic),
        joint("second", "a", "b", mimic=follows("first")),
        joint("weld", "base", "c", kind="fixed"),
        joint("weld2", "base", "d", kind="fixed"),
    )
    with pytest.raises(HandError, match=message):
        read_urdf(write(tmp_path, text))


def test_a_sliding_joint_has_its_own_scale_and_default_force(tmp_path: Path) -> None:
    hand = load_hand(write(tmp_path, LINKAGE), candidates=20)
    assert hand.slides.tolist() == [False, True]
    assert hand.joint_scale.tolist() == [1.0, 0.05]
    assert hand.effort.tolist() == [DEFAULT_EFFORT, DEFAULT_FORCE]
