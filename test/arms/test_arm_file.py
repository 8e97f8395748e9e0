"""Arm descriptions: what is taken of a URDF, and one clear error for each mistake."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from graspd_core import load_hand
from graspd_core.arms.arm import Arm, arm_links, arm_names, load_arm, tip_hand
from graspd_core.arms.arm_collision import hits_of_self
from graspd_core.arms.inverse_kinematics import start_table
from graspd_core.errors import ConfigError, GraspdError
from graspd_core.paths import config_dir

ROBOT = """<robot name="cell">
  <link name="world"/>
  <joint name="stand" type="fixed"><parent link="world"/><child link="pedestal"/></joint>
  <link name="pedestal"/>
  <joint name="j1" type="revolute"><parent link="pedestal"/><child link="a"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <link name="a"/>
  <joint name="camera_mount" type="fixed"><parent link="a"/><child link="camera"/></joint>
  <link name="camera"><collision><geometry><box size="0.1 0.02 0.02"/></geometry></collision></link>
  <joint name="j2" type="revolute"><parent link="a"/><child link="flange"/><origin xyz="0.4 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <link name="flange"/>
  <joint name="finger" type="prismatic"><parent link="flange"/><child link="jaw"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.04" effort="1" velocity="1"/></joint>
  <link name="jaw"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
</robot>
"""


def write(folder: Path, **keys: object) -> Path:
    """A description of the robot above, with keys as given; None leaves one out."""
    (folder / "cell.urdf").write_text(ROBOT)
    entries = {"urdf": "cell.urdf", "tip": "flange", **keys}
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in entries.items() if value is not None}))
    return path


def test_an_arm_is_cut_out_of_a_robot(tmp_path: Path):
    """What hangs behind the tip, and the jaw that another joint moves, are no part of it; the camera on it is."""
    arm = load_arm(write(tmp_path, base="pedestal", seed={"j1": 1}, limits={"j2": [-0.5, 0.25]}))
    assert arm.name == "cell"
    assert arm.joint_names == ("j1", "j2")
    assert set(arm.chain.link_names) == {"pedestal", "a", "camera", "flange"}
    assert arm.chain.link_names[arm.tip] == "flange"
    assert arm.seed.tolist() == [1.0, -0.125]
    assert (arm.lower.tolist(), arm.upper.tolist()) == ([-2.0, -0.5], [2.0, 0.25])
    assert len(arm.capsules.radius) == 1
    assert arm.capsules.radius[0] >= 0.01


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        ({"tip": "gripper"}, r"cell.yaml.tip: no link 'gripper' in the URDF; links: world, pedestal, a, camera"),
        ({"base": "floor"}, r"cell.yaml.base: no link 'floor' in the URDF; links: world"),
        ({"base": "camera"}, r"cell.yaml.base: 'camera' is not above the tip 'flange'; above it: a, pedestal, world"),
        ({"tip": None}, r"cell.yaml: tip is missing; keys: urdf, tip, base"),
        ({"urdf": None}, r"cell.yaml: urdf is missing"),
        ({"urdf": "other.urdf"}, r"other.urdf: cannot be read: No such file"),
        ({"tool": "flange"}, r"cell.yaml: unknown key 'tool'; valid keys: base, limits, mounts, name, seed, tip, urdf"),
        ({"tip": 3}, r"cell.yaml.tip: expected str, got 3"),
        ({"seed": [0, 0]}, r"cell.yaml.seed: expected dict, got \[0, 0\]"),
        ({"seed": {"j3": 0}}, r"cell.yaml.seed: no joint 'j3'; joints: j1, j2"),
        ({"seed": {"j2": 1.5}}, r"cell.yaml.seed.j2: 1.5 is no number within the limits \[-1, 1\]"),
        ({"seed": {"j2": "up"}}, r"cell.yaml.seed.j2: 'up' is no number"),
        ({"limits": {"finger": [0, 1]}}, r"cell.yaml.limits: no joint 'finger'; joints: j1, j2"),
        ({"limits": {"j1": [-3, 2]}}, r"cell.yaml.limits.j1: \[-3, 2\] is no range within the URDF's \[-2, 2\]"),
        ({"limits": {"j1": [1, 0]}}, r"cell.yaml.limits.j1: \[1, 0\] is no range"),
        ({"limits": {"j1": 2}}, r"cell.yaml.limits.j1: expected a lower and an upper number, got 2"),
        ({"limits": {"j1": [0, float("nan")]}}, r"cell.yaml.limits.j1: expected a lower and an upper number"),
        ({"mounts": {"x": {"position": [0, 0]}}}, r"cell.yaml.mounts.x.position: expected 3 values"),
        ({"mounts": {"x": {"quaternion_wxyz": [1, 1, 0, 0]}}}, r"mounts.x.quaternion_wxyz: .* length 1, not 1.41"),
        ({"mounts": {"x": {"yaw": 1}}}, r"cell.yaml.mounts.x: unknown key 'yaw'; valid keys: position, quat"),
        ({"tip": "pedestal", "base": "pedestal"}, r"has no joint that moves"),
    ],
)
def test_a_wrong_description_is_refused_in_one_line(tmp_path: Path, keys: dict[str, object], told: str):
    with pytest.raises(GraspdError, match=told) as caught:
        load_arm(write(tmp_path, **keys))
    assert "\n" not in str(caught.value)


def test_an_arm_that_could_hit_nothing_or_has_a_joint_that_follows_is_refused(tmp_path: Path):
    path = write(tmp_path)
    camera = '<collision><geometry><box size="0.1 0.02 0.02"/></geometry></collision>'
    (tmp_path / "cell.urdf").write_text(ROBOT.replace(camera, ""))
    with pytest.raises(ConfigError, match=r"cell.urdf: no link that moves has a <collision> or <visual> shape"):
        load_arm(path)
    (tmp_path / "cell.urdf").write_text(ROBOT.replace('<origin xyz="0.4 0 0"/>', '<mimic joint="j1"/>'))
    with pytest.raises(ConfigError, match=r"cell.yaml: joint 'j2' follows another; an arm's joints move by themselves"):
        load_arm(path)


def test_an_unknown_arm_and_a_file_that_is_no_yaml_are_refused(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"unknown arm 'ur99'; known: panda_like, ur5e_like, or the path of a .yaml"):
        load_arm("ur99")
    with pytest.raises(ConfigError, match=r"nowhere.yaml: No such file"):
        load_arm("nowhere.yaml")
    path = tmp_path / "arm.yaml"
    path.write_text("urdf: [")
    with pytest.raises(ConfigError, match=r"arm.yaml: not valid YAML"):
        load_arm(path)


def test_every_shipped_arm_is_listed_and_its_seed_posture_clear(arm: Arm):
    assert set(arm_names()) == {path.stem for path in (config_dir() / "arms").glob("*.urdf")}
    assert len(start_table(arm).q) > 1000
    hits = hits_of_self(arm, arm_links(arm, torch.as_tensor(arm.seed)[None]))
    assert hits.what
    assert (hits.depth < 0).all()


@pytest.mark.parametrize("hand", ["allegro_right", "allegro_left", "barrett_like", "leap_right", "parallel_gripper"])
def test_the_shipped_arms_carry_every_shipped_hand(arm: Arm, hand: str):
    """Its fingers point away from the arm: the tip's z axis points at the fingertips."""
    model = load_hand(hand, candidates=100)
    mount = tip_hand(arm, model)
    palm = mount.rotation.numpy() @ model.palm_center + mount.translation.numpy()
    assert 0.0 < palm[2] < 0.2
    assert np.hypot(*palm[:2]) < 0.06


def test_a_hand_that_nobody_mounts_is_refused(tmp_path: Path):
    hand = load_hand("barrett_like", candidates=100)
    arm = load_arm(write(tmp_path, mounts={"other": {}}))
    with pytest.raises(ConfigError, match=r"arm cell: nobody says how hand barrett_like is mounted; .*: other; or"):
        tip_hand(arm, hand)


def test_an_arm_is_taken_out_of_a_robot_that_the_caller_brings(tmp_path):
    path = write(tmp_path, urdf="robot_description")
    arm, plain = load_arm(path, ROBOT), load_arm(write(tmp_path))
    assert (arm.joint_names, arm.chain.link_names) == (plain.joint_names, plain.chain.link_names)
    path = write(tmp_path, urdf="robot_description")
    with pytest.raises(ConfigError, match=r"cell.yaml.urdf: robot_description is what the node hears at its start"):
        load_arm(path)
    with pytest.raises(GraspdError, match=r"robot_description: not well-formed XML"):
        load_arm(path, "<robot>")
    with pytest.raises(ConfigError, match=r"cell.yaml.tip: no link 'flange' in the URDF; links: base"):
        load_arm(path, '<robot name="r"><link name="base"/></robot>')
