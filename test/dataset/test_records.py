"""What rows hold, that they come back as they were, and that a block made twice is the same to the byte."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from graspd_core import METRICS, load_hand, load_scene, plan_grasps
from graspd_core.errors import ConfigError, FormatError, MeshError
from graspd_core.hands.model import all_joint_names, all_joint_positions
from graspd_core.paths import config_dir
from graspd_core.runtime.worker_process import WorkerProcess
from graspd_dataset import block_rows
from graspd_dataset.blocks import Block, DatasetRequest, blocks_of, by_object
from graspd_dataset.dataset_store import DatasetStore, key_of, parquet_bytes, read_parquet
from graspd_dataset.inspect_dataset import tables_of
from graspd_dataset.ray_engine import pickled_hand
from graspd_dataset.record_schema import arrow_schema, columns, schema_table

ROOT = Path(__file__).parents[2]


def test_a_block_made_again_in_another_process_is_the_same_to_the_byte(made: DatasetStore, blocks: tuple[Block, ...]):
    child = WorkerProcess()
    try:
        ready = child(block_rows.make_ready, blocks[1].object, None, blocks[1].config)
        again = child(block_rows.make_block, blocks[1], pickled_hand(blocks[1]), ready.shared)
    finally:
        child.close()
    (path,) = [path for path in made.list("grasps") if key_of(path) == blocks[1].key]
    assert again.file == made.read(path)
    assert ready.file == made.read(f"objects/{ready.sha256}.parquet")


def test_rows_are_the_grasps_that_were_planned(made: DatasetStore, blocks: tuple[Block, ...]):
    hand, scene = load_hand("parallel_gripper"), load_scene("shape:sphere")
    result = plan_grasps(scene, hand, count=2, seed=blocks[0].seed, preset="fast", measure=False)
    (table,) = [table for _, _, table, told in tables_of(made) if told["block"] == blocks[0].key]
    rows = table.to_pylist()
    assert [row["verdict"] for row in rows] == [str(grasp.verdict) for grasp in result.tried]
    for row, grasp in zip(rows, result.tried, strict=True):
        assert row["squeeze_position"] == grasp.squeeze.position.tolist()
        assert row["grasp_joint_positions"] == list(all_joint_positions(hand, grasp.grasp.joint_positions))
        assert [trial["displacement"] for trial in row["trials"]] == [t.displacement for t in grasp.trials]
        assert [contact["link"] for contact in row["contacts"]] == [c.link for c in grasp.contacts]
        assert row["joint_names"] == list(all_joint_names(hand))
        assert row["object_sha256"] == scene.object.sha256
        assert row["metric_epsilon"] is None


def test_failed_grasps_are_measured_where_it_is_asked_for():
    hand, scene = load_hand("parallel_gripper"), load_scene("shape:sphere")
    grasps = plan_grasps(scene, hand, count=1, preset="fast", verify="none", measure=False).grasps
    assert grasps[0].metrics is None
    (measured,) = block_rows.all_measured(scene, hand, grasps)
    assert measured.metrics is not None
    assert measured.metrics["penetration"] is not None


def test_every_metric_has_a_column_and_the_page_lists_all():
    names = [column.name for column in columns()]
    assert names == arrow_schema().names
    assert len(names) == len(set(names))
    assert {f"metric_{row.key}" for row in METRICS.values()} <= set(names)
    page = (ROOT / "docs" / "tables" / "dataset.md").read_text()
    assert schema_table() in page, f"docs/tables/dataset.md is not up to date; the table is\n{schema_table()}"


def test_a_table_comes_back_as_it_was_and_a_changed_byte_is_found(made: DatasetStore):
    path, content, table, told = next(iter(tables_of(made)))
    again, same = read_parquet(content, path)
    assert again.equals(table)
    assert same == told
    found = 0
    for place in range(4, len(content), max(len(content) // 60, 1)):
        spoilt = content[:place] + bytes([content[place] ^ 0xFF]) + content[place + 1 :]
        try:
            changed, meta = read_parquet(spoilt, path)
        except FormatError:
            found += 1
        else:
            # Bytes of statistics and of Parquet's own description of the rows may change; the rows may not.
            assert changed.equals(table) or meta != told or changed.schema != table.schema
    assert found > 20


def test_a_file_of_somebody_else_or_of_another_version_is_refused(made: DatasetStore):
    _, content, table, told = next(iter(tables_of(made)))
    with pytest.raises(FormatError, match="not a complete Parquet file"):
        read_parquet(content[:-20], "cut.parquet")
    with pytest.raises(FormatError, match="version 7; known: 1"):
        read_parquet(parquet_bytes(table, {**told, "version": 7}), "new.parquet")


def test_keys_go_by_content():
    request = DatasetRequest(("shape:box", "shape:mug"), hands=("parallel_gripper", "allegro_right"), per_object=300)
    blocks = blocks_of(request)
    assert [block.count for block in blocks[:3]] == [128, 128, 44]
    assert [block.seed for block in blocks[:3]] == [0, 1, 2]
    assert len(blocks) == len({block.key for block in blocks}) == 2 * 2 * 3
    assert [len(own) for _, own in by_object(blocks)] == [6, 6]
    # More of the same adds to what is there; another setting is another block.
    more = {block.key for block in blocks_of(replace(request, per_object=384 + 128))}
    assert len(more & {block.key for block in blocks}) == 2 * 2 * 2
    for changes in ({"friction": 0.5}, {"preset": "fast"}, {"seed": 9}, {"verify": "hard"}, {"scales": (1.1,)}):
        assert not {b.key for b in blocks_of(replace(request, **changes))} & {b.key for b in blocks}
    # What an object is called does not count.
    assert replace(blocks[0], object=replace(blocks[0].object, source="other")).key == blocks[0].key


@pytest.mark.parametrize("hand", ["parallel_gripper", "hands/parallel_gripper.yaml", "hands/parallel_gripper.urdf"])
def test_a_hand_given_as_a_file_is_named_without_folder_and_ending(hand: str):
    given = str(config_dir() / hand) if "/" in hand else hand
    (block,) = blocks_of(DatasetRequest(("shape:sphere",), (given,), 1))
    # The name is one folder of the data set, and of an export.
    assert block.hand_name == "parallel_gripper"


def test_random_scales_are_drawn_by_content_and_seed():
    request = DatasetRequest(("shape:box", "shape:mug"), random_scales=(3, 0.5, 2.0))
    scales = [thing.scale for thing, _ in by_object(blocks_of(request))]
    assert len(scales) == 8
    assert len(set(scales)) == 7
    assert all(0.5 <= scale <= 2.0 for scale in scales)
    assert scales == [thing.scale for thing, _ in by_object(blocks_of(request))]
    assert scales != [thing.scale for thing, _ in by_object(blocks_of(replace(request, seed=1)))]


@pytest.mark.parametrize(
    ("changes", "culprit"),
    [
        ({"per_object": 0}, "per-object: 0"),
        ({"block": 2000}, "count: 2000"),
        ({"measure": "some"}, "measure: 'some'; valid: verified, all, none"),
        ({"random_scales": (2, 2.0, 1.0)}, "random-scales: 2 2 1"),
        ({"scales": (0.0,)}, "scales: 0.0"),
        ({"mass": float("nan")}, "mass: nan"),
    ],
)
def test_a_request_that_makes_no_sense_is_refused(changes: dict, culprit: str):
    with pytest.raises(ConfigError, match=re.escape(culprit)):
        DatasetRequest(("shape:box",), **changes)


def test_what_is_named_must_be_there():
    with pytest.raises(MeshError, match=r"no_such\.obj"):
        blocks_of(DatasetRequest(("no_such.obj",)))
