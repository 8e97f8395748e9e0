"""Golden fingertips: forward kinematics against the published descriptions, through other libraries."""

from __future__ import annotations

import numpy as np
import pytest

from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.library import load_hand

TIPS = {
    "allegro_right": ("link_3.0_tip", "link_7.0_tip", "link_11.0_tip", "link_15.0_tip"),
    "allegro_left": ("link_3.0_tip", "link_7.0_tip", "link_11.0_tip", "link_15.0_tip"),
    "leap_right": ("fingertip", "fingertip_2", "fingertip_3", "thumb_fingertip"),
}
# Fingertip origins in the base frame [m] at a share of the joint range (None: zero, clipped to the limits). Allegro's
# are from pytorch-kinematics and MuJoCo, which agree to 1e-5 m; LEAP's from pytorch-kinematics.
ALLEGRO = {
    None: [[0, 0.05531, 0.13344], [0, 0, 0.13620], [0, -0.05531, 0.13344], [0.02596, 0.16123, -0.08550]],
    0.5: [
        [0.09535, 0.04752, 0.04437],
        [0.09535, 0, 0.04679],
        [0.09535, -0.04752, 0.04437],
        [0.08403, 0.05714, -0.0102],
    ],
    0.75: [
        [0.06303, 0.05726, -0.01746],
        [0.06303, 0.01509, -0.01396],
        [0.06303, -0.02719, -0.01483],
        [0.04901, -0.01368, -0.02021],
    ],
}
LEAP = {
    None: [
        [0.08210, 0.02266, -0.01952],
        [0.08210, -0.02279, -0.01952],
        [0.08210, -0.06824, -0.01952],
        [-0.08240, 0.07666, -0.00692],
    ],
    0.5: [
        [0.02002, 0.02266, -0.09861],
        [0.02002, -0.02279, -0.09861],
        [0.02002, -0.06824, -0.09861],
        [-0.06132, 0.04303, -0.08248],
    ],
    0.75: [
        [-0.04410, 0.00822, -0.08477],
        [-0.04410, -0.03723, -0.08477],
        [-0.04410, -0.08268, -0.08477],
        [-0.07388, -0.04030, -0.07664],
    ],
}
GOLDEN: list[tuple[str, float | None, np.ndarray]] = [
    (name, share, np.array(tips))
    for name, at in {"allegro_right": ALLEGRO, "leap_right": LEAP}.items()
    for share, tips in at.items()
]
# At mid-range the abduction joints are zero, so that the right hand's positions are mirrored.
GOLDEN.append(("allegro_left", 0.5, np.array(ALLEGRO[0.5]) * [1.0, -1.0, 1.0]))


@pytest.mark.parametrize(("name", "share", "golden"), GOLDEN)
def test_golden_fingertips(name: str, share: float | None, golden: np.ndarray) -> None:
    hand = load_hand(name, candidates=8)
    q = np.clip(0, hand.lower, hand.upper) if share is None else hand.lower + share * (hand.upper - hand.lower)
    tips = link_poses(hand, q)[1][[hand.link_index[tip] for tip in TIPS[name]]]
    np.testing.assert_allclose(tips, golden, atol=1e-5)  # the golden values have five decimals
