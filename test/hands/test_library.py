"""Loading hands: names, descriptions, bare URDFs, and errors that name the culprit."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from graspd_core.errors import HandError
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import Mount
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
    assert any("joint 'hinge' turns without end" in text for text in hand.warnings)
    assert (hand.lower, hand.upper) == (pytest.approx([-np.pi]), pytest.approx([np.pi]))
    assert hand.effort == pytest.approx([0.7])  # an effort of 0 is a placeholder, not a locked joint
    np.testing.assert_allclose(hand.joint_axis[1], [0, 1, 0])
    hull = hand.primitives_of[1][0]
    assert hull.kind == "hull"
    np.testing.assert_allclose(np.ptp(hull.vertices, axis=0), [0.01, 0.02, 0.04])
    assert len(hull.vertices) == 8
    np.testing.assert_allclose(hull.translation, [0, 0, 0.02])
    assert len(hand.candidate_points) == 40
    assert {0, 1} == set(hand.candidate_link.tolist())


def test_unknown_hand_lists_the_known_ones() -> None:
    with pytest.raises(HandError, match=r"unknown hand 'alegro'; known: .*allegro_right"):
        load_hand("alegro")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("approach: [1.0, 0.0, 0.0]", "approche: [1, 0, 0]", r"yaml:\d+: unknown key 'approche'; known: .*approach"),
        ("  link: base_link", "  lnik: base_link", r"yaml:\d+: unknown key 'lnik'; known: link, center, normal"),
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
                ("{parent: t, pose: 1}", "unknown key 'pose'; known: parent, position, quaternion_wxyz"),
                ("{parent: t, position: [0, 0]}", r"mount.position: expected 3 numbers, got \[0, 0\]"),
                ("{parent: t, position: [0, 0, .nan]}", "mount.position: expected 3 numbers"),
                ("{parent: t, quaternion_wxyz: [1, 1, 0, 0]}", "mount.quaternion_wxyz: .*length 1, not 1.41"),
            )
        ),
    ],
)
def test_a_bad_description_is_refused_by_line_and_key(allegro_copy: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(HandError, match=message) as caught:
        load_hand(_edit(allegro_copy, old, new))
    assert "\n" not in str(caught.value)


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


def test_a_description_that_is_no_mapping_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "hand.yaml"
    path.write_text("- 1\n")
    with pytest.raises(HandError, match=r"hand.yaml:1: the file: expected a mapping"):
        read_description(path)


@pytest.mark.parametrize("count", [0, -5])
def test_no_candidates_is_refused(count: int) -> None:
    with pytest.raises(HandError, match="candidates="):
        load_hand("allegro_right", candidates=count)
