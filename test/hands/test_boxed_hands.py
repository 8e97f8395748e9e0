"""What every built-in hand must show, a new one too; the makers' figures of the Allegro and the LEAP hand."""
# pyright: reportAttributeAccessIssue=false

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from graspd_core import Verdict, hand_names, load_hand, load_scene, plan_grasps
from graspd_core.hands.kinematics import hand_mesh, link_poses, primitive_mesh
from graspd_core.hands.link_distance import primitive_sdf
from graspd_core.hands.model import HandModel, all_joint_names, all_joint_positions
from graspd_core.hands.self_collision import link_overlaps
from graspd_core.hands.surface_points import dense_samples


@pytest.fixture(scope="module", params=hand_names())
def hand(request: pytest.FixtureRequest) -> HandModel:
    return load_hand(request.param)


# Fingertip origins in the base frame at mid-range [m], of the published descriptions through pytorch-kinematics and,
# for the Allegro, MuJoCo.
ALLEGRO_TIPS = [
    [0.09535, 0.04752, 0.04437],
    [0.09535, 0, 0.04679],
    [0.09535, -0.04752, 0.04437],
    [0.08403, 0.05714, -0.0102],
]
LEAP_TIPS = [
    [0.02002, 0.02266, -0.09861],
    [0.02002, -0.02279, -0.09861],
    [0.02002, -0.06824, -0.09861],
    [-0.06132, 0.04303, -0.08248],
]
TIPS = tuple(f"link_{number}.0_tip" for number in (3, 7, 11, 15))
GOLDEN = {
    "allegro_right": (TIPS, np.array(ALLEGRO_TIPS)),
    "leap_right": (("fingertip", "fingertip_2", "fingertip_3", "thumb_fingertip"), np.array(LEAP_TIPS)),
}


def tips(hand: HandModel, q: np.ndarray) -> np.ndarray:
    """Places of the links that carry no other."""
    ends = np.setdiff1d(np.arange(1, hand.num_links), hand.link_parent)
    return link_poses(hand, q)[1][ends]


def test_forward_kinematics_agree_with_mujocos(hand: HandModel) -> None:
    keep = '<mujoco><compiler fusestatic="false" discardvisual="true"/></mujoco>'
    text = re.sub(r"<robot\b[^>]*>", lambda match: match.group() + keep, Path(hand.urdf).read_text(), count=1)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    for q in (hand.open_posture, hand.closed_posture, *rng.uniform(hand.lower, hand.upper, (3, hand.num_joints))):
        # Coupled joints at their own values: MuJoCo only couples them while it steps.
        for name, value in zip(all_joint_names(hand), all_joint_positions(hand, q), strict=True):
            data.joint(name).qpos[0] = value
        mujoco.mj_kinematics(model, data)
        rotations, translations = link_poses(hand, q)
        # MuJoCo makes the root link one with the world.
        for link in range(1, hand.num_links):
            body = data.body(hand.link_names[link])
            np.testing.assert_allclose(translations[link], body.xpos, atol=1e-9)
            np.testing.assert_allclose(rotations[link], body.xmat.reshape(3, 3), atol=1e-9)


@pytest.mark.parametrize("name", GOLDEN)
def test_golden_fingertips(name: str) -> None:
    hand, (ends, golden) = load_hand(name, candidates=8), GOLDEN[name]
    found = link_poses(hand, 0.5 * (hand.lower + hand.upper))[1][[hand.link_index[end] for end in ends]]
    np.testing.assert_allclose(found, golden, atol=1e-5)  # the golden values have five decimals


def test_joints_have_room_and_force_postures_are_within_limits_and_bodies_are_solid(hand: HandModel) -> None:
    assert (hand.lower < hand.upper).all()
    assert np.isfinite([*hand.lower, *hand.upper, *hand.effort, *hand.velocity]).all()
    assert (hand.effort > 0).all()
    for q in (hand.open_posture, hand.closed_posture):
        assert ((hand.lower <= q) & (q <= hand.upper)).all()
    assert not hand.warnings
    # The lightest gripper and the heaviest hand in use.
    assert 0.1 < hand.link_mass.sum() < 5.0
    for inertia in hand.link_inertia:
        a, b, c = np.linalg.eigvalsh(inertia)
        assert a > 0
        assert a + b >= c


@pytest.mark.parametrize("posture", ["open_posture", "closed_posture"])
def test_no_link_is_inside_another(hand: HandModel, posture: str) -> None:
    points, links, _ = dense_samples(hand, count=4000, seed=11)
    overlap = link_overlaps(hand, getattr(hand, posture)[None], points, links)[0]
    assert np.where(hand.adjacent, 0.0, overlap).max() == 0.0


def test_fingertips_close_in_front_of_the_palm(hand: HandModel) -> None:
    assert np.linalg.norm(hand.palm_normal) == pytest.approx(1.0)
    opened, closed = tips(hand, hand.open_posture), tips(hand, hand.closed_posture)
    spread_open, spread_closed = (np.linalg.norm(ends - ends.mean(0), axis=1).mean() for ends in (opened, closed))
    assert spread_closed < spread_open
    for ends in (opened, closed):
        assert ((ends.mean(0) - hand.palm_center) @ hand.palm_normal) > -0.01


def test_candidates_lie_on_every_link_that_moves(hand: HandModel) -> None:
    with_solids = {p.link for p in hand.primitives if hand.link_group[p.link] != hand.link_group[0]}
    groups = {int(hand.link_group[link]) for link in with_solids}
    assert groups <= {int(hand.link_group[link]) for link in hand.candidate_link}


@pytest.mark.slow
def test_a_box_is_grasped(hand: HandModel) -> None:
    result = plan_grasps(load_scene("shape:box"), hand, count=1, seed=0, preset="balanced")
    best = result.grasps[0]
    assert best.verdict is Verdict.VERIFIED, best.reason
    for posture in (best.pregrasp, best.grasp, best.squeeze):
        assert ((hand.lower <= posture.joint_positions) & (posture.joint_positions <= hand.upper)).all()


# Extents of the makers' meshes in their link frames [m]: lower corner, upper corner.
ALLEGRO = {
    "base_link": ([-0.0295, -0.0567, -0.0950], [0.0113, 0.0567, 0.0017]),
    **{f"link_{4 * finger}.0": ([-0.0098, -0.0135, 0.0], [0.0098, 0.0135, 0.0220]) for finger in range(3)},
    **{f"link_{4 * finger + 1}.0": ([-0.0098, -0.0135, -0.0088], [0.0098, 0.0135, 0.0628]) for finger in range(3)},
    **{f"link_{4 * finger + 2}.0": ([-0.0098, -0.0135, -0.0063], [0.0098, 0.0135, 0.0472]) for finger in range(3)},
    **{f"link_{4 * finger + 3}.0": ([-0.0098, -0.0135, -0.0063], [0.0098, 0.0135, 0.0157]) for finger in range(3)},
    **dict.fromkeys(TIPS, ([-0.0120, -0.0120, -0.0110], [0.0120, 0.0120, 0.0120])),
    "link_12.0": ([-0.0392, -0.0080, -0.0080], [0.0055, 0.0260, 0.0415]),
    "link_13.0": ([-0.0098, -0.0135, -0.0002], [0.0098, 0.0135, 0.0218]),
    "link_14.0": ([-0.0098, -0.0135, -0.0088], [0.0098, 0.0135, 0.0577]),
    "link_15.0": ([-0.0098, -0.0135, -0.0088], [0.0098, 0.0135, 0.0313]),
}
FINGER = {
    "mcp_joint": ([-0.0430, -0.0080, -0.0028], [0.0100, 0.0625, 0.0330]),
    "pip": ([-0.0095, -0.0146, -0.0231], [0.0245, 0.0150, -0.0001]),
    # The lobes of its fork reach 4 mm farther than the box that stands for the fork.
    "dip": ([-0.0100, -0.0461, -0.0029], [0.0245, 0.0080 - 0.0040, 0.0317]),
    "fingertip": ([-0.0112, -0.0495, -0.0029], [0.0099, 0.0080, 0.0317]),
}
LEAP = {
    "palm_lower": ([-0.1000, -0.0987, -0.0347], [0.0030, 0.0257, 0.0113]),
    **{f"{name}{finger}": extent for name, extent in FINGER.items() for finger in ("", "_2", "_3")},
    "pip_4": ([-0.0244, -0.0145, -0.0230], [0.0096, 0.0151, 0.0]),
    "thumb_pip": ([-0.0100, -0.0173, -0.0249], [0.0100, 0.0173, 0.0001]),
    "thumb_dip": ([-0.0186, -0.0096, -0.0316], [0.0099, 0.0545, 0.0030]),
    "thumb_fingertip": ([-0.0112, -0.0622, -0.0309], [0.0184, 0.0094, 0.0021]),
}


@pytest.fixture(scope="module")
def allegro() -> HandModel:
    return load_hand("allegro_right")


def test_joint_order_limits_and_effort(allegro: HandModel) -> None:
    assert allegro.joint_names == tuple(f"joint_{i}.0" for i in range(16))
    np.testing.assert_allclose(allegro.lower, [-0.47, -0.196, -0.174, -0.227] * 3 + [0.263, -0.105, -0.189, -0.162])
    np.testing.assert_allclose(allegro.upper, [0.47, 1.61, 1.709, 1.618] * 3 + [1.396, 1.163, 1.644, 1.719])
    np.testing.assert_allclose(allegro.effort, 0.7)
    assert allegro.link_mass.sum() == pytest.approx(0.9861)
    leap = load_hand("leap_right")
    # Names are bare numbers that do not rise along a finger; sorting them would permute the joints.
    assert leap.joint_names == tuple(map(str, [1, 0, 2, 3, 5, 4, 6, 7, 9, 8, 10, 11, 12, 13, 14, 15]))
    np.testing.assert_allclose(leap.lower, [-0.314, -1.047, -0.506, -0.366] * 3 + [-0.349, -0.47, -1.2, -1.34])
    np.testing.assert_allclose(leap.upper, [2.23, 1.047, 1.885, 2.042] * 3 + [2.094, 2.443, 1.9, 1.88])
    np.testing.assert_allclose(leap.effort, 0.95)
    assert leap.link_mass.sum() == pytest.approx(0.746)
    assert (leap.open_posture[leap.joint_names.index("12")], leap.open_posture[0]) == (1.5, 0.2)


@pytest.mark.parametrize(
    ("name", "extents", "tolerance"),
    # The extents are rounded to 0.1 mm, and balls are drawn with inscribed facets; LEAP's fingers differ by 0.1 mm.
    [("allegro_right", ALLEGRO, 6e-5), ("leap_right", LEAP, 1.2e-4)],
)
def test_primitives_cover_the_true_extents(name: str, extents: dict[str, tuple], tolerance: float) -> None:
    allegro = load_hand(name)
    for link, (lower, upper) in extents.items():
        vertices = np.concatenate([primitive_mesh(p).vertices for p in allegro.primitives_of[allegro.link_index[link]]])
        np.testing.assert_allclose(vertices.max(0), upper, atol=tolerance, err_msg=link)
        # The ball of Allegro's tips reaches a millimetre into the box behind it.
        inside = 1e-3 if link in TIPS else 0.0
        assert (vertices.min(0) <= np.array(lower) + tolerance).all(), link
        assert (vertices.min(0) >= np.array(lower) - tolerance - inside).all(), link


def test_a_fist_is_seen_to_collide(allegro: HandModel) -> None:
    points, links, _ = dense_samples(allegro, seed=11)
    fist = allegro.lower + 0.75 * (allegro.upper - allegro.lower)
    overlap = np.where(allegro.adjacent, 0.0, link_overlaps(allegro, fist[None], points, links)[0])
    assert overlap.max() > 3e-3


def test_adjacency(allegro: HandModel) -> None:
    index, adjacent = allegro.link_index, allegro.adjacent
    assert (adjacent == adjacent.T).all()
    assert adjacent.diagonal().all()
    for one, other in (("link_3.0", "link_3.0_tip"), ("link_2.0", "link_3.0_tip"), ("base_link", "link_4.0")):
        assert adjacent[index[one], index[other]]
    for one, other in (("link_3.0_tip", "link_15.0_tip"), ("base_link", "link_7.0_tip"), ("link_1.0", "link_5.0")):
        assert not adjacent[index[one], index[other]]


def test_hand_mesh_lies_on_the_links_surfaces(allegro: HandModel) -> None:
    mesh = hand_mesh(allegro, allegro.closed_posture)
    rotations, translations = link_poses(allegro, allegro.closed_posture)
    distance = torch.full((len(mesh.vertices),), torch.inf, dtype=torch.float64)
    for primitive in allegro.primitives:
        local = torch.as_tensor((mesh.vertices - translations[primitive.link]) @ rotations[primitive.link])
        distance = torch.minimum(distance, primitive_sdf(primitive, local))
    assert float(distance.max()) < 1e-9
    assert mesh.faces.max() == len(mesh.vertices) - 1


def test_the_left_hand_is_the_mirror_image(allegro: HandModel) -> None:
    """Mirrored joint values give mirrored points: the mirror y → −y turns the sense of the three abduction joints."""
    left = load_hand("allegro_left")
    assert (left.joint_names, left.link_names) == (allegro.joint_names, allegro.link_names)
    mirror, sense = np.array([1.0, -1.0, 1.0]), np.ones(16)
    sense[[0, 4, 8]] = -1.0
    limits = np.sort(sense * np.stack([left.lower, left.upper]), axis=0)
    np.testing.assert_allclose(limits, [allegro.lower, allegro.upper])
    np.testing.assert_allclose(left.palm_center, mirror * allegro.palm_center)
    rng = np.random.default_rng(5)
    for q in rng.uniform(allegro.lower, allegro.upper, (5, 16)):
        one, other = link_poses(allegro, q), link_poses(left, sense * q)
        np.testing.assert_allclose(other[1], mirror * one[1], atol=1e-12)
        # Every solid is its own mirror image in its frame, so that its middle and its axes tell where it is.
        for a, b in zip(allegro.primitives, left.primitives, strict=True):
            assert (a.link, a.kind, a.size) == (b.link, b.kind, b.size)
            middle = [r[p.link] @ p.translation + t[p.link] for p, (r, t) in ((a, one), (b, other))]
            np.testing.assert_allclose(middle[1], mirror * middle[0], atol=1e-12)
            axes = [r[p.link] @ p.rotation for p, (r, _) in ((a, one), (b, other))]
            np.testing.assert_allclose(np.abs(np.sum(mirror[:, None] * axes[0] * axes[1], axis=0)), 1.0, atol=1e-12)
