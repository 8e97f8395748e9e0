"""What a bare URDF does not say, found: against the descriptions of the built-in hands, and on three-finger grippers.

Dimensions of the grippers are public figures of the makers, rounded; widths and masses are estimates, solids are bars.
"""

import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from graspd_core import HandModel, Outcome, Verdict, load_scene, plan_grasps
from graspd_core.errors import HandError
from graspd_core.hands.default_postures import default_palm, default_postures
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.library import hand_names, load_hand, read_hand_file
from graspd_core.hands.self_collision import adjacent_links, link_overlaps
from graspd_core.hands.surface_points import dense_samples
from graspd_core.paths import config_dir


@pytest.fixture(scope="module")
def allegro() -> tuple[HandModel, HandModel]:
    """The described hand and the guessed one."""
    path = config_dir() / "hands" / "allegro_right.urdf"
    return load_hand("allegro_right", candidates=10), default_postures(default_palm(read_hand_file(path)))


@pytest.mark.parametrize("name", hand_names())
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
@pytest.mark.parametrize("name", hand_names())
def test_a_guessed_hand_holds_a_box(name: str) -> None:
    hand = load_hand(config_dir() / "hands" / f"{name}.urdf")
    result = plan_grasps(load_scene("shape:box"), hand, count=1, seed=0, preset="fast", deadline=100.0)
    assert result.outcome is Outcome.SUCCEEDED


SIDES = np.deg2rad([0.0, 120.0, 240.0])
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Gripper:
    """A gripper and what is known of it.

    Attributes:
        urdf: its text; the last link of finger i is called `tip_i`.
        normal: out of the palm, base frame.
        center: a point of the axis around which the fingers close, base frame [m].
        outward: the direction away from that axis in which each finger stands, base frame.
        tip: the fingertip in the frame of the last link [m].
    """

    urdf: str
    normal: Vector
    center: Vector
    outward: tuple[Vector, ...]
    tip: Vector


def origin(xyz: Vector, rpy: Vector = (0, 0, 0)) -> str:
    numbers = [" ".join(f"{x:.9f}" for x in triple) for triple in (xyz, rpy)]
    return f'<origin xyz="{numbers[0]}" rpy="{numbers[1]}"/>'


def bar(name: str, start: Vector, end: Vector, widths: tuple[float, float] = (0.02, 0.02)) -> str:
    """A link with a box from start to end [m]."""
    along = np.subtract(end, start)
    length = float(np.linalg.norm(along))
    turn = (0.0, float(np.arctan2(np.hypot(along[0], along[1]), along[2])), float(np.arctan2(along[1], along[0])))
    (x, y, z), place = (*widths, length), origin(tuple(0.5 * np.add(start, end)), turn)
    mass = f'{place}<mass value="0.05"/><inertia ixx="2e-5" iyy="2e-5" izz="2e-5" ixy="0" ixz="0" iyz="0"/>'
    shape = f'{place}<geometry><box size="{x} {y} {z}"/></geometry>'
    return f'<link name="{name}"><inertial>{mass}</inertial><collision>{shape}</collision></link>'


def joint(
    ends: tuple[str, str],
    place: str,
    axis: Vector,
    limits: tuple[float, float] | None,
    follows: tuple[str, float] | None = None,
) -> str:
    """The joint that moves the second of two links against the first. Without limits it is fixed.

    The joint is named after the second link. `follows` has leader and multiplier.
    """
    links = f'<parent link="{ends[0]}"/><child link="{ends[1]}"/>{place}'
    if limits is None:
        return f'<joint name="j_{ends[1]}" type="fixed">{links}</joint>'
    kind, force = ("prismatic", 60) if abs(limits[1] - limits[0]) < 0.1 else ("revolute", 3)
    mimic = f'<mimic joint="{follows[0]}" multiplier="{follows[1]}"/>' if follows else ""
    return (
        f'<joint name="j_{ends[1]}" type="{kind}">{links}<axis xyz="{axis[0]} {axis[1]} {axis[2]}"/>{mimic}'
        f'<limit lower="{limits[0]}" upper="{limits[1]}" effort="{force}" velocity="1"/></joint>'
    )


def robotiq() -> Gripper:
    """After Robotiq's 3-Finger: eleven joints, none at zero in the middle; a scissor joint under each of the two.

    The palm faces y. Fingers lean outwards by 30 degrees at zero, their last phalanges bend back as far as −0.66 rad.
    """
    text = bar("palm", (0, -0.08, 0), (0, 0.02, 0), (0.12, 0.10))
    places = ((-0.0455, 0.0), (0.0455, 0.0), (0.0, np.pi))
    for i, (x, turn) in enumerate(places):
        side = 0.036 if i < 2 else -0.036
        text += bar(f"base_{i}", (0, -0.005, 0), (0, 0.01, 0)) + bar(f"first_{i}", (0, 0, 0), (0, 0.05, 0.028))
        text += bar(f"second_{i}", (0, 0, 0), (0, 0.039, 0)) + bar(f"tip_{i}", (0, 0, 0), (0, 0.035, 0))
        place, scissor = origin((x, 0.0214, side), (0, turn, 0)), (0, 1 - 2 * i, 0)
        text += joint(("palm", f"base_{i}"), place, scissor, (-0.1784, 0.192) if i < 2 else None)
        text += joint((f"base_{i}", f"first_{i}"), origin((0, 0, 0)), (-1, 0, 0), (0.0495, 1.2218))
        text += joint((f"first_{i}", f"second_{i}"), origin((0, 0.05, 0.028), (0.52, 0, 0)), (-1, 0, 0), (0.0, 1.5708))
        text += joint((f"second_{i}", f"tip_{i}"), origin((0, 0.039, 0)), (-1, 0, 0), (-0.6632, 1.0471))
    return Gripper(text, (0, 1, 0), (0, 0.0214, 0), ((0, 0, 1), (0, 0, 1), (0, 0, -1)), (0, 0.035, 0))


def sdh() -> Gripper:
    """After Schunk's SDH: roots on a triangle with sides of 66 mm, limits of 90 degrees either way, straight at zero.

    The palm faces z. Two fingers turn about their own length, coupled, from facing the third to facing each other.
    """
    text = bar("palm", (0, 0, 0), (0, 0, 0.09), (0.1, 0.1))
    places = ((-0.033, -0.019), (0.033, -0.019), (0.0, 0.038))
    for i, (x, y) in enumerate(places):
        text += bar(f"base_{i}", (0, 0, -0.01), (0, 0, 0.005), (0.026, 0.026))
        text += bar(f"first_{i}", (0, 0, 0), (0, 0, 0.0865), (0.026, 0.026))
        text += bar(f"tip_{i}", (0, 0, 0), (0, 0, 0.0685))
        place, limits = origin((x, y, 0.0986), (0, 0, np.pi if i == 2 else 0)), ((-1.5708, 0.0), (0.0, 1.5708), None)[i]
        text += joint(("palm", f"base_{i}"), place, (0, 0, 1), limits, ("j_base_0", -1.0) if i == 1 else None)
        text += joint((f"base_{i}", f"first_{i}"), origin((0, 0, 0)), (-1, 0, 0), (-1.5708, 1.5708))
        text += joint((f"first_{i}", f"tip_{i}"), origin((0, 0, 0.0865)), (-1, 0, 0), (-1.5708, 1.5708))
    pair = (0, -1, 0)
    return Gripper(text, (0, 0, 1), (0, 0, 0.09), (pair, pair, (0, 1, 0)), (0, 0, 0.0685))


def three_jaw() -> Gripper:
    """A centric gripper: three jaws slide towards its axis by 40 mm, driven by one motor; shut at zero."""
    text = bar("palm", (0, 0, 0), (0, 0, 0.06), (0.1, 0.1))
    for i, angle in enumerate(SIDES):
        text += bar(f"tip_{i}", (0.02, 0, 0.01), (0.02, 0, 0.08))
        place = origin((0, 0, 0.06), (0, 0, angle))
        text += joint(("palm", f"tip_{i}"), place, (1, 0, 0), (0.0, 0.04), ("j_tip_0", 1.0) if i else None)
    outward = tuple((float(np.cos(angle)), float(np.sin(angle)), 0.0) for angle in SIDES)
    return Gripper(text, (0, 0, 1), (0, 0, 0.06), outward, (0.02, 0, 0.08))


def one_motor() -> Gripper:
    """Two against one after tendon-driven hands: a motor bends all six joints, and another swivels the two.

    The palm faces −z. Fingers are half bent at zero; the third closes with negative values.
    """
    text = bar("palm", (0, 0, 0.06), (0, 0, 0), (0.1, 0.11))
    for i, y in enumerate((-0.0365, 0.0365, 0.0)):
        x, turn, sign = (-0.045, 0.0, 1) if i < 2 else (0.045, np.pi, -1)
        text += bar(f"base_{i}", (0, 0, 0.01), (0, 0, -0.005))
        place, limits = origin((x, y, 0), (0, 0, turn)), ((-0.3, 1.2), (-1.2, 0.3), None)[i]
        text += joint(("palm", f"base_{i}"), place, (0, 0, 1), limits, ("j_base_0", -1.0) if i == 1 else None)
        text += bar(f"first_{i}", (0, 0, 0), (0, 0, -0.066)) + bar(f"tip_{i}", (0, 0, 0), (0, 0, -0.05))
        limits = (-0.7, 0.8) if sign > 0 else (-0.8, 0.7)
        leads = ("j_first_0", float(sign)) if i else None
        text += joint((f"base_{i}", f"first_{i}"), origin((0, 0, 0)), (0, -sign, 0), limits, leads)
        bent = origin((0, 0, -0.066), (0, -0.5, 0))
        text += joint((f"first_{i}", f"tip_{i}"), bent, (0, -1, 0), (-0.5, 0.6), ("j_first_0", 0.6))
    return Gripper(text, (0, 0, -1), (0, 0, 0), ((-1, 0, 0), (-1, 0, 0), (1, 0, 0)), (0, 0, -0.05))


GRIPPERS = {make.__name__: make for make in (robotiq, sdh, three_jaw, one_motor)}


def write(text: str, folder: Path) -> Path:
    path = folder / "gripper.urdf"
    path.write_text(f'<robot name="gripper">{text}</robot>')
    return path


@pytest.fixture(scope="module", params=GRIPPERS)
def guessed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Gripper, HandModel]:
    """A gripper, and the hand with what was guessed of it."""
    gripper = GRIPPERS[request.param]()
    path = write(gripper.urdf, tmp_path_factory.mktemp("three"))
    return gripper, default_postures(default_palm(read_hand_file(path)))


def tips(gripper: Gripper, hand: HandModel, q: np.ndarray) -> np.ndarray:
    """Fingertips from the point on the gripper's axis [m]."""
    rotations, translations = link_poses(hand, q)
    ends = [hand.link_index[f"tip_{i}"] for i in range(3)]
    return rotations[ends] @ np.array(gripper.tip) + translations[ends] - np.array(gripper.center)


def test_the_palm_faces_where_the_fingers_close(guessed: tuple[Gripper, HandModel]) -> None:
    gripper, hand = guessed
    normal = np.array(gripper.normal, dtype=float)
    assert hand.palm_normal @ normal > np.cos(np.deg2rad(3.0))
    closed = tips(gripper, hand, hand.closed_posture)
    assert (closed @ normal).min() > 0.04
    offset = hand.palm_center - np.array(gripper.center)
    assert np.linalg.norm(offset - (offset @ normal) * normal) < 0.008


def test_the_fingers_close_around_the_palms_axis(guessed: tuple[Gripper, HandModel]) -> None:
    gripper, hand = guessed
    normal, outward = np.array(gripper.normal, dtype=float), np.array(gripper.outward, dtype=float)
    opened, closed = (tips(gripper, hand, q) for q in (hand.open_posture, hand.closed_posture))
    for i, j in ((0, 1), (0, 2), (1, 2)):
        narrow, wide = (float(np.linalg.norm(ends[i] - ends[j])) for ends in (closed, opened))
        assert narrow < wide
        if outward[i] @ outward[j] < 0:
            # Room for an object of 8 cm; and none for one of 6 cm.
            assert narrow < 0.06 < 0.08 < wide
    lateral_open, lateral_closed = (ends - np.outer(ends @ normal, normal) for ends in (opened, closed))
    assert (np.linalg.norm(lateral_open, axis=1) - np.linalg.norm(lateral_closed, axis=1) > 0.008).all()
    # Between the fingers on one side and those on the other, which did not pass through each other.
    middle = 0.5 * (lateral_closed[:2].mean(0) + lateral_closed[2])
    assert np.linalg.norm(middle) < 0.015
    assert ((lateral_closed[2] - lateral_closed[:2]) @ outward[2] > 0.01).all()


def test_closed_fingers_are_not_inside_each_other(guessed: tuple[Gripper, HandModel]) -> None:
    _, hand = guessed
    owner = np.array([int(name[-1]) if name[-1].isdigit() else -1 for name in hand.link_names])
    between = (owner[:, None] != owner) & (owner[:, None] >= 0) & (owner >= 0)
    postures = np.stack([hand.open_posture, hand.closed_posture])
    assert ((hand.lower <= postures) & (postures <= hand.upper)).all()
    points, links, _ = dense_samples(hand, count=2000, seed=5)
    assert link_overlaps(hand, postures, points, links)[:, between].max() < 1e-3


@pytest.mark.parametrize("gone", ["link_0.0", "link_4.0", "link_8.0"])
def test_two_fingers_and_a_thumb_are_no_gripper(gone: str, tmp_path: Path) -> None:
    # The Allegro without one of its fingers.
    tree = ET.parse(config_dir() / "hands" / "allegro_right.urdf")
    root, lost = tree.getroot(), {gone}
    for _ in range(6):
        for element in root.findall("joint"):
            ends = [str(end.get("link")) for end in (element.find("parent"), element.find("child")) if end is not None]
            lost |= {ends[1]} if ends[0] in lost else set()
    for element in [*root.findall("joint"), *root.findall("link")]:
        child = element.find("child")
        if (element.get("name") if child is None else child.get("link")) in lost:
            root.remove(element)
    tree.write(tmp_path / "three.urdf")
    guessed = default_palm(read_hand_file(tmp_path / "three.urdf"))
    whole = load_hand("allegro_right", candidates=1)
    assert guessed.num_joints == 12
    assert guessed.palm_normal @ whole.palm_normal > np.cos(np.deg2rad(15.0))


def test_a_finger_that_is_a_bare_frame_gets_a_palm(tmp_path: Path) -> None:
    text = bar("palm", (0, 0, -0.03), (0, 0, 0.03)) + '<link name="tip_0"/>'
    text += joint(("palm", "tip_0"), origin((0, 0, 0)), (1, 0, 0), (0.0, 0.05))
    assert np.linalg.norm(default_palm(read_hand_file(write(text, tmp_path))).palm_normal) == pytest.approx(1.0)


def test_joints_that_carry_the_palm_leave_its_normal_alone(tmp_path: Path) -> None:
    text = '<link name="arm"/>' + bar("palm", (0, 0, 0), (0, 0, 0.06), (0.1, 0.1))
    text += joint(("arm", "palm"), origin((0, 0, 0)), (1, 0, 0), (0.0, 1.5))
    for i, turn in enumerate((0.0, np.pi)):
        text += bar(f"tip_{i}", (0.02, 0, 0.01), (0.02, 0, 0.08))
        text += joint(("palm", f"tip_{i}"), origin((0, 0, 0.06), (0, 0, turn)), (1, 0, 0), (0.0, 0.04))
    hand = default_palm(read_hand_file(write(text, tmp_path)))
    # The middle of the surface points of a jaw's end is 2 mm off its axis.
    assert hand.palm_normal[2] > np.cos(np.deg2rad(3.0))


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["box", "sphere", "cylinder"])
@pytest.mark.parametrize("name", GRIPPERS)
def test_a_guessed_gripper_holds(name: str, shape: str, tmp_path: Path) -> None:
    hand = load_hand(write(GRIPPERS[name]().urdf, tmp_path))
    result = plan_grasps(load_scene(f"shape:{shape}"), hand, count=8, seed=0, preset="fast")
    # One motor for all three fingers lets a ball turn in nearly every grasp.
    least = 1 if (name, shape) == ("one_motor", "sphere") else 8
    assert sum(grasp.verdict is Verdict.VERIFIED for grasp in result.grasps) >= least
