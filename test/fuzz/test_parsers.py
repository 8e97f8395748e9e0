"""Spoilt files of every format that graspd reads end in a value or in one clear error, and a whole one in a value."""

from __future__ import annotations

import os
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

# GRASPD_FUZZ=50 tries fifty times as many examples, others each time; without it they are the same on every machine.
LONGER = int(os.environ.get("GRASPD_FUZZ", "1"))
NAMES = ("urdf", "mjcf", "description", "preset", "document", "mano", "dae", "cloud", "layout", "message", "bag")


def test_every_target_is_tried(fuzz: ModuleType) -> None:
    assert tuple(fuzz.TARGETS) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_the_first_seed_is_read(fuzz: ModuleType, folder: Path, name: str) -> None:
    target = fuzz.TARGETS[name]
    assert fuzz.try_input(target, target.seeds()[0], folder) is None


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=8 * LONGER, derandomize=LONGER == 1)
@given(data=st.data())
def test_a_spoilt_file_is_read_or_refused(
    fuzz: ModuleType, folder: Path, spoilt, name: str, data: st.DataObject
) -> None:
    target = fuzz.TARGETS[name]
    seed = data.draw(st.sampled_from(target.seeds()), label="seed")
    fuzz.try_input(target, data.draw(spoilt(seed), label="input"), folder)
