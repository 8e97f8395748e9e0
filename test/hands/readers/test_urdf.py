"""Each URDF loads as its author meant it, coupled joints included, or is refused by one line that names the element."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from expected import refused

from graspd_core.errors import HandError
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.library import DEFAULT_EFFORT, DEFAULT_FORCE, load_hand, read_hand_file
from graspd_core.hands.model import HandModel, Mimic, all_joint_names, all_joint_positions

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

END = "</robot>"
STUCK = (
    '<link name="x"/><joint name="stuck" type="revolute"><parent link="palm"/><child link="x"/>'
    "<limit {}/></joint></robot>"
)
HUNG = '<link name="{0}"/><joint name="w" type="{1}"><parent link="{0}"/><child link="palm"/></joint></robot>'
DROPPED = "link '{}' and {} joint 'w' above the base 'palm' were dropped"


def _read(tmp_path: Path, text: str | bytes) -> HandModel:
    path = tmp_path / "tiny.urdf"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_hand_file(path)


@pytest.mark.parametrize(
    ("radius", "shift", "kinds"),
    [
        (0.01, 0.0, ["capsule"]),
        (0.009, 0.0, ["cylinder", "sphere", "sphere"]),
        (0.01, 0.002, ["cylinder"] + ["sphere"] * 2),
    ],
)
def test_a_cylinder_with_its_balls_is_a_capsule(tmp_path: Path, radius: float, shift: float, kinds: list[str]) -> None:
    """Turned a quarter about y its axis lies along x; balls of another size or at another place are their own."""
    ball = '<collision><origin xyz="{} 0 0"/><geometry><sphere radius="{}"/></geometry></collision>'
    rod = '<cylinder radius="0.01" length="0.04"/>'
    rod = f'<collision><origin rpy="0 1.570796327 0"/><geometry>{rod}</geometry></collision>'
    text = ball.format(0.02 + shift, radius) + rod + ball.format(-0.02, radius)
    finger = [p for p in _read(tmp_path, HAND.replace(BOX, text, 1)).primitives if p.link == 0]
    assert sorted(p.kind for p in finger) == kinds
    if kinds == ["capsule"]:
        assert finger[0].size == (0.01, 0.02)
        assert np.allclose(finger[0].rotation[:, 2], [1, 0, 0])


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
        ("<collision>", "<visual>", r"the <visual> is used: palm"),
        ('type="revolute"', 'type="continuous"', r"joint 'hinge' has no limits: restricted to \[-3.14, 3.14\] rad"),
        ('upper="1"', 'upper="1e9"', r"joint 'hinge' has limits more than two turns apart: restricted to \[-0.5, "),
        (END, HUNG.format("world", "fixed"), DROPPED.format("world", "fixed")),
        (END, HUNG.format("up", "floating"), DROPPED.format("up", "floating")),
        (END, STUCK.format('lower=".3" upper=".3"'), "joint 'stuck' cannot move: its limits coincide; taken as fixed"),
        (
            END,
            STUCK.format('effort="3" velocity="1"'),
            "joint 'stuck' cannot move: its limits coincide at 0, which is what a <limit> without lower and upper",
        ),
    ],
)
def test_what_is_mended_leaves_a_warning(tmp_path: Path, old: str, new: str, warning: str) -> None:
    text = _changed((old, new)).replace("</collision>", "</visual>", 1 if new == "<visual>" else 0)
    hand = _read(tmp_path, text)
    assert (hand.base_link, hand.joint_names) == ("palm", ("hinge",))
    assert np.isfinite([hand.lower, hand.upper]).all()
    assert re.search(warning, "\n".join(hand.warnings))


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


TWINS = "".join(
    f'<link name="{side}_palm">{BOX}</link><joint name="{side}_arm" type="fixed"><parent link="torso"/>'
    f'<child link="{side}_palm"/><origin xyz="0 {y} 0"/></joint>'
    + "".join(
        f'<link name="{side}_{k}">{BOX}</link>'
        + HINGE.replace("hinge", f"{side}_j{k}").replace('"palm"', f'"{side}_palm"').replace("finger", f"{side}_{k}")
        for k in "ab"
    )
    for side, y in (("left", 0.3), ("right", -0.3))
)
# The half of a 2F-140: the outer knuckle carries the finger, the inner one beside it carries nothing.
KNUCKLES = "".join(
    f'<link name="{child}">{BOX}</link><joint name="{child}_joint" type="revolute"><parent link="{parent}"/>'
    f'<child link="{child}"/><origin xyz="{at}" rpy="{rpy}"/><axis xyz="1 0 0"/>'
    '<limit lower="0" upper="0.7" effort="10" velocity="1"/>{}</joint>'
    for parent, child, at, rpy in (
        ("palm", "outer_knuckle", "0 -0.0306 0.0549", "2.3 0 0"),
        ("outer_knuckle", "inner_finger", "0 0.0818 0.1", "0 0 0"),
        ("palm", "inner_knuckle", "0 -0.0127 0.0614", "2.3 0 0"),
    )
)
MIMIC = '<mimic joint="outer_knuckle_joint"/>'


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            HAND.replace('lower="-0.5" upper="1"', 'lower="-20" upper="90"'),
            "joint 'hinge': limits of -20 to 90 rad; if they are in degrees, write radians",
        ),
        (HAND.replace('effort="2"', 'effort="6e4"'), "joint 'hinge': implausible effort of 6e+04 N·m; valid: up to"),
        (f'<robot name="two"><link name="torso"/>{TWINS}</robot>', "fingers hang from 'left_palm' and 'right_palm'"),
        (
            f'<robot name="open"><link name="palm">{BOX}</link>{KNUCKLES.format("", "", "")}</robot>',
            "joints 'outer_knuckle_joint' and 'inner_knuckle_joint' look like parts of a closed linkage",
        ),
    ],
    ids=["degrees", "effort", "two hands", "open linkage"],
)
def test_what_a_hand_can_hardly_have_is_warned_of(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "tiny.urdf").write_text(text)
    hand = load_hand(tmp_path / "tiny.urdf", candidates=20)
    assert [warning for warning in hand.warnings if warning.startswith(told)], hand.warnings
    assert all(warning.startswith(f"hand {hand.name}: ") for warning in hand.named_warnings)


def test_what_is_as_it_should_be_is_not_warned_of(tmp_path: Path) -> None:
    """Coupled joints follow, and the description sets an effort. test_boxed_hands.py has the shipped hands."""
    (tmp_path / "a.urdf").write_text(
        f'<robot name="closed"><link name="palm">{BOX}</link>{KNUCKLES.format("", MIMIC, MIMIC)}</robot>'
    )
    assert not [w for w in load_hand(tmp_path / "a.urdf", candidates=20).warnings if "linkage" in w]
    (tmp_path / "tiny.urdf").write_text(HAND.replace('effort="2"', 'effort="6e4"'))
    (tmp_path / "tiny.yaml").write_text("urdf: tiny.urdf\neffort: 2.0\n")
    assert not [w for w in load_hand(tmp_path / "tiny.yaml", candidates=20).warnings if "effort" in w]


def test_a_xacro_file_is_named_with_the_command(tmp_path: Path) -> None:
    (tmp_path / "my.urdf.xacro").write_text(HAND)
    with pytest.raises(HandError, match=r"my.urdf.xacro: is a xacro file; .*: xacro my.urdf.xacro > hand.urdf"):
        load_hand(tmp_path / "my.urdf.xacro")


def test_warnings_of_a_hand_come_with_the_grasps_and_into_the_file(tmp_path: Path, capsys) -> None:
    from graspd_core.cli import main

    (tmp_path / "tiny.urdf").write_text(HAND.replace('lower="-0.5" upper="1"', 'lower="-20" upper="90"'))
    words = ["shape:sphere", "--hand", str(tmp_path / "tiny.urdf"), "-n", "1", "--verify", "none", "--preset", "fast"]
    main(["synthesize", *words, "--out", str(tmp_path / "grasps.json")])
    told = "hand tiny: joint 'hinge': limits of -20 to 90 rad; if they are in degrees, write radians"
    assert f"graspd: {told}" in capsys.readouterr().err
    assert told in json.loads((tmp_path / "grasps.json").read_text())["outcome"]["warnings"]


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
        ('name="finger"', 'name="fin&#10;ger"', r"tiny.urdf:1: link 'fin\\nger' has a name with a line break"),
        ('xyz="0 0 0.03"', 'xyz="0 0 30"', r"joint 'hinge': <origin xyz='0 0 30'>: exceeds 10 m"),
        ("<box", "<blob", "link 'palm': unknown collision shape <blob>; known: box, sphere, cylinder, capsule, mesh"),
        ('size="0.02 0.02 0.04"', 'size="20 20 40"', "link 'palm': <box size='20 20 40'>: larger than 2 m"),
        ('<box size="0.02 0.02 0.04"/>', "", "link 'palm': a <collision> has no <geometry> with a shape; valid: box,"),
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
    with refused(HandError, start=str(tmp_path / "tiny.urdf"), match=message):
        _read(tmp_path, text)


@pytest.mark.parametrize("before", ["", "<?xml version='1.0'?>\n", "<!-- a\nb --><?xml version='1.0'?>\n\n", "\n \n"])
def test_errors_name_the_line_of_the_file(tmp_path: Path, before: str) -> None:
    line = before.count("\n") + 2
    with pytest.raises(HandError, match=rf"tiny.urdf:{line}: joint 'hinge' has a zero axis"):
        _read(tmp_path, before + _changed(("<joint", "\n<joint"), ('"0 1 0"', '"0 0 0"')))


@pytest.mark.parametrize(
    "text",
    ["<!--" * 200_000, "<?xml " * 200_000, "<?xml encoding='punycode'?>" + "a" * 500_000 + "-" + "a" * 2_000_000],
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


def test_a_chain_has_at_most_a_hundred_joints(tmp_path: Path) -> None:
    joint = '<joint name="j{0}" type="fixed"><parent link="{1}"/><child link="l{0}"/></joint><link name="l{0}"/>'
    chain = [joint.format(k, f"l{k - 1}" if k else "finger") for k in range(100)]
    assert _read(tmp_path, _changed(("</robot>", "".join(chain[:99]) + "</robot>"))).num_links == 101
    with pytest.raises(HandError, match="at most 100 joints from the root"):
        _read(tmp_path, _changed(("</robot>", "".join(chain) + "</robot>")))


def test_a_file_without_end_is_refused() -> None:
    with pytest.raises(HandError, match="too large; valid: at most 32 MiB"):
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


@pytest.fixture(scope="module")
def hand(tmp_path_factory: pytest.TempPathFactory) -> HandModel:
    return _read(tmp_path_factory.mktemp("linkage"), LINKAGE)


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
    assert _read(tmp_path, fast).velocity.tolist() == [0.5]


def test_limits_of_the_wrong_sign_are_given_up_with_a_warning_but_not_the_speed(tmp_path: Path) -> None:
    fast = LIMIT.format(-1, 1, 0, 9)
    wrong = robot(
        joint("first", "base", "a", limit=LIMIT.format(0, 0.8, 1, 1)),
        joint("second", "a", "b", mimic=follows("first", multiplier=-1), limit=LIMIT.format(0, 0.8, 1, 0.25)),
        joint("third", "a", "c", kind="continuous", mimic=follows("first", multiplier=9), limit=fast),
        joint("still", "base", "d", kind="fixed"),
    )
    hand = _read(tmp_path, wrong)
    assert (hand.lower.tolist(), hand.upper.tolist(), hand.velocity.tolist()) == ([0.0], [0.8], [0.25])
    assert len(hand.warnings) == 1
    assert "'second'" in hand.warnings[0]


def test_a_follower_in_another_unit_is_refused(tmp_path: Path) -> None:
    slide = joint(
        "rail", "base", "d", kind="prismatic", mimic=follows("first", multiplier=50), limit=LIMIT.format(-50, 50, 1, 9)
    )
    millimetres = robot(joint("first", "base", "a"), slide, joint("b", "a", "b"), joint("c", "a", "c"))
    with pytest.raises(HandError, match=r"tiny.urdf: joint 'rail' has a travel of 100 m; .* at most 2 m"):
        _read(tmp_path, millimetres)


@pytest.mark.parametrize(
    ("mimic", "message"),
    [
        (follows("first"), "circle: first -> first"),
        (follows("second"), "circle: first -> second -> first"),
        (follows("lost"), r"joint 'first' mimics 'lost', which is not a movable joint; valid: first, second"),
        (follows("weld"), "joint 'first' mimics 'weld', which is not a movable joint"),
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
        _read(tmp_path, text)


def test_a_sliding_joint_has_its_own_scale_and_default_force(tmp_path: Path) -> None:
    (tmp_path / "linkage.urdf").write_text(LINKAGE)
    hand = load_hand(tmp_path / "linkage.urdf", candidates=20)
    assert hand.slides.tolist() == [False, True]
    assert hand.joint_scale.tolist() == [1.0, 0.05]
    assert hand.effort.tolist() == [DEFAULT_EFFORT, DEFAULT_FORCE]
    told = [w.partition("given for ")[2].partition(";")[0] for w in hand.warnings if "no effort" in w]
    assert told == ["first: 0.7 N·m is assumed", "rail: 40 N is assumed"]
