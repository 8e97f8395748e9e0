"""Settings: every boxed preset loads, and what is wrong in one is named with what would be right."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from graspd_core.config import SegmentationConfig, from_mapping
from graspd_core.errors import ConfigError
from graspd_core.optimize.closed_form.closed_form_config import LossWeights
from graspd_core.optimize.plan_config import PlanConfig, load_preset, plan_config, preset_names, to_mapping


@pytest.mark.parametrize("name", preset_names())
def test_every_boxed_preset_loads(name: str):
    assert isinstance(load_preset(name), PlanConfig)


def test_the_balanced_preset_is_the_default():
    assert load_preset("balanced") == PlanConfig()


def test_presets_differ_in_effort():
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


def test_weights_that_a_preset_leaves_out_are_those_of_the_method(tmp_path: Path):
    path = tmp_path / "mine.yaml"
    path.write_text("closed_form: {polish_weights: {penetration: 25}}\n")
    before, after = load_preset("balanced").settings, load_preset(str(path)).settings
    assert after == dataclasses.replace(
        before, polish_weights=dataclasses.replace(before.polish_weights, penetration=25.0)
    )


def test_a_mapping_of_a_config_makes_that_config_again():
    config = dataclasses.replace(PlanConfig(), resolution=24)
    assert plan_config(to_mapping(config)) == config


@pytest.mark.parametrize(
    ("text", "culprits"),
    [
        ("resolutoin: 32", ["'resolutoin'", "resolution", "closed_form"]),
        ("closed_form: {delta: 1.0}", ["closed_form", "'delta'", "delta_start"]),
        ("closed_form: {weights: {tusk: 1.0}}", ["closed_form.weights", "'tusk'", "wrench_resistance"]),
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
    ],
)
def test_a_bad_preset_file_is_named(tmp_path: Path, text: str, culprits: list[str]):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_preset(str(path))
    message = str(caught.value)
    assert "\n" not in message
    assert all(part in message for part in ["bad.yaml", *culprits]), message


def test_a_file_that_is_no_text_is_named(tmp_path: Path):
    path = tmp_path / "noise.yaml"
    path.write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(ConfigError, match=r"noise\.yaml"):
        load_preset(str(path))


@pytest.mark.parametrize("name", ["best", "missing.yaml"])
def test_an_unknown_preset_lists_the_known(name: str):
    with pytest.raises(ConfigError) as caught:
        load_preset(name)
    assert all(known in str(caught.value) for known in (name, "fast", "balanced", "accurate"))


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


def test_every_setting_is_explained():
    for cls in (PlanConfig, LossWeights, type(PlanConfig().settings), type(PlanConfig().grasp_stages)):
        for setting in dataclasses.fields(cls):
            assert f"        {setting.name}: " in (cls.__doc__ or ""), f"{cls.__name__}.{setting.name}"
