"""What a data set would take, from one block of each hand that is made and thrown away."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence

from graspd_core.dataset import block_rows
from graspd_core.dataset.block_rows import MadeBlock
from graspd_core.dataset.blocks import Block
from graspd_core.dataset.guarded_calls import Limits, call_guarded, close_child
from graspd_core.dataset.ray_engine import pickled_hand


def dry_run(blocks: Sequence[Block], limits: Limits, workers: int | None) -> str:
    """Count, hours and bytes of the blocks, as a sentence a line."""
    if not blocks:
        return "nothing is missing"
    workers = workers or os.cpu_count() or 1
    measured: dict[str, tuple[Block, MadeBlock]] = {}
    for block in blocks:
        if block.hand_content not in measured:
            ready = call_guarded(limits, block_rows.make_ready, block.object, None, block.config)
            made = call_guarded(limits, block_rows.make_block, block, pickled_hand(block), ready.shared)
            measured[block.hand_content] = block, made
    close_child()
    lines, wanted = [], Counter[str]()
    for block in blocks:
        wanted[block.hand_content] += block.count
    cpu = size = tried = 0.0
    for hand, (block, made) in measured.items():
        share = wanted[hand] / block.count
        cpu, size, tried = cpu + share * made.cpu, size + share * len(made.file), tried + share * made.rows
        told = f"{made.verified} of {made.rows} verified, {made.cpu:.1f} CPU s, {len(made.file) / 1024:.0f} kB"
        lines.append(f"{block.hand}: one block of {block.object.source}: {told}, {made.peak_mb:.0f} MB at the peak")
    hours = f"{cpu / 3600:.3g} CPU hours, {cpu / 3600 / workers:.3g} hours on {workers} cores"
    lines.append(f"{len(blocks)} blocks, {sum(wanted.values())} grasps wanted, about {tried:.0f} tried: {hours}")
    return "\n".join([*lines, f"about {size / 2**20:.1f} MB"])
