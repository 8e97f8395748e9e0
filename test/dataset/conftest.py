"""A small data set, made once without Ray: two blocks of a sphere; and what the tests of a folder of files share."""

import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from graspd_dataset.blocks import Block, DatasetRequest, blocks_of
from graspd_dataset.dataset_store import DatasetStore
from graspd_dataset.inspect_dataset import tables_of

sys.path.insert(0, str(Path(__file__).parent))
from small_dataset import REQUEST, make_here


@pytest.fixture(scope="session")
def blocks() -> tuple[Block, ...]:
    return blocks_of(REQUEST)


@pytest.fixture(scope="session")
def made(blocks: tuple[Block, ...], tmp_path_factory: pytest.TempPathFactory) -> DatasetStore:
    """The data set. Tests only read it."""
    store = DatasetStore(str(tmp_path_factory.mktemp("dataset")))
    make_here(blocks, store)
    return store


@pytest.fixture(scope="session")
def allegro(tmp_path_factory: pytest.TempPathFactory) -> DatasetStore:
    """Eight grasps of a mug. Tests only read them."""
    store = DatasetStore(str(tmp_path_factory.mktemp("allegro")))
    make_here(blocks_of(DatasetRequest(("shape:mug",), per_object=8, preset="fast", measure="none")), store)
    return store


@pytest.fixture(scope="session")
def exported(allegro: DatasetStore, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    """A folder with the eight grasps in every format, and their rows in the data set. Tests only read it."""
    from graspd_core.cli import main

    folder = tmp_path_factory.mktemp("exported")
    for kind in ("isaac", "graspgen", "dexgraspbench"):
        assert main(["dataset", "export", allegro.where, "--to", kind, "--out", str(folder / kind)]) == 0
    return folder, [row for _, _, table, _ in tables_of(allegro) for row in table.to_pylist()]


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
