"""Where a hand sits on an arm: one entry of the description."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from graspd_core.errors import HandError
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import HandModel, Mount
from graspd_core.paths import config_dir


def load_with(folder: Path, entry: str) -> HandModel:
    for suffix in ("urdf", "yaml"):
        shutil.copy(config_dir() / "hands" / f"parallel_gripper.{suffix}", folder)
    path = folder / "parallel_gripper.yaml"
    path.write_text(path.read_text() + entry)
    return load_hand(path, candidates=8)


def test_a_mount_is_read_and_its_quaternion_made_exact(tmp_path: Path) -> None:
    entry = "mount:\n  parent: tool0\n  position: [0, 0, 0.02]\n  quaternion_wxyz: [0.7071, 0, 0, 0.7071]\n"
    mount = load_with(tmp_path, entry).mount
    assert mount is not None
    assert (mount.parent, mount.position) == ("tool0", (0.0, 0.0, 0.02))
    np.testing.assert_allclose(mount.quaternion_wxyz, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-15)


def test_a_parent_is_enough(tmp_path: Path) -> None:
    assert load_with(tmp_path, "mount: {parent: flange}\n").mount == Mount(
        "flange", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
    )


def test_a_hand_without_the_entry_has_no_mount(tmp_path: Path) -> None:
    assert load_with(tmp_path, "").mount is None


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("mount: tool0\n", r"mount: expected a mapping of keys to values, got 'tool0'"),
        ("mount: {position: [0, 0, 0]}\n", r"mount.parent is missing"),
        ("mount: {parent: 3}\n", r"mount.parent: expected text, got 3"),
        ("mount: {parent: t, pose: 1}\n", r"unknown key 'pose'; known: parent, position, quaternion_wxyz"),
        ("mount: {parent: t, position: [0, 0]}\n", r"mount.position: expected 3 numbers, got \[0, 0\]"),
        ("mount: {parent: t, position: [0, 0, .nan]}\n", r"mount.position: expected 3 numbers"),
        ("mount: {parent: t, quaternion_wxyz: [1, 1, 0, 0]}\n", r"mount.quaternion_wxyz: .*length 1, not 1.41"),
    ],
)
def test_a_bad_mount_is_refused_by_line_and_key(tmp_path: Path, entry: str, message: str) -> None:
    with pytest.raises(HandError, match=rf"parallel_gripper.yaml:\d+: {message}"):
        load_with(tmp_path, entry)
