"""Each URDF loads as its author meant it, coupled joints included, or is refused by one line that names the element."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graspd_core.errors import HandError
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.library import DEFAULT_EFFORT, DEFAULT_FORCE, load_hand, read_hand_file
from graspd_core.hands.model import HandModel, Mimic, all_joint_names, all_joint_positions
from graspd_core.hands.readers.urdf import read_urdf

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
        (
            "</robot>",
            '<link name="x"/><joint name="stuck" type="revolute"><parent link="palm"/><child link="x"/>'
            '<limit effort="3" velocity="1"/></joint></robot>',
            r"joint 'stuck' cannot move: its limits coincide at 0, which is what a <limit> without lower and upper",
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
        (
            '<limit lower="-0.5" upper="1"',
            "<limit",
            r"'tiny' has no joint that moves \(2 links\).*; joint 'hinge' cannot move: .* at 0",
        ),
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


SMALL_BOX = '<collision><geometry><box size="0.01 0.01 0.01"/></geometry></collision>'
LIMIT = '<limit lower="{}" upper="{}" effort="{}" velocity="{}"/>'


def joint(name: str, parent: str, child: str, *, kind: str = "revolute", limit: str = "", mimic: str = "") -> str:
    limit = limit or LIMIT.format(-1, 1, 0, 2)
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0.02 0.01 0.03" rpy="0.3 -0.2 0.5"/><axis xyz="0 1 1"/>{limit}{mimic}</joint>'
    )


def robot(*joints: str) -> str:
    links = "".join(f'<link name="{name}">{SMALL_BOX}</link>' for name in ("base", "a", "b", "c", "d"))
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


def test_only_joints_that_lead_are_variables_and_keep_their_followers_within_limits(hand: HandModel) -> None:
    assert hand.joint_names == ("first", "rail")
    assert all_joint_names(hand) == ("first", "second", "third", "rail")
    index = hand.link_index
    # c follows b: -2 (0.5 q - 0.2) + 0.1.
    assert hand.mimics == (Mimic("second", index["b"], 0, 0.5, -0.2), Mimic("third", index["c"], 0, -1.0, 0.5))
    assert hand.link_joint.tolist() == [-1, 0, 0, 0, 1]
    assert all_joint_positions(hand, np.array([0.6, 0.05])).tolist() == pytest.approx([0.6, 0.1, -0.1, 0.05])
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
