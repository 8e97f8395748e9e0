"""A small data set, made once without Ray: two blocks of a sphere; and what the tests of a folder of files share."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from graspd_core.dataset import block_rows
from graspd_core.dataset.blocks import Block, DatasetRequest, blocks_of
from graspd_core.dataset.dataset_store import DatasetStore, block_path
from graspd_core.dataset.ray_engine import pickled_hand

REQUEST = DatasetRequest(
    ("shape:sphere",), hands=("parallel_gripper",), per_object=4, block=2, preset="fast", measure="none"
)


def make_here(blocks: tuple[Block, ...], store: DatasetStore) -> None:
    """Make blocks in this process, as workers do in theirs."""
    for block in blocks:
        ready = block_rows.make_ready(block.object, None, block.config)
        made = block_rows.make_block(block, pickled_hand(block), ready.shared)
        store.write(f"objects/{ready.sha256}.parquet", ready.file)
        store.write(block_path(block.hand_name, made.object_sha256, block.key), made.file)


@pytest.fixture(scope="session")
def blocks() -> tuple[Block, ...]:
    return blocks_of(REQUEST)


@pytest.fixture(scope="session")
def made(blocks: tuple[Block, ...], tmp_path_factory: pytest.TempPathFactory) -> DatasetStore:
    """The data set; not to be changed."""
    store = DatasetStore(str(tmp_path_factory.mktemp("dataset")))
    make_here(blocks, store)
    return store


@pytest.fixture
def copied(made: DatasetStore, tmp_path: Path) -> DatasetStore:
    """A copy that may be spoilt."""
    shutil.copytree(made.where, tmp_path / "copy")
    return DatasetStore(str(tmp_path / "copy"))


@pytest.fixture
def graspd() -> Callable[..., int]:
    """Runs the command in this process."""
    from graspd_core.cli import main

    return lambda *words: main([str(word) for word in words])
