"""Settings of plans and of scenes: presets load, one file reaches every field, and what is wrong in one is named."""

import dataclasses
import inspect
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from expected import refused

from graspd_bench.rendering.depth_noise import NONE
from graspd_bench.rendering.tabletop import ring_poses, tabletop, views_of
from graspd_core import (
    PinholeCamera,
    PlanConfig,
    PointCloud,
    Target,
    load_preset,
    override,
    preset_names,
    scene_from_views,
)
from graspd_core.config import SceneConfig, SegmentationConfig, from_mapping, load_scene_config
from graspd_core.errors import ConfigError
from graspd_core.perception.obstacles import make_obstacles
from graspd_core.perception.reconstruct.reconstruct import reconstruct
from graspd_core.perception.segment.segment import segment


@pytest.mark.parametrize("name", preset_names())
def test_every_boxed_preset_loads(name: str):
    assert isinstance(load_preset(name), PlanConfig)


def test_the_balanced_preset_is_the_default_and_presets_differ_in_effort():
    assert load_preset("balanced") == PlanConfig()
    fast, balanced, accurate = (load_preset(name).settings for name in ("fast", "balanced", "accurate"))
    steps = [
        c.starts_per_grasp * (c.explore_steps + c.refine_steps + c.polish_steps) for c in (fast, balanced, accurate)
    ]
    assert steps[0] < steps[1] < steps[2]


def test_a_preset_file_changes_only_what_it_names(tmp_path: Path):
    path = tmp_path / "mine.yaml"
    path.write_text("resolution: 32\nclosed_form:\n  delta_end: 1\n  weights: {wrench_resistance: 2.5}\n")
    config = load_preset(str(path))
    assert config.resolution == 32
    assert config.settings.weights == dataclasses.replace(PlanConfig().settings.weights, wrench_resistance=2.5)
    assert isinstance(config.settings.delta_end, float)
    assert config.grasp_stages == PlanConfig().grasp_stages
    path.write_text("closed_form: {polish_weights: {penetration: 25}}\n")
    before, after = load_preset("balanced").settings, load_preset(str(path)).settings
    assert after == dataclasses.replace(
        before, polish_weights=dataclasses.replace(before.polish_weights, penetration=25.0)
    )


@pytest.mark.parametrize(
    ("text", "culprits"),
    [
        ("resolutoin: 32", ["bad.yaml:1: unknown key 'resolutoin'; did you mean 'resolution'?"]),
        ("closed_form: {delta: 1.0}", ["closed_form", "'delta'", "'delta_end'"]),
        (
            "method: closed_form\n\nclosed_form:\n  weights: {tusk: 1.0}",
            ["bad.yaml:4: closed_form.weights: ", "'tusk'"],
        ),
        ("# A comment.\nclosed_form:\n  delta_end: low", ["bad.yaml:3: closed_form.delta_end: expected float"]),
        ("robust: {}\ncertainty: {probability: 2}", ["bad.yaml:2: certainty.probability: 2.0"]),
        (f"? 0x{'f' * 5000}\n: 1", ["bad.yaml:1: unknown key", "huge int", "valid: certainty"]),
        ("resolution: fine", ["resolution", "expected int", "'fine'"]),
        ("resolution: 32.5", ["resolution", "expected int", "32.5"]),
        ("resolution: true", ["resolution", "expected int", "True"]),
        ("closed_form: {delta_end: '0.01'}", ["closed_form.delta_end", "expected float"]),
        ("closed_form: {delta_end: .nan}", ["closed_form.delta_end", "nan", "finite"]),
        ("grasp_stages: {grip_force: -.inf}", ["grasp_stages.grip_force", "inf", "finite"]),
        ("grasp_stages: {open_steps: -1}", ["grasp_stages.open_steps", "-1", "zero or more"]),
        ("closed_form: 3", ["closed_form", "mapping", "3"]),
        ("[1, 2]", ["mapping", "[1, 2]"]),
        ("method: magic", ["method", "'magic'", "closed_form"]),
        ("a: [1", ["not valid YAML"]),
        ("robust: {}\nresolution: 32\nrobust: {}", ["bad.yaml", "line 3: 'robust' occurs twice"]),
    ],
)
def test_a_bad_preset_file_is_named(tmp_path: Path, text: str, culprits: list[str]):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with refused(ConfigError, "bad.yaml", *culprits):
        load_preset(str(path))


@pytest.mark.parametrize("name", ["resolution", "method", "closed_form.weights.posture"])
def test_a_name_below_a_value_is_refused(name: str):
    with pytest.raises(ConfigError, match=rf"settings.{name}: .*'deeper': 3"):
        override(load_preset("fast"), {f"{name}.deeper": 3})


def test_a_file_that_is_no_text_is_named(tmp_path: Path):
    path = tmp_path / "noise.yaml"
    path.write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(ConfigError, match=r"noise\.yaml"):
        load_preset(str(path))


@pytest.mark.parametrize("name", ["best", "missing.yaml"])
def test_an_unknown_preset_lists_the_known(name: str):
    with refused(ConfigError, name, "fast", "balanced", "accurate"):
        load_preset(name)


def test_places_are_read_with_their_signs():
    read = from_mapping(SegmentationConfig, {"roi_low": [-0.5, -1, 0.0], "roi_high": None})
    assert read == SegmentationConfig(roi_low=(-0.5, -1.0, 0.0))


@pytest.mark.parametrize(
    ("value", "complaint"),
    [
        ([0.0, 1.0], r"config.roi_low: expected 3 values, got \[0.0, 1.0\]"),
        (0.5, "config.roi_low: expected 3 values, got 0.5"),
        ([0.0, "left", 1.0], r"config.roi_low\[1\]: expected float, got 'left'"),
        ([0.0, 1.0, float("-inf")], r"config.roi_low\[2\]: -inf must be a finite number$"),
    ],
)
def test_a_place_that_is_none_is_named(value: object, complaint: str):
    with pytest.raises(ConfigError, match=complaint):
        from_mapping(SegmentationConfig, {"roi_low": value})


PARTS = [(part.name, getattr(SceneConfig(), part.name)) for part in dataclasses.fields(SceneConfig)]
FIELDS = {f"{name}.{field.name}": field for name, part in PARTS for field in dataclasses.fields(part)}
CAMERA = PinholeCamera(160, 120, 154.0, 154.0, 79.5, 59.5)


def written(folder: Path, text: str) -> Path:
    path = folder / "scene.yaml"
    path.write_text(text)
    return path


def test_an_empty_file_holds_the_defaults_and_a_missing_one_is_named(tmp_path: Path):
    assert load_scene_config(written(tmp_path, "")) == SceneConfig()
    with pytest.raises(ConfigError, match=r"none\.yaml: No such file"):
        load_scene_config(tmp_path / "none.yaml")


def test_one_file_reaches_every_field(tmp_path: Path):
    def other(name: str, value: Any) -> Any:
        given = {"roi_low": [0.0, 0.0, 0.0], "roi_high": [1.0, 1.0, 1.0], "poisson": "open3d", "piled": True}
        return given[name] if name in given else 2 * value

    values = {name: {f: other(f, v) for f, v in dataclasses.asdict(part).items()} for name, part in PARTS}
    config = dataclasses.asdict(load_scene_config(written(tmp_path, yaml.safe_dump(values))))
    for name, part in PARTS:
        assert all(config[name][field] != value for field, value in dataclasses.asdict(part).items())


def test_the_documented_settings_are_those_of_the_code():
    page = (Path(__file__).parents[2] / "docs" / "tables" / "clouds.md").read_text().split("<!-- scene:end -->")[0]
    documented = {name: shown for name, *shown in re.findall(r"^\| `([\w.]+)` \| (\S+) \| (.+) \|$", page, re.M)}
    expected = {}
    for name, part in PARTS:
        attributes = (inspect.getdoc(part) or "").split("Attributes:\n")[1].split("\n\n")[0]
        told = dict(re.findall(r"^ {4}(\w+): (.+(?:\n {8}.+)*)", attributes, re.M))
        for field, value in dataclasses.asdict(part).items():
            default = f"{value:g}" if type(value) in (int, float) else yaml.safe_dump(value).split("\n")[0]
            expected[f"{name}.{field}"] = [default, " ".join(told[field].split())]
    assert documented == expected


@pytest.mark.parametrize(
    ("text", "culprits"),
    [
        ("segmentation: {gab: 0.01}", ["scene.yaml:1: segmentation: ", "'gab'", "did you mean 'gap'?"]),
        ("obstacle: {padding: 0.01}", ["'obstacle'", "did you mean 'obstacles'?"]),
        ("segmentation: {gap: 0}", ["segmentation.gap", "0.0", "above zero"]),
        ("reconstruction: {max_points: 10}", ["reconstruction.max_points", "10", "at least 1000"]),
        ("reconstruction: {seen_distance: 0.02}", ["seen_distance", "0.02", "guessed_distance=0.02"]),
        ("segmentation: {roi_low: [0, 0, 0], roi_high: [1, 1, 0]}", ["roi_low", "roi_high=(1.0, 1.0, 0.0)"]),
        ("reconstruction: {poisson: pcl}", ["reconstruction.poisson", "pcl", "grid, open3d"]),
        ("segmentation: [", ["not valid YAML"]),
    ],
)
def test_a_bad_file_is_named(tmp_path: Path, text: str, culprits: list[str]):
    with refused(ConfigError, "scene.yaml", *culprits):
        load_scene_config(written(tmp_path, text))


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
