"""The grid of trust: one where the surface was seen, zero where it was guessed."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from graspd_core.errors import MeshError
from graspd_core.mesh.shapes import make_shape
from graspd_core.perception.scene import build_scene, sample_confidence
from graspd_core.types import Plane

SPHERE = make_shape("sphere")


def test_trust_is_that_of_the_nearest_surface():
    seen = (SPHERE.vertices[:, 0] > 0).astype(float)
    table = Plane(np.array([0.0, 0.0, 1.0]), -0.035)
    scene = build_scene(SPHERE, confidence=seen, support=table, resolution=24)
    assert scene.support is table
    assert scene.confidence is not None
    assert scene.confidence.shape == scene.sdf.field.shape[1:]
    assert set(scene.confidence.unique().tolist()) == {0.0, 1.0}
    x = torch.tensor([[[0.035, 0.0, 0.0], [-0.035, 0.01, 0.0], [0.5, 0.0, 0.0], [-0.5, 0.0, 0.1]]])
    assert sample_confidence(scene.confidence, scene.sdf, x).tolist() == [[1.0, 0.0, 1.0, 0.0]]
    # It rises from one to the other within two cells about the border, to the rounding of float32.
    cell = float(scene.sdf.spacing)
    border = torch.stack([torch.linspace(-cell, cell, 21), torch.full((21,), 0.035), torch.zeros(21)], -1)[None]
    values = sample_confidence(scene.confidence, scene.sdf, border)[0]
    assert (values.diff() >= -1e-6).all()
    assert values[0] < values[-1]


def test_a_scene_without_trust_has_no_grid():
    scene = build_scene(SPHERE, resolution=16)
    assert (scene.confidence, scene.support, scene.obstacles) == (None, None, ())


def test_one_trust_for_every_vertex():
    with pytest.raises(MeshError, match=r"3 values of confidence for \d+ vertices"):
        build_scene(SPHERE, source="half a ball", confidence=np.ones(3))
