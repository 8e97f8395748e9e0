"""Files whole or not at all, on a disk and on a real S3 protocol server; a full disk; a server that is busy."""

import pickle
import resource
from collections.abc import Iterator
from pathlib import Path

import pytest
from expected import refused
from s3_server import Server, s3_server

from graspd_dataset import dataset_store
from graspd_dataset.dataset_store import DatasetStore, StorageError
from graspd_dataset.inspect_dataset import count_by_content, faults_of_dataset, stats_of
from graspd_dataset.merge_datasets import merge


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with s3_server() as running:
        yield running


@pytest.fixture(autouse=True)
def no_pause(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(dataset_store, "_PAUSE", 0.01)


def test_s3_and_a_disk_hold_the_same_bytes(server: Server, made: DatasetStore, tmp_path: Path):
    remote = DatasetStore(server.url("whole"))
    assert remote.list("grasps") == []
    assert merge([made], remote) == (2, 0)
    assert remote.list("grasps") == made.list("grasps")
    assert [remote.read(path) for path in remote.list("")] == [made.read(path) for path in made.list("")]
    assert list(faults_of_dataset(remote)) == []
    assert stats_of(remote).rows == count_by_content(made)[0]
    again = pickle.loads(pickle.dumps(remote))
    assert again.list("grasps") == remote.list("grasps")


def test_a_server_that_refuses_one_request_in_ten_loses_and_doubles_nothing(server: Server, made: DatasetStore):
    server.fail_each = 10
    try:
        before = server.refused
        remote = DatasetStore(server.url("flaky"))
        for number in range(12):
            remote.write(f"failed/{number}.json", b"{}".ljust(200))
        merge([made], remote)
        assert len(remote.list("failed")) == 12
        assert count_by_content(remote) == count_by_content(made)
        assert list(faults_of_dataset(remote)) == []
        assert server.refused > before
    finally:
        server.fail_each = 0


def test_a_server_that_is_gone_or_a_bucket_that_is_not_there_is_one_line_and_tells_no_secret(monkeypatch):
    monkeypatch.setattr(dataset_store, "_TRIES", 1)
    gone = DatasetStore("s3://a:b@bucket/x?region=us-east-1&scheme=http&endpoint_override=127.0.0.1:9")
    with refused(StorageError, "bucket"):
        gone.write("runs/a.json", b"{}")
    with pytest.raises(StorageError, match="nowhere://x"):
        DatasetStore("nowhere://x").list("grasps")
    remote = DatasetStore("s3://key:secret@bucket/x?region=us-east-1")
    assert "secret" not in remote.label
    assert remote.label == "s3://bucket/x"


def test_a_full_disk_leaves_no_part_of_a_file(tmp_path: Path):
    store = DatasetStore(str(tmp_path))
    store.write("grasps/a.parquet", b"x" * 1000)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(StorageError, match=r"grasps/b\.parquet: File too large"):
            store.write("grasps/b.parquet", b"x" * 100_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.name for path in (tmp_path / "grasps").iterdir()] == ["a.parquet"]
    store.write("grasps/b.parquet", b"x" * 100_000)
    assert len(store.list("grasps")) == 2


def test_a_file_is_removed_from_a_disk_and_from_s3(server: Server, tmp_path: Path):
    for store in (DatasetStore(str(tmp_path)), DatasetStore(server.url("removed"))):
        store.write("failed/a.json", b"{}")
        store.remove("failed/a.json")
        store.remove("failed/a.json")
        assert store.list("failed") == []
