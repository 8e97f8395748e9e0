"""Each URDF loads as its author meant it, or is refused by one line that names the element."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graspd_core.errors import HandError
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.library import read_hand_file
from graspd_core.hands.model import HandModel

BOX = '<collision><geometry><box size="0.02 0.02 0.04"/></geometry></collision>'
HINGE = (
    '<joint name="hinge" type="revolute"><parent link="palm"/><child link="finger"/><origin xyz="0 0 0.03"/>'
    '<axis xyz="0 1 0"/><limit lower="-0.5" upper="1" effort="2" velocity="3"/></joint>'
)
HAND = f'<robot name="tiny"><link name="palm">{BOX}</link><link name="finger">{BOX}</link>{HINGE}</robot>'


LOOP = '<link name="x"/><link name="y"/>' + "".join(
    f'<joint name="{one}" type="continuous"><parent link="{one}"/><child link="{other}"/></joint>'
    for one, other in ("xy", "yx")
) + "</robot>"  # fmt: skip


def _read(tmp_path: Path, text: str | bytes) -> HandModel:
    path = tmp_path / "tiny.urdf"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_hand_file(path)


def _changed(*pairs: tuple[str, str]) -> str:
    text = HAND
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new, 1)
    return text


@pytest.mark.parametrize(
    "text",
    [
        HAND.encode("utf-8-sig"),
        HAND.encode("utf-16"),
        b"<!-- before --><?xml version='1.0' encoding='latin-1'?>\n" + HAND.replace("tiny", "tinÿ").encode("latin-1"),
        b"\n\n  " + HAND.encode(),
        HAND.replace("</robot>", '<gazebo><a:b c:d="1"/></gazebo></robot>').encode(),
        HAND.replace("<robot ", '<robot xmlns="http://www.ros.org" ').encode(),
        HAND.replace("</robot>", "<!-- ${not} <xacro:me> <!DOCTYPE x> --></robot>").encode(),
    ],
    ids=["BOM", "UTF-16", "comment before the header", "space", "undeclared", "namespace", "comments"],
)
def test_sloppy_xml_is_read(tmp_path: Path, text: bytes) -> None:
    hand = _read(tmp_path, text)
    assert hand.joint_names == ("hinge",)
    assert hand.warnings == ()


@pytest.mark.parametrize(
    ("old", "new", "warning"),
    [
        ("<collision>", "<visual>", r"the <visual> is taken: palm"),
        ('type="revolute"', 'type="continuous"', r"joint 'hinge' turns without end: kept to \[-3.14, 3.14\] rad"),
        ('upper="1"', 'upper="1e9"', r"joint 'hinge' turns without end: kept to \[-0.5, "),
        (
            "</robot>",
            '<link name="world"/><joint name="w" type="fixed"><parent link="world"/><child link="palm"/></joint>'
            "</robot>",
            r"link 'world' and fixed joint 'w' above the base 'palm' were dropped",
        ),
        (
            "</robot>",
            '<link name="up"/><joint name="w" type="floating"><parent link="up"/><child link="palm"/></joint></robot>',
            r"link 'up' and floating joint 'w' above the base 'palm' were dropped",
        ),
        (
            "</robot>",
            '<link name="x"/><joint name="stuck" type="revolute"><parent link="palm"/><child link="x"/>'
            '<limit lower="0.3" upper="0.3"/></joint></robot>',
            r"joint 'stuck' cannot move: its limits coincide; welded",
        ),
    ],
)
def test_what_is_mended_leaves_a_warning(tmp_path: Path, old: str, new: str, warning: str) -> None:
    text = _changed((old, new)).replace("</collision>", "</visual>", 1 if new == "<visual>" else 0)
    hand = _read(tmp_path, text)
    assert (hand.base_link, hand.joint_names) == ("palm", ("hinge",))
    assert np.isfinite([hand.lower, hand.upper]).all()
    with pytest.raises(AssertionError, match=warning):
        raise AssertionError("\n".join(hand.warnings))


def test_a_welded_joint_stays_where_its_limits_put_it(tmp_path: Path) -> None:
    tail = (
        '<link name="x"/><link name="y"/><joint name="still" type="revolute"><parent link="palm"/><child link="x"/>'
        '<axis xyz="0 0 1"/><limit lower="0.3" upper="0.3"/></joint><joint name="follows" type="prismatic">'
        '<parent link="x"/><child link="y"/><limit lower="-9" upper="9"/>'
        '<mimic joint="still" multiplier="0.1"/></joint>'
    )
    hand = _read(tmp_path, HAND.replace("</robot>", f"{tail}</robot>"))
    rotations, translations = link_poses(hand, np.zeros(1))
    x, y = hand.link_index["x"], hand.link_index["y"]
    np.testing.assert_allclose(rotations[x][:2, 0], [np.cos(0.3), np.sin(0.3)])
    np.testing.assert_allclose(translations[y], 0.03 * rotations[x][:, 0], atol=1e-12)
    assert (hand.mimics, hand.link_group[y]) == ((), 0)


@pytest.mark.parametrize(
    ("effort", "expected"), [('effort="2"', 2.0), ('effort="0"', np.inf), ("", np.inf), ('effort="inf"', np.inf)]
)
def test_an_effort_of_zero_is_unset(tmp_path: Path, effort: str, expected: float) -> None:
    assert _read(tmp_path, _changed(('effort="2"', effort))).effort[0] == expected


def test_axes_are_normalised_and_inertials_optional(tmp_path: Path) -> None:
    hand = _read(tmp_path, _changed(('"0 1 0"', '"0 3e-9 4e-9"')))
    np.testing.assert_allclose(hand.joint_axis[1], [0, 0.6, 0.8])
    assert (hand.link_mass == 0).all()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<robot ", '<!DOCTYPE a [<!ENTITY x "xx">]><robot ', r"tiny.urdf:1: a <!DOCTYPE> is refused"),
        ("</robot>", "", "not well-formed XML: no element found"),
        ("<robot", "<sdf", "not well-formed XML: mismatched tag"),
        ("</robot>", "<xacro:macro/></robot>", r"is a xacro file \(<xacro:macro>\)"),
        ('lower="-0.5"', 'lower="${low}"', r"joint 'hinge': xacro left over in <limit>: \$\{low\}"),
        ('lower="-0.5"', 'lower="nan"', r"joint 'hinge': <limit lower='nan'>: expected 1 finite number"),
        ('upper="1"', 'upper="-1"', r"joint 'hinge' has lower -0.5 above upper -1"),
        ("<limit", "<limits", "joint 'hinge' has no <limit>"),
        ('"0 1 0"', '"0 0 0"', "joint 'hinge' has a zero axis"),
        ('type="revolute"', 'type="planar"', "joint 'hinge' is of type 'planar'; known: revolute, continuous"),
        ('type="revolute"', 'type="prismatic"', None),
        ('<child link="finger"/>', "", "joint 'hinge' has no <child link"),
        ('name="finger"', 'name="palm"', "link 'palm' is defined twice"),
        ('name="finger"', 'name=""', "a <link> has no name"),
        ('name="finger"', 'name="fin&#10;ger"', r"tiny.urdf:1: link 'fin\\nger' has a name with a line end"),
        ('xyz="0 0 0.03"', 'xyz="0 0 30"', r"joint 'hinge': <origin xyz='0 0 30'>: more than 10 m away"),
        ("<box", "<blob", "link 'palm': unknown collision shape <blob>; known: box, sphere, cylinder, capsule, mesh"),
        ('size="0.02 0.02 0.04"', 'size="20 20 40"', "link 'palm': <box size='20 20 40'>: larger than 2 m"),
        ('<box size="0.02 0.02 0.04"/>', "", "link 'palm': a <collision> element has no geometry"),
        ("<collision>", '<inertial><mass value="-1"/></inertial><collision>', "link 'palm' has a negative mass"),
        (HINGE, "", "one root link, this file has 2: palm, finger"),
        (f'<link name="finger">{BOX}</link>{HINGE}', "", r"'tiny' has no joint that moves \(1 links\)"),
        ('<child link="finger"/>', '<child link="thumb"/>', "child link 'thumb', which the file does not define"),
        ('xyz="0 1 0"', 'xyz="0 up 0"', "<axis xyz='0 up 0'>: expected 3 finite number"),
        ('size="0.02 0.02 0.04"', 'size="0.02 0 0.04"', "sizes must be positive"),
        ("</robot>", LOOP, "not reachable from the root: x, y"),
        ("</robot>", HINGE.replace('"hinge"', '"second"') + "</robot>", "link 'finger' is the child of two joints"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path: Path, old: str, new: str, message: str | None) -> None:
    text = _changed((old, new))
    if message is None:
        assert _read(tmp_path, text).slides.all()
        return
    with pytest.raises(HandError, match=message) as caught:
        _read(tmp_path, text)
    assert str(caught.value).startswith(str(tmp_path / "tiny.urdf"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("before", ["", "<?xml version='1.0'?>\n", "<!-- a\nb --><?xml version='1.0'?>\n\n", "\n \n"])
def test_errors_name_the_line_of_the_file(tmp_path: Path, before: str) -> None:
    line = before.count("\n") + 2
    with pytest.raises(HandError, match=rf"tiny.urdf:{line}: joint 'hinge' has a zero axis"):
        _read(tmp_path, before + _changed(("<joint", "\n<joint"), ('"0 1 0"', '"0 0 0"')))


@pytest.mark.parametrize(
    "text",
    [
        "<!--" * 200_000,
        "<?xml " * 200_000,
        "<?xml encoding='punycode'?>" + "a" * 500_000 + "-" + "a" * 2_000_000,
    ],
    ids=["comments", "headers", "encoding"],
)
def test_a_file_made_to_take_long_is_refused_soon(tmp_path: Path, text: str) -> None:
    """Read in quadratic time, each would take minutes, and the test's time would be over."""
    with pytest.raises(HandError, match="not well-formed"):
        _read(tmp_path, text)


@pytest.mark.parametrize(
    ("text", "message"),
    [("<link/>" * 301, "301 links"), ("<joint/>" * 301, "301 joints"),
     (f"<link>{'<visual/>' * 2001}</link>", "2001 collision and visual shapes")],
)  # fmt: skip
def test_a_crowd_is_refused_before_it_is_looked_at(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(HandError, match=f"tiny.urdf: {message}; a hand has at most"):
        _read(tmp_path, f"<robot>{text}</robot>")


def test_a_file_without_end_is_refused() -> None:
    with pytest.raises(HandError, match="larger than 32 MiB"):
        read_hand_file(Path("/dev/zero"))


def test_other_formats_are_named(tmp_path: Path) -> None:
    with pytest.raises(HandError, match="the root element is <sdf>; a URDF has <robot>, an MJCF file <mujoco>"):
        _read(tmp_path, "<sdf/>")
    with pytest.raises(HandError, match="no link has a collision or a visual shape"):
        _read(tmp_path, HAND.replace(BOX, ""))
    with pytest.raises(HandError, match="nested more than 150 deep"):
        _read(tmp_path, "<robot>" + "<link>" * 3000)
    with pytest.raises(HandError, match=r"tiny.urdf: cannot be read"):
        read_hand_file(tmp_path / "none" / "tiny.urdf")
