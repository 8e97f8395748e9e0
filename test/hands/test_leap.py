"""The LEAP hand that graspd ships with: golden values, geometry, postures."""

from __future__ import annotations

import numpy as np
import pytest

from graspd_core.hands.hand_mesh import primitive_mesh
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.library import load_hand
from graspd_core.hands.model import HandModel

TIPS = ("fingertip", "fingertip_2", "fingertip_3", "thumb_fingertip")
# Extents of the maker's meshes in their link frames [m]: lower corner, upper corner.
FINGER = {
    "mcp_joint": ([-0.0430, -0.0080, -0.0028], [0.0100, 0.0625, 0.0330]),
    "pip": ([-0.0095, -0.0146, -0.0231], [0.0245, 0.0150, -0.0001]),
    # The lobes of its fork reach 4 mm farther than the box that stands for the fork.
    "dip": ([-0.0100, -0.0461, -0.0029], [0.0245, 0.0080 - 0.0040, 0.0317]),
    "fingertip": ([-0.0112, -0.0495, -0.0029], [0.0099, 0.0080, 0.0317]),
}
EXTENTS = {
    "palm_lower": ([-0.1000, -0.0987, -0.0347], [0.0030, 0.0257, 0.0113]),
    **{f"{name}{finger}": extent for name, extent in FINGER.items() for finger in ("", "_2", "_3")},
    "pip_4": ([-0.0244, -0.0145, -0.0230], [0.0096, 0.0151, 0.0]),
    "thumb_pip": ([-0.0100, -0.0173, -0.0249], [0.0100, 0.0173, 0.0001]),
    "thumb_dip": ([-0.0186, -0.0096, -0.0316], [0.0099, 0.0545, 0.0030]),
    "thumb_fingertip": ([-0.0112, -0.0622, -0.0309], [0.0184, 0.0094, 0.0021]),
}


@pytest.fixture(scope="module")
def hand() -> HandModel:
    return load_hand("leap_right")


def test_joints_keep_the_order_of_the_tree(hand: HandModel) -> None:
    """Names are bare numbers that do not rise along a finger; sorting them would permute the joints."""
    assert hand.joint_names == tuple(map(str, [1, 0, 2, 3, 5, 4, 6, 7, 9, 8, 10, 11, 12, 13, 14, 15]))
    np.testing.assert_allclose(hand.lower, [-0.314, -1.047, -0.506, -0.366] * 3 + [-0.349, -0.47, -1.2, -1.34])
    np.testing.assert_allclose(hand.upper, [2.23, 1.047, 1.885, 2.042] * 3 + [2.094, 2.443, 1.9, 1.88])
    np.testing.assert_allclose(hand.effort, 0.95)
    assert hand.link_mass.sum() == pytest.approx(0.746)
    assert hand.open_posture[hand.joint_names.index("12")] == 1.5
    assert hand.open_posture[0] == 0.2


@pytest.mark.parametrize("name", EXTENTS)
def test_primitives_cover_the_true_extents(hand: HandModel, name: str) -> None:
    meshes = [primitive_mesh(p).vertices for p in hand.primitives_of[hand.link_index[name]]]
    vertices = np.concatenate(meshes)
    lower, upper = EXTENTS[name]
    # 0.12 mm: the extents are rounded to 0.1 mm, fingers differ by as much, and the tip's dome has inscribed facets.
    np.testing.assert_allclose(vertices.min(0), lower, atol=1.2e-4)
    np.testing.assert_allclose(vertices.max(0), upper, atol=1.2e-4)


def test_thumb_opposes_the_fingers_when_open(hand: HandModel) -> None:
    links = [hand.link_index[name] for name in TIPS]
    rotations, translations = link_poses(hand, hand.open_posture)
    # Points amid the soft tips, where others put their tip frames.
    local = np.array([[0.0, -0.040, 0.015]] * 3 + [[0.0, -0.045, -0.015]])
    tips = np.einsum("nij,nj->ni", rotations[links], local) + translations[links]
    assert ((tips - hand.palm_center) @ hand.palm_normal > 0.03).all()
    assert np.linalg.norm(tips[3] - tips[1]) > 0.08  # room for an object of 8 cm
