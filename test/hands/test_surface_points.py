"""Candidates and dense samples lie on the hand's outer surface and cover it; on disk they are that hand's alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from graspd_core.hands import surface_points as sampling
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.library import load_hand, read_hand_file
from graspd_core.hands.link_distance import primitive_sdf
from graspd_core.hands.model import HandModel, Primitive
from graspd_core.hands.self_collision import adjacent_links, collision_spheres
from graspd_core.hands.surface_points import (
    candidates,
    dense_samples,
    feature_points,
    primitive_area,
    samples_with_edges,
    surface_points,
    with_candidates,
)
from graspd_core.runtime import disk_cache as cache

CORNERS = np.array([[0.0, 0, 0], [0.03, 0, 0], [0, 0.02, 0], [0, 0, 0.04]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
BARREL = 2 * np.pi * 0.01 * 0.04
# Solids with their areas [m²] and volumes [m³]. The slanted face of the hull is by de Gua's theorem.
SHAPES = [
    (Primitive(0, "box", np.eye(3), np.zeros(3), (0.01, 0.02, 0.03)), 8 * (0.0002 + 0.0006 + 0.0003), 8 * 6e-6),
    (Primitive(0, "sphere", np.eye(3), np.array([0.1, 0, 0]), (0.02,)), 4 * np.pi * 0.0004, 4 / 3 * np.pi * 8e-6),
    (Primitive(0, "capsule", np.eye(3), np.zeros(3), (0.01, 0.02)), 4e-4 * np.pi + BARREL, 16 / 3 * np.pi * 1e-6),
    (Primitive(0, "cylinder", np.eye(3)[:, [1, 2, 0]], np.zeros(3), (0.01, 0.02)), 2e-4 * np.pi + BARREL, np.pi * 4e-6),
    (Primitive(0, "hull", np.eye(3), np.zeros(3), (), CORNERS, FACES), 0.0013 + np.sqrt(61) * 1e-4, 4e-6),
]


def _group_distance(hand: HandModel, points: np.ndarray, links: np.ndarray) -> np.ndarray:
    """Signed distance to the union of each point's rigid group [m]."""
    rotations, translations = link_poses(hand, hand.open_posture)
    base = np.einsum("pij,pj->pi", rotations[links], points) + translations[links]
    distance = np.full(len(points), np.inf)
    for primitive in hand.primitives:
        link = primitive.link
        same = hand.link_group[links] == hand.link_group[link]
        local = torch.as_tensor((base[same] - translations[link]) @ rotations[link])
        distance[same] = np.minimum(distance[same], primitive_sdf(primitive, local).numpy())
    return distance


def test_candidates_lie_on_the_outer_surface(hand: HandModel) -> None:
    distance = _group_distance(hand, hand.candidate_points, hand.candidate_link)
    assert len(distance) == 600
    assert np.abs(distance).max() < 1e-6
    ahead = _group_distance(hand, hand.candidate_points + 1e-4 * hand.candidate_normals, hand.candidate_link)
    assert (ahead > 0.5e-4).all()  # normals point outwards, at edges and corners too
    np.testing.assert_allclose(np.linalg.norm(hand.candidate_normals, axis=1), 1.0, atol=1e-12)


def test_candidates_cover_the_surface(hand: HandModel) -> None:
    points, links, _ = dense_samples(hand, count=6000, seed=7)
    rotations, translations = link_poses(hand, hand.open_posture)

    def base(x: np.ndarray, owner: np.ndarray) -> np.ndarray:
        return np.einsum("pij,pj->pi", rotations[owner], x) + translations[owner]

    ours, theirs = base(hand.candidate_points, hand.candidate_link), base(points, links)
    mates = hand.link_group[links][:, None] == hand.link_group[hand.candidate_link][None]
    gap = np.where(mates, np.linalg.norm(theirs[:, None] - ours[None], axis=-1), np.inf).min(1)
    tips = np.array(["tip" in name for name in hand.link_names])[links]
    # 400 points for 1,000 cm² are 17 mm apart on a square lattice, 12 mm from its worst place to the nearest point;
    # fingertips are sampled twice as densely as that, backs half as densely.
    assert np.quantile(gap[tips], 0.95) < 0.008
    assert gap[tips].max() < 0.012
    assert np.median(gap) < 0.009
    assert np.quantile(gap, 0.9) < 0.016
    assert gap.max() < 0.027


def test_corners_that_face_the_grasp_are_candidates(hand: HandModel) -> None:
    medial = hand.primitives_of[hand.link_index["link_2.0"]][0]
    corners, _, is_corner = feature_points(medial, 0.01)
    palmar = corners[is_corner & (corners[:, 0] > 0) & (corners[:, 2] > 0)]
    own = hand.candidate_points[hand.candidate_link == hand.link_index["link_2.0"]]
    assert len(palmar) == 2
    for corner in palmar:
        assert np.linalg.norm(own - corner, axis=1).min() < 1e-9


FOREARM = """<robot name="armed">
  <link name="forearm"><collision><geometry><box size="0.08 0.08 0.25"/></geometry></collision></link>
  <link name="wrist"><collision><geometry><box size="0.05 0.05 0.03"/></geometry></collision></link>
  <link name="palm"><collision><geometry><box size="0.08 0.03 0.08"/></geometry></collision></link>
  <link name="left"><collision><geometry><box size="0.015 0.015 0.08"/></geometry></collision></link>
  <link name="right"><collision><geometry><box size="0.015 0.015 0.08"/></geometry></collision></link>
  <joint name="a" type="revolute"><parent link="forearm"/><child link="wrist"/><origin xyz="0 0 0.15"/>
    <axis xyz="1 0 0"/><limit lower="-0.5" upper="0.5" effort="5" velocity="2"/></joint>
  <joint name="b" type="revolute"><parent link="wrist"/><child link="palm"/><origin xyz="0 0 0.07"/>
    <axis xyz="0 1 0"/><limit lower="-0.5" upper="0.5" effort="5" velocity="2"/></joint>
  <joint name="c" type="revolute"><parent link="palm"/><child link="left"/><origin xyz="-0.03 0 0.09"/>
    <axis xyz="0 1 0"/><limit lower="0" upper="1" effort="1" velocity="2"/></joint>
  <joint name="d" type="revolute"><parent link="palm"/><child link="right"/><origin xyz="0.03 0 0.09"/>
    <axis xyz="0 -1 0"/><limit lower="0" upper="1" effort="1" velocity="2"/></joint>
</robot>"""


def test_a_forearm_and_a_wrist_get_no_candidates(tmp_path: Path) -> None:
    (tmp_path / "armed.urdf").write_text(FOREARM)
    hand = load_hand(tmp_path / "armed.urdf", candidates=200)
    share = {name: (hand.candidate_link == link).mean() for link, name in enumerate(hand.link_names)}
    assert share["forearm"] == share["wrist"] == 0
    assert min(share["palm"], share["left"], share["right"]) > 0.15


def test_dense_samples_carry_the_outer_area(hand: HandModel) -> None:
    points, links, areas = dense_samples(hand, count=20000, seed=3)
    assert len(points) >= 20000
    assert np.abs(_group_distance(hand, points, links)).max() < 1e-6
    tip = areas[links == hand.link_index["link_3.0_tip"]].sum()
    # Ball and cylinder make a half ball on a barrel, and of its end what the box behind does not cover (a strip each
    # side of |x| < 9.8 mm); 15 %: three sigma of some 400 random samples.
    end = np.pi * 0.012**2 - (
        4 * (0.0098 * np.sqrt(0.012**2 - 0.0098**2) / 2 + 0.012**2 / 2 * np.arcsin(0.0098 / 0.012))
    )
    assert tip == pytest.approx(2 * np.pi * 0.012**2 + 2 * np.pi * 0.012 * 0.011 + end, rel=0.15)


@pytest.mark.parametrize(("shape", "area", "volume"), SHAPES, ids=[shape.kind for shape, *_ in SHAPES])
def test_surface_points_lie_on_the_primitive_and_are_uniform_by_area(
    shape: Primitive, area: float, volume: float
) -> None:
    points, normals = surface_points(shape, 500, np.random.default_rng(0))
    assert primitive_sdf(shape, torch.as_tensor(points)).abs().max() < 1e-12
    ahead = primitive_sdf(shape, torch.as_tensor(points + 1e-5 * normals))
    np.testing.assert_allclose(ahead, 1e-5, atol=1e-8)
    assert primitive_area(shape) == pytest.approx(area)
    # Divergence theorem: the outward flux of x through the surface is three times the volume.
    points, normals = surface_points(shape, 40000, np.random.default_rng(1))
    flux = primitive_area(shape) * ((points - shape.translation) * normals).sum(1).mean()
    assert flux / 3 == pytest.approx(volume, rel=0.02)  # 40,000 samples: half a per cent


def test_proxy_spheres_fill_the_links_and_bulge_little(hand: HandModel) -> None:
    centers, radii, links = collision_spheres(hand)
    assert 60 <= len(centers) <= 110
    points, owners, _ = dense_samples(hand, seed=5)
    for link in range(hand.num_links):
        mine = links == link
        assert mine.any()
        of_link = [primitive_sdf(p, torch.as_tensor(centers[mine])).numpy() for p in hand.primitives_of[link]]
        depth = np.min(of_link, axis=0)
        assert (depth + radii[mine]).max() < 0.003  # the bulge that the module's docstring owns up to
        surface = points[owners == link]
        reach = np.linalg.norm(surface[:, None] - centers[mine][None], axis=-1) - radii[mine]
        assert np.median(reach.min(1)) < 0.005  # half the surface is within 5 mm of a sphere


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("GRASPD_CACHE", raising=False)
    with_candidates.cache_clear()
    cache.forget()
    yield tmp_path / "graspd"
    with_candidates.cache_clear()
    cache.forget()


def arrays_of(hand):
    samples = [part[:500] for part in samples_with_edges(hand, count=500, seed=3)]
    return [hand.adjacent, hand.candidate_points, hand.candidate_normals, hand.candidate_link, *samples]


# One hand with coupled joints and one whose joints slide.
@pytest.mark.parametrize("name", ["barrett_like", "parallel_gripper"])
def test_what_is_on_disk_is_what_sampling_gives(name, own_cache, monkeypatch):
    hand = load_hand(name, candidates=100)
    fresh = arrays_of(hand)
    bare = replace(hand, adjacent=np.zeros_like(hand.adjacent))
    expected = [
        hand.adjacent,
        *candidates(hand, 100, 0),
        *(part[:500] for part in dense_samples(hand, count=500, seed=3)),
    ]
    cache.forget()
    for module, function in ((sampling, "candidates"), (sampling, "dense_samples")):
        monkeypatch.setattr(module, function, lambda *_, **__: pytest.fail("sampled again"))
    read = arrays_of(load_hand(name, candidates=100))
    assert adjacent_links(bare).tolist() == hand.adjacent.tolist()
    for a, b, c in zip(fresh, read, expected, strict=True):
        assert a.dtype == b.dtype == c.dtype
        assert (a == b).all()
        assert (b == c).all()


def test_another_hand_has_its_own(own_cache):
    hand = load_hand("parallel_gripper", candidates=50)
    files = set(own_cache.glob("hand-*.npz"))
    with_candidates(replace(hand, name="other", urdf="elsewhere"), 60)
    assert len(set(own_cache.glob("hand-*.npz")) - files) == 1
    solid = hand.primitives[0]
    thicker = replace(hand, primitives=(replace(solid, translation=solid.translation + 1e-6), *hand.primitives[1:]))
    for changed in (thicker, replace(hand, upper=hand.upper + 1e-6), replace(hand, palm_normal=-hand.palm_normal)):
        files = set(own_cache.glob("hand-*.npz"))
        with_candidates(changed, 60)
        assert len(set(own_cache.glob("hand-*.npz")) - files) == 1


@pytest.mark.parametrize("alien", [{"adjacent": np.zeros(3)}, {"adjacent": np.float64(1)}, {"other": np.zeros((9, 9))}])
def test_an_alien_file_is_sampled_again(alien, own_cache):
    hand = load_hand("parallel_gripper", candidates=50)
    bare = replace(hand, adjacent=np.zeros_like(hand.adjacent))
    adjacent_links(bare)
    for file in own_cache.glob("hand-*-adjacent-*.npz"):
        np.savez(file, **alien)
    cache.forget()
    assert adjacent_links(bare).tolist() == hand.adjacent.tolist()


@pytest.mark.parametrize(("first", "adjacent"), [(0.01, True), (0.055, False)])
def test_a_link_that_is_in_the_palm_in_most_postures_is_so_in_the_model_only(tmp_path, first, adjacent):
    """A finger that turns down from upright, beside a palm whose solid begins `first` [m] from it."""

    def link(name: str, solid: str, at: str) -> str:
        return f'<link name="{name}"><collision><origin xyz="{at}"/><geometry>{solid}</geometry></collision></link>'

    def joint(parent: str, child: str, at: str) -> str:
        ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/><axis xyz="-1 0 0"/>'
        return f'<joint name="to_{child}" type="revolute">{ends}<limit lower="0" upper="0.7" effort="1"/></joint>'

    made = link("palm", '<box size="0.1 0.1 0.04"/>', f"0 {first + 0.05} 0.05")
    made += link("knuckle", '<sphere radius="0.005"/>', "0 0 0") + joint("palm", "knuckle", "0 0 0")
    made += link("finger", '<box size="0.01 0.01 0.06"/>', "0 0 0.04") + joint("knuckle", "finger", "0 0 0.01")
    (tmp_path / "hand.urdf").write_text(f'<robot name="a">{made}</robot>')
    hand = replace(read_hand_file(tmp_path / "hand.urdf"), open_posture=np.zeros(2))
    found = adjacent_links(hand)
    assert found[hand.link_index["palm"], hand.link_index["finger"]] == adjacent
