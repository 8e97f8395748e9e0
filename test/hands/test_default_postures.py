"""What a bare URDF does not say, found: against the descriptions of the built-in hands, and in a trial."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graspd_core.errors import HandError
from graspd_core.hands.default_postures import default_palm, default_postures
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.library import hand_names, load_hand, read_hand_file
from graspd_core.hands.model import HandModel
from graspd_core.hands.self_collision import adjacent_links, link_overlaps
from graspd_core.hands.surface_points import dense_samples
from graspd_core.paths import config_dir

HANDS = [name for name in hand_names() if (config_dir() / "hands" / f"{name}.urdf").is_file()]


@pytest.fixture(scope="module")
def allegro() -> tuple[HandModel, HandModel]:
    """The described hand and the guessed one."""
    path = config_dir() / "hands" / "allegro_right.urdf"
    return load_hand("allegro_right", candidates=10), default_postures(default_palm(read_hand_file(path)))


@pytest.mark.parametrize("name", HANDS)
def test_the_palm_is_found(name: str) -> None:
    described = load_hand(name, candidates=10)
    guessed = default_palm(read_hand_file(Path(described.urdf)))
    assert described.palm_normal @ guessed.palm_normal > np.cos(np.deg2rad(15.0))
    assert np.linalg.norm(described.palm_center - guessed.palm_center) < 0.02
    np.testing.assert_allclose(guessed.approach, guessed.palm_normal)
    assert any("palm guessed" in text for text in guessed.warnings)


def test_postures_open_and_close_the_hand(allegro: tuple[HandModel, HandModel]) -> None:
    _, guessed = allegro
    tips = [guessed.link_index[f"link_{i}.0_tip"] for i in (3, 7, 11, 15)]

    def gaps(posture: np.ndarray) -> np.ndarray:
        placed = link_poses(guessed, posture)[1][tips]
        return np.linalg.norm(placed[:3] - placed[3], axis=1)

    # Room for an object of 8 cm between the thumb and every finger; closed, the ball between the thumb and the finger
    # that it meets is 0.32 finger lengths, 4.7 cm, across.
    assert gaps(guessed.open_posture).min() > 0.08
    assert gaps(guessed.closed_posture).min() < 0.047
    guessed = replace(guessed, adjacent=adjacent_links(guessed))
    points, links, _ = dense_samples(guessed, count=2000, seed=5)
    for posture in (guessed.open_posture, guessed.closed_posture):
        assert ((guessed.lower <= posture) & (posture <= guessed.upper)).all()
        overlap = np.where(guessed.adjacent, 0.0, link_overlaps(guessed, posture[None], points, links)[0])
        assert overlap.max() < 1e-3
    again = default_postures(default_palm(read_hand_file(Path(guessed.urdf))))
    np.testing.assert_array_equal(again.open_posture, guessed.open_posture)


def test_turning_the_base_turns_the_palm_with_it(allegro: tuple[HandModel, HandModel], tmp_path: Path) -> None:
    _, guessed = allegro
    # The hand behind a plate that it is bolted to askew.
    text = Path(guessed.urdf).read_text()
    end = text.rindex("</robot>")
    path = tmp_path / "askew.urdf"
    path.write_text(
        text[:end] + '<link name="plate"/><joint name="bolt" type="fixed"><parent link="plate"/>'
        '<child link="base_link"/><origin xyz="0.1 -0.2 0.3" rpy="0.5 -0.7 1.1"/></joint></robot>'
    )
    askew = default_palm(read_hand_file(path))
    index = askew.link_index["base_link"]
    rotations, translations = link_poses(askew, askew.lower)
    # Surface points are drawn anew in another order: 3 mm of the palm's middle.
    np.testing.assert_allclose(askew.palm_normal, rotations[index] @ guessed.palm_normal, atol=0.03)
    expected = rotations[index] @ guessed.palm_center + translations[index]
    np.testing.assert_allclose(askew.palm_center, expected, atol=3e-3)


def test_a_description_overrides_what_it_names(tmp_path: Path) -> None:
    urdf = config_dir() / "hands" / "parallel_gripper.urdf"
    path = tmp_path / "mine.yaml"
    path.write_text(f"urdf: {urdf}\nopen:\n  left_jaw: 0.05\n")
    hand = load_hand(path, candidates=10)
    assert hand.name == "mine"
    np.testing.assert_allclose(hand.open_posture, [0.05])
    assert hand.closed_posture[0] < 0.02
    assert [text for text in hand.warnings if "closed posture guessed" in text]
    assert not [text for text in hand.warnings if "open" in text]
    path.write_text(f"urdf: {urdf}\npalm:\n  center: [0, 0, 0.1]\n")
    with pytest.raises(HandError, match=r"mine.yaml:2: palm.normal is missing"):
        load_hand(path)


@pytest.mark.slow
@pytest.mark.parametrize("name", HANDS)
def test_a_guessed_hand_holds_a_box(name: str) -> None:
    from graspd_core.perception.load_scene import load_scene
    from graspd_core.planning.plan_grasps import plan_grasps
    from graspd_core.types import Outcome

    hand = load_hand(config_dir() / "hands" / f"{name}.urdf")
    result = plan_grasps(load_scene("shape:box"), hand, count=1, seed=0, preset="fast", deadline=100.0)
    assert result.outcome is Outcome.SUCCEEDED
