"""MJCF files: what is read means what MuJoCo makes of it, and what is not read is refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graspd_core.errors import HandError
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.library import read_hand_file
from graspd_core.hands.model import HandModel


def _read(folder: Path, text: str) -> HandModel:
    path = folder / "changed.xml"
    path.write_text(text)
    return read_hand_file(path)


def test_geoms_limits_and_warnings(folder: Path, mjcf: str) -> None:
    hand = _read(folder, mjcf)
    kinds = {hand.link_names[p.link]: p.kind for p in hand.primitives}
    # The visual wedge on a2 does not count, because a capsule there collides.
    assert kinds == {"palm": "box", "a": "capsule", "a2": "capsule", "tip": "hull", "b": "hull", "b2": "hull"}
    lower, upper = np.deg2rad([-10, -5, -10]), np.deg2rad([90, 60, 90])
    np.testing.assert_allclose(hand.lower, [*lower, 0])
    np.testing.assert_allclose(hand.upper, [*upper, 0.05])
    finger = hand.primitives_of[hand.link_index["a"]][0]
    assert finger.size == pytest.approx((0.01, 0.025))
    np.testing.assert_allclose(finger.translation, [0, 0, 0.025])
    np.testing.assert_allclose(
        np.ptp(hand.primitives_of[hand.link_index["tip"]][0].vertices, axis=0), [0.02, 0.04, 0.02]
    )
    assert hand.link_mass[hand.link_index["tip"]] == 0.01
    assert [text.split(" was")[0].split(" were")[0] for text in hand.warnings] == [
        "geoms of the world itself",
        "the free joint of the base 'palm'",
    ]


def test_visual_geoms_stand_in_where_none_collides(folder: Path, mjcf: str) -> None:
    hand = _read(folder, mjcf.replace('<geom pos="0 0 .02"/>', "", 1))
    assert hand.primitives_of[hand.link_index["a2"]][0].kind == "hull"
    assert any("visual ones are taken: a2" in text for text in hand.warnings)


def test_a_base_that_turns_hangs_in_the_world(folder: Path, mjcf: str) -> None:
    hand = _read(folder, mjcf.replace("<freejoint/>", '<joint name="wrist"/>'))
    assert (hand.base_link, hand.joint_names[0]) == ("world", "wrist")
    np.testing.assert_allclose(link_poses(hand, np.zeros(5))[1][hand.link_index["palm"]], [1, 2, 3])


def test_defaults_in_several_sections_and_for_other_actuators_hold(folder: Path, mjcf: str) -> None:
    apart = mjcf.replace('<geom type="capsule"/>', '<geom type="capsule"/></default><default>', 1)
    apart = apart.replace("</default>\n<asset>", '<general forcerange="-2 2"/></default>\n<asset>', 1)
    apart = apart.replace(' forcerange="-2 2" kp', " kp", 1)
    whole, hand = _read(folder, mjcf), _read(folder, apart)
    assert [p.kind for p in hand.primitives] == [p.kind for p in whole.primitives]
    assert hand.effort.tolist() == [2.0, np.inf, np.inf, 6.0]
    assert whole.effort.tolist() == [2.0, np.inf, np.inf, 15.0]


def test_ranges_that_do_not_hold_limit_nothing(folder: Path, mjcf: str) -> None:
    hand = _read(folder, mjcf.replace("forcerange", 'forcelimited="false" forcerange').replace('"-5 60"', '"3 3"'))
    assert hand.effort.tolist() == [np.inf, np.inf, np.inf, 15.0]
    assert any("joint 'j2' turns without end" in text for text in hand.warnings)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<freejoint/>", '<include file="x.xml"/>', "body 'palm': <include> is not read"),
        ('<body name="tip"', '<replicate count="9"/><body name="tip"', "body 'a2': <replicate> is not read"),
        ("</worldbody>", '<body name="mug"/></worldbody>', "the world has 2 bodies, a hand has one: palm, mug"),
        ('type="slide"', 'type="ball"', "joint 's1' is of type 'ball'; known: hinge, slide"),
        ('range="0 .05"', "", "joint 's1' slides by 100 m"),
        ('range="-5 60"', 'range="5 -60"', "joint 'j2' has lower 5 above upper -60"),
        ('axis="1 0 1"', 'axis="0 0 0"', "changed.xml:8: .*axis too small in joint Element name 'j2'"),
        ('euler="10 -', 'quat="1 0 0 0" euler="10 -', "changed.xml:7: body 'a': .*multiple orientation specifiers"),
        ('eulerseq="zyx"', 'eulerseq="zz"', "changed.xml:1: .*'eulerseq' must have exactly 3 characters"),
        ('childclass="f"', 'childclass="g"', "changed.xml:6: body 'palm': .*unknown default childclass"),
        ('size=".01 .02 .01"', 'size=".01 -.02 .01"', "changed.xml:13: .*size 1 must be positive in geom"),
        ('type="ellipsoid"', 'type="hfield"', "body 'tip': <geom type='hfield'> is not read; known: sphere"),
        ('mesh="w"', 'mesh="q"', "names the mesh 'q'; known: t, w"),
        (
            'vertex="0 0 0 .02 0 0 0 .02 0 0 0 .03"',
            'vertex="0 0 0"',
            "mesh 't': <mesh vertex=...>: 1 points; expected four",
        ),
        ('file="wedge.obj"', 'file="lost.obj"', "mesh 'w': mesh 'lost.obj' was not found"),
        ('polycoef="0.1 .5 0 0 0"', 'polycoef="0.1 .5 2 0 0"', "only a straight line is read"),
        ('joint2="j3"', 'joint2="j9"', "changed.xml:19: .*unknown element 'j9' in equality constraint"),
        ("<equality>", '<equality><weld body1="a" body2="b"/>', "equality <weld> is not read"),
        ('fromto="0 0 0 0 0 .05"', 'fromto="0 0 0 0 0 0"', "changed.xml:9: .*fromto points too close"),
        ('name="b2"', 'name="a2"', "MuJoCo refuses it: .*repeated name 'a2' in body"),
        ('mass=".01"', 'mass="-1"', "body 'tip': weighs -1 kg"),
        ('gear="3"', 'gear="3 e"', "changed.xml:20: .*bad format in attribute 'gear'"),
        ('ref=".01"', 'ref="nan"', "joint 's1': <joint ref='nan'>: expected finite numbers"),
        ("</worldbody>", "<site><body/></site>" * 301 + "</worldbody>", "307 links; a hand has at most 300"),
    ],
)
def test_what_is_not_read_is_named(folder: Path, mjcf: str, old: str, new: str, message: str) -> None:
    assert old in mjcf
    with pytest.raises(HandError, match=message) as caught:
        _read(folder, mjcf.replace(old, new, 1))
    assert str(caught.value).startswith(str(folder / "changed.xml"))
    assert "\n" not in str(caught.value)
