"""The page of a grasp: it stands alone, and shows object and hand where the grasp puts them."""

from __future__ import annotations

import base64
import io
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

from graspd_core.hands.library import load_hand
from graspd_core.mesh.shapes import make_shape
from graspd_core.types import Grasp, Posture, TrialResult, Verdict
from graspd_viewer.grasp_page import placed_hand, save_view

# Half a turn about z: x and y change sign.
HALF_TURN = np.array([0.0, 0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def hand():
    return load_hand("allegro_right")


def grasp_at(hand, verdict: Verdict) -> Grasp:
    posture = Posture(np.array([0.1, 0.2, 0.3]), HALF_TURN, hand.open_posture)
    trials = () if verdict is Verdict.UNVERIFIED else (TrialResult("hold", verdict is Verdict.VERIFIED, 0.0, 0.0),)
    return Grasp(posture, posture, posture, (), 0.0, trials=trials)


def shown(path: Path) -> dict[str, np.ndarray]:
    """Bounds of every mesh in a page, read back from its embedded GLB."""
    (encoded,) = re.findall(r'base64_data\s*=\s*"([A-Za-z0-9+/=]+)"', path.read_text())
    scene = trimesh.load_scene(io.BytesIO(base64.b64decode(encoded)), file_type="glb")
    return {name: mesh.bounds for name, mesh in scene.geometry.items()}


def test_the_page_shows_object_and_hand_and_needs_no_network(tmp_path: Path, hand):
    cup = make_shape("mug")
    save_view(tmp_path / "deep" / "view.html", cup, hand, [grasp_at(hand, Verdict.VERIFIED)], name="<mug>")
    page = (tmp_path / "deep" / "view.html").read_text()
    assert not re.findall(
        r"""(?:src|href)\s*=\s*["']?https?:|@import|fetch\(\s*["']http|import[^;]{0,80}["']http""", page
    )
    assert not re.findall(r"<(?:link|iframe|img)\b", page)
    assert f"<title>&lt;mug&gt;, {hand.name}: verified grasp</title>" in page
    meshes = shown(tmp_path / "deep" / "view.html")
    assert set(meshes) == {"object", "hand"}
    # float32 in the file
    assert meshes["object"] == pytest.approx(np.stack([cup.vertices.min(0), cup.vertices.max(0)]), abs=1e-6)


def test_the_hand_is_where_the_posture_puts_it(hand):
    posture = grasp_at(hand, Verdict.VERIFIED).grasp
    centre = placed_hand(hand, posture).vertices.mean(0)
    at_origin = placed_hand(hand, Posture(np.zeros(3), np.array([1.0, 0, 0, 0]), hand.open_posture)).vertices.mean(0)
    assert centre == pytest.approx(at_origin * [-1, -1, 1] + posture.position, abs=1e-9)


def test_a_grasp_that_failed_is_not_shown(tmp_path: Path, hand):
    save_view(tmp_path / "view.html", make_shape("box"), hand, [grasp_at(hand, Verdict.FAILED)])
    assert set(shown(tmp_path / "view.html")) == {"object"}
    assert f"<title>object, {hand.name}: no grasp</title>" in (tmp_path / "view.html").read_text()
