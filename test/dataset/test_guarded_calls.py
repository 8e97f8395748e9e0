"""What a block does to its process is written down, and the next one has a process that works."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from graspd_core.runtime.worker_process import WorkerProcess, resident_mb
from graspd_dataset import guarded_calls
from graspd_dataset.blocks import Block
from graspd_dataset.dataset_store import DatasetStore
from graspd_dataset.guarded_calls import Limits, prepare_object, run_block
from graspd_dataset.ray_engine import block_job, object_job

FILL = "x = [bytearray(b'1' * 2**20) for _ in range(4000)]"


@pytest.fixture
def child() -> Iterator[WorkerProcess]:
    process = WorkerProcess(killed_with_thread=True)
    yield process
    process.close()


def test_a_bounded_call_gives_what_the_work_gives_or_raises(child: WorkerProcess):
    assert child.bounded(60.0, 4096.0, divmod, 17, 5) == (3, 2)
    with pytest.raises(ZeroDivisionError):
        child.bounded(60.0, 4096.0, divmod, 17, 0)
    assert resident_mb(os.getpid()) > 10
    assert resident_mb(2**22 + 1) == 0.0


@pytest.mark.parametrize(
    ("work", "argument", "limits", "error", "told"),
    [
        (time.sleep, 600, (0.3, 4096.0), TimeoutError, "the call did not end within 0.3 s"),
        (os._exit, 7, (60.0, 4096.0), ChildProcessError, "died with exit code 7"),
        (os.abort, None, (60.0, 4096.0), ChildProcessError, "died with exit code -6"),
        (exec, FILL, (60.0, 300.0), MemoryError, "more than 300"),
    ],
)
def test_a_bounded_call_that_goes_wrong_costs_its_child_only(child: WorkerProcess, work, argument, limits, error, told):
    with pytest.raises(error, match=told):
        child.bounded(*limits, work, *([] if argument is None else [argument]))
    assert child.bounded(60.0, 4096.0, divmod, 17, 5) == (3, 2)


def test_the_child_is_killed_with_its_parent_in_the_middle_of_a_call():
    program = (
        "import time\nfrom graspd_core.runtime.worker_process import WorkerProcess\n"
        "child = WorkerProcess(killed_with_thread=True)\nprint(child._process.pid, flush=True)\n"
        "child.bounded(600, 4096, time.sleep, 600)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    number = int(parent.stdout.readline())
    while resident_mb(number) == 0:
        time.sleep(0.01)
    parent.kill()
    parent.wait()
    parent.stdout.close()
    while Path(f"/proc/{number}/stat").exists() and " Z " not in Path(f"/proc/{number}/stat").read_text():
        time.sleep(0.01)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[DatasetStore]:
    yield DatasetStore(str(tmp_path / "out"))
    guarded_calls.close_child()


def record(store: DatasetStore) -> dict:
    (path,) = store.list("failed")
    return json.loads(store.read(path))


def test_an_object_that_cannot_be_used_is_written_down(store: DatasetStore, blocks: tuple[Block, ...]):
    thing = replace(blocks[0].object, source="broken.obj", content="0")
    report, shared = prepare_object(object_job(thing, blocks[0].config), b"v 0 0 0\nv 1 0 0\n", store, Limits())
    assert (report.failed, shared) == ("raised", b"")
    assert "MeshError" in report.error
    assert record(store)["asked"]["object"] == "broken.obj"
    assert record(store)["key"] == thing.key
    assert not store.list("objects")


def test_a_block_that_hangs_is_written_down(store: DatasetStore, blocks: tuple[Block, ...]):
    report = run_block(block_job(blocks[0]), b"no hand", b"no scene", store, Limits(seconds=0.05))
    assert report.failed == record(store)["failed"] == "hung"
    assert not store.list("grasps")


def test_a_block_that_raises_is_written_down_with_its_traceback(store: DatasetStore, blocks: tuple[Block, ...]):
    report = run_block(block_job(blocks[0]), b"no hand", b"no scene", store, Limits())
    assert report.failed == "raised"
    assert "UnpicklingError" in report.error
    assert "block_rows.py" in record(store)["traceback"]


def test_a_mesh_that_came_along_is_the_object(store: DatasetStore, blocks: tuple[Block, ...], tmp_path: Path):
    import graspd_core

    graspd_core.save_mesh(tmp_path / "box.ply", graspd_core.make_shape("box"))
    content = (tmp_path / "box.ply").read_bytes()
    thing = replace(blocks[0].object, source="there/box.ply", content="1")
    report, shared = prepare_object(object_job(thing, blocks[0].config), content, store, Limits())
    assert report.failed == ""
    assert len(store.list("objects")) == 1
    assert len(shared) > 100_000


def test_a_worker_loads_neither_torch_nor_mujoco(tmp_path: Path):
    program = (
        "import sys\nfrom graspd_dataset.guarded_calls import Job, Limits, run_block\n"
        "from graspd_dataset.dataset_store import DatasetStore\n"
        "DatasetStore(sys.argv[1]).write('a', b'x')\n"
        "print([name for name in ('torch', 'mujoco', 'scipy', 'open3d', 'pyarrow') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True)
    assert done.stdout == "[]\n", done.stderr
