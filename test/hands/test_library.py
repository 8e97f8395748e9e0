"""Loading hands: names, descriptions, bare URDFs, errors that name the culprit; and the report on a hand."""

import dataclasses
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from expected import refused

from graspd_bench.rendering.render import hand_picture
from graspd_core.cli import main
from graspd_core.cli.hands_command import as_text, as_yaml
from graspd_core.errors import HandError
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import HandModel, Mount
from graspd_core.hands.readers.description import read_description
from graspd_core.paths import config_dir

GRIPPER = """<!-- a comment before the header, and a namespace that nobody declared -->
<?xml version="1.0"?>
<robot name="pincer">
  <link name="body"><collision><geometry><box size="0.06 0.06 0.04"/></geometry></collision></link>
  <link name="finger"><collision><origin xyz="0 0 0.02"/>
    <geometry><mesh filename="package://pincer/meshes/finger.obj" scale="0.001 0.001 0.001"/></geometry>
  </collision></link>
  <joint name="hinge" type="continuous">
    <parent link="body"/><child link="finger"/><origin xyz="0 0 0.03"/><axis xyz="0 2 0"/>
    <limit effort="0" velocity="0"/>
  </joint>
  <gazebo><sensor:camera on="1"/></gazebo>
</robot>"""

# A box of 10 x 20 x 40 mm, in millimetres, with a dent that its hull fills.
FINGER_OBJ = """
v -5 -10 -20\nv 5 -10 -20\nv 5 10 -20\nv -5 10 -20
v -5 -10 20\nv 5 -10 20\nv 5 10 20\nv -5 10 20\nv 0 0 10
f 1 3 2\nf 1 4 3\nf 1 2 6\nf 1 6 5\nf 2 3 7\nf 2 7 6\nf 3 4 8\nf 3 8 7\nf 4 1 5\nf 4 5 8
f 5 6 9\nf 6 7 9\nf 7 8 9\nf 8 5 9
"""


@pytest.fixture
def gripper(tmp_path: Path) -> Path:
    (tmp_path / "pincer" / "meshes").mkdir(parents=True)
    (tmp_path / "pincer" / "urdf").mkdir()
    (tmp_path / "pincer" / "meshes" / "finger.obj").write_text(FINGER_OBJ)
    path = tmp_path / "pincer" / "urdf" / "pincer.urdf"
    path.write_text(GRIPPER)
    return path


@pytest.fixture
def allegro_copy(tmp_path: Path) -> Path:
    for name in ("allegro_right.yaml", "allegro_right.urdf"):
        shutil.copy(config_dir() / "hands" / name, tmp_path / name)
    return tmp_path / "allegro_right.yaml"


def _edit(path: Path, old: str, new: str) -> Path:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    return path


def test_a_bare_urdf_with_a_mesh_loads_with_a_warning(gripper: Path) -> None:
    hand = load_hand(gripper, candidates=40)
    assert hand.name == "pincer"
    assert any("palm guessed" in text for text in hand.warnings)
    assert any("open and closed posture guessed" in text for text in hand.warnings)
    assert any("joint 'hinge' has no limits" in text for text in hand.warnings)
    assert (hand.lower, hand.upper) == (pytest.approx([-np.pi]), pytest.approx([np.pi]))
    told = "no effort is given for hinge: 0.7 N·m is assumed; set `effort` in a hand description"
    assert told in hand.warnings
    assert hand.effort == pytest.approx([0.7])  # an effort of 0 is a placeholder, not a locked joint
    np.testing.assert_allclose(hand.joint_axis[1], [0, 1, 0])
    hull = hand.primitives_of[1][0]
    assert hull.kind == "hull"
    np.testing.assert_allclose(np.ptp(hull.vertices, axis=0), [0.01, 0.02, 0.04])
    assert len(hull.vertices) == 8
    np.testing.assert_allclose(hull.translation, [0, 0, 0.02])
    assert len(hand.candidate_points) == 40
    assert {0, 1} == set(hand.candidate_link.tolist())


def test_unknown_hand_lists_the_known_ones_and_a_description_that_is_no_mapping_is_refused(tmp_path: Path) -> None:
    with pytest.raises(HandError, match=r"unknown hand 'alegro'; did you mean 'allegro_left'"):
        load_hand("alegro")
    path = tmp_path / "hand.yaml"
    path.write_text("- 1\n")
    with pytest.raises(HandError, match=r"hand.yaml:1: the file: expected a mapping"):
        read_description(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("approach: [1.0, 0.0, 0.0]", "approche: [1, 0, 0]", r":\d+: unknown key 'approche'; did you mean 'approach'"),
        ("  link: base_link", "  lnik: base_link", r"yaml:\d+: unknown key 'lnik'; did you mean 'link'"),
        ("  link: base_link", "  link: link_3.0", r"yaml:\d+: palm.link: 'link_3.0' is not fixed to the base"),
        ("joint_1.0: 0.35", "joint_1.0: 2.5", r"yaml:\d+: open.joint_1.0: 2.5 is outside the limits \[-0.196, 1.61\]"),
        ("  joint_1.0: 0.35\n", "", r"yaml:\d+: open: no value for joint_1.0"),
        ("joint_1.0: 0.35", "joint_x: 0.35", r"yaml:\d+: open.joint_x: no such joint"),
        ("joint_1.0: 0.35", "joint_1.0: wide", r"yaml:\d+: open.joint_1.0: expected a number, got 'wide'"),
        ("normal: [1.0, 0.0, 0.0]", "normal: [0, 0, 0]", r"yaml:\d+: palm.normal: a direction cannot be zero"),
        ("normal: [1.0, 0.0, 0.0]", "normal: [1, 0", r"yaml:\d+: not well-formed YAML"),
        ("effort: 0.7", "effort: -1", r"yaml:\d+: effort: expected positive numbers"),
        ("urdf: allegro_right.urdf", "urdf: lost.urdf", r"lost.urdf: cannot be read"),
        ("closed:", "shut:", r"unknown key 'shut'"),
        ("  joint_1.0: 0.35", "  joint_1.0: &a {x: *a}", r"yaml:\d+: open.joint_1.0: expected a number, got \{'x'"),
        ("effort: 0.7", "effort: {0x10: a}", r"yaml:\d+: effort.16: expected a number, got 'a'"),
        ("palm:\n", "<<: {mount: 3}\npalm:\n", r"yaml:\d+: mount: expected a mapping"),
        ("urdf: allegro_right.urdf", "urdf: !file allegro_right.urdf", r"yaml:\d+: not well-formed YAML: could not"),
        ("urdf: allegro_right.urdf", "urdf: 2026-99-99", r"yaml:1: not well-formed YAML: ValueError"),
        ("effort: 0.7", "effort: " + "[" * 3000, r"yaml:\d+: not well-formed YAML"),
        *(
            ("effort: 0.7", f"mount: {mount}", rf"yaml:\d+: {message}")
            for mount, message in (
                ("tool0", "mount: expected a mapping of keys to values, got 'tool0'"),
                ("{position: [0, 0, 0]}", "mount.parent is missing"),
                ("{parent: 3}", "mount.parent: expected text, got 3"),
                ("{parent: t, pose: 1}", "unknown key 'pose'; valid: parent, position, quaternion_wxyz"),
                ("{parent: t, position: [0, 0]}", r"mount.position: expected 3 numbers, got \[0, 0\]"),
                ("{parent: t, position: [0, 0, .nan]}", "mount.position: expected 3 numbers"),
                ("{parent: t, quaternion_wxyz: [1, 1, 0, 0]}", "mount.quaternion_wxyz: length 1.41; valid: a unit"),
            )
        ),
    ],
)
def test_a_bad_description_is_refused_by_line_and_key(allegro_copy: Path, old: str, new: str, message: str) -> None:
    with refused(HandError, match=message):
        load_hand(_edit(allegro_copy, old, new))


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        (
            "mount: {parent: tool0, position: [0, 0, 0.02], quaternion_wxyz: [0.7071, 0, 0, 0.7071]}\n",
            Mount("tool0", (0.0, 0.0, 0.02), (0.5**0.5, 0.0, 0.0, 0.5**0.5)),
        ),
        ("mount: {parent: flange}\n", Mount("flange", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))),
        ("", None),
    ],
)
def test_a_mount_is_read_and_its_quaternion_made_exact(allegro_copy: Path, entry: str, expected: Mount | None) -> None:
    allegro_copy.write_text(allegro_copy.read_text() + entry)
    mount = load_hand(allegro_copy, candidates=8).mount
    assert (mount is None) == (expected is None)
    if mount is not None and expected is not None:
        assert (mount.parent, mount.position) == (expected.parent, expected.position)
        assert mount.quaternion_wxyz == pytest.approx(expected.quaternion_wxyz, abs=1e-15)


@pytest.mark.parametrize("count", [0, -5])
def test_no_candidates_is_refused(count: int) -> None:
    with pytest.raises(HandError, match="candidates: "):
        load_hand("allegro_right", candidates=count)


@pytest.fixture(scope="module")
def hand() -> HandModel:
    return load_hand("barrett_like", candidates=80)


def test_the_report_counts_what_is_there_and_names_every_link_and_joint(hand: HandModel) -> None:
    text = as_text(dataclasses.replace(hand, warnings=("something was mended",)))
    assert sum(map(int, re.findall(r"(\d+) candidates$", text, re.MULTILINE))) == 80
    assert f"{hand.num_joints} actuated joints, {len(hand.mimics)} coupled" in text
    assert len(re.findall(r"^  \S.* candidates$", text, re.MULTILINE)) == 1
    checked, pairs = map(int, re.findall(r"self-collision: (\d+) of (\d+)", text)[0])
    assert 0 < checked < pairs
    assert len(hand.mimics) > 0
    for name in (*hand.link_names, *hand.joint_names, *(mimic.name for mimic in hand.mimics)):
        assert name in text
    assert "warning: something was mended" in text
    assert f"= {hand.mimics[0].multiplier:g} · " in text


@pytest.mark.parametrize("name", ["barrett_like", "leap_right"])
def test_the_written_description_loads_as_the_same_hand(name: str, tmp_path: Path) -> None:
    hand = load_hand(name, candidates=10)
    path = tmp_path / "again.yaml"
    path.write_text(as_yaml(hand, hand.urdf))
    again = load_hand(path, candidates=10)
    np.testing.assert_allclose(again.palm_center, hand.palm_center, atol=1e-4)
    np.testing.assert_allclose(again.open_posture, hand.open_posture, atol=1e-3)
    np.testing.assert_allclose(again.closed_posture, hand.closed_posture, atol=1e-3)
    assert again.warnings == ()


def test_awkward_names_and_tiny_limits_are_written_so_that_they_are_read(tmp_path: Path) -> None:
    text = (config_dir() / "hands" / "parallel_gripper.urdf").read_text()
    base = load_hand("parallel_gripper", candidates=10)
    (tmp_path / "a #1.urdf").write_text(text.replace(f'"{base.base_link}"', '"7: up"'))
    hand = load_hand(tmp_path / "a #1.urdf", candidates=10)
    lower = hand.lower + 1e-5
    hand = dataclasses.replace(hand, lower=lower, open_posture=lower, closed_posture=lower)
    path = tmp_path / "again.yaml"
    path.write_text(as_yaml(hand, "a #1.urdf"))
    again = load_hand(path, candidates=10)
    assert again.base_link == "7: up"
    assert again.open_posture.tolist() == hand.lower.tolist()


def test_the_picture_shows_hand_candidates_and_palm(hand: HandModel) -> None:
    image = hand_picture(hand).astype(int)
    height, width, _ = image.shape
    red, green, blue = image[..., 0], image[..., 1], image[..., 2]
    for rows in (slice(0, height // 2), slice(height // 2, None)):
        for columns in (slice(0, width // 2), slice(width // 2, None)):
            view = (rows, columns)
            assert ((blue > red + 15) & (green < blue))[view].mean() > 0.02
            assert (red > 1.5 * blue)[view].sum() > 50
            assert (green > 1.5 * np.maximum(red, blue))[view].sum() > 20
            # Nothing is cut off at the picture's edge.
            assert (image[view][[0, -1]] == 255).all()


def test_the_command_inspects_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture, description = tmp_path / "gripper.png", tmp_path / "gripper.yaml"
    urdf = config_dir() / "hands" / "parallel_gripper.urdf"
    options = ["--candidates", "40", "--picture", str(picture), "--yaml", str(description)]
    assert main(["hands", "inspect", str(urdf), *options]) == 0
    shown = capsys.readouterr().out
    assert "left_jaw" in shown
    assert "warning: palm guessed" in shown
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert load_hand(description, candidates=10).warnings == ()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.urdf"], "nowhere.urdf: no such file"),
        (["allegro_right", "--picture", "hand.jpg"], "hand.jpg; valid: a file name that ends in .png"),
        (["MANO_RIGHT.pkl", "--yaml", "hand.yaml"], "--yaml: MANO_RIGHT.pkl is a MANO file; valid: a hand"),
    ],
)
def test_the_command_refuses_in_one_line(arguments, message, refusal_of, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert message in refusal_of("hands", "inspect", *arguments)
