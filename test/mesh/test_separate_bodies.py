"""Bodies that stand apart are told, parts of one thing are not."""

from __future__ import annotations

import numpy as np
import pytest

from graspd_core.mesh.components import bodies_apart
from graspd_core.mesh.shapes import make_shape
from graspd_core.perception.load_scene import load_scene
from graspd_core.perception.scene import build_scene
from graspd_core.types import TriangleMesh, joined


def block(size, centre=(0, 0, 0)) -> TriangleMesh:
    """A box of twelve faces."""
    corners = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing="ij"), -1).reshape(-1, 3)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return TriangleMesh(corners * size + np.asarray(centre, float), np.array(faces))


def cup(handle_gap: float) -> TriangleMesh:
    """A solid cup with a handle of three bars, each a body of its own."""
    out = 0.04 + handle_gap
    bars = [block((0.03, 0.008, 0.008), (out + 0.015, 0, z)) for z in (-0.03, 0.03)]
    return joined(block((0.08, 0.08, 0.1)), *bars, block((0.008, 0.008, 0.068), (out + 0.03, 0, 0)))


@pytest.mark.parametrize("gap", [0.0, -0.02, 0.001])
def test_a_handle_of_its_own_that_touches_reaches_in_or_just_misses_is_no_other_body(gap):
    assert bodies_apart(cup(gap)) == (1, np.inf)


@pytest.mark.parametrize(
    "mesh",
    [
        make_shape("mug"),
        joined(make_shape("sphere"), TriangleMesh(make_shape("sphere").vertices * 0.5, make_shape("sphere").faces)),
        joined(*(block(np.roll((0.03, 0.03, 0.1), turn)) for turn in range(3))),
        joined(block((0.2, 0.2, 0.01)), block((0.005,) * 3, (0.05, 0.03, 0.0075))),
    ],
    ids=["mug", "hollow", "cross", "pebble-on-plate"],
)
def test_what_hangs_together_or_lies_within_is_one(mesh):
    assert bodies_apart(mesh) == (1, np.inf)


def test_bodies_apart_are_counted_and_the_gap_is_theirs():
    pair = joined(block((0.06,) * 3), block((0.05,) * 3, (0.155, 0, 0)))
    bodies, gap = bodies_apart(pair)
    assert bodies == 2
    # Between flat faces of four corners each and a few hundred points more.
    assert gap == pytest.approx(0.1, abs=1e-3)
    assert bodies_apart(joined(pair, block((0.02,) * 3, (0, 0.2, 0))))[0] == 3


def test_a_scene_tells_of_bodies_apart():
    pair = joined(block((0.06,) * 3), block((0.06,) * 3, (0.16, 0, 0)))
    assert load_scene(pair, resolution=16).object.warnings == (
        "mesh: 2 bodies, 100 mm apart; they are grasped as one rigid thing",
    )
    # What was reconstructed from a cloud is one thing already.
    assert build_scene(pair, confidence=np.ones(len(pair.vertices)), resolution=16).object.warnings == ()
