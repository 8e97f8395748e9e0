"""Blocks made in this process, without Ray: what whole runs are compared with."""

from collections.abc import Sequence

from graspd_dataset import block_rows
from graspd_dataset.blocks import Block, DatasetRequest
from graspd_dataset.dataset_store import DatasetStore, block_path
from graspd_dataset.ray_engine import pickled_hand

REQUEST = DatasetRequest(
    ("shape:sphere",), hands=("parallel_gripper",), per_object=4, block=2, preset="fast", measure="none"
)


def make_here(blocks: Sequence[Block], store: DatasetStore) -> None:
    """Make blocks in this process, as workers do in theirs."""
    for block in blocks:
        ready = block_rows.make_ready(block.object, None, block.config)
        made = block_rows.make_block(block, pickled_hand(block), ready.shared)
        store.write(f"objects/{ready.sha256}.parquet", ready.file)
        store.write(block_path(block.hand_name, made.object_sha256, block.key), made.file)
