"""Hands of many solids, of fine meshes and of thin or large shapes: loaded and planned with at a bounded cost.

The LEAP hand that its makers publish has fine meshes for collision shapes. A stand-in of its links' extents is made of
the shipped hand here: every link is a shell of thin plates, each a fine mesh file.
"""

import itertools
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from expected import some

from graspd_core import Outcome, load_scene, plan_grasps
from graspd_core.hands.kinematics import link_poses
from graspd_core.hands.library import load_hand, read_hand_file
from graspd_core.hands.link_distance import bounds, make_collision_tensors, solid_distance
from graspd_core.hands.model import HandModel, Primitive
from graspd_core.hands.self_collision import MOST_OF_GROUP, MOST_OF_HAND, collision_spheres
from graspd_core.hands.surface_points import surface_points, with_candidates
from graspd_core.paths import config_dir
from graspd_core.se3 import SE3

PLATE = 0.0015
# One moving joint, so that a hand is a hand.
ONE = (
    '<robot name="one"><link name="a"><collision><geometry>{shape}</geometry></collision></link>'
    '<link name="b"><collision><geometry><sphere radius="0.01"/></geometry></collision></link>'
    '<joint name="j" type="continuous"><parent link="a"/><child link="b"/><origin xyz="0 0 2"/></joint></robot>'
)


def rounded(half: np.ndarray, fineness: int) -> trimesh.Trimesh:
    """A block with rounded edges, about the origin."""
    ball = trimesh.creation.icosphere(subdivisions=fineness)
    corners = np.sign(ball.vertices) * np.abs(ball.vertices) ** 0.25
    return trimesh.Trimesh(corners / np.abs(corners).max(0) * half, ball.faces, process=False)


def extent(solids: Sequence[Primitive]) -> np.ndarray:
    """Least and greatest coordinates in the link's frame [m]."""
    ends = np.array([bounds(solid) for solid in solids])
    return np.stack([ends[:, 0].min(0), ends[:, 1].max(0)])


def fine_leap(folder: Path, fineness: int) -> Path:
    """The stand-in, 102 meshes of 20 · 4ⁿ faces."""
    text = (config_dir() / "hands" / "leap_right.urdf").read_text()
    shipped = load_hand("leap_right", candidates=1)
    for name, solids in zip(shipped.link_names, shipped.primitives_of, strict=True):
        low, high = extent(solids)
        shapes = ""
        for side in range(6):
            axis, sign = side // 2, 2 * (side % 2) - 1
            half, middle = 0.5 * (high - low), 0.5 * (high + low)
            middle[axis] += sign * (half[axis] - PLATE / 2)
            half[axis] = PLATE / 2
            file = f"{name}_{side}.stl"
            rounded(half, fineness).apply_translation(middle).export(folder / file)
            shapes += f'<collision><geometry><mesh filename="{file}"/></geometry></collision>'
        link = some(re.search(rf'<link name="{name}">.*?</link>', text, re.DOTALL))
        bare = re.sub(r"<collision>.*?</collision>", "", link[0], flags=re.DOTALL)
        text = text.replace(link[0], bare.replace("</link>", shapes + "</link>"))
    path = folder / "leap.urdf"
    path.write_text(text)
    return path


def cut_up(parts: tuple[int, int, int]) -> HandModel:
    """The shipped Allegro hand with each of its boxes cut into many."""

    def pieces(box: Primitive) -> list[Primitive]:
        size = np.array(box.size) / parts
        cells = (2 * np.array(list(np.ndindex(*parts))) + 1 - parts) * size
        return [
            replace(box, translation=box.translation + box.rotation @ cell, size=tuple(size.tolist())) for cell in cells
        ]

    hand = load_hand("allegro_right", candidates=1)
    solids = [pieces(solid) if solid.kind == "box" else [solid] for solid in hand.primitives]
    return replace(hand, primitives=tuple(itertools.chain.from_iterable(solids)))


def by_group(hand: HandModel) -> np.ndarray:
    return np.bincount(hand.link_group[collision_spheres(hand)[2]])


def bareness(hand: HandModel) -> float:
    """How far the surface is from the proxy spheres of its group at most [m]."""
    centers, radii, links = collision_spheres(hand)
    rotations, translations = link_poses(hand, hand.open_posture)
    placed = np.einsum("sij,sj->si", rotations[links], centers) + translations[links]
    worst, rng = 0.0, np.random.default_rng(0)
    for primitive in hand.primitives:
        points = surface_points(primitive, 50, rng)[0] @ rotations[primitive.link].T + translations[primitive.link]
        mates = hand.link_group[links] == hand.link_group[primitive.link]
        gaps = np.linalg.norm(points[:, None] - placed[mates], axis=-1) - radii[mates]
        worst = max(worst, float(gaps.min(1).max()))
    return worst


@pytest.mark.parametrize(
    ("make", "bare"),
    [(lambda folder: read_hand_file(fine_leap(folder, 1)), 0.03), (lambda _: cut_up((5, 5, 4)), 0.02)],
    ids=["meshes", "boxes"],
)
def test_a_crowded_hand_has_as_many_spheres_as_any(
    make: Callable[[Path], HandModel], bare: float, tmp_path: Path
) -> None:
    hand = make(tmp_path)
    counts = by_group(hand)
    assert counts.sum() <= MOST_OF_HAND
    assert counts.max() <= MOST_OF_GROUP
    assert (counts[np.unique(hand.link_group[[p.link for p in hand.primitives]])] > 0).all()
    # As many for every part of it: a shell's spheres each stand for a patch some 4 cm across.
    assert bareness(hand) < bare


@pytest.mark.parametrize(
    ("shape", "bare"),
    [
        ('<box size="2 2 0.000001"/>', 0.25),
        ('<box size="0.1 0.1 0.001"/>', 0.02),
        ('<box size="0.000001 0.000001 2"/>', 0.03),
        ('<cylinder radius="0.08" length="0.002"/>', 0.025),
        ('<cylinder radius="1" length="0.001"/>', 0.3),
        ('<cylinder radius="0.000001" length="2"/>', 0.03),
        ('<capsule radius="0.0001" length="2"/>', 0.03),
        ('<sphere radius="0.0001"/>', 0.0001),
        ('<mesh filename="plate.stl"/>', 0.02),
    ],
)
def test_a_thin_or_large_solid_has_few_spheres_all_over_it(shape: str, bare: float, tmp_path: Path) -> None:
    rounded(np.array([0.05, 0.05, 0.0002]), 2).export(tmp_path / "plate.stl")
    path = tmp_path / "one.urdf"
    path.write_text(ONE.format(shape=shape))
    hand = read_hand_file(path)
    assert by_group(hand)[0] <= MOST_OF_GROUP
    assert bareness(hand) < bare


def test_many_meshes_share_a_bounded_number_of_corners(tmp_path: Path) -> None:
    hand = read_hand_file(fine_leap(tmp_path, 3))
    assert len(hand.primitives) == 102
    assert sum(len(p.vertices) for p in hand.primitives) < 13_000
    # Fewer corners, and yet the plates' size: the rounded edges lose a tenth of a millimetre.
    shipped = load_hand("leap_right", candidates=1)
    whole = extent(shipped.primitives_of[shipped.link_index["pip"]])
    np.testing.assert_allclose(extent(hand.primitives_of[hand.link_index["pip"]]), whole, atol=2e-4)


@pytest.mark.parametrize("squash", [1.0, 1e-2, 1e-4])
def test_a_fine_mesh_becomes_a_close_hull(squash: float, tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.012)
    ball.vertices *= [1.0, 1.0, squash]
    ball.export(tmp_path / "ball.stl")
    path = tmp_path / "one.urdf"
    path.write_text(ONE.format(shape='<mesh filename="ball.stl"/>'))
    hull = read_hand_file(path).primitives[0]
    assert len(ball.faces) > 80_000
    assert 4 <= len(hull.vertices) <= 200
    if squash == 1.0:
        # Facets lie up to 0.3 mm below a ball's surface where the corners are the best 200 of all.
        a, b, c = hull.vertices[hull.faces].transpose(1, 0, 2)
        across = np.cross(b - a, c - a)
        depth = (across * a).sum(1) / np.linalg.norm(across, axis=1)
        assert 0.012 - depth.min() < 6e-4


@pytest.mark.parametrize("sections", [60, 120, 200])
def test_a_flat_cone_is_a_hull_too(sections: int, tmp_path: Path) -> None:
    # Of even directions most end in the tip and in one side of the rim.
    cone = trimesh.creation.cone(radius=0.02, height=0.02, sections=sections)
    cone.vertices *= [1.0, 0.01, 0.0005]
    cone.export(tmp_path / "cone.stl")
    path = tmp_path / "one.urdf"
    path.write_text(ONE.format(shape='<mesh filename="cone.stl"/>'))
    hull = read_hand_file(path).primitives[0]
    np.testing.assert_allclose(np.ptp(hull.vertices, axis=0)[0], 0.04, rtol=0.01)


def test_distances_to_very_many_solids_are_those_to_each() -> None:
    hand = cut_up((5, 5, 4))
    solids = make_collision_tensors(hand, "cpu", torch.float32)
    links = SE3(*(torch.as_tensor(a).float().expand(3, *a.shape) for a in link_poses(hand, hand.open_posture)))
    points = torch.as_tensor(np.random.default_rng(0).uniform(-0.1, 0.1, (3, 400, 3))).float()
    together = solid_distance(solids, links, points)
    for row in range(3):
        alone = solid_distance(solids, links[row : row + 1], points[row : row + 1])
        torch.testing.assert_close(together[row : row + 1], alone, rtol=0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "make",
    [lambda folder: load_hand(fine_leap(folder, 4)), lambda _: with_candidates(cut_up((5, 5, 4)), 600)],
    ids=["meshes", "boxes"],
)
def test_a_crowded_hand_holds_a_box(make: Callable[[Path], HandModel], tmp_path: Path) -> None:
    hand = make(tmp_path)
    result = plan_grasps(load_scene("shape:box"), hand, count=1, seed=0, preset="fast")
    assert result.outcome is Outcome.SUCCEEDED
