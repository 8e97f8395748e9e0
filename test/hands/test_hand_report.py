"""The report on a hand, the description that it writes, the picture, and the command."""

from __future__ import annotations

import dataclasses
import shlex
from pathlib import Path

import numpy as np
import pytest

from graspd_bench.rendering.render import hand_picture
from graspd_core.cli import build_parser, main
from graspd_core.cli.hands_command import as_text, as_yaml, report
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import HandModel
from graspd_core.paths import config_dir


@pytest.fixture(scope="module")
def hand() -> HandModel:
    return load_hand("barrett_like", candidates=80)


def test_the_report_counts_what_is_there(hand: HandModel) -> None:
    found = report(hand)
    assert sum(link.candidates for link in found.links) == 80
    assert sum(len(link.solids) for link in found.links) == len(hand.primitives)
    assert [joint.name for joint in found.joints if not joint.coupling] == list(hand.joint_names)
    assert len([joint for joint in found.joints if joint.coupling]) == len(hand.mimics) > 0
    assert found.links[0].depth == 0
    assert all(link.depth > 0 for link in found.links[1:])
    assert found.pairs[0] < found.pairs[1]


def test_the_text_names_every_link_and_joint(hand: HandModel) -> None:
    text = as_text(report(dataclasses.replace(hand, warnings=("something was mended",))))
    for name in (*hand.link_names, *hand.joint_names, *(mimic.name for mimic in hand.mimics)):
        assert name in text
    assert "warning: something was mended" in text
    assert f"= {hand.mimics[0].multiplier:g} · " in text


@pytest.mark.parametrize("name", ["barrett_like", "leap_right"])
def test_the_written_description_loads_as_the_same_hand(name: str, tmp_path: Path) -> None:
    hand = load_hand(name, candidates=10)
    path = tmp_path / "again.yaml"
    path.write_text(as_yaml(report(hand), hand.urdf))
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
    path.write_text(as_yaml(report(hand), "a #1.urdf"))
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
    arguments = [
        "hands",
        "inspect",
        str(urdf),
        "--candidates",
        "40",
        "--picture",
        str(picture),
        "--yaml",
        str(description),
    ]
    assert main(arguments) == 0
    shown = capsys.readouterr().out
    assert "left_jaw" in shown
    assert "warning: palm guessed" in shown
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert load_hand(description, candidates=10).warnings == ()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.urdf"], "nowhere.urdf: no such file"),
        (["allegro_right", "--picture", "hand.jpg"], "hand.jpg: a .png file is written"),
        (["MANO_RIGHT.pkl", "--yaml", "hand.yaml"], "hand.yaml: a description names a URDF or MJCF file, not a MANO"),
    ],
)
def test_the_command_refuses_in_one_line(
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["hands", "inspect", *arguments]) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.count("\n") == 1


def test_the_commands_of_the_page_parse() -> None:
    page = Path(__file__).parents[2] / "docs" / "hands.md"
    lines = [line.strip() for line in page.read_text().splitlines() if line.startswith("    graspd ")]
    assert len(lines) >= 2
    for line in lines:
        build_parser().parse_args(shlex.split(line)[1:])
