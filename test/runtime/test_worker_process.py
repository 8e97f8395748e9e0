"""A function in a process of its own; and freed memory, where the C library has no call to give it back."""

import ctypes
import math
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from graspd_core.runtime.worker_process import WorkerProcess, limit_malloc_arenas, trim_heap


@pytest.fixture
def child() -> Iterator[WorkerProcess]:
    process = WorkerProcess()
    yield process
    process.close()


def test_the_work_is_done_elsewhere(child: WorkerProcess):
    assert child(os.getpid) == child(os.getpid) != os.getpid()


def test_modules_are_imported_before_the_first_call_and_those_that_cannot_be_do_no_harm():
    process = WorkerProcess("no_such_module", "colorsys")
    try:
        # Asked for nothing that would import it.
        assert process(eval, "'colorsys' in __import__('sys').modules")
    finally:
        process.close()


def test_values_and_errors_come_back_and_the_child_lives_on(child: WorkerProcess):
    assert child(math.sqrt, 2.25) == 1.5
    with pytest.raises(ValueError, match="math domain") as caught:
        child(math.sqrt, -1.0)
    assert "worker_process.py" in caught.value.__notes__[0]
    # An error that cannot travel says what it was.
    with pytest.raises(RuntimeError, match="Homebound: no luggage"):
        child(exec, "class Homebound(Exception): pass\nraise Homebound('no luggage')")
    with pytest.raises((AttributeError, pickle.PicklingError)):
        child(lambda: 1)
    assert child(math.sqrt, 4.0) == 2.0


def test_arrays_tensors_and_named_arguments_travel(child: WorkerProcess):
    points = np.arange(6.0).reshape(2, 3)
    assert child(np.sum, points, axis=0).tolist() == [3.0, 5.0, 7.0]
    field = torch.arange(5.0)
    assert torch.equal(child(torch.mul, field, 2.0), 2.0 * field)


def test_only_a_process_that_asked_for_it_has_its_work_done_elsewhere():
    # In a process of its own: tests before this one may have asked for it in theirs.
    program = (
        "import os\n"
        "from graspd_core.runtime.worker_process import run_isolated, start_worker_process\n"
        "print(run_isolated(os.getpid) == os.getpid())\n"
        "start_worker_process()\n"
        "start_worker_process()\n"
        "print(run_isolated(os.getpid) == run_isolated(os.getpid) != os.getpid())\n"
        "print(run_isolated(run_isolated, os.getpid) == run_isolated(os.getpid))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.split() == ["True", "True", "True"]


@pytest.mark.parametrize("way", ["script", "stdin", "command", "module"])
def test_the_main_module_of_its_user_is_not_imported_again(way: str, tmp_path: Path):
    """A script without a guard, what is typed into an interpreter, and a module that only the working directory has."""
    program = (
        "import os, sys\n"
        "from graspd_core.runtime.worker_process import run_isolated, start_worker_process\n"
        "sys.path.append(os.path.join(os.getcwd(), 'more'))\n"
        "import beside\n"
        "print('imported')\n"
        "start_worker_process()\n"
        "print(run_isolated(beside.whoami) not in (os.getpid(), None))\n"
    )
    (tmp_path / "more").mkdir()
    (tmp_path / "more/beside.py").write_text("import os\n\ndef whoami():\n    return os.getpid()\n")
    (tmp_path / "mine.py").write_text(program)
    how = {"script": ["mine.py"], "stdin": ["-"], "command": ["-c", program], "module": ["-m", "mine"]}
    done = subprocess.run(
        [sys.executable, *how[way]], input=program, cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert (done.stdout.split(), done.stderr) == (["imported", "True"], "")


def test_when_the_child_is_killed_nothing_is_lost(child: WorkerProcess):
    first = child(os.getpid)
    os.kill(first, signal.SIGKILL)
    assert child(os.getpid) not in (first, os.getpid())


def test_work_that_kills_its_process_does_not_kill_this_one(child: WorkerProcess):
    with pytest.raises(MemoryError, match="_exit: the worker process died twice"):
        child(os._exit, 1)
    assert child(math.sqrt, 4.0) == 2.0


def test_ctrl_c_in_the_terminal_leaves_the_child_alone(child: WorkerProcess):
    first = child(os.getpid)
    os.kill(first, signal.SIGINT)
    assert child(os.getpid) == first


def test_an_answer_that_was_not_waited_for_is_not_the_next_ones(child: WorkerProcess, tmp_path: Path):
    def interrupt(*_):
        raise KeyboardInterrupt

    asked_for = tmp_path / "asked for"
    late = f"until [ -e '{asked_for}' ]; do sleep 0.01; done; echo late"
    assert child(subprocess.getoutput, "echo ready") == "ready"
    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.1)
        with pytest.raises(KeyboardInterrupt):
            child(subprocess.getoutput, late)
    finally:
        signal.signal(signal.SIGALRM, before)
        asked_for.touch()
    assert child(subprocess.getoutput, "echo next") == "next"


def test_the_child_ends_with_its_parent():
    program = (
        "import os, signal, math\n"
        "from graspd_core.runtime.worker_process import WorkerProcess\n"
        "aside = WorkerProcess()\n"
        "assert aside(math.sqrt, 4.0) == 2.0\n"
        "print(aside._process.pid, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    child = int(done.stdout)
    while _alive(child):
        time.sleep(0.02)


def _alive(process: int) -> bool:
    try:
        with open(f"/proc/{process}/stat") as file:
            return file.read().split()[2] != "Z"
    except FileNotFoundError:
        return False


def no_library(name: None) -> object:
    raise OSError("no such library")


@pytest.mark.parametrize("library", [lambda name: object(), no_library])
def test_where_the_c_library_has_no_such_thing_nothing_is_raised(monkeypatch: pytest.MonkeyPatch, library):
    monkeypatch.setattr(ctypes, "CDLL", library)
    trim_heap()
    limit_malloc_arenas()
