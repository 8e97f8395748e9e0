"""A data set that is there: resumed by listing, looked through, merged, sampled, read by others."""

import importlib
import json
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from small_dataset import REQUEST, make_here

from graspd_core.errors import FormatError
from graspd_dataset.blocks import Block, DatasetRequest, blocks_of
from graspd_dataset.dataset_store import DatasetStore, file_hash, key_of, parquet_bytes, read_parquet
from graspd_dataset.guarded_calls import Report, failed_report
from graspd_dataset.inspect_dataset import count_by_content, faults_of_dataset, recorded_hashes, stats_of, tables_of
from graspd_dataset.merge_datasets import merge, sample
from graspd_dataset.ray_engine import object_job
from graspd_dataset.run_dataset import begin_run, command_of, missing_blocks, remove_failure, with_unrecorded, write_run

Run = Callable[..., int]


def test_what_is_missing_is_found_by_listing(copied: DatasetStore, blocks: tuple[Block, ...], tmp_path: Path):
    assert missing_blocks(blocks, copied) == []
    first = next(path for path in copied.list("grasps") if key_of(path) == blocks[0].key)
    (Path(copied.where) / first).unlink()
    assert missing_blocks(blocks, copied) == [blocks[0]]
    # A temporary file of a process that was killed is no block.
    (Path(copied.where) / f"{first}abc123").write_bytes(b"PAR1")
    assert missing_blocks(blocks, copied) == [blocks[0]]
    copied.write(f"failed/{blocks[0].key}.json", b"{}")
    assert missing_blocks(blocks, copied) == []
    assert missing_blocks(blocks, copied, retry_failed=True) == [blocks[0]]
    # Blocks of an object that failed are not tried again.
    store = DatasetStore(str(tmp_path))
    store.write(f"failed/{blocks[0].object.key}.json", b"{}")
    assert missing_blocks(blocks, store) == []


def _rewritten(store: DatasetStore, change: Callable[..., object]) -> None:
    path, _, table, told = next(iter(tables_of(store)))
    kept = {key: value for key, value in told.items() if key not in ("format", "version")}
    store.write(path, parquet_bytes(change(table), kept))


def _column(table, name: str, values: list):
    import pyarrow as pa

    at = table.schema.get_field_index(name)
    return table.set_column(at, table.schema.field(at), pa.array(values, table.schema.field(at).type))


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda t: _column(t, "verdict", ["failed"] * len(t)), "verdicts contradict the trials"),
        (lambda t: _column(t, "grasp_quaternion_wxyz", [[1.0, 1.0, 0.0, 0.0]] * len(t)), "not of unit length"),
        (lambda t: _column(t, "squeeze_position", [[float("nan")] * 3] * len(t)), "not finite"),
        (lambda t: t.drop_columns(["score"]), "columns are not those of the schema: score"),
        (lambda t: t.slice(1), "rows are missing"),
        (lambda t: _column(t, "hand_name", ["other"] * len(t)), "belongs in grasps/hand=other/"),
    ],
)
def test_a_file_that_says_wrong_things_is_found(copied: DatasetStore, spoil: Callable, told: str):
    _rewritten(copied, spoil)
    assert any(told in fault for fault in faults_of_dataset(copied))


def test_spoilt_moved_doubled_and_missing_files_are_found(copied: DatasetStore, graspd: Run, capsys):
    root = Path(copied.where)
    first, second = (root / path for path in copied.list("grasps"))
    content = first.read_bytes()
    first.write_bytes(content[: len(content) // 3])
    assert graspd("dataset", "validate", root) == 1
    assert f"{first.name}: not a complete Parquet file" in capsys.readouterr().out
    first.write_bytes(content)
    shutil.copy(first, second)
    (fault, twice) = list(faults_of_dataset(copied))
    assert f"its metadata does not match its name: the metadata names block {first.stem}" in fault
    assert "a grasp is also in" in twice
    second.unlink()
    shutil.rmtree(root / "objects")
    (fault,) = list(faults_of_dataset(copied))
    assert "objects/" in fault
    assert "is missing" in fault


def _recorded(store: DatasetStore, **changes: Any) -> None:
    """Write the record that a run of the command leaves."""
    write_run(store, with_unrecorded(store, replace(begin_run(store, REQUEST, 2), **changes)))


def test_a_byte_that_changed_anywhere_is_found(copied: DatasetStore, graspd: Run, capsys):
    """Headers of pages and the footer are under no checksum of Parquet's; every 61st byte of every file is tried."""
    assert graspd("dataset", "validate", copied.where) == 0
    assert "2 blocks, no fault; 2 without a hash on record" in capsys.readouterr().out
    _recorded(copied)
    assert graspd("dataset", "validate", copied.where) == 0
    assert capsys.readouterr().out.endswith("2 blocks, no fault\n")
    known = recorded_hashes(copied)
    for path in (*copied.list("grasps"), *copied.list("objects")):
        content = copied.read(path)
        assert file_hash(content) in known[path]
        for at in range(0, len(content), max(len(content) // 12, 1)):
            changed = bytearray(content)
            changed[at] ^= 0x01
            copied.write(path, bytes(changed))
            assert any(path in fault for fault in faults_of_dataset(copied)), f"{path}: byte {at}"
        copied.write(path, content)
    lost = copied.list("grasps")[0]
    (Path(copied.where) / lost).unlink()
    assert f"{lost}: is missing, but a run wrote it" in list(faults_of_dataset(copied))
    (run,) = copied.list("runs")
    copied.write(run, copied.read(run)[:-9])
    assert any("not a record of a run" in fault for fault in faults_of_dataset(copied))


def test_a_merged_data_set_has_the_hashes_of_all(made: DatasetStore, copied: DatasetStore, tmp_path: Path):
    """Two halves of one command on two machines: the record of both is called the same."""
    other = DatasetStore(str(tmp_path / "other"))
    shutil.copytree(copied.where, other.where)
    for store, path in zip((copied, other), made.list("grasps"), strict=True):
        (Path(store.where) / path).unlink()
        _recorded(store, command="graspd dataset shape:sphere --out here")
    out = DatasetStore(str(tmp_path / "out"))
    merge([copied, other], out)
    assert {*out.list("grasps"), *out.list("objects")} == recorded_hashes(out).keys()
    assert list(faults_of_dataset(out)) == []


def test_files_are_read_without_a_thread(copied: DatasetStore):
    """One of Arrow's that still runs when the process ends aborts it, in one run of ten."""
    code = "import os, sys, pyarrow.parquet; from graspd_dataset.dataset_store import read_parquet as read;"
    code += "before = len(os.listdir('/proc/self/task')); read(open(sys.argv[1], 'rb').read(), 'x');"
    code += "print(len(os.listdir('/proc/self/task')) - before)"
    path = Path(copied.where) / copied.list("grasps")[0]
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "0"


def test_merged_data_sets_hold_every_block_once(made: DatasetStore, copied: DatasetStore, tmp_path: Path, graspd: Run):
    removed = copied.list("grasps")[0]
    (Path(copied.where) / removed).unlink()
    out = DatasetStore(str(tmp_path / "out"))
    assert merge([copied, made], out) == (2, 1)
    assert merge([made], out) == (0, 2)
    assert count_by_content(out) == count_by_content(made)
    assert [out.read(path) for path in out.list("grasps")] == [made.read(path) for path in made.list("grasps")]
    assert graspd("dataset", "merge", made.where, "--out", tmp_path / "other") == 0
    assert "tried in MuJoCo" in (tmp_path / "other" / "README.md").read_text()


def test_a_key_with_other_rows_is_a_conflict(made: DatasetStore, copied: DatasetStore, tmp_path: Path):
    _rewritten(copied, lambda t: _column(t, "score", [7.0] * len(t)))
    with pytest.raises(FormatError, match=r"rows differ from .* which has the same key; keep only one"):
        merge([made, copied], DatasetStore(str(tmp_path / "out")))


def test_a_sample_depends_on_rows_and_seed_only(made: DatasetStore, tmp_path: Path, graspd: Run):
    content, rows = sample(made, 2, seed=5)
    assert rows == 2
    assert content == sample(made, 2, seed=5)[0]
    table, _ = read_parquet(content, "sample")
    assert table.num_rows == 2
    everything = count_by_content(made)[0]
    assert sample(made, 1000, seed=0)[1] == everything
    assert len({sample(made, 1, seed=seed)[0] for seed in range(8)}) > 1
    out = tmp_path / "some.parquet"
    assert graspd("dataset", "sample", made.where, "--count", 3, "--verdict", "verified", "--out", out) == 0
    table, _ = read_parquet(out.read_bytes(), "sample")
    assert table["verdict"].to_pylist() == ["verified"] * 3


def test_stats_count_rows_and_reasons(made: DatasetStore, graspd: Run, capsys):
    stats = stats_of(made)
    hand = stats.hands["parallel_gripper"]
    assert (hand.blocks, len(hand.objects), hand.verdicts["verified"]) == (2, 1, 4)
    assert stats.rows == count_by_content(made)[0]
    assert stats.reasons.total() == hand.verdicts["failed"]
    assert graspd("dataset", "stats", made.where) == 0
    assert "| parallel_gripper | 1 | 2 |" in capsys.readouterr().out
    assert graspd("dataset", "stats", made.where, "--json", "--quiet") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["hands"]["parallel_gripper"]["verdicts"] == dict(hand.verdicts)
    assert document["reasons"] == dict(stats.reasons)


def test_others_read_it_in_one_line(made: DatasetStore):
    import datasets
    import duckdb
    import pandas as pd
    import polars as pl

    rows = count_by_content(made)[0]
    where = f"{made.where}/grasps"
    frame = pd.read_parquet(where)
    assert len(frame) == rows
    assert set(frame["hand"]) == {"parallel_gripper"}
    polar = pl.read_parquet(f"{where}/**/*.parquet", hive_partitioning=True)
    assert polar.height == rows
    assert polar.filter(pl.col("verdict") == "verified").height == 4
    asked = f"select hand, count(*), max(squeeze_position[1]) from '{where}/*/*/*.parquet' group by hand"
    assert duckdb.execute(asked).fetchall()[0][:2] == ("parallel_gripper", rows)
    hugging = datasets.load_dataset(
        "parquet", data_files=f"{where}/*/*/*.parquet", split="train", cache_dir=f"{made.where}-cache"
    )
    assert len(hugging) == rows
    assert hugging[0]["contacts"][0]["link"] == frame["contacts"][0][0]["link"]


def test_a_block_without_a_candidate_is_a_block(copied: DatasetStore):
    _rewritten(copied, lambda t: t.slice(0, 0))
    stats = stats_of(copied)
    assert stats.hands["parallel_gripper"].blocks == 2
    assert 0 < stats.rows < 4
    assert list(faults_of_dataset(copied)) == []


ONE = ["shape:sphere", "--out", "out", "--per-object", "1"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["stats"], "dataset stats: 0 data sets; valid: exactly one"),
        (["stats", "a", "b"], "dataset stats: 2 data sets"),
        (["validate", "nowhere"], "no data set"),
        (["shape:box"], "--out is missing"),
        (["shape:box", "--out", "x", "--workers", "0"], "workers: 0"),
        (["sample", "a", "--out", "x.csv"], "ends with .parquet"),
        (["merge", "a"], "--out is missing"),
        (["shape:box", "--out", "nowhere://x"], "nowhere://x"),
        ([*ONE, "--random-scales", "nan", "1", "2"], "random-scales: nan 1 2; valid: N >= 0"),
        ([*ONE, "--random-scales", "2.5", "1", "2"], "random-scales: 2.5 1 2; valid: N >= 0"),
        ([*ONE, "--patience", "-1"], "patience: -1; valid: a positive number"),
        ([*ONE, "--patience", "nan"], "patience: nan; valid: a positive number"),
        ([*ONE, "--memory", "0"], "memory: 0; valid: a positive number"),
    ],
)
def test_wrong_words_are_one_line(words: list[str], told: str, refusal_of, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert told in refusal_of("dataset", *words)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--address", "127.0.0.1:9"], "127.0.0.1:9: Connection refused; start Ray"),
        (["--memory", "1", "--dry-run"], "more than 1 MB; change --memory or --patience"),
    ],
)
def test_a_run_that_cannot_begin_says_why(words: list[str], told: str, graspd: Run, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert graspd("dataset", *ONE, *words) == 2
    assert told in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_example_trains_on_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    store = DatasetStore(str(tmp_path))
    request = DatasetRequest(
        ("shape:sphere", "shape:box"), hands=("parallel_gripper",), per_object=3, preset="fast", measure="none"
    )
    make_here(blocks_of(request), store)
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples"))
    assert importlib.import_module("train_on_dataset").main([store.where, "parallel_gripper", "2"]) == 0
    told = capsys.readouterr().out
    assert "of 1 objects held out" in told
    assert "of the best half by the network" in told


def test_a_file_that_a_killed_process_was_writing_does_not_count(copied: DatasetStore, graspd: Run):
    _recorded(copied)
    for path in (*copied.list("grasps"), *copied.list("objects"), *copied.list("runs")):
        half = Path(copied.where) / f"{path}x1y2z3_4"
        half.write_bytes(copied.read(path)[:40])
    assert begin_run(copied, REQUEST, 2, any_code=True).blocks == 2
    assert with_unrecorded(copied, begin_run(copied, REQUEST, 2, any_code=True)).files.keys() == {
        *copied.list("grasps"), *copied.list("objects")
    }  # fmt: skip
    assert stats_of(copied).rows == sum(table.num_rows for _, _, table, _ in tables_of(copied))
    assert graspd("dataset", "validate", copied.where) == 0


def test_an_object_that_failed_and_then_succeeded_is_no_failure(copied: DatasetStore, blocks: tuple[Block, ...]):
    first = blocks[0]
    failed_report(copied, object_job(first.object, first.config), MemoryError("too much"))
    assert stats_of(copied).failed == []
    more = blocks_of(replace(REQUEST, per_object=6))
    assert missing_blocks(more, copied) == []
    remove_failure(copied, Report(first.object.key, failed="memory"), {first.object.key})
    assert missing_blocks(more, copied) == []
    remove_failure(copied, Report(first.object.key), {first.object.key})
    assert [block.seed for block in missing_blocks(more, copied)] == [2]


def test_a_record_or_a_file_that_lacks_an_entry_is_one_line(copied: DatasetStore, graspd: Run, capsys, tmp_path: Path):
    for path in ("failed/a.json", "runs/a.json"):
        copied.write(path, b'{"files": {}}')
        with pytest.raises(FormatError, match=f"{path}: not a record of a run or a failure"):
            stats_of(copied) if path.startswith("failed") else begin_run(copied, REQUEST, 2)
        copied.remove(path)
    # An object's file is a Parquet file of graspd too, but no block.
    copied.write("grasps/hand=x/object=y/z.parquet", copied.read(copied.list("objects")[0]))
    for action in ("stats", "validate", "merge", "sample", "export"):
        status = graspd("dataset", action, copied.where, "--out", tmp_path / f"{action}.parquet")
        told = capsys.readouterr()
        assert status == (1 if action == "validate" else 2)
        assert ("its columns are not those" if status == 1 else "z.parquet: not a block") in told.out + told.err


def test_the_recorded_command_has_every_digit():
    request = replace(REQUEST, mass=0.123456789, scales=(1.0, 0.3333333333333333), per_object=1)
    words = shlex.split(command_of(request, "out"))
    assert float(words[words.index("--mass") + 1]) == request.mass
    assert tuple(map(float, words[words.index("--scales") + 1 :][:2])) == request.scales
    assert words[words.index("--scales") + 1] == "1"


def test_the_hashes_of_a_merged_record_are_those_of_the_kept_files(made: DatasetStore, copied: DatasetStore, tmp_path):
    """Another version of pyarrow writes the same rows as other bytes."""
    other = DatasetStore(str(tmp_path / "other"))
    shutil.copytree(made.where, other.where)
    path = other.list("grasps")[0]
    table, header = read_parquet(other.read(path), path)
    other.write(path, parquet_bytes(table, {**header, "writer": "another"}))
    for store in (copied, other):
        _recorded(store, command="graspd dataset shape:sphere --out here")
    merge([other], copied)
    assert list(faults_of_dataset(copied)) == []
