"""The Allegro hand that graspd ships with: golden values, geometry, postures."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from graspd_core.hands.hand_mesh import hand_mesh, primitive_mesh
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.library import load_hand
from graspd_core.hands.link_distance import hand_sdf
from graspd_core.hands.model import HandModel
from graspd_core.hands.self_collision import link_overlaps
from graspd_core.hands.surface_points import dense_samples

TIPS = ("link_3.0_tip", "link_7.0_tip", "link_11.0_tip", "link_15.0_tip")
# Extents of the maker's meshes in their link frames [m]: lower corner, upper corner.
PROXIMAL = ([-0.0098, -0.0135, -0.0088], [0.0098, 0.0135, 0.0628])
MEDIAL = ([-0.0098, -0.0135, -0.0063], [0.0098, 0.0135, 0.0472])
DISTAL = ([-0.0098, -0.0135, -0.0063], [0.0098, 0.0135, 0.0157])
BASE = ([-0.0098, -0.0135, 0.0], [0.0098, 0.0135, 0.0220])
TIP = ([-0.0120, -0.0120, -0.0110], [0.0120, 0.0120, 0.0120])
EXTENTS = {
    "base_link": ([-0.0295, -0.0567, -0.0950], [0.0113, 0.0567, 0.0017]),
    **{f"link_{4 * finger}.0": BASE for finger in range(3)},
    **{f"link_{4 * finger + 1}.0": PROXIMAL for finger in range(3)},
    **{f"link_{4 * finger + 2}.0": MEDIAL for finger in range(3)},
    **{f"link_{4 * finger + 3}.0": DISTAL for finger in range(3)},
    **dict.fromkeys(TIPS, TIP),
    "link_12.0": ([-0.0392, -0.0080, -0.0080], [0.0055, 0.0260, 0.0415]),
    "link_13.0": ([-0.0098, -0.0135, -0.0002], [0.0098, 0.0135, 0.0218]),
    "link_14.0": ([-0.0098, -0.0135, -0.0088], [0.0098, 0.0135, 0.0577]),
    "link_15.0": ([-0.0098, -0.0135, -0.0088], [0.0098, 0.0135, 0.0313]),
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


@pytest.mark.parametrize("name", EXTENTS)
def test_primitives_cover_the_true_extents(hand: HandModel, name: str) -> None:
    meshes = [primitive_mesh(p).vertices for p in hand.primitives_of[hand.link_index[name]]]
    vertices = np.concatenate(meshes)
    lower, upper = EXTENTS[name]
    # 0.06 mm: the extents are rounded to 0.1 mm, and the tip's ball is drawn with inscribed facets.
    assert (vertices.min(0) <= np.array(lower) + 6e-5).all()
    assert (vertices.max(0) >= np.array(upper) - 6e-5).all()
    # 1 mm: the tip's ball reaches that far into the box behind it; everything else is as snug as the rounding.
    assert (vertices.min(0) >= np.array(lower) - 1.0001e-3).all()
    assert (vertices.max(0) <= np.array(upper) + 6e-5).all()


def test_a_fist_is_seen_to_collide(hand: HandModel) -> None:
    points, links, _ = dense_samples(hand, seed=11)
    fist = hand.lower + 0.75 * (hand.upper - hand.lower)
    overlap = np.where(hand.adjacent, 0.0, link_overlaps(hand, fist[None], points, links)[0])
    assert overlap.max() > 3e-3


def test_thumb_opposes_the_fingers_when_open(hand: HandModel) -> None:
    tips = link_poses(hand, hand.open_posture)[1][[hand.link_index[name] for name in TIPS]]
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
    for link in range(hand.num_links):
        local = torch.as_tensor((mesh.vertices - translations[link]) @ rotations[link])
        distance = torch.minimum(distance, hand_sdf(hand, link, local))
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
