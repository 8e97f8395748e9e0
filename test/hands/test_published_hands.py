"""The Allegro and the LEAP hand that graspd ships with: their makers' figures, geometry, postures."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from graspd_core.hands.kinematics import hand_mesh, link_poses, primitive_mesh
from graspd_core.hands.library import load_hand
from graspd_core.hands.link_distance import primitive_sdf
from graspd_core.hands.model import HandModel
from graspd_core.hands.self_collision import link_overlaps
from graspd_core.hands.surface_points import dense_samples

TIPS = ("link_3.0_tip", "link_7.0_tip", "link_11.0_tip", "link_15.0_tip")
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
def hand() -> HandModel:
    return load_hand("allegro_right")


def test_joint_order_limits_and_effort(hand: HandModel) -> None:
    assert hand.joint_names == tuple(f"joint_{i}.0" for i in range(16))
    np.testing.assert_allclose(hand.lower, [-0.47, -0.196, -0.174, -0.227] * 3 + [0.263, -0.105, -0.189, -0.162])
    np.testing.assert_allclose(hand.upper, [0.47, 1.61, 1.709, 1.618] * 3 + [1.396, 1.163, 1.644, 1.719])
    np.testing.assert_allclose(hand.effort, 0.7)
    assert hand.link_mass.sum() == pytest.approx(0.9861)
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
    hand = load_hand(name)
    for link, (lower, upper) in extents.items():
        vertices = np.concatenate([primitive_mesh(p).vertices for p in hand.primitives_of[hand.link_index[link]]])
        np.testing.assert_allclose(vertices.max(0), upper, atol=tolerance, err_msg=link)
        # The ball of Allegro's tips reaches a millimetre into the box behind it.
        inside = 1e-3 if link in TIPS else 0.0
        assert (vertices.min(0) <= np.array(lower) + tolerance).all(), link
        assert (vertices.min(0) >= np.array(lower) - tolerance - inside).all(), link


def test_a_fist_is_seen_to_collide(hand: HandModel) -> None:
    points, links, _ = dense_samples(hand, seed=11)
    fist = hand.lower + 0.75 * (hand.upper - hand.lower)
    overlap = np.where(hand.adjacent, 0.0, link_overlaps(hand, fist[None], points, links)[0])
    assert overlap.max() > 3e-3


@pytest.mark.parametrize(
    ("name", "links", "fingers", "thumb"),
    [
        ("allegro_right", TIPS, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        # Points amid the soft tips, where others put their tip frames.
        (
            "leap_right",
            ("fingertip", "fingertip_2", "fingertip_3", "thumb_fingertip"),
            (0.0, -0.04, 0.015),
            (0.0, -0.045, -0.015),
        ),
    ],
)
def test_thumb_opposes_the_fingers_when_open(name: str, links: tuple, fingers: tuple, thumb: tuple) -> None:
    hand = load_hand(name)
    ends = [hand.link_index[link] for link in links]
    rotations, translations = link_poses(hand, hand.open_posture)
    tips = np.einsum("nij,nj->ni", rotations[ends], np.array([fingers] * 3 + [thumb])) + translations[ends]
    assert ((tips - hand.palm_center) @ hand.palm_normal > 0.03).all()
    assert np.linalg.norm(tips[3] - tips[1]) > 0.08  # room for an object of 8 cm


def test_adjacency(hand: HandModel) -> None:
    index, adjacent = hand.link_index, hand.adjacent
    assert (adjacent == adjacent.T).all()
    assert adjacent.diagonal().all()
    for one, other in (("link_3.0", "link_3.0_tip"), ("link_2.0", "link_3.0_tip"), ("base_link", "link_4.0")):
        assert adjacent[index[one], index[other]]
    for one, other in (("link_3.0_tip", "link_15.0_tip"), ("base_link", "link_7.0_tip"), ("link_1.0", "link_5.0")):
        assert not adjacent[index[one], index[other]]


def test_hand_mesh_lies_on_the_links_surfaces(hand: HandModel) -> None:
    mesh = hand_mesh(hand, hand.closed_posture)
    rotations, translations = link_poses(hand, hand.closed_posture)
    distance = torch.full((len(mesh.vertices),), torch.inf, dtype=torch.float64)
    for primitive in hand.primitives:
        local = torch.as_tensor((mesh.vertices - translations[primitive.link]) @ rotations[primitive.link])
        distance = torch.minimum(distance, primitive_sdf(primitive, local))
    assert float(distance.max()) < 1e-9
    assert mesh.faces.max() == len(mesh.vertices) - 1


def test_the_left_hand_is_the_mirror_image(hand: HandModel) -> None:
    """Mirrored joint values give mirrored points: the mirror y → −y turns the sense of the three abduction joints."""
    left = load_hand("allegro_left")
    assert (left.joint_names, left.link_names) == (hand.joint_names, hand.link_names)
    mirror, sense = np.array([1.0, -1.0, 1.0]), np.ones(16)
    sense[[0, 4, 8]] = -1.0
    np.testing.assert_allclose(np.sort(sense * np.stack([left.lower, left.upper]), axis=0), [hand.lower, hand.upper])
    np.testing.assert_allclose(left.palm_center, mirror * hand.palm_center)
    rng = np.random.default_rng(5)
    for q in rng.uniform(hand.lower, hand.upper, (5, 16)):
        one, other = link_poses(hand, q), link_poses(left, sense * q)
        np.testing.assert_allclose(other[1], mirror * one[1], atol=1e-12)
        # Every solid is its own mirror image in its frame, so that its middle and its axes tell where it is.
        for a, b in zip(hand.primitives, left.primitives, strict=True):
            assert (a.link, a.kind, a.size) == (b.link, b.kind, b.size)
            middle = [r[p.link] @ p.translation + t[p.link] for p, (r, t) in ((a, one), (b, other))]
            np.testing.assert_allclose(middle[1], mirror * middle[0], atol=1e-12)
            axes = [r[p.link] @ p.rotation for p, (r, _) in ((a, one), (b, other))]
            np.testing.assert_allclose(np.abs(np.sum(mirror[:, None] * axes[0] * axes[1], axis=0)), 1.0, atol=1e-12)
