"""Settings of a scene: one file reaches every field, every field is used, and what is wrong in the file is named."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from graspd_bench.rendering.depth_noise import NONE
from graspd_bench.rendering.tabletop import ring_poses, tabletop, views_of
from graspd_core.config import SceneConfig, load_scene_config
from graspd_core.errors import ConfigError
from graspd_core.perception.cloud.camera import PinholeCamera
from graspd_core.perception.cloud.point_cloud import PointCloud
from graspd_core.perception.load_scene import scene_from_views
from graspd_core.perception.obstacles import make_obstacles
from graspd_core.perception.reconstruct.reconstruct import reconstruct
from graspd_core.perception.segment.segment import segment
from graspd_core.perception.segment.target_selection import Target

PAGE = Path(__file__).parents[2] / "docs" / "clouds.md"
PARTS = [(part.name, getattr(SceneConfig(), part.name)) for part in dataclasses.fields(SceneConfig)]
FIELDS = {f"{name}.{field.name}": field for name, part in PARTS for field in dataclasses.fields(part)}
CAMERA = PinholeCamera(160, 120, 154.0, 154.0, 79.5, 59.5)


def written(folder: Path, text: str) -> Path:
    path = folder / "scene.yaml"
    path.write_text(text)
    return path


def test_an_empty_file_holds_the_defaults(tmp_path: Path):
    assert load_scene_config(written(tmp_path, "")) == SceneConfig()


def test_one_file_reaches_every_field(tmp_path: Path):
    def other(name: str, value: Any) -> Any:
        given = {"roi_low": [0.0, 0.0, 0.0], "roi_high": [1.0, 1.0, 1.0], "poisson": "open3d"}
        return given[name] if name in given else 2 * value

    values = {name: {f: other(f, v) for f, v in dataclasses.asdict(part).items()} for name, part in PARTS}
    config = dataclasses.asdict(load_scene_config(written(tmp_path, yaml.safe_dump(values))))
    for name, part in PARTS:
        assert all(config[name][field] != value for field, value in dataclasses.asdict(part).items())


@pytest.mark.parametrize(
    ("text", "culprits"),
    [
        ("segmentation: {gab: 0.01}", ["scene.yaml.segmentation", "'gab'", "gap", "voxel"]),
        ("obstacle: {padding: 0.01}", ["'obstacle'", "obstacles, reconstruction, segmentation"]),
        ("segmentation: {gap: 0}", ["segmentation.gap", "0.0", "above zero"]),
        ("reconstruction: {max_points: 10}", ["reconstruction.max_points", "10", "at least 1000"]),
        ("reconstruction: {seen_distance: 0.02}", ["seen_distance", "0.02", "guessed_distance=0.02"]),
        ("segmentation: {roi_low: [0, 0, 0], roi_high: [1, 1, 0]}", ["roi_low", "roi_high=(1.0, 1.0, 0.0)"]),
        ("reconstruction: {poisson: pcl}", ["reconstruction.poisson", "pcl", "grid, open3d"]),
        ("segmentation: [", ["not valid YAML"]),
    ],
)
def test_a_bad_file_is_named(tmp_path: Path, text: str, culprits: list[str]):
    with pytest.raises(ConfigError) as caught:
        load_scene_config(written(tmp_path, text))
    message = str(caught.value)
    assert "\n" not in message
    assert all(part in message for part in ["scene.yaml", *culprits]), message


def test_a_missing_file_is_named(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"none\.yaml: No such file"):
        load_scene_config(tmp_path / "none.yaml")


def recorded(config: Any, prefix: str, read: set[str]) -> Any:
    """The same settings; `read` gets the names of those that are looked at."""

    class Recorded(type(config)):
        def __getattribute__(self, name: str) -> Any:
            read.add(f"{prefix}.{name}")
            return super().__getattribute__(name)

    return Recorded(**vars(config))


def test_every_field_is_used_on_the_way_from_views_to_a_scene():
    read: set[str] = set()
    settings = SceneConfig(**{name: recorded(part, name, read) for name, part in PARTS})
    read.clear()
    on_table = tabletop("mug", obstacles=[("cylinder", 0.0, 0.16), ("box", 0.0, -0.16)])
    view = views_of(on_table, CAMERA, ring_poses(1, elevation=0.3, azimuth=0.4), NONE)[0]
    corners = (np.array([-0.07, -0.07, 0.0]), np.array([0.07, 0.07, 0.2]))
    scene_from_views([view], target=Target(box=corners), settings=settings, resolution=16)
    # The things alone, in the air.
    above = PointCloud(view.points[view.points[:, 2] > 0.008], view.viewpoint)
    segment([above], target=Target(point=np.array([0.0, 0.0, 0.05])), settings=settings.segmentation)
    ring = np.array([[0.12 * np.cos(t), 0.12 * np.sin(t), 0.01 * t] for t in np.linspace(0, 12.6, 200)])
    make_obstacles([ring], None, on_table.truth, 1.0, settings.obstacles)
    assert set(FIELDS) - read == set()


def test_the_settings_change_the_mesh_and_its_confidence():
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(4000, 3))
    views = [PointCloud(0.04 * ball / np.linalg.norm(ball, axis=1, keepdims=True), np.array([0.5, 0.0, 0.3]))]
    usual = SceneConfig().reconstruction
    here = reconstruct(views, settings=dataclasses.replace(usual, max_faces=500, seen_distance=1e-6))
    assert len(here.mesh.faces) <= 500
    assert here.confidence.max() < 1.0


def documented() -> list[str]:
    """The table of the fields as it has to be."""
    rows = ["| field | default | |", "|---|---|---|"]
    for name, part in PARTS:
        texts = dict(re.findall(r"^ {8}(\w+): (.*)$", type(part).__doc__ or "", re.MULTILINE))
        for field in dataclasses.fields(part):
            value = getattr(part, field.name)
            shown = "null" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
            rows.append(f"| `{name}.{field.name}` | {shown} | {texts[field.name]} |")
    return rows


def test_the_table_of_fields_is_that_of_the_docstrings():
    """Where it is not, what has to stand there is what this prints."""
    found = re.search(r"<!-- scene:begin -->\n(.*?)<!-- scene:end -->", PAGE.read_text(), re.DOTALL)
    assert found is not None
    assert found[1].strip() == "\n".join(documented()), "\n".join(["", *documented()])
