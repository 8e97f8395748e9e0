"""Whole runs on Ray: stopped, killed, refused and poisoned in the middle; nothing is lost and nothing is there twice.

What comes out is compared to the byte with blocks that were made without Ray.
"""

import json
import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from s3_server import s3_server
from small_dataset import REQUEST, make_here

from graspd_dataset.blocks import blocks_of
from graspd_dataset.dataset_store import DatasetStore, key_of
from graspd_dataset.inspect_dataset import count_by_content, faults_of_dataset

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]
WORDS = ["shape:sphere", "--hands", "parallel_gripper", "--block", "2", "--preset", "fast", "--measure", "none"]
MANY = replace(REQUEST, per_object=40)


def files(store: DatasetStore) -> dict[str, bytes]:
    """Content of all blocks by their path."""
    return {path: store.read(path) for path in store.list("grasps")}


@pytest.fixture(scope="session")
def many(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Twenty blocks, made without Ray."""
    store = DatasetStore(str(tmp_path_factory.mktemp("many")))
    make_here(blocks_of(MANY), store)
    return files(store)


Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Starts a command; at the end nothing of it may be left."""
    begun: list[subprocess.Popen[str]] = []
    family: set[psutil.Process] = set()

    def start(*words: object) -> subprocess.Popen[str]:
        command = [sys.executable, *map(str, words)]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        process = subprocess.Popen(
            command, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=tmp_path, env=environment
        )
        begun.append(process)
        return process

    start.family = lambda process: family.update(psutil.Process(process.pid).children(recursive=True))  # type: ignore[attr-defined]
    yield start
    for process in begun:
        if process.poll() is None:
            start.family(process)  # type: ignore[attr-defined]
            process.kill()
        process.communicate()
    _, left = psutil.wait_procs(family, timeout=120)
    assert [process.cmdline() for process in left] == []


def dataset(start: Start, out: object, *words: object) -> subprocess.Popen[str]:
    return start("-m", "graspd_core.cli", "dataset", *WORDS, "--out", out, "--workers", "2", *words)


def wait_for_blocks(store: DatasetStore, process: subprocess.Popen[str], number: int) -> None:
    while len(store.list("grasps")) < number:
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)


def test_a_run_on_this_machine_makes_what_blocks_make_alone(start: Start, made: DatasetStore, tmp_path: Path):
    store = DatasetStore(str(tmp_path / "out"))
    process = dataset(start, store.where, "--per-object", "4")
    wait_for_blocks(store, process, 1)
    start.family(process)  # type: ignore[attr-defined]
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    assert files(store) == files(made)
    assert "| parallel_gripper | 1 | 2 |" in output
    assert "2/2 blocks, 4 of" in errors
    card = (tmp_path / "out" / "README.md").read_text()
    assert "graspd dataset shape:sphere --hands parallel_gripper --per-object 4" in card
    assert list(faults_of_dataset(store)) == []


def test_ray_may_run_twice_in_a_process(start: Start):
    program = (
        "from graspd_dataset.ray_engine import ray_running\n"
        "for _ in range(2):\n with ray_running(None, 1) as ray: print(ray.get(ray.remote(lambda: 3).remote()))\n"
    )
    output, errors = start("-c", program).communicate()
    assert output == "3\n3\n", errors


def test_a_driver_that_is_killed_goes_on_where_it_was(start: Start, many: dict[str, bytes], tmp_path: Path):
    store = DatasetStore(str(tmp_path / "out"))
    process = dataset(start, store.where, "--per-object", "40")
    wait_for_blocks(store, process, 3)
    start.family(process)  # type: ignore[attr-defined]
    process.kill()
    process.communicate()
    there = files(store)
    assert 3 <= len(there) < 20
    process = dataset(start, store.where, "--per-object", "40")
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    assert "of 20 blocks exist" in errors
    assert files(store) == many
    rows, different = count_by_content(store)
    assert rows == different


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_sigterm_keep_what_is_done(start: Start, many: dict[str, bytes], tmp_path: Path, number: int):
    store = DatasetStore(str(tmp_path / "out"))
    process = dataset(start, store.where, "--per-object", "40")
    wait_for_blocks(store, process, 3)
    start.family(process)  # type: ignore[attr-defined]
    process.send_signal(number)
    _, errors = process.communicate()
    assert process.returncode == 130, errors
    assert "repeat the command to continue" in errors
    assert "Traceback" not in errors
    assert files(store).items() <= many.items()


def test_a_node_that_is_killed_loses_and_doubles_nothing(start: Start, many: dict[str, bytes], tmp_path: Path):
    process = start(Path(__file__).parent / "cluster_run.py", tmp_path / "out")
    store = DatasetStore(str(tmp_path / "out"))
    wait_for_blocks(store, process, 1)
    start.family(process)  # type: ignore[attr-defined]
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    told = json.loads(output.splitlines()[-1])
    assert told == {"slots": 2, "failed": [], "reports": 20}
    assert files(store) == many


def test_an_s3_server_that_refuses_one_request_in_ten(start: Start, many: dict[str, bytes]):
    with s3_server() as server:
        server.fail_each = 10
        process = dataset(start, server.url("out"), "--per-object", "40")
        output, errors = process.communicate()
        assert process.returncode == 0, errors
        assert "testing:testing" not in output + errors
        server.fail_each = 0
        store = DatasetStore(server.url("out"))
        assert files(store) == many
        assert server.refused > 3
        assert list(faults_of_dataset(store)) == []
        # A block is one request: it is there whole or not at all.
        assert [r for r in server.requests if "PUT" in r and "grasps" in r and "partNumber" in r] == []


def test_a_cluster_that_is_there_is_used_through_rays_client(start, made, tmp_path, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as first, socket.create_server(("127.0.0.1", 0)) as second:
        ports = [server.getsockname()[1] for server in (first, second)]
    for name, value in {
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
        "RAY_USAGE_STATS_ENABLED": "0",
    }.items():
        monkeypatch.setenv(name, value)
    options = [
        f"--port={ports[0]}",
        f"--ray-client-server-port={ports[1]}",
        "--node-ip-address=127.0.0.2",
        "--num-cpus=1",
    ]
    options += ["--include-dashboard=false", f"--object-store-memory={2**27}", "--block"]
    with tempfile.TemporaryDirectory(prefix="graspd-head-") as folder:
        head = start("-m", "ray.scripts.scripts", "start", "--head", *options, f"--temp-dir={folder}")
        while not listens(ports[1]):
            assert head.poll() is None, head.communicate()
            time.sleep(0.1)
        process = dataset(start, tmp_path / "out", "--per-object", "4", "--address", f"ray://127.0.0.1:{ports[1]}")
        _, errors = process.communicate()
        start.family(head)  # type: ignore[attr-defined]
        head.terminate()
        head.communicate()
    assert process.returncode == 0, errors
    assert files(DatasetStore(str(tmp_path / "out"))) == files(made)


def listens(port: int) -> bool:
    """Whether somebody listens at a port of this machine."""
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 256 kB."""
    where = tmp_path / "disk"
    where.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", where], capture_output=True)
    if mounted.returncode:
        pytest.skip("file systems may not be mounted here")
    yield where
    subprocess.run(["umount", "-l", where], check=True)


def test_a_full_disk_ends_the_run_in_one_line_and_what_is_there_stays(start, many, small_disk):
    store = DatasetStore(str(small_disk / "out"))
    process = dataset(start, store.where, "--per-object", "40")
    _, errors = process.communicate()
    assert process.returncode == 2, errors
    assert "No space left on device" in errors.splitlines()[-1]
    assert "Traceback" not in errors
    there = files(store)
    assert there.items() < many.items()
    assert not [path for path in store.list("") if key_of(path) not in many and path.endswith(".part")]
    subprocess.run(["mount", "-o", "remount,size=16m", small_disk], check=True)
    process = dataset(start, store.where, "--per-object", "40")
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    assert files(store) == many


def test_a_poisoned_object_is_written_down_and_stops_nothing(start: Start, many: dict[str, bytes], tmp_path: Path):
    (tmp_path / "broken.obj").write_text("v 0 0 0\nv 1 0 0\n")
    store = DatasetStore(str(tmp_path / "out"))
    words = ["broken.obj", *WORDS, "--out", store.where, "--workers", "2", "--per-object", "40"]
    process = start("-m", "graspd_core.cli", "dataset", *words)
    _, errors = process.communicate()
    assert process.returncode == 1, errors
    assert "raised: broken.obj: MeshError" in errors
    assert files(store) == many
    process = start("-m", "graspd_core.cli", "dataset", *words)
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    assert "40 of 40 blocks are skipped: each has a file or a failure on record" in errors
