"""A hand, an object and verified grasps of it, and a library that holds them."""

from __future__ import annotations

from pathlib import Path

import pytest

from graspd_core import GraspResult, HandModel, Scene, load_hand, load_preset, load_scene, plan_grasps
from graspd_core.library.grasp_library import GraspLibrary
from graspd_core.library.known_grasps import add_planned


@pytest.fixture(scope="session")
def hand() -> HandModel:
    return load_hand("allegro_right")


@pytest.fixture(scope="session")
def scene() -> Scene:
    return load_scene("shape:sphere")


@pytest.fixture(scope="session")
def planned(scene: Scene, hand: HandModel) -> GraspResult:
    return plan_grasps(scene, hand, count=4, preset="fast", seed=3)


@pytest.fixture
def library(tmp_path: Path, scene: Scene, hand: HandModel, planned: GraspResult) -> GraspLibrary:
    library = GraspLibrary(tmp_path / "known.grasps")
    library.create()
    assert add_planned(library, scene, hand, load_preset("fast"), planned.grasps, "standard") == 4
    return library
